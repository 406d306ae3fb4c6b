# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A calibration over DDS: simulator, calibrator and user in separate processes."""

from __future__ import annotations

import signal
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from sensor_msgs.msg import Imu
from visualization_msgs.msg import MarkerArray

GRAVITY = 9.80665
POSES = 12
SIMULATED = {
    'effects': ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
                'cross_axis=0.006,-0.004,0.003'],
    'mounting': [8.0, -5.0, 30.0], 'poses': POSES, 'rate': 200.0, 'dwell': 1.2, 'turn': 0.4,
    'noise': 0.005, 'wait': 10.0, 'listeners': 2, 'flat_first': True}
FLAT_FOR = 220
CAPTURE = {'still_window': 0.25, 'min_dwell': 0.6}


def vectors(messages: list[Any]) -> Any:
    """Return the accelerations as an (n, 3) array [g]."""
    return np.array([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z]
                     for m in messages]) / GRAVITY


def count(markers: list[Any]) -> int:
    """Return the number of poses in the last markers."""
    return sum(m.ns == 'poses' for m in markers[-1].markers) if markers else 0


def is_level(truth: list[Any]) -> bool:
    return all(message.vector.x == 0.0 and message.vector.z > 0.0 for message in truth)


def rms_mg(forces: Any) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(forces, axis=1) - 1.0) ** 2))) * 1e3


def test_calibration_and_level_survive_a_kill(bench: Any) -> None:
    bench.without_shared_memory()
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    raw = bench.listen(Imu, 'imu/data_raw')
    truth = bench.listen(Vector3Stamped, 'simulator/truth')
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    node = bench.calibrator(**CAPTURE, **bench.deep)
    simulator = bench.start('simulator', **SIMULATED)
    # First flat, then 12 poses, then flat until the end.
    bench.spin(lambda: count(markers) == POSES + 1 and is_level(truth[-FLAT_FOR:]), 300.0)

    assert not corrected
    answer = bench.call('fit')
    assert answer.success, answer.message
    answer = bench.call('set_level')
    assert answer.success, answer.message

    corrected.clear()
    bench.spin(lambda: len(corrected) > 300)
    flat = vectors(corrected[100:])
    up = flat.mean(axis=0)
    assert rms_mg(flat) < 1.0
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 0.2

    assert bench.end(simulator, signal.SIGTERM)[0] == 0
    still = [message for message in raw
             if abs(message.angular_velocity.x) + abs(message.angular_velocity.y) < 0.02]
    assert rms_mg(vectors(still)) > 10.0
    assert rms_mg(vectors(bench.echo(still[::5], corrected))) < 1.0
    bench.end(node, signal.SIGKILL)
    check_restarted(bench, still[-100:], count(markers))


def check_restarted(bench: Any, messages: list[Any], poses: int) -> None:
    """Check that a new process has the calibration and the poses of the killed process."""
    bench.join_anew()
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.calibrator(**CAPTURE)
    bench.exchange(corrected, lambda: messages[0])
    bench.spin(lambda: count(markers) == poses)
    bench.echo(messages, corrected)
    up = vectors(corrected).mean(axis=0)
    assert np.degrees(np.arccos(up[2] / np.linalg.norm(up))) < 0.2
    bench.spin(lambda: diagnostics and 'model 10' in str(diagnostics[-1].status))
    answer = bench.call('fit')
    assert answer.success, answer.message
    status, printed = bench.end(node, signal.SIGINT)
    assert status == 0
    assert 'Traceback' not in printed
