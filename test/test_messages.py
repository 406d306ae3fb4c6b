# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of Imu messages: their bytes (`Rewriter`), their numbers (`corrected`), one reading.

All correct the same random messages, with extreme values in every field. The number of messages is
the variable IMU_MESSAGES, 800 by default.

"""

from contextlib import nullcontext
from dataclasses import replace
from itertools import product
import math
import os
import struct

from accel_calib.effects import EFFECTS
from accel_calib.errors import AccelCalibError, InputError
from accel_calib.logs import (
    ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE,
    IMU_DOUBLES, joined, layout_of, LITTLE_ENDIAN, ORIENTATION, ORIENTATION_COVARIANCE)
from accel_calib.messages import corrected, OneReading, output_frame, Rewriter
from accel_calib.units import STANDARD_GRAVITY
from bag_files import swapped
from inside import Model, rotation_from_rpy
import numpy as np
import pytest
from shared import known, random_directions, table, values_of, with_effects

COUNT = int(os.environ.get('IMU_MESSAGES', '800'))
COVARIANCES = ORIENTATION_COVARIANCE, ANGULAR_VELOCITY_COVARIANCE, ACCELERATION_COVARIANCE
EXTREMES = (0.0, -0.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1e-310, 2.0 ** 53,
            1e16, 1e300, -1e300, 1.7e308)
NAMES = ('', 'i', 'imu', 'imu_li', 'imu_link', 'base/imu_link_7', 'a b', 'übung', '日本/フレーム',
         'é' * 77, 'x' * 300)
TEMPERATURES = (25.0, -40.0, 125.0, -273.15, 1e4)
SECONDS = (0, 1, -1, 2 ** 31 - 1, -2 ** 31, 1_700_000_000)
NANOSECONDS = (0, 1, 999_999_999, 2 ** 32 - 1)
CASES = table('effects_of_messages')
LAGS = CASES['lag']


def calibration_of(effects, *, unit='m/s2', turned=False):
    """Return a linear fit with these effects, and a covariance of all values."""
    rng, fitted = np.random.default_rng(1), known(unit)
    values = {**fitted.model.values,
              **{name: np.array(each, float) for name, each in effects.items()}}
    model = Model(values, rotation_from_rpy(0.3, -0.2, 1.0) if turned else np.eye(3))
    root = rng.normal(size=(len(model.vector), len(model.vector))) * 1e-4
    return replace(fitted, model=model, covariance=root @ root.T)


@pytest.fixture(scope='module')
def calibration():
    return calibration_of({})


@pytest.fixture(scope='module')
def levelled():
    return calibration_of({}, turned=True)


def message(doubles, name='imu', stamp=(100, 0), padding=bytes(7)):
    """Return a message in little-endian CDR."""
    letters = name.encode() + b'\0'
    head = struct.pack('<iII', *stamp, len(letters)) + letters
    return LITTLE_ENDIAN + head + padding[:-len(head) % 8] + doubles.tobytes()


def doubles_of(data):
    return np.frombuffer(data[-8 * IMU_DOUBLES:], '<f8')


def rewriter_of(data, calibration, name='imu'):
    return Rewriter(layout_of(data), calibration, STANDARD_GRAVITY, name)


def fields_of(count=6):
    """Return the (n, 37) doubles of messages with known covariances."""
    fields = np.random.default_rng(2).normal(size=(count, IMU_DOUBLES))
    for part in COVARIANCES:
        root = fields[:, part].reshape(-1, 3, 3) * 0.01
        fields[:, part] = (root @ np.swapaxes(root, 1, 2)).reshape(-1, 9)
    return fields


@pytest.mark.parametrize('turned', [False, True])
def test_the_bias_of_the_gyro_is_subtracted_before_the_rate_is_turned(turned):
    used, bias, fields = calibration_of({}, turned=turned), (0.01, -0.02, 0.03), fields_of(1)[0]
    for first, is_known in ((4e-4, True), (-1.0, False)):
        fields[ANGULAR_VELOCITY_COVARIANCE.start] = first
        data = message(fields)
        rewriter = rewriter_of(data, used)
        rewriter.bias = bias
        expected = fields[ANGULAR_VELOCITY] - np.array(bias) * is_known
        np.testing.assert_allclose(doubles_of(rewriter(data, {}))[ANGULAR_VELOCITY],
                                   used.rotation.T @ expected, rtol=1e-12)


@pytest.mark.parametrize('ros2', [False, True])
@pytest.mark.parametrize('name', [*NAMES, None])
def test_messages_get_other_numbers_and_another_frame_id(ros2, name):
    raws = [message(each, 'imu_link', (k - 1, 5 * k)) for k, each in enumerate(fields_of(4))]
    if ros2:
        raws[1] = swapped(raws[1])
    else:  # the serialization of ROS 1: four bytes of seq, no NUL, no padding
        raws = [raw[:12] + struct.pack('<I', 8) + b'imu_link' + raw[-296:] for raw in raws]
    before = joined(raws, 37, 'imu', ros2=ros2)
    found = joined(list(before.rewrite(fields_of(4)[::-1], name)), 37, 'imu', ros2=ros2)
    assert found.frame_ids == ['imu_link' if name is None else name]
    np.testing.assert_array_equal(found.stamps, before.stamps)
    np.testing.assert_array_equal(found.swapped, before.swapped)
    np.testing.assert_array_equal(found.doubles(slice(0, 37)), fields_of(4)[::-1])


def test_single_messages_and_arrays_have_the_same_lag(calibration):
    calibration, fields = with_effects(calibration, LAGS, 1e-8), fields_of(1)[0]
    datas = [message(fields, stamp=(100 + k // 10, k % 10 * 100_000_000)) for k in range(400)]
    rewriter, together = rewriter_of(datas[0], calibration), joined(datas, 37, 'imu')
    temperature = 25.0 + 3.0 * np.sin(np.arange(400) / 90.0)
    expected = corrected(calibration, together.doubles(slice(0, 37)),
                         {**together.columns, 'temperature': temperature})
    found = [doubles_of(rewriter(data, {'temperature': warm}))
             for data, warm in zip(datas, temperature.tolist(), strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert np.ptp(expected[:, ACCELERATION.start]) > 1e-3


def test_no_force_beyond_100_g_is_published(calibration):
    raw = message(fields_of(1)[0])
    rewriter, place = rewriter_of(raw, calibration), layout_of(raw).place(ACCELERATION)
    data = bytearray(raw)
    for reading, axis in product((1e3, -1e300), range(3)):
        struct.pack_into('<3d', data, place, *(reading * np.eye(3)[axis]))
        with pytest.raises(InputError, match='expected less than 100 g; check the calibration'):
            rewriter(bytes(data), {'temperature': 20.0})
    for reading in (np.nan, np.inf):
        struct.pack_into('<3d', data, place, 0.0, reading, 9.8)
        assert rewriter(bytes(data), {'temperature': 20.0}) is None


def random_covariance(rng):
    """Return a covariance: absent, of independent axes, of any numbers, with an extreme, zero."""
    values, kind = np.zeros(9), rng.integers(5)
    if kind == 0:
        values[0] = -1.0
    elif kind == 1:
        values[[0, 4, 8]] = 4e-4
    elif kind == 2:
        values[:] = rng.normal(size=9)
    elif kind == 3:
        values[rng.integers(9)] = rng.choice(EXTREMES)
    return values


def random_message(rng):
    """Return a message with random padding, its 37 doubles, its stamp [s] and its frame_id."""
    doubles = rng.normal(size=37) * 5.0
    for part in COVARIANCES:
        doubles[part] = random_covariance(rng)
    for _ in range(rng.integers(3)):
        doubles[rng.integers(37)] = rng.choice(EXTREMES)
    name, stamp = str(rng.choice(NAMES)), (rng.choice(SECONDS), rng.choice(NANOSECONDS))
    return message(doubles, name, stamp, rng.bytes(7)), doubles, stamp[0] + stamp[1] * 1e-9, name


def expected_of(calibration, doubles, time, temperature):
    """Return the corrected doubles of a message, or an error."""
    rate = doubles[ANGULAR_VELOCITY]
    absent = doubles[ANGULAR_VELOCITY.stop] == -1.0 or not np.all(np.isfinite(rate))
    context = {'time': np.array([time]), 'temperature': np.array([temperature]),
               'rate': np.full((1, 3), np.nan) if absent else rate[np.newaxis]}
    try:
        return corrected(calibration, doubles[np.newaxis], context)[0]
    except AccelCalibError as error:
        return error


def check_equal(found, wanted):
    """Check all fields of a corrected message."""
    assert np.max(np.abs(wanted[ACCELERATION])) <= 100.0 * STANDARD_GRAVITY * (1.0 + 1e-9)
    np.testing.assert_allclose(found[ACCELERATION], wanted[ACCELERATION], rtol=1e-9, atol=1e-9)
    for part in (ORIENTATION, ANGULAR_VELOCITY, *COVARIANCES):
        finite = np.abs(wanted[part][np.isfinite(wanted[part])])
        np.testing.assert_allclose(found[part], wanted[part], rtol=1e-9,
                                   atol=1e-12 * max(1.0, finite.max(initial=0.0)))


@pytest.mark.filterwarnings('ignore:overflow', 'ignore:invalid value')
@pytest.mark.parametrize('turned', [False, True])
@pytest.mark.parametrize('effects', CASES)
def test_bytes_are_corrected_as_numbers_are(effects, turned):
    calibration = calibration_of(CASES[effects], turned=turned)
    rng, published = np.random.default_rng([3, len(effects), turned]), 0
    for _ in range(COUNT // 8):
        data, doubles, time, frame_id = random_message(rng)
        temperature = float(rng.choice(TEMPERATURES))
        assert layout_of(data).frame_id == frame_id
        name = output_frame(calibration, frame_id)
        wanted = expected_of(calibration, doubles, time, temperature)
        try:
            found = rewriter_of(data, calibration, name)(data, {'temperature': temperature})
        except AccelCalibError:
            assert isinstance(wanted, AccelCalibError) or not (
                np.max(np.abs(wanted[ACCELERATION])) < 100.0 * STANDARD_GRAVITY)
            continue
        if found is None:
            assert not np.isfinite(np.sum(doubles[ACCELERATION]))
            continue
        published += 1
        assert found[4:12] == data[4:12]
        assert layout_of(found).frame_id == name
        check_equal(doubles_of(found), wanted)
    assert published > COUNT // 16


OTHERS = [name for name, effect in EFFECTS.items() if not effect.linear]
KNOWN = {'temperature': 31.0, 'supply_voltage': 3.1, 'time': 4000.0, 'rate': (1.0, -2.0, 0.5),
         'std': (0.01, 0.02, 0.03), 'previous': (0.0, 0.6, -0.8)}
OWN = [4e-8, 1e-8, -1e-8, 1e-8, 5e-8, 2e-8, -1e-8, 2e-8, 6e-8]


@pytest.mark.parametrize(('names', 'unit', 'scale', 'turned'), [
    *(((), *each, turned) for each in (('m/s2', 1.0), ('g', 9.80665), ('native', 9.81))
      for turned in (False, True)),
    *(((name,), 'm/s2', 1.0, True) for name in OTHERS),
    *((tuple(np.random.default_rng(seed).choice(OTHERS, size=4, replace=False)), 'g', 9.80665,
       True) for seed in range(5))])
def test_one_reading_and_its_covariance_are_corrected_as_arrays_are(names, unit, scale, turned):
    rng = np.random.default_rng(5)
    values = {name: values_of(name, rng.normal(size=18)) for name in names}
    calibration = calibration_of(values, unit=unit, turned=turned)
    here = OneReading(calibration, scale).at(KNOWN)
    known = {key: np.array([value]) for key, value in KNOWN.items()}
    for reading in random_directions(20, rng) * rng.uniform(0.1, 3.0, (20, 1)):
        reading = calibration.units.from_g(reading)
        force = calibration.correct(reading[np.newaxis], known)
        found = here.correct(*reading.tolist())
        np.testing.assert_allclose(found, force[0] * scale, rtol=0, atol=1e-12)
        expected = calibration.force_covariance(force, known)[0] * scale ** 2
        spreads = here.with_spread(found, [0.0] * 9), here.with_spread(found, OWN)
        np.testing.assert_allclose(np.reshape(spreads[0], (3, 3)), expected, rtol=1e-9, atol=1e-18)
        np.testing.assert_allclose(np.subtract(*spreads), -np.array(OWN), atol=1e-18)


def lagging():
    """Return a calibration with a lag, and with 20 poses at 20 to 39 °C."""
    return with_effects(calibration_of({'offset_temperature': [2e-3, -1e-3, 1e-3, 50.0, 1.0]}), {},
                        temperature=20.0 + np.arange(20.0), time=100.0 * np.arange(20.0))


def test_acting_temperature_is_limited_to_its_range_at_the_poses():
    calibration = lagging()
    low, high = calibration.ranges['temperature_of_offset']
    assert (low, high) == pytest.approx((20.5, 39.5), abs=0.02)
    assert 'time' not in calibration.ranges
    at = [calibration.apply([[0.0, 0.0, 9.8]] * 200, time=1e6 + np.arange(200.0),
                            temperature=np.full(200, each))[-1] for each in (high, 90.0, 25.0)]
    np.testing.assert_allclose(at[0], at[1], atol=1e-6)
    assert np.max(np.abs(at[0] - at[2])) > 1e-3


def test_context_of_one_reading_is_limited_to_the_ranges():
    calibration = calibration_of({'offset_temperature': [2e-3, -1e-3, 1e-3]}, turned=True)
    calibration = with_effects(calibration, {}, temperature=np.linspace(20.0, 30.0, 20))
    reader = OneReading(calibration)
    unknown = reader.at({'temperature': np.nan}).correct(1.0, 2.0, 9.0)
    assert np.linalg.norm(unknown) == pytest.approx(np.linalg.norm([1.0, 2.0, 9.0]), rel=0.1)
    for temperature, edge in ((80.0, 30.0), (-40.0, 20.0)):
        beyond, at_edge = (reader.at({'temperature': each}).correct(1.0, 2.0, 9.0)
                           for each in (temperature, edge))
        assert beyond == at_edge
        context = {'temperature': np.array([temperature])}
        np.testing.assert_allclose(beyond, calibration.correct(np.array([[1.0, 2.0, 9.0]]),
                                                               context)[0], atol=1e-12)


def test_each_message_without_its_context_is_refused():
    calibration = calibration_of({'offset_temperature': [2e-3, -1e-3, 1e-3]})
    data, lacking = message(fields_of(1)), {'supply_voltage': 3.3}
    rewriter = rewriter_of(data, calibration)
    for context in ({'temperature': 30.0}, lacking, lacking, {'temperature': 31.0}):
        with pytest.raises(InputError) if context is lacking else nullcontext():
            rewriter(data, context)


def test_effects_too_large_to_be_corrected_are_refused():
    with pytest.raises(InputError, match='too large'):
        OneReading(calibration_of({'cubic': [-0.5] * 3})).at({}).correct(30.0, 0.0, 0.0)
