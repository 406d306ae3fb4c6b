# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Serialized Imu messages become what typed ones become, field by field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import os
from pathlib import Path
import struct
from typing import Any

from accel_calib import imu
from accel_calib.errors import InputError
from accel_calib.files import read_calibration, write_calibration
from accel_calib.model import Model
from accel_calib.ros import conversion
from accel_calib.ros.context import context_of_message
from accel_calib.ros.rewriter import Rewriter
from accel_calib.ros.serialized import layout_of, layout_with, motion_of, rows_of
from accel_calib.sphere import rotation_from_rpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

MESSAGES = 300
GRAVITY = 9.80665
NAMES = ['', 'i', 'imu', 'imu_li', 'imu_link', 'base/imu_link_7', 'übung', 'x' * 300]
COVARIANCES = ['absent', 'unknown', 'known', 'full', 'other']
EFFECTS = {'quadratic': [1e-3, -2e-3, 1e-3], 'gain_temperature': [3e-4, -2e-4, 1e-4],
           'offset_temperature': [1e-3, 2e-3, -1e-3], 'lever_arm': [0.1, -0.05, 0.02],
           'warm_up': [0.01, 0.005, -0.01, 900.0, 600.0]}

Stored = Callable[..., Path]


def covariance(kind: str, rng: np.random.Generator) -> Any:
    """Make a covariance as drivers send it."""
    values = np.zeros(9)
    root = rng.normal(size=(3, 3)) * 0.01
    if kind == 'absent':
        values[0] = -1.0
    elif kind == 'known':
        values[[0, 4, 8]] = 4e-4
    elif kind == 'full':
        values = (root @ root.T).ravel()
    elif kind == 'other':
        values[4] = 1e-3
    return values


def random_message(rng: np.random.Generator) -> Imu:
    """Make a message with all fields drawn."""
    message = Imu()
    message.header.frame_id = str(rng.choice(NAMES))
    message.header.stamp.sec = int(rng.integers(-2**31, 2**31))
    message.header.stamp.nanosec = int(rng.integers(0, 10**9))
    for vector, size in ((message.orientation, 1.0), (message.angular_velocity, 2.0),
                         (message.linear_acceleration, 8.0)):
        for axis in vector.get_fields_and_field_types():
            setattr(vector, axis, float(rng.normal() * size))
    for name in ('orientation', 'angular_velocity', 'linear_acceleration'):
        setattr(message, f'{name}_covariance', covariance(str(rng.choice(COVARIANCES)), rng))
    if rng.uniform() < 0.05:
        message.angular_velocity.y = float('nan')
    return message


def serialized(message: Imu, rng: np.random.Generator) -> bytes:
    """Serialize a message, with garbage for padding."""
    data = bytearray(serialize_message(message))
    layout = layout_of(bytes(data))
    assert layout is not None
    data[layout.name_end:layout.begin] = rng.bytes(layout.begin - layout.name_end)
    return bytes(data)


def calibration_of(path: Path, *, levelled: bool, effects: bool) -> Any:
    """Give the stored calibration, turned and with effects where that is asked for."""
    calibration = read_calibration(path)
    values = dict(calibration.model.values)
    if effects:
        values |= {name: np.array(each) for name, each in EFFECTS.items()}
    rotation = rotation_from_rpy(0.3, -0.2, 1.0) if levelled else np.eye(3)
    root = np.random.default_rng(1).normal(size=(60, len(np.concatenate([*values.values()]))))
    return replace(calibration, model=Model(values, rotation), covariance=root.T @ root * 1e-8)


def check_equal(got: Imu, expected: Imu) -> None:
    """Compare two messages field by field."""
    assert got.header == expected.header
    np.testing.assert_allclose(conversion.fields_of(got)[0, :28],
                               conversion.fields_of(expected)[0, :28], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(conversion.fields_of(got)[0, 28:],
                               conversion.fields_of(expected)[0, 28:], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize('effects', [False, True])
@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize(('unit', 'frame_id'), [('m/s2', ''), ('g', 'base_link')])
def test_rewritten_messages_are_the_typed_ones(
        stored: Stored, unit: str, frame_id: str, levelled: bool, effects: bool) -> None:
    calibration = calibration_of(stored(unit=unit), levelled=levelled, effects=effects)
    scale = 1.0 if unit == 'm/s2' else GRAVITY
    rng = np.random.default_rng(3)
    rewriters: dict[Any, Rewriter] = {}
    warm = {'temperature': np.array([31.0])}
    for _ in range(MESSAGES):
        message = random_message(rng)
        data = serialized(message, rng)
        layout = layout_of(data)
        assert layout is not None
        assert layout == layout_with(message.header.frame_id)
        if layout not in rewriters:
            rewriters[layout] = Rewriter(layout, calibration, scale, frame_id)
        corrected = rewriters[layout](data, 31.0)
        expected = conversion.corrected_message(
            message, calibration, scale, context_of_message(message, calibration.model.needs,
                                                            warm), frame_id)
        assert corrected is not None
        check_equal(deserialize_message(corrected, Imu), expected)
        gravity = np.array([0.1, -0.2, 9.8])
        motion = deserialize_message(
            motion_of(corrected, rewriters[layout].layout, gravity), Vector3Stamped)
        assert motion.header == expected.header
        np.testing.assert_allclose(
            [motion.vector.x, motion.vector.y, motion.vector.z],
            np.array(conversion.reading_of(expected)) - gravity, atol=1e-11)


def test_each_message_is_corrected_at_its_own_temperature(stored: Stored) -> None:
    calibration = calibration_of(stored(), levelled=False, effects=False)
    values = {**calibration.model.values, 'offset_temperature': np.array([1e-3, 2e-3, -1e-3])}
    calibration = replace(calibration, model=Model(values), covariance=np.eye(12) * 1e-8)
    rng = np.random.default_rng(7)
    message = random_message(rng)
    data = serialized(message, rng)
    layout = layout_of(data)
    assert layout is not None
    rewriter = Rewriter(layout, calibration, 1.0, '')
    for temperature in (20.0, 20.0, 35.0, 20.0):
        corrected = rewriter(data, temperature)
        assert corrected is not None
        check_equal(deserialize_message(corrected, Imu), conversion.corrected_message(
            message, calibration, 1.0, {'temperature': np.array([temperature])}, ''))
    with pytest.raises(InputError, match='temperature'):
        rewriter(data, float('nan'))


def test_samples_for_the_watch_are_those_of_typed_messages() -> None:
    rng = np.random.default_rng(4)
    messages = [random_message(rng) for _ in range(MESSAGES)]
    for message in messages:
        message.header.frame_id = 'imu_link'
    rows = rows_of([serialized(message, rng) for message in messages],
                   layout_with('imu_link'), range(MESSAGES))
    for k, (row, message) in enumerate(zip(rows, messages)):
        rate = conversion.rate_of(message)
        np.testing.assert_array_equal(row, [
            conversion.seconds(message.header), *conversion.reading_of(message),
            *((np.nan,) * 3 if rate is None else rate), k, np.nan])


def test_what_is_not_a_whole_little_endian_imu_is_not_read() -> None:
    rng = np.random.default_rng(5)
    data = serialized(random_message(rng), rng)
    assert layout_of(data) is not None
    for other in (b'', data[:3], data[:15], data[:40], data[:-1], data + b'\x00',
                  b'\x00\x00' + data[2:], b'\x00\x03' + data[2:], b'\x00\x07' + data[2:],
                  data[:12] + struct.pack('<I', 0) + data[16:],
                  data[:12] + struct.pack('<I', 2**32 - 1) + data[16:]):
        assert layout_of(other) is None


def swapped(data: bytes) -> bytes:
    """Give a little-endian message as a big-endian machine writes it."""
    layout = layout_of(data)
    assert layout is not None
    stamp = struct.unpack_from('<iII', data, 4)
    fields = struct.unpack_from(f'<{imu.FIELDS}d', data, layout.begin)
    return (b'\x00\x00\x00\x00' + struct.pack('>iII', *stamp) + data[16:layout.begin]
            + struct.pack(f'>{imu.FIELDS}d', *fields))


def test_odd_messages_go_the_long_way_and_broken_ones_are_dropped(
        bench: Any, stored: Stored) -> None:
    path = stored(flat=np.array([0.2, -0.4, 0.8]) / np.sqrt(0.84))
    calibration = read_calibration(path)
    heard = bench.listen(Imu, 'imu/data_calibrated')
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=path)
    bench.exchange(heard, lambda: bench.imu([1.0, -2.0, 9.3]))
    rng = np.random.default_rng(6)
    for _ in range(5):
        message = random_message(rng)
        expected = conversion.corrected_message(message, calibration, 1.0, {}, '')
        for data in (serialized(message, rng), swapped(serialized(message, rng))):
            heard.clear()
            bench.send(data)
            bench.spin(lambda: heard)
            check_equal(heard[-1], expected)
    heard.clear()
    bench.send(serialized(message, rng)[:90])
    bench.send(b'\x00\x01\x00\x00')
    bench.send(os.urandom(64))
    last = bench.imu([1.0, -2.0, 9.3])
    bench.send(last)
    bench.spin(lambda: heard)
    assert heard[0].header.stamp == last.header.stamp
    bench.spin(lambda: any('3 readings' in array.status[0].message for array in diagnostics))


def test_nobody_listening_takes_nothing_from_the_watch(bench: Any, stored: Stored) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=stored())
    bench.node.destroy_subscription(next(
        each for each in bench.node.subscriptions if each.topic == 'imu/data_calibrated'))

    def told() -> bool:
        bench.send(bench.imu([0.1, 0.2, 9.8]))
        values = {value.key: value.value for value in diagnostics[-1].status[0].values
                  } if diagnostics else {}
        return values.get('messages', '0') != '0'

    bench.spin(told)


def test_calibrations_stored_with_effects_are_applied(bench: Any, stored: Stored) -> None:
    path = stored()
    effects = {name: EFFECTS[name] for name in ('quadratic', 'lever_arm')}
    calibration = calibration_of(path, levelled=True, effects=False)
    values = {**calibration.model.values, **{k: np.array(v) for k, v in effects.items()}}
    size = len(np.concatenate([*values.values()]))
    calibration = replace(calibration, model=Model(values, calibration.model.rotation),
                          covariance=np.eye(size) * 1e-8)
    write_calibration(path, calibration)
    heard = bench.listen(Imu, 'imu/data_calibrated')
    bench.calibrator(calibration_file=path)
    sent: list[Imu] = []

    def make() -> Imu:
        message = bench.imu([1.0, -2.0, 9.3], linear_acceleration_covariance=covariance(
            'known', np.random.default_rng(1)))
        message.angular_velocity.z = 1.5
        sent.append(message)
        return message

    got = bench.exchange(heard, make)
    calibration = read_calibration(path)
    context = context_of_message(sent[0], calibration.model.needs, {})
    expected = conversion.corrected_message(sent[0], calibration, 1.0, context, '')
    expected.header.stamp = got.header.stamp
    check_equal(got, expected)
