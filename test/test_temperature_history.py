# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The temperatures that a node remembers for a calibration that it gets later."""

from __future__ import annotations

from inside import Model, TemperatureHistory
import numpy as np
import pytest

KEY = 'temperature_of_offset'
START = 1.7e9
"""Stamps are seconds since 1970."""


def lagging(lag: float, *, of_sensor: bool) -> Model:
    """Return a model with a temperature that lags."""
    return Model({'offset_temperature': np.array([1e-3, 1e-3, 1e-3, lag, float(of_sensor)])})


def test_points_do_not_depend_on_the_batches() -> None:
    time = START + np.arange(0.0, 120.0, 0.5)
    warm = 20.0 + 0.25 * (time - START)
    known, later = lagging(30.0, of_sensor=True), lagging(20.0, of_sensor=True)
    found = []
    for batch in (1, 7, 40, len(time)):  # a recording that is played fast has long ones
        history = TemperatureHistory()
        history.follow(known)
        for begin in range(0, len(time), batch):
            history.add(time[begin:begin + batch], warm[begin:begin + batch])
        during = history.during(known, START + 60.0, START + 70.0)[KEY]
        stream = history.stream(later)
        assert stream is not None
        found.append([history.columns[KEY], *during, stream.value[KEY]])
    np.testing.assert_allclose(found, np.tile(found[0], (4, 1)), atol=1e-9)
    assert found[0][0] == pytest.approx(warm[-1] + 30.0 * 0.25, abs=0.2)


def test_history_starts_again_if_the_time_jumps_back_within_a_batch() -> None:
    jumped, again = TemperatureHistory(), TemperatureHistory()
    jumped.add(START + np.arange(100.0, 200.0), np.full(100, 50.0))
    jumped.add(START + np.array([200.0, 201.0, 0.0, 1.0, 2.0, 30.0]),
               np.array([50.0, 50.0, 20.0, 21.0, 22.0, 20.0]))
    again.add(START + np.array([0.0, 1.0, 2.0, 30.0]), np.array([20.0, 21.0, 22.0, 20.0]))
    found, expected = (each.stream(lagging(30.0, of_sensor=False)) for each in (jumped, again))
    assert found is not None
    assert expected is not None
    assert found.value == expected.value
    assert expected.value[KEY] == pytest.approx(21.0, abs=1.0)
