# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations, or rests, of one sensor agree, and those of a changed sensor do not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from accel_calib.calibrate import Calibration, fit_poses, level
from accel_calib.capture import capture
from accel_calib.compare import compare, compared, Drift, history_of, monitor, rest_errors, status
from accel_calib.estimate import estimate
from accel_calib.logs import read_recording
from accel_calib.units import units_of
from inside import (
    DRIFT_MEMORY, Model, model_with, PARAMETER_NAMES, predict, rotation_free, rotation_from_rpy,
    Runs, simulate_poses, spread_directions)
import numpy as np
import pytest
from shared import data, random_directions, sensor

G = units_of('g')


def poses_of(model, rng, count=12, **settings):
    directions = spread_directions(count) @ rotation_from_rpy(*rng.uniform(-3, 3, 3)).T
    return simulate_poses(model, directions, rng, **settings)


def without_noise(poses):
    columns = {key: value for key, value in poses.columns.items() if key not in ('std', 'count')}
    return type(poses)(columns, poses.row)


def runs_of(model, rng, count, poses=12, name='10', **settings):
    return [fit_poses(poses_of(model, rng, poses, **settings), G, model=name)
            for _ in range(count)]


def with_offset(model, axis, change):
    offset = model.values['offset'].copy()
    offset[axis] += change
    return model_with({**model.values, 'offset': offset})


@pytest.mark.parametrize(('count', 'sets'), [(2, 30), (5, 10)])
@pytest.mark.parametrize('measured', [True, False])
def test_runs_of_one_sensor_agree(count, sets, measured):
    alarms = 0
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        model = sensor(rng)
        tables = [poses_of(model, rng) for _ in range(count)]
        tables = tables if measured else [without_noise(poses) for poses in tables]
        alarms += not compare([fit_poses(poses, G, model='10') for poses in tables]).agree
    assert alarms <= 0.1 * sets


def test_the_spread_of_twenty_runs_matches_their_uncertainty():
    rng = np.random.default_rng(1001)
    found = compare(runs_of(sensor(rng), rng, 20, 24))
    assert found.agree
    assert found.dof == 19 * 9
    assert found.chi2 == pytest.approx(found.dof, rel=0.4)
    assert tuple(one.name for one in found.parameters) == PARAMETER_NAMES
    assert np.mean([one.ratio for one in found.parameters]) == pytest.approx(1.0, abs=0.2)
    assert np.mean([run.rms_mg / run.expected_mg for run in found.runs]) == pytest.approx(
        1.0, abs=0.2)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_a_change_of_1_mg_in_one_run_is_found_and_the_run_is_named(axis):
    rng = np.random.default_rng(axis)
    model = sensor(rng)
    runs = runs_of(model, rng, 5, 20)
    runs[3] = runs_of(with_offset(model, axis, 1e-3), rng, 1, 20)[0]
    found = compare(runs)
    assert not found.agree
    assert found.outlier == 3
    assert min(found.runs, key=lambda run: run.p_value) is found.runs[3]
    assert abs(found.runs[3].direction[axis]) > 0.8
    assert found.runs[3].largest_mg == pytest.approx(1.0, abs=0.6)


def test_rotation_free_parameters_are_those_of_any_axes():
    rng = np.random.default_rng(3)
    poses = poses_of(sensor(rng), rng, 20)
    nine, ten = (fit_poses(poses, G, model=name) for name in ('9', '10'))
    turned = level(nine, poses.reading[4], 'ros')
    free = [rotation_free(run, {}, 1.0) for run in (nine, ten, turned)]
    for other in free[1:]:
        np.testing.assert_allclose(other.values, free[0].values, atol=1e-7)
    spread = [one.slope @ run.covariance @ one.slope.T
              for one, run in zip(free, (nine, ten), strict=False)]
    np.testing.assert_allclose(spread[0], spread[1], rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(spread[1])[:3]), ten.offset_sd, rtol=1e-6)


def test_slope_of_the_rotation_free_parameters_is_their_derivative():
    rng = np.random.default_rng(4)
    directions = spread_directions(12)
    poses = simulate_poses(sensor(rng, 'offset', 'axis_gain', 'cross_axis', 'misalignment'),
                           directions, rng, context={'reference': directions})
    run = fit_poses(poses, G)
    free = rotation_free(run, {}, 1.0)
    for k, column in enumerate(free.slope.T):
        values = run.model.vector.copy()
        values[k] += 1e-6
        sizes = np.cumsum([len(part) for part in run.model.values.values()])[:-1]
        moved = replace(run, model=Model(dict(zip(run.model.effects, np.split(values, sizes),
                                                  strict=True))))
        change = (rotation_free(moved, {}, 1.0).values - free.values) / 1e-6
        np.testing.assert_allclose(change, column, atol=1e-5)


@pytest.mark.parametrize(('first', 'second'), [('9', '10'), ('12', '10'), ('12', '9')])
def test_models_with_other_axes_agree(first, second):
    alarms = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        model = sensor(rng, 'offset', 'axis_gain', 'cross_axis', 'misalignment')
        runs = []
        for name in (first, second):
            directions = random_directions(20, rng)
            context = {'reference': directions} if name == '12' else {}
            poses = simulate_poses(model, directions, rng, context=context)
            runs.append(fit_poses(poses, G, model=name))
        found = compare(runs)
        alarms += not found.agree
        assert found.dof == 9
    assert alarms <= 1


def test_a_smaller_model_is_taken_as_exact_if_its_poses_determine_no_larger_one():
    rng = np.random.default_rng(16)
    model = sensor(rng, 'offset', 'gain')
    found = compare([*runs_of(model, rng, 1, 6, '4'), *runs_of(model, rng, 1, 24)])
    assert found.agree
    assert found.dof == 9
    assert any('the model of run 1 omits gain.xy, gain.xz, gain.yz' in note
               for note in found.notes)


@pytest.mark.parametrize('exact', [(), ((0, 1), (0, 2)), ((0, 1), (1, 1), (2, 1), (3, 1))])
def test_squared_differences_are_those_of_all_contrasts(exact):
    rng = np.random.default_rng(len(exact))
    count, size = 4, 3
    factors = rng.normal(size=(count, size, size)) * 1e-3
    for run, row in exact:
        factors[run, row] = 0.0
    covariances = factors @ np.swapaxes(factors, 1, 2)
    values = 1.0 + np.einsum('nij,nj->ni', factors, rng.normal(size=(count, size)))
    contrasts = np.kron(np.eye(count)[1:] - np.eye(count)[:1], np.eye(size))
    spread = np.zeros((count * size, count * size))
    for k, one in enumerate(covariances):
        spread[k * size:(k + 1) * size, k * size:(k + 1) * size] = one
    away, matrix = contrasts @ values.ravel(), contrasts @ spread @ contrasts.T
    chi2, rank = Runs(values, covariances, np.inf).squared
    assert rank == np.linalg.matrix_rank(matrix, hermitian=True)
    np.testing.assert_allclose(chi2, away @ np.linalg.pinv(matrix, hermitian=True) @ away,
                               rtol=1e-4)


def test_a_history_compares_each_pair_with_the_uncertainty_of_the_largest_model():
    rng = np.random.default_rng(5)
    small, large = model_with({'offset': [0.01, 0.0, 0.0], 'gain': 0.002}), sensor(rng)
    calibrations = [*runs_of(small, rng, 2, name='4'), *runs_of(large, rng, 1)]
    history = history_of(calibrations)
    pair = history.between(0, 1)
    assert pair.p_value == history.changes[0].comparison.p_value
    assert [each.stated_sd[0] > 0.0 for each in pair.parameters] == [True] * 9
    assert all('model 10' in note for note in pair.notes if 'omits' in note)
    assert compare(calibrations[:2]).parameters[6].stated_sd[0] == 0.0


def test_runs_at_other_temperatures_agree_when_they_correct_for_it():
    rng = np.random.default_rng(10)
    effects = {**sensor(rng).values, 'offset_temperature': np.array([5e-4, -4e-4, 3e-4])}
    model = model_with(effects)

    def run(middle):
        warm = {'temperature': rng.uniform(middle - 10.0, middle + 10.0, 30)}
        poses = poses_of(model, rng, 30, context=warm)
        plain = fit_poses(poses, G, model='10')
        fit = estimate(model, poses)
        return plain, replace(plain, model=fit.model, covariance=fit.covariance)

    cold, warm = run(15.0), run(35.0)
    assert compare([cold[1], warm[1]]).agree
    found = compare([cold[0], warm[0]])
    assert not found.agree
    assert any('taken at 1' in note and 'temperature' in note for note in found.notes)


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
