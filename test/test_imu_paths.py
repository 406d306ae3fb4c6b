# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized Imu messages against the typed path, with extreme values in every field.

Both paths correct the same random messages: `Rewriter` their bytes, `corrected` the numbers that
another reader (`struct`) takes from them. The number of messages is the variable IMU_MESSAGES,
800 by default. Bytes that are no message never raise anything but an error of this package.
`OneReading` corrects a single reading as the arrays do.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math
import os
from pathlib import Path
import struct
from typing import Any

from accel_calib.calibrate import fit_poses
from accel_calib.effects import EFFECTS
from accel_calib.errors import AccelCalibError, InputError
from accel_calib.logs import joined, layout_of
from accel_calib.messages import corrected, output_frame, Rewriter
from accel_calib.stored import read_calibration
from accel_calib.units import units_of
from inside import Model, OneReading, rotation_from_rpy, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import random_directions, sensor

COUNT = int(os.environ.get('IMU_MESSAGES', '800'))
GRAVITY = 9.80665
QUATERNION, RATE, FORCE = slice(0, 4), slice(13, 16), slice(25, 28)
COVARIANCES = slice(4, 13), slice(16, 25), slice(28, 37)
EXTREMES = (0.0, -0.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1e-310, 2.0 ** 53,
            1e16, 1e300, -1e300, 1.7e308)
NAMES = ('', 'i', 'imu_link', 'base/imu_link_7', 'a b', 'übung', '日本/フレーム', 'é' * 77,
         'x' * 300)
TEMPERATURES = (25.0, -40.0, 125.0, -273.15, 1e4)
SECONDS = (0, 1, -1, 2 ** 31 - 1, -2 ** 31, 1_700_000_000)
NANOSECONDS = (0, 1, 999_999_999, 2 ** 32 - 1)
CASES: dict[str, dict[str, list[float]]] = {
    'linear': {},
    'bent': {'quadratic': [1e-3, -2e-3, 1e-3], 'cubic': [1e-4, 2e-4, -1e-4],
             'odd_quadratic': [1e-4, -1e-4, 2e-4], 'gain_asymmetry': [1e-3, -1e-3, 2e-3]},
    'context': {'gain_temperature': [3e-4, -2e-4, 1e-4], 'lever_arm': [0.1, -0.05, 0.02],
                'offset_temperature': [1e-3, 2e-3, -1e-3],
                'warm_up': [0.01, 0.005, -0.01, 900.0, 600.0]},
    'lag': {'offset_temperature': [1e-3, 2e-3, -1e-3, 8.0, 1.0],
            'gain_temperature': [1e-3, -1e-3, 5e-4, 5.0, 0.0],
            'temperature_rate': [0.02, -0.03, 0.01]},
}


def calibration_with(stored: Callable[..., Path], effects: str, turned: bool) -> Any:
    """Return a calibration with these effects, with a mounting if `turned`."""
    calibration = read_calibration(stored())
    values = {**calibration.model.values,
              **{name: np.array(each) for name, each in CASES[effects].items()}}
    size = len(np.concatenate([*values.values()]))
    root = np.random.default_rng(1).normal(size=(60, size))
    rotation = rotation_from_rpy(0.3, -0.2, 1.0) if turned else np.eye(3)
    return replace(calibration, model=Model(values, rotation), covariance=root.T @ root * 1e-8)


def random_covariance(rng: np.random.Generator) -> Any:
    values = np.zeros(9)
    kind = rng.integers(5)
    if kind == 0:
        values[0] = -1.0
    elif kind == 1:
        values[[0, 4, 8]] = 4e-4
    elif kind == 2:
        values[:] = rng.normal(size=9)
    elif kind == 3:
        values[rng.integers(9)] = rng.choice(EXTREMES)
    return values


def random_message(rng: np.random.Generator) -> tuple[bytes, Any]:
    """Return a message in little-endian CDR with random padding, and its 37 doubles."""
    doubles = rng.normal(size=37) * 5.0
    for part in COVARIANCES:
        doubles[part] = random_covariance(rng)
    for _ in range(rng.integers(3)):
        doubles[rng.integers(37)] = rng.choice(EXTREMES)
    name = str(rng.choice(NAMES)).encode() + b'\0'
    head = struct.pack('<iII', rng.choice(SECONDS), rng.choice(NANOSECONDS), len(name)) + name
    return b'\0\1\0\0' + head + rng.bytes(-len(head) % 8) + doubles.tobytes(), doubles


def typed(data: bytes) -> tuple[float, str]:
    """Return the stamp [s] and the frame_id of a message."""
    seconds, nanoseconds, length = struct.unpack_from('<iII', data, 4)
    return seconds + nanoseconds * 1e-9, data[16:15 + length].decode()


def expected(calibration: Any, data: bytes, doubles: Any, temperature: float) -> Any:
    """Return what the typed path makes of a message: its doubles, or an error."""
    rate = doubles[RATE]
    absent = doubles[RATE.stop] == -1.0 or not np.all(np.isfinite(rate))
    context = {'time': np.array([typed(data)[0]]), 'temperature': np.array([temperature]),
               'rate': np.full((1, 3), np.nan) if absent else rate[np.newaxis]}
    try:
        return corrected(calibration, doubles[np.newaxis], context)[0]
    except AccelCalibError as error:
        return error


def check_equal(found: Any, wanted: Any) -> None:
    """Check all fields of a corrected message."""
    size = np.max(np.abs(wanted[FORCE]))
    assert size <= 100.0 * GRAVITY * (1.0 + 1e-9)
    np.testing.assert_allclose(found[FORCE], wanted[FORCE], rtol=1e-9, atol=1e-9)
    for part in (QUATERNION, RATE, *COVARIANCES):
        finite = np.abs(wanted[part][np.isfinite(wanted[part])])
        np.testing.assert_allclose(found[part], wanted[part], rtol=1e-9,
                                   atol=1e-12 * max(1.0, finite.max(initial=0.0)))


@pytest.mark.filterwarnings('ignore:overflow', 'ignore:invalid value')
@pytest.mark.parametrize('turned', [False, True])
@pytest.mark.parametrize('effects', CASES)
def test_bytes_are_corrected_as_numbers_are(stored: Callable[..., Path], effects: str,
                                            turned: bool) -> None:
    calibration = calibration_with(stored, effects, turned)
    rng = np.random.default_rng([3, len(effects), turned])
    published = 0
    for _ in range(COUNT // 8):
        data, doubles = random_message(rng)
        temperature = float(rng.choice(TEMPERATURES))
        layout = layout_of(data)
        assert layout is not None
        stamp, frame_id = typed(data)
        name = output_frame(calibration, frame_id)
        wanted = expected(calibration, data, doubles, temperature)
        try:
            found = Rewriter(layout, calibration, 1.0, GRAVITY, name)(
                data, {} if np.isnan(temperature) else {'temperature': temperature})
        except AccelCalibError:
            assert isinstance(wanted, AccelCalibError) or not (
                np.max(np.abs(wanted[FORCE])) < 100.0 * GRAVITY)
            continue
        if found is None:
            assert not np.isfinite(np.sum(doubles[FORCE]))
            continue
        published += 1
        assert found[4:12] == data[4:12]
        assert typed(found) == (stamp, name)
        check_equal(np.frombuffer(found[-296:], '<f8'), wanted)
    assert published > COUNT // 16


@pytest.mark.parametrize('turned', [False, True])
def test_a_covariance_that_is_not_finite_becomes_unknown_in_every_field(
        stored: Callable[..., Path], turned: bool) -> None:
    calibration = calibration_with(stored, 'linear', turned)
    for part in COVARIANCES:
        data, _ = random_message(np.random.default_rng(1))
        doubles = np.zeros(37)
        doubles[FORCE], doubles[part.start + 4] = (0.0, 0.0, GRAVITY), math.nan
        data = data[:-296] + doubles.tobytes()
        layout = layout_of(data)
        assert layout is not None
        found = Rewriter(layout, calibration, 1.0, GRAVITY, 'imu')(data, {'temperature': 25.0})
        assert found is not None
        np.testing.assert_array_equal(np.frombuffer(found[-296:], '<f8')[part], 0.0)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a message with bytes changed, removed or added."""
    changed = bytearray(data)
    kind = rng.integers(4)
    if kind == 0:
        changed[rng.integers(16)] = rng.integers(256)
    elif kind == 1:
        del changed[rng.integers(len(changed)):]
    elif kind == 2:
        changed[12:16] = rng.bytes(4)
    else:
        changed += rng.bytes(rng.integers(1, 9))
    return bytes(changed)


def refusal(data: bytes) -> str:
    """Return why a message is refused; empty if it is not."""
    try:
        joined([data], 37, 'imu')
    except AccelCalibError as error:
        return str(error)
    return ''


def test_bytes_that_are_no_message_have_no_layout_or_end_in_one_error() -> None:
    rng = np.random.default_rng(5)
    refused = 0
    for _ in range(COUNT):
        data = damaged(random_message(rng)[0], rng)
        layout = layout_of(data)
        error = refusal(data)
        assert layout is None or (len(data) == layout.size and not error)
        assert not error or 'damaged, expected a whole message' in error
        refused += bool(error)
    assert refused > COUNT // 2


OTHERS = [name for name, effect in EFFECTS.items() if not effect.linear]
KNOWN = {'temperature': 31.0, 'supply_voltage': 3.1, 'time': 4000.0, 'rate': (1.0, -2.0, 0.5),
         'std': (0.01, 0.02, 0.03), 'previous': (0.0, 0.6, -0.8)}
OWN = [4e-8, 1e-8, -1e-8, 1e-8, 5e-8, 2e-8, -1e-8, 2e-8, 6e-8]
SHAPES = {'start': 1000.0, 'tau': 1800.0, 'instant': 3000.0, 'lag': 0.0, 'of_sensor': 0.0,
          'form': 0.0}
SIZES = {'g/h': 1.0, 'm': 0.1, 'g': 0.01, '1/°C': 1e-3, 'g/°C': 1e-3}


def calibration_of(*names, unit='m/s2', seed=1, levelled=True):
    """Return a calibration with a linear fit and these effects, and a covariance of all values."""
    rng = np.random.default_rng(seed)
    units = units_of(unit)
    poses = simulate_poses(sensor(rng), spread_directions(20), rng)
    poses = poses.with_columns(reading=units.from_g(poses.reading),
                               std=units.from_g(poses['std']))
    fitted = fit_poses(poses, units, model='10')
    values = dict(fitted.model.values)
    for name in names:
        effect = EFFECTS[name]
        own = rng.normal(size=len(effect.parameters)) * SIZES.get(effect.unit, 0.003)
        values[name] = np.concatenate([own, [SHAPES[part] for part in effect.shape]])
    rotation = rotation_from_rpy(0.3, -0.2, 1.0) if levelled else np.eye(3)
    model = Model(values, rotation)
    root = rng.normal(size=(len(model.vector), len(model.vector))) * 1e-4
    return replace(fitted, model=model, covariance=root @ root.T)


def arrays():
    return {key: np.array([value]) for key, value in KNOWN.items()}


def check(calibration, scale):
    """Compare forces and covariances at readings of 0.1 to 3 g."""
    here = OneReading(calibration, scale).at(KNOWN)
    rng = np.random.default_rng(5)
    for reading in random_directions(20, rng) * rng.uniform(0.1, 3.0, (20, 1)):
        reading = calibration.units.from_g(reading)
        force = calibration.correct(reading[np.newaxis], arrays())
        found = here.correct(*reading.tolist())
        np.testing.assert_allclose(found, force[0] * scale, rtol=0, atol=1e-12)
        expected = calibration.force_covariance(force, arrays())[0] * scale ** 2
        spreads = here.with_spread(found, [0.0] * 9), here.with_spread(found, OWN)
        np.testing.assert_allclose(np.reshape(spreads[0], (3, 3)), expected, rtol=1e-9,
                                   atol=1e-18)
        np.testing.assert_allclose(np.subtract(*spreads), -np.array(OWN), atol=1e-18)


@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize(('unit', 'scale'), [('m/s2', 1.0), ('g', 9.80665), ('native', 9.81)])
def test_linear_calibration_is_that_of_the_arrays(unit, scale, levelled):
    check(calibration_of(unit=unit, levelled=levelled), scale)


@pytest.mark.parametrize('name', OTHERS)
def test_each_effect_is_that_of_the_catalogue(name):
    check(calibration_of(name), 1.0)


@pytest.mark.parametrize('seed', range(5))
def test_models_of_several_effects_are_those_of_the_arrays(seed):
    rng = np.random.default_rng(seed)
    names = rng.choice(OTHERS, size=4, replace=False)
    check(calibration_of(*names, unit='g', seed=seed), 9.80665)


def test_acting_temperature_is_limited_to_its_range_at_the_poses():
    calibration = calibration_of('offset_temperature')
    values = dict(calibration.model.values)
    values['offset_temperature'] = np.array([*values['offset_temperature'][:3], 50.0, 1.0])
    count = len(calibration.poses)
    poses = calibration.poses.with_columns(temperature=20.0 + np.arange(count),
                                           time=100.0 * np.arange(count))
    calibration = replace(calibration, model=Model(values), poses=poses)
    low, high = calibration.ranges['temperature_of_offset']
    assert (low, high) == pytest.approx((20.5, 19.5 + count), abs=0.02)
    assert 'time' not in calibration.ranges
    at = [calibration.apply([[0.0, 0.0, 9.8]] * 200, time=1e6 + np.arange(200.0),
                            temperature=np.full(200, each))[-1] for each in (high, 90.0, 25.0)]
    np.testing.assert_allclose(at[0], at[1], atol=1e-6)
    assert np.max(np.abs(at[0] - at[2])) > 1e-3


def test_context_of_one_reading_is_limited_to_the_ranges():
    calibration = calibration_of('offset_temperature')
    poses = calibration.poses.with_columns(temperature=np.linspace(20.0, 30.0, 20))
    calibration = replace(calibration, poses=poses)
    reader = OneReading(calibration)
    for temperature, edge in ((80.0, 30.0), (-40.0, 20.0)):
        beyond, at_edge = (reader.at({'temperature': each}).correct(1.0, 2.0, 9.0)
                           for each in (temperature, edge))
        assert beyond == at_edge
        context = {'temperature': np.array([temperature])}
        np.testing.assert_allclose(beyond, calibration.correct(np.array([[1.0, 2.0, 9.0]]),
                                                               context)[0], atol=1e-12)


def test_effects_too_large_to_be_corrected_are_refused():
    calibration = calibration_of()
    model = Model({**calibration.model.values, 'cubic': np.full(3, -0.5)})
    large = replace(calibration, model=model,
                    covariance=np.zeros((len(model.vector), len(model.vector))))
    with pytest.raises(InputError, match='too large'):
        OneReading(large).at({}).correct(30.0, 0.0, 0.0)
