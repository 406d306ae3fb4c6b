# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Processing of messages between imu/data_raw and imu/data_calibrated."""

from dataclasses import replace
import math
import os
from pathlib import Path
import signal
from typing import Any

from accel_calib.stored import read_calibration, write_calibration
from bag_files import swapped
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from faults.sample import sample
from geometry_msgs.msg import Quaternion, Vector3, Vector3Stamped
from inside import Model, spread_directions
from inside_ros import force_of
import numpy as np
import pytest
from rclpy.serialization import serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import BatteryState, FluidPressure, Imu, Temperature
from shared import GRAVITY, OWN, Readings, Stored, with_effects
from std_msgs.msg import Bool, Float32, Float64, Float64MultiArray

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


# An effect that the calibration lacks is found and corrected


POSES = 18
MOVES = np.array([0.002, -0.0015, 0.001])
"""Offset per ampere [g]."""


def message(publisher: Any, value: float) -> Any:
    """Return a message with a number, of the type of a publisher."""
    kind = publisher.msg_type
    field = next(field for field in ('data', 'voltage', 'fluid_pressure', 'temperature')
                 if field in kind.get_fields_and_field_types())
    return kind(**{field: value})


def published(bench: Any, publisher: Any, value: float) -> None:
    """Publish a temperature, or other number, that the node takes before its answer."""
    publisher.publish(message(publisher, value))
    bench.call('self_test')


def meet(bench: Any, publisher: Any, value: float, name: str = 'temperature [°C]') -> None:
    """Publish a number until the node knows it; a publisher may see a node earlier."""
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')

    def known() -> bool:
        publisher.publish(message(publisher, value))
        shown = {value.key: value.value for each in diagnostics for value in each.status[0].values}
        return shown.get(name) == f'{value:.3f}'

    bench.spin(known)


def test_an_own_effect_is_named_corrected_and_needed_by_the_node(
        bench: Any, readings: Readings, tmp_path: Path) -> None:
    (tmp_path / 'own.py').write_text(OWN, encoding='utf-8')
    about = {'sensor': 'arm', 'passthrough': True, 'context': ['motor_current:=motor/current']}
    publisher = bench.node.create_publisher(Float64, 'motor/current', 10)
    first = bench.calibrator(**about, also=tmp_path / 'own.py')
    meet(bench, publisher, 25.0, 'motor_current')
    for k, direction in enumerate(spread_directions(POSES)):
        current = 25.0 + 12.0 * np.sin(2.1 * k)
        published(bench, publisher, current)
        bench.feed(readings([direction], dwell=1.8) + MOVES * abs(current - 25.0) * 9.80665)
    answer = bench.call('refine')
    assert answer.success, answer.message
    assert 'field_of_motor' in answer.message
    for current in (15.0, 30.0):
        meet(bench, publisher, current, 'motor_current')
        shift = MOVES * abs(current - 25.0) * 9.80665
        bench.echo([bench.imu(reading + shift) for reading in readings([[0, 0, 1]])[:40]],
                   bench.came_out)
        assert np.linalg.norm(np.mean([*map(force_of, bench.came_out)], axis=0)) == pytest.approx(
            9.80665, abs=0.02)
    assert bench.end(first, signal.SIGINT)[0] == 0
    bench.join_anew()
    second = bench.start('calibrator', **about)
    bench.client('self_test')
    status, printed = bench.end(second, signal.SIGINT)
    assert status == 0, printed
    assert "the effect 'field_of_motor'" in printed
    status, printed = bench.end(bench.start('calibrator', also='/nowhere/own.py'))
    assert status == 2, printed
    assert 'also is /nowhere/own.py,' in printed


TOPICS = {'supply_voltage [V]': ('battery', BatteryState, 12.25),
          'pressure': ('air', FluidPressure, 101325.5), 'rotor': ('rotor', Temperature, 55.5),
          'load': ('load', Float32, 0.75), 'temperature [°C]': ('die', Float64, 31.5)}


def test_each_type_of_context_is_read_and_what_cannot_be_read_is_said(bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    publishers = {name: (bench.node.create_publisher(kind, topic, 10), value)
                  for name, (topic, kind, value) in TOPICS.items()}
    bench.node.create_publisher(Float64MultiArray, 'array', 10)  # its layout is no quantity
    entries = [f'{name.split()[0]}:=/{topic}' for name, (topic, *_) in TOPICS.items()]
    bench.calibrator(context=[*entries, 'text:=/imu/data_raw', 'none:=/nowhere',
                              'spread:=/rotor/variance', 'array:=/array'])
    wanted = ('no text arrives: /imu/data_raw has the type sensor_msgs/Imu with the numbers '
              'orientation.x, ', 'no none arrives: there is no topic /nowhere',
              'no array arrives: /array has the type std_msgs/Float64MultiArray with no number',
              'topics with a number: /air, /battery, /die, /load, /rotor')

    def said() -> bool:
        for publisher, value in publishers.values():
            publisher.publish(message(publisher, value))
        said = diagnostics[-1].status if diagnostics else []
        return any(all(words in each.message for words in wanted) for each in said)

    bench.spin(said)
    shown = {value.key: value.value for value in diagnostics[-1].status[0].values}
    for name, (_, value) in publishers.items():
        assert shown[name] == f'{value:.3f}'
    assert (shown['none'], shown['spread']) == ('not known', '0.000')


CURVE = [2e-3, -1e-3, 3e-3, 1e-3, 2e-3, -2e-3, 15.0, 35.0]


@pytest.mark.parametrize(('name', 'values'), sample([
    ('offset_temperature', [1e-3, -1.5e-3, 2e-3, 30.0, 0.0]),
    ('empirical-offset-temperature-1-2', CURVE),
    ('offset_temperature', [1e-3, -1.5e-3, 2e-3, 30.0, 1.0])], 1, seed=2))
def test_messages_are_corrected_as_offline(bench: Any, readings: Readings, name: str,
                                           values: list[float], stored: Stored
                                           ) -> None:
    path = stored(sensor='imu_link')
    publisher = bench.node.create_publisher(Temperature, 'temperature', 10)
    bench.calibrator(calibration_file=str(path))
    bench.spin(lambda: publisher.get_subscription_count() > 0)
    reading = readings([[0.0, 0.6, 0.8]])[0]
    # The node knows the temperatures before the calibration: a reload continues the lag.
    meet(bench, publisher, 20.0)
    bench.exchange(bench.came_out, lambda: bench.imu(reading))
    # So long after the messages so far that the temperature before does not matter.
    times, warm, found = bench.stamp + 1e5 + np.arange(60), 20.0 + 0.25 * np.arange(60), []
    for k in range(60):
        published(bench, publisher, warm[k])
        if k == 30:
            calibration, turn = read_calibration(path), np.arange(20)
            calibration = with_effects(
                calibration, {name: values}, 1e-14,
                temperature=25.0 + 10.0 * np.cos(turn * 2.0), time=turn * 100.0)
            write_calibration(path, calibration)
            answer = bench.call('load')
            assert answer.success, answer.message
        bench.stamp = times[k] - 0.02  # the next message has the next stamp
        found += bench.echo([bench.imu(reading)], bench.came_out)
    expected = calibration.apply(np.tile(reading, (60, 1)), time=times, temperature=warm)
    # The history has a point every 2 s, so that the rate of the past differs slightly.
    np.testing.assert_allclose([*map(force_of, found[30:])], expected[30:], atol=2e-3)
    assert np.ptp(expected[30:], axis=0).max() > 0.02
    begun_now = calibration.apply(np.tile(reading, (30, 1)), time=times[30:],
                                  temperature=warm[30:])
    if 'lag' in calibration.model.terms.effects[-1].shape:
        assert np.abs(begun_now - expected[30:]).max() > 0.02
