# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a robot in the field meets: wrong stamps, several drivers, few poses, a given mounting."""

from __future__ import annotations

from collections.abc import Callable
import math
from pathlib import Path
import re
import signal
import time
from typing import Any

from accel_calib.stored import read_calibration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from faults.sample import sample
from geometry_msgs.msg import Vector3
from inside import CALIBRATOR, rotation_from_rpy, spread_directions
import numpy as np
import pytest
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool
import yaml

GRAVITY = 9.80665
CONE = np.radians(10.0)
NODE = 'calibrator'

Readings = Callable[..., Any]
Stored = Callable[..., Path]


def status(diagnostics: list[DiagnosticArray], concern: str = '') -> DiagnosticStatus:
    """Return the last status of a concern; without a concern, that of the state."""
    name = f'{NODE}: {concern or "state"}'
    return next(each for each in diagnostics[-1].status if each.name == name)


def values(found: DiagnosticStatus) -> dict[str, str]:
    return {each.key: each.value for each in found.values}


def force_of(message: Imu) -> Any:
    vector = message.linear_acceleration
    return np.array([vector.x, vector.y, vector.z])


def rest(bench: Any, still: list[Bool], reading: Any) -> Callable[[], Imu]:
    """Let the sensor rest with this reading until the node says so; return more messages."""
    rng = np.random.default_rng(3)

    def now() -> Any:
        return np.asarray(reading) + 0.005 * rng.normal(size=3)

    bench.feed([now() for _ in range(110)])
    bench.spin(lambda: still and still[-1].data)
    return lambda: bench.imu(now())


def cone(count: int = 8) -> Any:
    """Return directions within 10° of the z axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    tilt = np.where(np.arange(count) % 2, CONE, 0.4 * CONE)
    return np.column_stack([np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle),
                            np.cos(tilt)])


# The heading and the mounting


def test_the_heading_is_called_arbitrary_near_its_singular_direction_and_then_kept(
        bench: Any, stored: Stored) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    path = stored()
    bench.calibrator(calibration_file=path)
    make = rest(bench, still, [GRAVITY, 0.0, 0.0])
    answer = bench.call_while('set_level', make)
    assert answer.success, answer.message
    assert 'the heading of the mounting is arbitrary' in answer.message
    for way in ('~/set_heading', 'mounting_rpy', 'base_frame'):
        assert way in answer.message
    first = read_calibration(path).rotation
    for _ in range(3):
        assert bench.call_while('set_level', make).success
    turn = first.T @ read_calibration(path).rotation
    assert np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0)) < 0.5


def test_a_given_mounting_is_used_kept_by_set_level_and_reported(
        bench: Any, stored: Stored) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    path, rpy = stored(), [0.02, -0.03, 2.0]
    given = rotation_from_rpy(*rpy)
    bench.calibrator(calibration_file=path, mounting_rpy=rpy)
    got = bench.exchange(bench.came_out, lambda: bench.imu([0.0, 0.0, GRAVITY]))
    calibration = read_calibration(path)
    np.testing.assert_allclose(
        force_of(got), given @ calibration.correct(np.array([[0.0, 0.0, GRAVITY]]))[0], atol=1e-9)
    assert got.header.frame_id == 'imu_link_levelled'
    flat = calibration.predict(np.array([[0.0, 0.0, GRAVITY]]) @ given)[0]
    answer = bench.call_while('set_level', rest(bench, still, flat))
    assert answer.success, answer.message
    assert re.search(r'roll 1\.1\d°, pitch -1\.7\d°, yaw 114\.\d+°', answer.message)
    assert '<origin xyz="0 0 0" rpy="' in answer.message
    assert 'static_transform_publisher --roll' in answer.message
    found = read_calibration(path)
    np.testing.assert_allclose(found.rotation.T, given, atol=2e-3)
    about = yaml.safe_load(path.read_text())['mounting']
    np.testing.assert_allclose([about['roll'], about['pitch'], about['yaw']], rpy, atol=2e-3)
    assert about['urdf'] in answer.message


def test_a_level_pose_that_contradicts_the_given_mounting_is_refused(
        bench: Any, stored: Stored) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(calibration_file=stored(), mounting_rpy=[0.5, 0.0, 0.0])
    answer = bench.call_while('set_level', rest(bench, still, [0.0, 0.0, GRAVITY]))
    assert not answer.success
    assert 'differs by more than 10° of tilt from the mounting' in answer.message


def test_the_mounting_comes_from_the_static_transforms_and_is_published(
        tf_message: Any, bench: Any, stored: Stored) -> None:
    from geometry_msgs.msg import TransformStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    robot = bench.node.create_publisher(tf_message, '/tf_static', latched)
    heard: list[Any] = []
    bench.node.create_subscription(tf_message, '/tf_static', heard.append, latched)
    steps = []
    for parent, child, half in (('base_link', 'mast', 0.3), ('mast', 'imu_link', 0.2)):
        step = TransformStamped(child_frame_id=child)
        step.header.frame_id = parent
        step.transform.rotation.z, step.transform.rotation.w = math.sin(half), math.cos(half)
        steps.append(step)
    robot.publish(tf_message(transforms=steps))
    path = stored()
    bench.calibrator(calibration_file=path, base_frame='base_link', publish_tf=True)
    reading = np.array([1.0, 2.0, 9.5])
    bench.exchange(bench.came_out, lambda: bench.imu(reading))
    expected = rotation_from_rpy(0.0, 0.0, 1.0) @ read_calibration(path).correct(reading[None])[0]

    def turned() -> bool:
        bench.send(bench.imu(reading))
        return bool(np.allclose(force_of(bench.came_out[-1]), expected, atol=1e-6)
                    if bench.came_out else False)

    bench.spin(turned)
    bench.spin(lambda: any(each.child_frame_id == 'imu_link_levelled'
                           for message in heard for each in message.transforms))
    found = next(each for message in heard for each in message.transforms
                 if each.child_frame_id == 'imu_link_levelled')
    assert found.header.frame_id == 'imu_link'
    # It undoes the mounting: the levelled frame is parallel to the base.
    assert found.transform.rotation.z == pytest.approx(-math.sin(0.5))
    assert found.transform.rotation.w == pytest.approx(math.cos(0.5))


def test_parameters_that_need_tf_are_refused_in_words_without_it(
        without_tf2: None, bench: Any) -> None:
    for parameter, value in (('base_frame', 'base_link'), ('publish_tf', True)):
        process = bench.start('calibrator', **{parameter: value})
        printed = process.communicate(timeout=60)[0]
        assert process.returncode == 2
        assert f'the parameter {parameter} needs the package tf2_msgs' in printed
        assert 'Traceback' not in printed


# The stream


@pytest.mark.parametrize(('kind', 'words'), sample([
    ('zero', 'the stamps are zero'), ('constant', 'the stamps are constant'),
    ('shuffled', 'the stamps are out of order')], 1))
def test_wrong_stamps_are_in_the_second_diagnostics_at_latest(
        bench: Any, kind: str, words: str) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(passthrough=True)
    sent = 0

    def make() -> Imu:
        nonlocal sent
        sent += 1
        message = bench.imu([0.1, 0.2, 9.8])
        if kind == 'zero':
            message.header.stamp.sec = message.header.stamp.nanosec = 0
        elif kind == 'constant':
            message.header.stamp.sec, message.header.stamp.nanosec = 1000, 5
        elif sent % 2:
            message.header.stamp.sec -= 1
        return message

    bench.exchange(bench.came_out, make)
    diagnostics.clear()

    def said() -> bool:
        bench.send(make())
        return bool(diagnostics) and words in status(diagnostics, 'stream').message

    bench.spin(said)
    assert len(diagnostics) <= 2  # one each second


def test_two_publishers_on_the_topic_are_named(bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(passthrough=True)
    bench.start('simulator')

    def said() -> bool:
        bench.send(bench.imu([0.1, 0.2, 9.8]))
        found = status(diagnostics, 'stream').message if diagnostics else ''
        return all(words in found for words in (
            'two publishers on the topic /imu/data_raw', '/bench', '/simulator'))

    bench.spin(said)
    assert status(diagnostics, 'stream').level == DiagnosticStatus.WARN


def test_the_diagnostics_have_the_true_rate_and_the_resolved_names(
        bench: Any, stored: Stored) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    process = bench.run(*CALIBRATOR, '--ros-args', '-r', '__ns:=/left',
                        '-r', 'imu/data_raw:=/driver/imu', '-p', f'calibration_file:={stored()}')
    publisher = bench.node.create_publisher(Imu, '/driver/imu', 100)
    bench.spin(lambda: publisher.get_subscription_count() > 0)
    started, sent = time.monotonic(), 0

    def rate() -> float:
        stream = next((each.message for each in diagnostics[-1].status
                       if each.name == 'left/calibrator: stream'), '') if diagnostics else ''
        shown = re.match(r'([\d.]+) Hz on /driver/imu$', stream)
        return float(shown[1]) if shown else 0.0

    def true() -> bool:
        nonlocal sent
        while sent < (time.monotonic() - started) * 100.0:
            publisher.publish(bench.imu([0.1, 0.2, 9.8]))  # with stamps at 50 Hz
            sent += 1
        return rate() == pytest.approx(100.0, rel=0.05)

    bench.spin(true)
    found = {each.name: each for each in diagnostics[-1].status}
    assert set(found) == {f'left/calibrator: {concern}' for concern in (
        'state', 'stream', 'calibration', 'drift', 'storage')}
    assert {each.hardware_id for each in found.values()} == {'imu_link'}
    assert values(found['left/calibrator: state'])['rate [Hz]']
    assert bench.end(process, signal.SIGINT)[0] == 0


def test_the_log_says_what_the_node_waits_for_and_the_unit_that_is_likely(bench: Any) -> None:
    from rcl_interfaces.msg import Log
    lines = bench.listen(Log, '/rosout', latched=True)
    process = bench.calibrator()
    bench.spin(lambda: any('although /bench publishes' in line.msg for line in lines))

    def said() -> bool:
        bench.send(bench.imu([0.0, 0.1, 1.0]))
        return any('start the node with units:=g' in line.msg for line in lines)

    bench.spin(said)
    printed = bench.end(process, signal.SIGINT)[1]
    assert 'waiting: no Imu messages on /imu/data_raw, although /bench publishes' in printed
    assert 'Imu messages arrive on /imu/data_raw' in printed
    assert 'start the node with units:=g' in printed


def test_there_is_one_line_for_each_pose_and_none_when_done(
        bench: Any, readings: Readings) -> None:
    process = bench.calibrator(passthrough=True)
    bench.feed(readings(spread_directions(19)))
    again = readings(spread_directions(19)[:6])
    bench.feed(again)
    lines = [line for line in bench.end(process, signal.SIGINT)[1].splitlines()
             if 'pose' in line and 'read' not in line]
    counts = [int(found[1]) for line in lines if (found := re.search(r'pose (\d+)\b', line))]
    assert counts == list(range(1, 20)), '\n'.join(lines)
    assert re.search(r'pose 7 of about 1\d, \d\.\d\d mg, next: turn the sensor so that', lines[6])
    assert not any('or call ~/fit' in line for line in lines[:8])
    assert not any('1 poses' in line for line in lines)
    assert len([line for line in lines if 'no longer help' in line]) <= 1


# Few poses


def test_set_level_works_without_a_fit(bench: Any) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(sensor='arm', passthrough=True)
    reading = np.array([1.0, -0.5, 9.7])
    answer = bench.call_while('set_level', rest(bench, still, reading))
    assert answer.success, answer.message
    assert 'roll' in answer.message
    bench.exchange(bench.came_out, lambda: bench.imu(reading))
    bench.spin(lambda: bench.came_out[-1].header.frame_id == 'imu_link_levelled' or bench.send(
        bench.imu(reading)))
    got = bench.came_out[-1]
    np.testing.assert_allclose(force_of(got)[:2], 0.0, atol=0.01)
    assert read_calibration(bench.home / 'accel_calib' / 'arm.yaml').is_levelled


def test_a_cone_of_poses_gives_what_it_carries_with_numbers(
        bench: Any, readings: Readings) -> None:
    bench.calibrator(sensor='arm', passthrough=True, min_pose_angle=0.05)
    bench.feed(readings(cone()))
    answer = bench.call('fit')
    assert answer.success, answer.message
    assert re.search(r'along gravity', answer.message)
    assert re.search(r'\d+(\.\d+)? mg', answer.message)
    assert 'turn the sensor so that' in answer.message
    found = read_calibration(bench.home / 'accel_calib' / 'arm.yaml')
    lengths = np.linalg.norm(found.correct(readings(cone(5), dwell=1.0)[:20]), axis=1)
    assert abs(float(np.mean(lengths)) / GRAVITY - 1.0) < 1e-3


def test_one_rest_gives_gyro_bias_mounting_and_the_offset_along_gravity(bench: Any) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(sensor='arm', passthrough=True, gyro_bias=True, fill_covariance=True)
    bias, rng = np.array([0.01, -0.02, 0.005]), np.random.default_rng(1)

    def make() -> Imu:
        x, y, z = bias + 0.001 * rng.normal(size=3)
        return bench.imu([0.5, 0.0, 10.0] + 0.01 * rng.normal(size=3),
                         angular_velocity=Vector3(x=x, y=y, z=z))

    bench.exchange(bench.came_out, make)
    bench.echo((make() for _ in range(150)), bench.came_out)
    bench.spin(lambda: still and still[-1].data)
    answer = bench.call_while('calibrate_at_rest', make)
    assert answer.success, answer.message
    assert 'gyro bias' in answer.message
    assert 'along gravity' in answer.message
    found = read_calibration(bench.home / 'accel_calib' / 'arm.yaml')
    np.testing.assert_allclose(found.gyro.bias, bias, atol=5 * found.gyro.sd.max() + 1e-4)
    bench.exchange(bench.came_out, make)
    bench.spin(lambda: bench.came_out[-1].header.frame_id == 'imu_link_levelled' or bench.send(
        make()))
    got = bench.echo((make() for _ in range(40)), bench.came_out)
    rates = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z]
                      for m in got])
    np.testing.assert_allclose(rates.mean(axis=0), 0.0, atol=1e-3)
    assert np.linalg.norm(np.mean([force_of(m) for m in got], axis=0)) == pytest.approx(
        GRAVITY, abs=0.01)
    assert got[-1].angular_velocity_covariance[0] == pytest.approx(1e-6, rel=0.5)
    assert got[-1].linear_acceleration_covariance[0] > 0.5e-4


# Preview, accept, undo


def test_a_fit_waits_for_confirmation_on_the_preview(bench: Any, readings: Readings) -> None:
    preview = bench.listen(Imu, 'calibrator/preview')
    bench.calibrator(sensor='arm', passthrough=True, confirm=True)
    bench.feed(readings(spread_directions(12)))
    path = bench.home / 'accel_calib' / 'arm.yaml'
    for end in ('undo', 'save'):
        answer = bench.call('fit')
        assert answer.success, answer.message
        assert '~/preview' in answer.message
        assert not path.exists()
        raw = bench.imu([0.3, 0.4, 9.7])
        bench.exchange(preview, lambda raw=raw: raw)
        assert np.linalg.norm(force_of(preview[-1]) - [0.3, 0.4, 9.7]) > 0.05
        assert bench.exchange(bench.came_out, lambda raw=raw: raw) == raw
        assert bench.call(end).success
        assert path.exists() is (end == 'save')
    bench.exchange(bench.came_out, lambda: bench.imu([0.3, 0.4, 9.7]))
    bench.spin(lambda: np.linalg.norm(force_of(bench.came_out[-1]) - [0.3, 0.4, 9.7]) > 0.05
               or bench.send(bench.imu([0.3, 0.4, 9.7])))


def test_undo_goes_back_step_by_step_also_after_a_restart(
        bench: Any, readings: Readings) -> None:
    bench.without_shared_memory()
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    process = bench.calibrator(sensor='arm', passthrough=True)
    bench.feed(readings(spread_directions(12)))
    path = bench.home / 'accel_calib' / 'arm.yaml'
    assert bench.call('fit').success
    fitted = path.read_text()
    answer = bench.call_while('set_level', rest(bench, still, readings([[0.0, 0.0, 1.0]])[-1]))
    assert answer.success, answer.message
    assert 'changes offset by (+0.00, +0.00, +0.00) mg' in answer.message
    assert read_calibration(path).is_levelled
    assert bench.end(process, signal.SIGKILL)[0] == -signal.SIGKILL
    bench.join_anew()
    bench.calibrator(sensor='arm', passthrough=True)
    bench.exchange(bench.came_out, lambda: bench.imu([0.3, 0.4, 9.7]))
    assert bench.call('undo').success
    assert path.read_text() == fitted
    answer = bench.call('undo')
    assert answer.success, answer.message
    assert not path.exists()
    assert not bench.call('undo').success
    assert len(list(path.parent.glob('arm.yaml.undone*'))) == 2


def test_automatic_fits_rewrite_the_file_only_for_a_change_beyond_the_uncertainty(
        bench: Any, readings: Readings) -> None:
    path = bench.home / 'accel_calib' / 'arm.yaml'
    bench.calibrator(sensor='arm', auto_fit=True, auto_fit_poses=12, passthrough=True)
    bench.feed(readings(spread_directions(12)))
    bench.spin(path.exists)
    written = path.stat().st_mtime_ns
    bench.feed(readings(spread_directions(25)[:8]))
    assert path.stat().st_mtime_ns == written
    assert len(list(path.parent.glob('arm.yaml.before*'))) == 1


# Start and end


def test_a_signal_at_any_time_of_the_start_ends_the_node_without_a_traceback(bench: Any) -> None:
    for wait in sample((0.05, 0.2, 0.4, 0.6, 0.8, 1.0, 1.3), 3):
        process = bench.start('calibrator')
        time.sleep(wait)
        status, printed = bench.end(process, signal.SIGTERM)
        assert status in (0, -signal.SIGTERM), printed
        assert 'Traceback' not in printed


def test_leftovers_of_killed_processes_are_removed_at_the_start(
        bench: Any, stored: Stored) -> None:
    path = stored()
    left = [path.with_name(f'.{name}.12345.tmp') for name in (path.name, 'known_poses.csv')]
    for each in left:
        each.write_text('half a file')
    bench.calibrator(calibration_file=path)
    assert not any(each.exists() for each in left)
    assert path.exists()


@pytest.mark.parametrize('change', sample([
    lambda text: re.sub(r'(x: |x:\s*)-?0\.\d+', r'\g<1>7.5', text, count=1),
    lambda text: re.sub(r'rotation:\n(- \[.*\]\n){3}',
                        'rotation:\n' + '- [0.0, 0.0, 0.0]\n' * 3, text)], 1))
def test_an_absurd_calibration_edited_by_hand_is_not_used(
        bench: Any, stored: Stored, change: Callable[[str], str]) -> None:
    path = stored()
    absurd = change(path.read_text())
    assert absurd != path.read_text()
    path.write_text(absurd)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=path)
    bench.spin(lambda: diagnostics and status(diagnostics, 'calibration').level
               == DiagnosticStatus.ERROR)
    assert 'implausible' in status(diagnostics, 'calibration').message
    assert path.with_name(f'{path.name}.damaged1').read_text() == absurd


def test_switching_the_correction_on_says_what_is_published(bench: Any, stored: Stored) -> None:
    bench.calibrator()
    assert 'nothing is published' in bench.call('enable', data=True).message


def test_the_managed_node_loads_on_configure_and_publishes_when_active(
        bench: Any, stored: Stored) -> None:
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState, GetState
    heard = bench.listen(Imu, 'imu/data_calibrated')
    process = bench.start('calibrator_lifecycle', calibration_file=stored())
    change = bench.node.create_client(ChangeState, 'calibrator/change_state')
    state = bench.node.create_client(GetState, 'calibrator/get_state')
    publisher = bench.node.create_publisher(Imu, 'imu/data_raw', 100)

    def ask(client: Any, request: Any) -> Any:
        bench.spin(client.service_is_ready)
        future = client.call_async(request)
        bench.spin(future.done)
        return future.result()

    def go(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(ask(change, request).success)

    def pushes(seconds: float = 0.6) -> int:
        heard.clear()
        ends = time.monotonic() + seconds

        def done() -> bool:
            publisher.publish(bench.imu([0.1, 0.2, 9.8]))
            return time.monotonic() > ends

        bench.spin(done)
        return len(heard)

    for _ in range(2):
        assert go(Transition.TRANSITION_CONFIGURE)
        bench.spin(lambda: publisher.get_subscription_count() > 0)
        assert pushes() == 0
        assert go(Transition.TRANSITION_ACTIVATE)
        bench.spin(lambda: pushes() > 0)
        assert go(Transition.TRANSITION_DEACTIVATE)
        pushes(0.3)
        assert pushes() == 0
        assert go(Transition.TRANSITION_CLEANUP)
        assert ask(state, GetState.Request()).current_state.label == 'unconfigured'
    assert bench.end(process, signal.SIGINT)[0] == 0


def test_the_quality_of_service_can_be_overridden(bench: Any, stored: Stored) -> None:
    process = bench.run(
        *CALIBRATOR, '--ros-args',
        '-p', f'calibration_file:={stored()}', '-p',
        'qos_overrides./imu/data_calibrated.publisher.reliability:=best_effort')
    bench.spin(lambda: bench.node.get_publishers_info_by_topic('/imu/data_calibrated'))
    info = bench.node.get_publishers_info_by_topic('/imu/data_calibrated')[0]
    assert info.qos_profile.reliability.name == 'BEST_EFFORT'
    assert bench.end(process, signal.SIGINT)[0] == 0


def test_the_progress_is_published_for_the_person_at_the_robot(
        bench: Any, readings: Readings) -> None:
    progress = bench.listen(DiagnosticStatus, 'calibrator/progress', latched=True)
    bench.calibrator(passthrough=True)
    bench.feed(readings(spread_directions(4)))
    bench.spin(lambda: progress and values(progress[-1])['poses'] == '4')
    found = values(progress[-1])
    assert progress[-1].message == found['next pose'] != ''
    assert len(found['next direction'].split()) == 3
    assert 0.0 < float(found['coverage']) < 1.0
    assert found['poses in all, about'] in ('11', '12', '13')
    assert any(values(each)['still'] == 'true' for each in progress)
