# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Sensors that fall silent, change, lose their clock, or speak with another QoS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import signal
import time
from typing import Any

from accel_calib.logs import read_poses
from diagnostic_msgs.msg import DiagnosticArray
from faults.sample import sample
from inside import CALIBRATOR
import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool

GRAVITY = 9.80665
UP, LEFT, FORWARD = [0, 0, 1], [0, 1, 0], [1, 0, 0]
SILENCE = 2.3
"""Longer than the time after which the stream counts as silent [s]."""

Readings = Callable[..., Any]


def fall_silent(bench: Any, still: list[Bool]) -> None:
    """Publish nothing until the node notices: nobody knows whether a silent sensor rests."""
    bench.spin(lambda: still and still[-1].data)
    bench.spin(lambda: not still[-1].data)
    bench.stamp += SILENCE


def captured(bench: Any, sensor: str = 'imu_link') -> list[list[int]]:
    """Return the directions of the stored poses of a sensor."""
    poses = read_poses(bench.home / 'accel_calib' / f'imu.data_raw@{sensor}_poses.csv')
    assert poses.sensor == sensor
    found: list[list[int]] = np.round(poses.reading / GRAVITY).astype(int).tolist()
    return found


def output_of(bench: Any, process: Any) -> str:
    """End the node, and return what it printed."""
    status, printed = bench.end(process, signal.SIGTERM)
    assert status == 0, printed
    assert 'Traceback' not in printed
    return str(printed)


def test_nothing_of_a_rest_before_a_silence_is_used_after_it(bench: Any, readings: Readings
                                                             ) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    node = bench.calibrator(passthrough=True, auto_capture=False)
    bench.feed(readings([UP], dwell=3.0))
    fall_silent(bench, still)
    for _ in range(5):
        bench.send(bench.imu([GRAVITY, 0.0, 0.0]))
    bench.spin(lambda: bench.came_out)
    for name in ('capture_pose', 'set_level'):
        answer = bench.call_while(name, lambda: bench.imu([GRAVITY, 0.0, 0.0]))
        assert not answer.success
        assert 'still' in answer.message
    printed = output_of(bench, node)
    assert 'no Imu messages on /imu/data_raw' in printed
    assert 'jumped' not in printed  # the stamps are as late as the messages
    assert not list(bench.home.glob('accel_calib/*.csv'))


def test_a_sensor_that_comes_back_with_another_rate_is_captured(bench: Any, readings: Readings
                                                                ) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    node = bench.calibrator(passthrough=True)
    bench.feed(readings([UP, LEFT], dwell=3.0))
    fall_silent(bench, still)
    bench.stamp += 30.0
    moved = readings([FORWARD, UP], dwell=6.0)
    kept = bench.stamp
    messages = [bench.imu(reading) for reading in moved[::2]]  # 25 Hz
    for k, message in enumerate(messages):
        seconds = kept + 0.04 * k
        message.header.stamp.sec, message.header.stamp.nanosec = (
            int(seconds), round(seconds % 1.0 * 1e9))
    bench.echo(messages, bench.came_out)
    bench.spin(lambda: diagnostics and {
        value.key: value.value for value in diagnostics[-1].status[0].values
        }['poses captured'] == '3')
    output_of(bench, node)
    found = captured(bench)
    assert found == [UP, LEFT, FORWARD]


def test_a_sensor_with_another_frame_id_takes_over_with_files_of_its_own(
        bench: Any, readings: Readings, stored: Callable[..., Path]) -> None:
    folder = bench.home / 'accel_calib'
    folder.mkdir(parents=True)
    stored(sensor='imu_link').rename(folder / 'imu.data_raw@imu_link.yaml')
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    node = bench.calibrator(passthrough=True)
    bench.feed(readings([UP], dwell=3.0))
    fall_silent(bench, still)
    raw: list[Imu] = []

    def other() -> Imu:
        raw.append(bench.imu([0.0, GRAVITY, 0.0]))
        raw[-1].header.frame_id = 'other'
        return raw[-1]

    bench.came_out.clear()
    bench.spin(lambda: bench.send(other()) or len(bench.came_out) > 100)
    assert {each.header.frame_id for each in bench.came_out} == {'other'}
    assert all(each in raw for each in bench.came_out)  # not corrected by the stored calibration
    printed = output_of(bench, node)
    assert printed.count("now have frame_id 'other' instead of 'imu_link'") == 1
    for name, direction in (('imu_link', UP), ('other', LEFT)):
        assert captured(bench, name) == [direction]


@pytest.mark.parametrize(('jump', 'words'), sample([
    (-3600.0, 'jumped back by 3600'), (86400.0, 'jumped ahead by 864')], 1))
def test_capture_goes_on_after_a_jump_of_the_clock_which_is_logged_once(
        bench: Any, readings: Readings, jump: float, words: str) -> None:
    bench.stamp = 10_000.0
    node = bench.calibrator(passthrough=True)
    bench.feed(readings([UP, LEFT], dwell=2.5))
    bench.stamp += jump
    bench.feed(readings([FORWARD, UP], dwell=2.5))
    printed = output_of(bench, node)
    assert printed.count(words) == 1
    assert len(printed.splitlines()) < 20
    found = captured(bench)
    assert found[:3] == [UP, LEFT, FORWARD]


def test_poses_of_a_recording_that_is_played_in_a_loop_count_once(bench: Any, readings: Readings
                                                                  ) -> None:
    node = bench.calibrator(passthrough=True)
    recording = readings([UP, LEFT, FORWARD, UP], dwell=2.5)
    for _ in range(3):
        bench.stamp = 1000.0
        bench.feed(recording)
    printed = output_of(bench, node)
    poses = read_poses(bench.home / 'accel_calib' / 'imu.data_raw@imu_link_poses.csv')
    assert captured(bench) == [UP, LEFT, FORWARD]
    assert np.all(poses['count'] < 2.5 * 50 * 2.1)  # UP is in the recording twice
    assert printed.count('the stamps jumped back') == 1


@pytest.mark.parametrize('stamp', sample([0, 1000], 1))
def test_a_rest_is_not_used_while_the_stamps_stand(bench: Any, readings: Readings, stamp: int
                                                   ) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    node = bench.calibrator(passthrough=True)
    bench.feed(readings([UP], dwell=3.0))
    bench.spin(lambda: still and still[-1].data)

    def standing() -> Imu:
        message = bench.imu([GRAVITY, 0.0, 0.0])
        message.header.stamp.sec, message.header.stamp.nanosec = stamp, 0
        return message

    ends = time.monotonic() + 3.5
    bench.spin(lambda: [bench.send(standing()) for _ in range(8)] and time.monotonic() > ends
               and not still[-1].data)
    answer = bench.call_while('set_level', standing)
    assert not answer.success
    assert 'the stamps have not changed for' in answer.message
    bench.feed(readings([LEFT, UP], dwell=3.0))
    printed = output_of(bench, node)
    assert 'the stamps are' in printed
    found = captured(bench)
    assert found[:2] == [UP, LEFT]
    assert FORWARD not in found


def test_one_absurd_first_reading_does_not_spoil_the_capture(bench: Any, readings: Readings
                                                             ) -> None:
    node = bench.calibrator(passthrough=True)
    bench.exchange(bench.came_out, lambda: bench.imu([0.0, 0.0, 1e200]))
    bench.feed(readings([UP, LEFT], dwell=2.5))
    printed = output_of(bench, node)
    assert 'three finite numbers up to 9.81e+04; it is dropped' in printed
    found = captured(bench)
    assert found[0] == UP


def test_an_incompatible_qos_is_named_with_both_nodes_and_what_to_do(bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.run(*CALIBRATOR, '--ros-args', '-p',
                     'qos_overrides./imu/data_raw.subscription.reliability:=reliable')
    bench.client('self_test')
    bench.spin(lambda: diagnostics)
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    bench.node.create_publisher(Imu, 'imu/data_raw', best_effort)
    heard: list[Imu] = []
    bench.node.create_subscription(Imu, 'imu/data_calibrated', heard.append, latched)
    wanted = ('/bench publishes on /imu/data_raw with the QoS best effort, but the subscriber '
              'expects reliable', '/imu/data_calibrated has the QoS volatile, but the subscriber '
              'expects transient local, so that /bench receives nothing')
    bench.spin(lambda: all(words in diagnostics[-1].status[0].message for words in wanted))
    printed = output_of(bench, node)
    assert all(printed.count(words) == 1 for words in wanted)


@pytest.mark.parametrize('publisher', sample([
    QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
    QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)], 1))
def test_every_qos_of_a_driver_fits_and_is_not_reported(bench: Any, publisher: QoSProfile) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.start('calibrator')
    bench.client('self_test')
    driver = bench.node.create_publisher(Imu, 'imu/data_raw', publisher)

    def arrived() -> bool:
        driver.publish(bench.imu([0.0, 0.0, GRAVITY]))
        return bool(diagnostics) and 'no calibration yet' in diagnostics[-1].status[0].message

    bench.spin(arrived)
    assert 'QoS' not in output_of(bench, node)
