# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The node reports a drift of the sensor, and raises no false alarms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from accel_calib.calibrate import fit_poses
from accel_calib.stored import write_calibration
from accel_calib.units import units_of
from conftest import EFFECTS, GRAVITY
from diagnostic_msgs.msg import DiagnosticArray
from inside import model_with, simulate_poses, spread_directions
import numpy as np
from sensor_msgs.msg import Temperature

OFFSET = np.array([0.0, 0.0, 0.005])
TILTED = [[0.0, 0.0, 1.0], [0.2, 0.0, 0.98], [0.0, 0.2, 0.98]]


def calibrated(path: Path) -> Path:
    """Return the path of a stored calibration that was made at 24 to 25 °C."""
    units = units_of('m/s2')
    poses = simulate_poses(model_with(EFFECTS), spread_directions(24), np.random.default_rng(3),
                           noise_g=0.001)
    poses = poses.with_columns(reading=units.from_g(poses.reading),
                               std=units.from_g(poses['std']),
                               temperature=np.linspace(24.0, 25.0, 24))
    write_calibration(path, fit_poses(poses, units, model='10', sensor='imu_link'))
    return path


def drift(bench: Any) -> Any:
    """Return the finding of the self-test about drift."""
    return next(each for each in bench.call('self_test').status if each.name.endswith(': drift'))


def test_a_shift_of_5_mg_causes_a_warning_at_the_third_rest_and_a_knock_does_not(
        bench: Any, readings: Callable[..., Any], tmp_path: Path) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    warm = bench.node.create_publisher(Temperature, 'temperature', 10)
    bench.calibrator(calibration_file=calibrated(tmp_path / 'made.yaml'))
    bench.spin(lambda: warm.get_subscription_count() > 0)

    def rests(count: int, offset: Any) -> None:
        warm.publish(Temperature(temperature=38.2))
        for k in range(count):
            given = readings(TILTED[k:k + 2], dwell=1.4)
            bench.feed(given[:90] + GRAVITY * offset)
        bench.feed(np.tile(given[70:90], (3, 1)))  # until the last one has surely ended

    rests(2, 0.0 * OFFSET)
    rests(1, 10.0 * OFFSET)
    rests(2, 0.0 * OFFSET)
    assert drift(bench).level == b'\x00', drift(bench).message
    rests(2, OFFSET)
    assert drift(bench).level == b'\x00', drift(bench).message
    rests(1, OFFSET)
    assert drift(bench).level == b'\x01', drift(bench).message
    words = 'the temperature is 38.2 °C, but the sensor was calibrated at 24.0 to 25.0 °C'
    assert words in drift(bench).message
    assert bench.call('self_test').passed != b'\x01'
    diagnostics.clear()

    def reported() -> bool:
        bench.send(bench.imu(GRAVITY * np.array([0.3, 0.3, 0.9])))
        return any(words in array.status[0].message for array in diagnostics)

    bench.spin(reported)
    status = diagnostics[-1].status[0]
    assert status.level == b'\x01'
    values = {value.key: value.value for value in status.values}
    assert 4.0 < float(values['changed by [mg]']) < 6.0
    assert values['rests since it changed'] == '3'
