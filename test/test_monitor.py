# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Rests of a calibrated sensor: lasting changes are reported, knocks and noise are not."""

from __future__ import annotations

from typing import Any

from accel_calib.calibrate import Calibration, fit_poses
from accel_calib.capture import capture
from accel_calib.compare import compared, Drift, monitor, rest_errors, status
from accel_calib.logs import read_recording
from accel_calib.units import units_of
from inside import DRIFT_MEMORY, Model, predict, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import data, random_directions, sensor

LEAST = 0.001
NOISE = 0.0003
UP = np.array([0.0, 0.6, 0.8])


def made(truth: Model, rng: np.random.Generator, *, poses: int = 12, noise: float = NOISE,
         **columns: Any) -> Calibration:
    table = simulate_poses(truth, spread_directions(poses), rng, noise_g=10.0 * noise, samples=100)
    return fit_poses(table.with_columns(**columns), units_of('g'), model='10')


def rested(before: Drift, calibration: Calibration, truth: Model, up: Any,
           rng: np.random.Generator, *, shift: Any = 0.0, noise: float = NOISE,
           temperature: float | None = None) -> Drift:
    """Return the state after one rest in each orientation, with shifted readings [g]."""
    mean = predict(truth, np.atleast_2d(np.asarray(up, float)), {}) + shift
    mean = mean + noise * rng.normal(size=mean.shape)
    context = {} if temperature is None else {'temperature': np.full(len(mean), temperature)}
    for rest in rest_errors(calibration, mean, np.full(mean.shape, noise), context):
        before = compared(before, rest, LEAST)
    return before


@pytest.mark.parametrize('noise', [0.0001, 0.0003, 0.0005])
@pytest.mark.parametrize('seed', range(5))
def test_shift_of_5_mg_is_reported_at_the_third_rest(noise: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = sensor(rng)
    calibration = made(truth, rng, noise=noise, poses=24)
    state = rested(monitor(calibration), calibration, truth, [UP] * 4, rng, noise=noise)
    state = rested(state, calibration, truth, [UP] * 2, rng, noise=noise, shift=0.005 * UP)
    assert state.change is None
    state = rested(state, calibration, truth, UP, rng, noise=noise, shift=0.005 * UP)
    assert state.change is not None
    assert state.change.error == pytest.approx(0.005, abs=4.0 * noise)
    assert (state.since, state.lasted) == (5, 3)


def test_noise_and_uncertainty_of_the_calibration_are_not_a_change() -> None:
    rng = np.random.default_rng(1)
    for directions in ([UP] * 800, random_directions(800, rng)):
        truth = sensor(rng)
        calibration = made(truth, rng)
        state = rested(monitor(calibration), calibration, truth, directions, rng)
        assert (state.change, state.count) == (None, 800)
        assert len(state.rests) == DRIFT_MEMORY


@pytest.mark.parametrize('knock', [-0.05, 0.004, 0.05, 0.2])
def test_one_or_two_knocks_are_not_a_change(knock: float) -> None:
    rng = np.random.default_rng(2)
    truth = sensor(rng)
    calibration = made(truth, rng)
    state = monitor(calibration)
    for count in (1, 2):
        state = rested(state, calibration, truth, [UP] * 6, rng)
        state = rested(state, calibration, truth, [UP] * count, rng, shift=knock * UP)
        assert state.change is None
    assert rested(state, calibration, truth, [UP] * 6, rng).change is None


def test_undetermined_parameters_are_not_a_change() -> None:
    rng = np.random.default_rng(3)
    truth = sensor(rng)
    near_faces = np.vstack([np.eye(3), -np.eye(3)] * 3) + 0.04 * rng.normal(size=(18, 3))
    near_faces /= np.linalg.norm(near_faces, axis=1, keepdims=True)
    calibration = fit_poses(simulate_poses(truth, near_faces, rng, noise_g=0.01), units_of('g'),
                            model='10')
    between = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    state = rested(monitor(calibration), calibration, truth, between, rng)
    assert state.stated > 0.003
    off = (3.0 * state.stated - state.rests[0].error) * between
    state = rested(monitor(calibration), calibration, truth, [between] * 50, rng, shift=off)
    assert state.change is None
    state = rested(monitor(calibration), calibration, truth, [between] * 50, rng, shift=4.0 * off)
    assert state.change is not None


def test_offset_and_gain_are_distinguished_where_the_attitudes_allow() -> None:
    rng = np.random.default_rng(4)
    truth = sensor(rng)
    calibration = made(truth, rng, poses=36)
    faces = np.vstack([np.eye(3), -np.eye(3)])
    moved = np.array([0.004, -0.006, 0.005])
    state = rested(monitor(calibration), calibration, truth, faces, rng, shift=moved)
    assert state.change is not None
    assert (state.change.kind, state.change.clear) == ('offset', True)
    np.testing.assert_allclose(state.change.shift, moved, atol=0.0008)
    assert 'the offset has changed by (+' in status(state)
    state = rested(monitor(calibration), calibration, truth, 1.006 * faces, rng)
    assert state.change is not None
    assert (state.change.kind, state.change.clear) == ('gain', True)
    assert 'the gain has changed by +0.6' in status(state)
    state = rested(monitor(calibration), calibration, truth, [UP] * 5, rng, shift=0.005 * UP)
    assert state.change is not None
    assert not state.change.clear
    assert 'the offset or the gain has changed' in status(state)


def test_change_clears_only_when_rests_clearly_read_1_g_again() -> None:
    rng = np.random.default_rng(5)
    truth = sensor(rng)
    calibration = made(truth, rng)
    z = np.array([0.0, 0.0, 1.0])
    state = rested(monitor(calibration), calibration, truth, [z] * 3, rng, shift=0.005 * z)
    aside = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] * 20
    state = rested(state, calibration, truth, aside, rng, shift=0.005 * z)
    assert state.change is not None
    assert state.lasted == 43
    state = rested(state, calibration, truth, [z], rng)
    assert state.change is not None
    state = rested(state, calibration, truth, [z] * 5, rng)
    assert state.change is not None
    state = rested(state, calibration, truth, [z] * 6, rng)
    assert (state.change, state.since, state.lasted) == (None, 0, 0)


def test_a_lasting_change_is_reported_once_and_with_one_cause() -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        truth = sensor(rng)
        state, reports, clear = monitor(calibration := made(truth, rng)), 0, set()
        for up in random_directions(60, rng):
            before = state.change
            state = rested(state, calibration, truth, [1.015 * up], rng)
            reports += (before is None) is not (state.change is None)
            if state.change is not None and state.change.clear:
                clear.add(state.change.kind)
        assert reports == 1
        assert clear <= {'gain'}


def test_sensor_that_repeats_worse_than_stated_is_not_reported_as_changed() -> None:
    rng = np.random.default_rng(6)
    truth = sensor(rng)
    calibration = made(truth, rng, noise=0.0001)
    state = monitor(calibration)
    reading = predict(truth, random_directions(1500, rng), {})
    reading = reading + 0.0003 * rng.normal(size=reading.shape)
    for rest in rest_errors(calibration, reading, np.full(reading.shape, 0.0001), {}):
        state = compared(state, rest, LEAST)
        assert state.change is None
    assert state.scatter == pytest.approx(2.5, rel=0.5)


def test_poses_that_repeat_badly_increase_the_stated_uncertainty() -> None:
    rng = np.random.default_rng(7)
    truth = sensor(rng)
    table = simulate_poses(truth, spread_directions(36), rng, noise_g=0.001)
    table = table.with_columns(reading=table.reading + 0.001 * rng.normal(size=(36, 3)))
    calibration = fit_poses(table, units_of('g'), model='10')
    state = monitor(calibration)
    assert np.sqrt(state.repeats) == pytest.approx(0.001, rel=0.3)
    assert rested(state, calibration, truth, UP, rng, noise=0.0001).stated > 0.0009


def test_changes_too_small_to_matter_are_ignored() -> None:
    rng = np.random.default_rng(8)
    truth = sensor(rng)
    calibration = made(truth, rng, poses=60, noise=0.0001)
    shift = 0.0008 * UP
    state = rested(monitor(calibration), calibration, truth, [UP] * 20, rng, shift=shift,
                   noise=0.0001)
    assert state.change is None
    state = rested(state, calibration, truth, [UP] * 20, rng, shift=2.0 * shift, noise=0.0001)
    assert state.change is not None


@pytest.mark.parametrize(('temperature', 'words'), [
    (38.2, 'the temperature is 38.2 °C, but the sensor was calibrated at 24.0 to 25.3 °C: capture '
           'poses at this temperature and call ~/refine'),
    (26.0, 'call ~/reset, capture poses and call ~/fit'),
    (None, 'call ~/reset, capture poses and call ~/fit')])
def test_advice_names_the_temperature_where_it_changed(
        temperature: float | None, words: str) -> None:
    rng = np.random.default_rng(9)
    truth = sensor(rng)
    calibration = made(truth, rng, temperature=np.linspace(24.0, 25.3, 12))
    state = rested(monitor(calibration), calibration, truth, [UP] * 4, rng,
                   temperature=temperature)
    assert 'stated uncertainty' in status(state)
    state = rested(state, calibration, truth, [UP] * 3, rng, shift=-0.005 * UP,
                   temperature=temperature)
    assert status(state).startswith('|a| at rest has differed by -')
    assert 'for 3 rests' in status(state)
    assert status(state).endswith(words)


@pytest.mark.parametrize(('name', 'unit'), [
    ('mpu9150_imu0', 'm/s2'), ('mpu9150_imu1', 'm/s2'), ('xsens_mti_counts', 'native')])
def test_real_rests_are_not_a_change_unless_shifted(name: str, unit: Any) -> None:
    units = units_of(unit)
    poses = capture(read_recording(data(f'{name}.csv')), units).poses
    others = np.arange(0, len(poses), 2)
    calibration = fit_poses(poses.take(others), units, model='10')
    rests = poses.take(np.delete(np.arange(len(poses)), others))
    force = calibration.correct(rests.reading)
    shift = calibration.predict(1.005 * force) - calibration.predict(force)
    state = monitor(calibration)
    for rest in rest_errors(calibration, rests.reading, rests.noise, {}):
        state = compared(state, rest, LEAST)
        assert state.change is None
    for rest in rest_errors(calibration, (rests.reading + shift)[:3], rests.noise[:3], {}):
        state = compared(state, rest, LEAST)
    assert state.change is not None
    assert state.lasted == 3
