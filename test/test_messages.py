# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Serialized Imu messages: layout and correction."""

from itertools import product
import struct

from accel_calib.calibrate import fit_poses, level, thermal_stream
from accel_calib.errors import InputError
from accel_calib.logs import (
    ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE,
    doubles_at, IMU_DOUBLES, joined, layout_of, ORIENTATION, ORIENTATION_COVARIANCE, renamed,
    samples_of)
from accel_calib.messages import corrected, output_frame, Rewriter
from accel_calib.units import STANDARD_GRAVITY, units_of
from inside import frame_ids, rotation_from_rpy, simulate_poses, spread_directions, stamps_of
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared import sensor, with_effects

UNITS = units_of('m/s2')
NAMES = ['', 'i', 'imu', 'imu_li', 'imu_link', 'base/imu_link_7', 'übung', 'x' * 300]
COVARIANCES = ['absent', 'unknown', 'known', 'full', 'other']


@pytest.fixture
def calibration():
    rng = np.random.default_rng(1)
    poses = simulate_poses(sensor(rng), spread_directions(20), rng)
    poses = poses.with_columns(reading=UNITS.from_g(poses.reading), std=UNITS.from_g(poses['std']))
    return fit_poses(poses, UNITS)


@pytest.fixture
def levelled(calibration):
    flat = rotation_from_rpy(0.4, 0.2, -1.0) @ np.array([0, 0, 1.0])
    return level(calibration, calibration.predict(flat[np.newaxis] * UNITS.per_g)[0], 'ros')


def messages(count=6):
    fields = np.random.default_rng(2).normal(size=(count, IMU_DOUBLES))
    for part in (ORIENTATION_COVARIANCE, ANGULAR_VELOCITY_COVARIANCE,
                 ACCELERATION_COVARIANCE):
        root = fields[:, part].reshape(-1, 3, 3) * 0.01
        fields[:, part] = (root @ np.swapaxes(root, 1, 2)).reshape(-1, 9)
    return fields


def test_without_a_mounting_only_the_acceleration_changes(calibration):
    fields = messages()
    found = corrected(calibration, fields)
    np.testing.assert_allclose(found[:, ACCELERATION],
                               calibration.correct(fields[:, ACCELERATION]))
    rest = np.r_[0:ACCELERATION.start]
    np.testing.assert_array_equal(found[:, rest], fields[:, rest])


def test_with_a_mounting_all_fields_are_in_one_frame(levelled):
    fields, rotation = messages(), levelled.model.rotation
    found = corrected(levelled, fields)
    np.testing.assert_allclose(found[:, ANGULAR_VELOCITY],
                               fields[:, ANGULAR_VELOCITY] @ rotation)
    for part in (ANGULAR_VELOCITY_COVARIANCE, ORIENTATION_COVARIANCE):
        turned, given = found[:, part].reshape(-1, 3, 3), fields[:, part].reshape(-1, 3, 3)
        np.testing.assert_allclose(rotation @ turned @ rotation.T, given, atol=1e-15)
    before = Rotation.from_quat(fields[:, ORIENTATION])
    after = Rotation.from_quat(found[:, ORIENTATION])
    np.testing.assert_allclose(after.apply(found[:, ANGULAR_VELOCITY]),
                               before.apply(fields[:, ANGULAR_VELOCITY]))


def test_corrected_messages_have_the_frame_they_are_in(calibration, levelled):
    assert output_frame(calibration, 'imu_link', 'base') == 'imu_link'
    assert output_frame(levelled, 'imu_link') == 'imu_link_levelled'
    assert output_frame(levelled, 'imu_link', 'base') == 'base'
    assert output_frame(levelled.in_sensor_frame, 'imu_link', 'base') == 'imu_link'


@pytest.mark.parametrize('turned', [False, True])
def test_the_bias_of_the_gyro_is_subtracted_before_the_rate_is_turned(calibration, levelled,
                                                                      turned):
    used, bias = levelled if turned else calibration, np.array([0.01, -0.02, 0.03])
    data = random_message(np.random.default_rng(6), 'imu')
    fields = every(data)
    for first, known in ((4e-4, True), (-1.0, False)):
        fields[0, ANGULAR_VELOCITY_COVARIANCE.start] = first
        data = data[:-296] + fields.tobytes()
        rewriter = Rewriter(layout_of(data), used, 1.0, STANDARD_GRAVITY, 'imu')
        rewriter.bias = tuple(bias)
        rate = every(rewriter(data, {}))[0, ANGULAR_VELOCITY]
        expected = fields[0, ANGULAR_VELOCITY] - bias * known
        np.testing.assert_allclose(rate, used.rotation.T @ expected, rtol=1e-12)


@pytest.mark.parametrize('ros2', [False, True])
@pytest.mark.parametrize('name', NAMES)
def test_messages_get_another_frame_id(ros2, name):
    rng = np.random.default_rng(7)
    raws = [random_message(rng, 'imu_link') for _ in range(4)]
    if ros2:
        raws[1] = swapped(raws[1])
    else:  # the serialization of ROS 1: four bytes of seq, no NUL, no padding
        raws = [raw[:12] + struct.pack('<I', 8) + b'imu_link' + raw[-296:] for raw in raws]
    before = joined(raws, 37, 'imu', ros2=ros2)
    after = renamed(before, name)
    again = joined([bytes(each) for each in after.each()], 37, 'imu', ros2=ros2)
    for found in (after, again):
        assert frame_ids(found) == [name]
        np.testing.assert_array_equal(stamps_of(found), stamps_of(before))
        np.testing.assert_array_equal(doubles_at(found, slice(0, 37)),
                                      doubles_at(before, slice(0, 37)))


def test_a_known_covariance_is_transformed_and_grows_by_that_of_the_calibration(levelled):
    fields = messages()
    found = corrected(levelled, fields)
    inverse = levelled.model.rotation.T @ np.linalg.inv(levelled.gain)
    own = inverse @ fields[:, ACCELERATION_COVARIANCE].reshape(-1, 3, 3) @ inverse.T
    added = found[:, ACCELERATION_COVARIANCE].reshape(-1, 3, 3) - own
    np.testing.assert_allclose(added, levelled.force_covariance(found[:, ACCELERATION]),
                               atol=1e-15)
    assert np.all(np.linalg.eigvalsh(added) > 0)


def covariance(kind, rng):
    """Return a covariance as drivers send it."""
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


def random_message(rng, frame_id=None):
    """Return a serialized message with random fields and padding."""
    name = (rng.choice(NAMES) if frame_id is None else frame_id).encode() + b'\0'
    doubles = rng.normal(size=37) * 5.0
    for part in (ORIENTATION_COVARIANCE, ANGULAR_VELOCITY_COVARIANCE,
                 ACCELERATION_COVARIANCE):
        doubles[part] = covariance(rng.choice(COVARIANCES), rng)
    if rng.uniform() < 0.05:
        doubles[ANGULAR_VELOCITY.start + 1] = np.nan
    stamp = struct.pack('<iI', rng.integers(-2 ** 31, 2 ** 31), rng.integers(0, 10 ** 9))
    head = stamp + struct.pack('<I', len(name)) + name
    return b'\0\1\0\0' + head + rng.bytes(-len(head) % 8) + doubles.tobytes()


@pytest.mark.parametrize('name', ['', 'imu_link', 'robot/imü'])
def test_a_layout_has_the_frame_id_of_its_messages(name):
    assert layout_of(random_message(np.random.default_rng(1), name)).frame_id == name


def swapped(data):
    """Return a little-endian message as a big-endian machine writes it."""
    begin = layout_of(data).begin
    stamp, doubles = struct.unpack_from('<iII', data, 4), np.frombuffer(data, '<f8', -1, begin)
    return b'\0\0\0\0' + struct.pack('>iII', *stamp) + data[16:begin] + doubles.astype(
        '>f8').tobytes()


def every(data):
    return doubles_at(joined([data], 37, 'imu'), slice(0, 37))


def lagged(calibration):
    """Return a calibration with lags of both kinds."""
    return with_effects(calibration, {
        'temperature_rate': [0.02, -0.03, 0.01], 'gain_temperature': [1e-3, -1e-3, 5e-4, 5.0, 0.0],
        'offset_temperature': [1e-3, 2e-3, -1e-3, 8.0, 1.0]}, 1e-8)


def test_single_messages_and_arrays_have_the_same_lag(calibration):
    calibration, rng = lagged(calibration), np.random.default_rng(7)
    first = bytearray(random_message(rng, 'imu'))
    rewriter = Rewriter(layout_of(first), calibration, 1.0, STANDARD_GRAVITY, 'imu')
    datas = []
    for k in range(400):
        struct.pack_into('<II', first, 4, 100 + k // 10, k % 10 * 100_000_000)
        datas.append(bytes(first))
    together = joined(datas, 37, 'imu')
    temperature = 25.0 + 3.0 * np.sin(np.arange(400) / 90.0)
    expected = corrected(calibration, doubles_at(together, slice(0, 37)),
                         {**samples_of(together), 'temperature': temperature})
    found = [every(rewriter(data, {'temperature': warm}))[0]
             for data, warm in zip(datas, temperature.tolist(), strict=True)]
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    assert np.ptp(expected[:, ACCELERATION.start]) > 1e-3


def test_lag_carries_over_from_block_to_block(calibration):
    calibration = lagged(calibration)
    doubles = np.repeat(every(random_message(np.random.default_rng(7), 'imu')), 300, axis=0)
    context = {'time': 100.0 + np.arange(300) * 0.1, 'rate': np.zeros((300, 3)),
               'temperature': 25.0 + np.arange(300) * 0.01}
    expected = corrected(calibration, doubles, context)
    stream = thermal_stream(calibration.model)
    parts = [corrected(calibration, doubles[rows],
                       {key: values[rows] for key, values in context.items()}, stream)
             for rows in (slice(0, 77), slice(77, 300))]
    np.testing.assert_allclose(np.concatenate(parts), expected, rtol=1e-9)
    alone = corrected(calibration, doubles[77:], {key: values[77:] for key, values in
                                                  context.items()})
    assert np.max(np.abs(alone - expected[77:])) > 1e-3


def test_no_force_beyond_100_g_is_published(calibration):
    data = bytearray(random_message(np.random.default_rng(9), 'imu'))
    layout = layout_of(bytes(data))
    rewriter = Rewriter(layout, calibration, 1.0, STANDARD_GRAVITY, 'imu')
    place = layout.place(ACCELERATION)
    for reading, axis in product((1e3, -1e300), range(3)):
        values = [0.0, 0.0, 0.0]
        values[axis] = reading
        struct.pack_into('<3d', data, place, *values)
        with pytest.raises(InputError, match='expected less than 100 g; check the calibration'):
            rewriter(bytes(data), {'temperature': 20.0})
    for reading in (np.nan, np.inf):
        struct.pack_into('<3d', data, place, 0.0, reading, 9.8)
        assert rewriter(bytes(data), {'temperature': 20.0}) is None
