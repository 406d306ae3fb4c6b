# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Processing of messages between imu/data_raw and imu/data_calibrated."""

from dataclasses import replace
import math
import os
from typing import Any

from accel_calib.stored import read_calibration
from bag_files import swapped
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from inside import Model
from inside_ros import force_of
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from shared import Readings, Stored
from std_msgs.msg import Bool

GRAVITY = 9.80665
READING = np.array([1.0, -2.0, 9.3])
RATE = np.array([0.1, 0.2, -0.3])
KNOWN = np.array([4.0, 1.0, 0.0, 1.0, 5.0, 0.5, 0.0, 0.5, 6.0]) * 1e-3
FLAT = np.array([0.2, -0.4, 0.8]) / np.sqrt(0.84)


def rate_of(message: Imu) -> Any:
    vector = message.angular_velocity
    return np.array([vector.x, vector.y, vector.z])


def quaternion_of(message: Imu) -> Rotation:
    q = message.orientation
    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def stamps(messages: list[Imu]) -> list[Any]:
    return [message.header.stamp for message in messages]


def full(bench: Any, reading: Any = READING, **fields: Any) -> Imu:
    """Return a message with all fields set."""
    return bench.imu(reading, orientation=Quaternion(x=0.5, y=0.5, z=0.5, w=0.5),
                     angular_velocity=Vector3(x=RATE[0], y=RATE[1], z=RATE[2]), **fields)


@pytest.mark.parametrize('frame', ['ros', 'ned'])
def test_corrected_message_is_in_the_levelled_frame(bench: Any, stored: Stored, frame: str
                                                    ) -> None:
    path = stored(flat=FLAT)
    axes = np.diag([1.0, -1.0, -1.0]) if frame == 'ned' else np.eye(3)
    calibration = read_calibration(path)
    calibration = replace(calibration, model=Model(calibration.model.values,
                                                   calibration.rotation @ axes))
    rotation = calibration.model.rotation
    bench.calibrator(calibration_file=path, output_frame_id='base_link', frame=frame)
    sent: list[Imu] = []

    def make() -> Imu:
        sent.append(full(bench, orientation_covariance=KNOWN))
        return sent[-1]

    got = bench.exchange(bench.came_out, make)
    assert got.header.frame_id == 'base_link'
    assert got.header.stamp in [message.header.stamp for message in sent]
    np.testing.assert_allclose(quaternion_of(got).as_matrix(),
                               quaternion_of(sent[0]).as_matrix() @ rotation, atol=1e-9)
    np.testing.assert_allclose(force_of(got), calibration.correct(READING[None])[0], atol=1e-12)
    np.testing.assert_allclose(rate_of(got), rotation.T @ RATE, atol=1e-12)
    np.testing.assert_allclose(got.orientation_covariance.reshape(3, 3),
                               rotation.T @ KNOWN.reshape(3, 3) @ rotation, atol=1e-15)


def test_readings_in_g_are_published_in_si_and_without_rotation_in_the_frame_of_the_sensor(
        bench: Any, stored: Stored) -> None:
    path = stored(unit='g', flat=FLAT)
    calibration = read_calibration(path)
    bench.calibrator(calibration_file=path, units='g', rotate=False, output_frame_id='base_link')
    got = bench.exchange(bench.came_out, lambda: full(
        bench, READING / GRAVITY, angular_velocity_covariance=KNOWN,
        linear_acceleration_covariance=KNOWN))
    assert got.header.frame_id == 'imu_link'
    force = calibration.matrix @ (READING / GRAVITY - calibration.offset)
    np.testing.assert_allclose(force_of(got), force * GRAVITY, atol=1e-12)
    assert got.linear_acceleration_covariance[0] == pytest.approx(KNOWN[0] * GRAVITY ** 2, rel=0.1)
    np.testing.assert_array_equal(rate_of(got), RATE)
    np.testing.assert_array_equal(got.angular_velocity_covariance, KNOWN)
    assert got.orientation == Quaternion(x=0.5, y=0.5, z=0.5, w=0.5)


def test_raw_messages_are_published_with_passthrough_and_when_switched_off(
        bench: Any, stored: Stored) -> None:
    bench.calibrator(passthrough=True, calibration_file=stored().with_name('new.yaml'),
                     output_frame_id='base_link')
    sent: list[Imu] = []

    def make() -> Imu:
        sent.append(full(bench, linear_acceleration_covariance=KNOWN))
        return sent[-1]

    assert bench.exchange(bench.came_out, make) in sent
    stored('new.yaml', flat=FLAT)
    assert bench.call('load').success
    bench.exchange(bench.came_out, make)
    bench.spin(lambda: bench.came_out[-1].header.frame_id == 'base_link')
    assert bench.call('enable', data=False).success
    bench.exchange(bench.came_out, make)
    bench.spin(lambda: bench.came_out[-1] in sent)


def test_motion_is_the_force_without_the_gravity_of_the_last_rest(
        bench: Any, stored: Stored, readings: Readings) -> None:
    path = stored(flat=FLAT)
    calibration = read_calibration(path)
    motion = bench.listen(Vector3Stamped, 'calibrator/linear_acceleration')
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(calibration_file=path)
    bench.exchange(bench.came_out, lambda: bench.imu(READING))
    assert not motion
    bench.spin(lambda: still and not still[-1].data)
    rest = readings([FLAT], dwell=12.0)
    bench.feed(rest[:300])
    bench.spin(lambda: still[-1].data)
    more = iter(rest[300:])  # the rest may become known after the last of these messages
    bench.exchange(motion, lambda: bench.imu(next(more)))
    push = np.array([0.5, -1.0, 2.0])
    reading = calibration.predict(np.array([[0.0, 0.0, GRAVITY]]) + push)[0]
    bench.exchange(motion, lambda: bench.imu(reading))
    bench.spin(lambda: abs(motion[-1].vector.z - push[2]) < 0.02)
    got = motion[-1].vector
    np.testing.assert_allclose([got.x, got.y, got.z], push, atol=0.02)


def test_messages_in_another_encoding_are_corrected_and_unusable_ones_dropped_and_reported(
        bench: Any, stored: Stored) -> None:
    calibration = read_calibration(path := stored(sensor='imu_link', flat=FLAT))
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=path)
    bench.exchange(bench.came_out, lambda: bench.imu(READING))
    message = full(bench, angular_velocity_covariance=KNOWN, linear_acceleration_covariance=KNOWN)
    data = serialize_message(message)
    for count, each in enumerate((data, swapped(data)), 1):
        bench.send(each)
        bench.spin(lambda count=count: stamps(bench.came_out).count(message.header.stamp) == count)
        np.testing.assert_allclose(force_of(bench.came_out[-1]),
                                   calibration.correct(READING[None])[0], atol=1e-12)
    bench.came_out.clear()
    others = [bench.imu(READING) for _ in range(20)]
    for other in others:
        other.header.frame_id = 'another'
    unusable = [bench.imu([bad, 0.0, GRAVITY]) for bad in (math.nan, math.inf, 2000.0)]
    for sent in ([*unusable, data[:90], b'\x00\x01\x00\x00', os.urandom(64)],
                 [part for other in others for part in (bench.imu(READING), other)]):
        last = bench.imu(READING)
        for each in (*sent, last):
            bench.send(each)
        bench.spin(lambda last=last: last.header.stamp in stamps(bench.came_out))
    assert not [each for each in stamps([*unusable, *others]) if each in stamps(bench.came_out)]
    assert {each.header.frame_id for each in bench.came_out} == {'imu_link_levelled'}
    for words in ('dropped 5 messages with NaN', 'dropped 20 messages of another sensor',
                  'dropped 1 corrected message with implausible values'):
        bench.spin(lambda words=words: any(words in array.status[0].message
                                           for array in diagnostics))
    assert diagnostics[-1].status[0].level == DiagnosticStatus.WARN


def test_nothing_is_published_before_a_calibration(bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(use_sim_time=True)  # and nobody publishes /clock

    def reported() -> bool:
        bench.send(bench.imu(READING))
        return any('no calibration yet' in array.status[0].message for array in diagnostics)

    bench.spin(reported)
    assert not bench.came_out
