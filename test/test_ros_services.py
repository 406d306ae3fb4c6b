# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The services of the calibrator, and their answers if they fail."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import re
from typing import Any

from accel_calib.logs import read_poses
from accel_calib.units import units_of
from diagnostic_msgs.msg import DiagnosticArray
from inside import Model, plan_for, simulate_poses, spread_directions
from inside_ros import pose_markers
import numpy as np
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool
from visualization_msgs.msg import MarkerArray

Readings = Callable[..., Any]
Stored = Callable[..., Path]


def count(markers: list[Any], namespace: str = 'poses') -> int:
    return sum(m.ns == namespace for m in markers[-1].markers) if markers else 0


def test_log_and_markers_report_that_more_poses_no_longer_help() -> None:
    poses = simulate_poses(Model({}), spread_directions(24), np.random.default_rng(1))
    asked = plan_for(poses, units_of('g'), 'auto').asked
    assert asked.words == 'more poses no longer help: 24 poses determine |a| to within 0.18 mg'
    markers = pose_markers(np.zeros((0, 3)), asked, 'imu').markers
    assert [m.text for m in markers if m.ns == 'next'] == [asked.words]
    few = plan_for(poses.take(slice(0, 8)), units_of('g'), 'auto').asked
    arrow, text = [m for m in pose_markers(np.zeros((0, 3)), few, 'imu').markers
                   if m.ns == 'next']
    np.testing.assert_allclose([getattr(arrow.points[1], axis) for axis in 'xyz'], few.direction)
    assert text.text == few.words


def test_poses_are_captured_and_removed_on_request(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(auto_capture=False, sensor='arm', passthrough=True)
    poses = readings([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dwell=3.0)
    bench.feed(poses[:140])
    bench.spin(lambda: still and still[-1].data)
    assert count(markers) == 0
    answer = bench.call_while('capture_pose', lambda: bench.imu(poses[130]))
    assert answer.success, answer.message
    assert re.match(r'1 pose: .*; next: turn the sensor so that the .* points up \([-+xyz ]+\)$',
                    answer.message)
    bench.spin(lambda: count(markers) == 1)
    asked = markers[-1].markers[-1].text
    assert answer.message.endswith(asked)

    def reported() -> bool:
        bench.send(bench.imu(poses[130]))
        return bool(diagnostics) and any(value.key == 'next' and value.value == asked
                                         for value in diagnostics[-1].status[0].values)

    bench.spin(reported)
    bench.feed(poses[140:165])
    bench.spin(lambda: not still[-1].data)
    rng = np.random.default_rng(1)
    answer = bench.call_while('capture_pose', lambda: bench.imu(
        poses[150] + 2.0 * rng.normal(size=3)))
    assert not answer.success
    assert 'not still' in answer.message
    bench.feed(poses[165:310])
    bench.spin(lambda: still[-1].data)
    assert bench.call_while('capture_pose', lambda: bench.imu(poses[300])).success
    bench.spin(lambda: count(markers) == 2)
    table = bench.home / 'accel_calib' / 'arm_poses.csv'
    bench.spin(lambda: len(read_poses(table)) == 2)
    assert bench.call('undo_pose').success
    bench.spin(lambda: count(markers) == 1)
    assert bench.call('undo_pose').success
    assert not bench.call('undo_pose').success


def test_self_test_names_what_fails(bench: Any, stored: Stored) -> None:
    rng = np.random.default_rng(1)

    def moving() -> Imu:
        return bench.imu(np.array([0, 0, 9.8]) + 3.0 * rng.normal(size=3))

    corrected = bench.listen(Imu, 'imu/data_calibrated')
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=stored('good.yaml'))
    answer = bench.call('self_test')
    assert answer.passed == b'\x00'
    assert 'no Imu messages' in {status.name: status.message for status in answer.status}[
        'calibrator: stream']
    bench.exchange(corrected, moving)
    diagnostics.clear()

    def running() -> bool:
        bench.send(moving())
        return len(diagnostics) > 1

    bench.spin(running)
    answer = bench.call('self_test')
    assert answer.passed == b'\x01', [status.message for status in answer.status]
    assert answer.id == 'imu_link'
