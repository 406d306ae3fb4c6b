# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The node finds an effect that its calibration lacks, and corrects it."""

from collections.abc import Callable
import time
from typing import Any

from accel_calib.files import read_calibration
from accel_calib.sphere import spread_directions
import numpy as np
import pytest
from sensor_msgs.msg import Imu, Temperature
from visualization_msgs.msg import MarkerArray

Readings = Callable[..., Any]
POSES = 26
MOVES = np.array([0.002, -0.0015, 0.001])
"""Offset per °C [g]."""


def warmed(bench: Any, readings: Readings, publisher: Any) -> None:
    """Publish poses, each at another temperature."""
    for k, direction in enumerate(spread_directions(POSES)):
        temperature = 25.0 + 12.0 * np.sin(2.1 * k)
        published(bench, publisher, temperature, 0.05 if k else 1.0)  # until both have met
        shift = MOVES * (temperature - 25.0) * 9.80665
        bench.feed(readings([direction], dwell=1.8) + shift)


def published(bench: Any, publisher: Any, temperature: float, seconds: float) -> None:
    """Publish a temperature repeatedly."""
    ends = time.monotonic() + seconds

    def late() -> bool:
        publisher.publish(Temperature(temperature=temperature))
        return time.monotonic() > ends

    bench.spin(late)


def test_temperature_effect_is_named_stored_and_corrected(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    publisher = bench.node.create_publisher(Temperature, 'temperature', 10)
    bench.calibrator(sensor='arm', passthrough=True)
    bench.spin(lambda: publisher.get_subscription_count() > 0)
    warmed(bench, readings, publisher)
    bench.spin(lambda: sum(m.ns == 'poses' for m in markers[-1].markers) >= POSES - 1)
    answer = bench.call('refine')
    assert answer.success, answer.message
    assert 'offset_temperature' in answer.message
    found = read_calibration(bench.home / 'accel_calib' / 'arm.yaml')
    np.testing.assert_allclose(found.model.values['offset_temperature'], MOVES, atol=2e-4)

    for temperature in (15.0, 35.0):
        published(bench, publisher, temperature, 0.2)
        shift = MOVES * (temperature - 25.0) * 9.80665
        bench.echo([bench.imu(reading + shift) for reading in readings([[0, 0, 1]])[:40]],
                   corrected)
        up = np.mean([[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z]
                      for m in corrected], axis=0)
        assert np.linalg.norm(up) == pytest.approx(9.80665, abs=0.02)


def test_refinement_of_too_few_poses_is_refused(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    bench.calibrator(sensor='arm', passthrough=True)
    bench.feed(readings([[0, 0, 1], [1, 0, 0]]))
    bench.spin(lambda: markers and sum(m.ns == 'poses' for m in markers[-1].markers) >= 2)
    answer = bench.call('refine')
    assert not answer.success
    assert 'expected at least 4' in answer.message
