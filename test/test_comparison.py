# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Comparison: calibrations of one sensor agree, and those of a changed sensor do not."""

from dataclasses import replace

from accel_calib.calibrate import fit_poses, level
from accel_calib.compare import compare, history_of
from accel_calib.estimate import estimate
from accel_calib.units import units_of
from inside import (
    Model, model_with, PARAMETER_NAMES, rotation_free, rotation_from_rpy, Runs, simulate_poses,
    spread_directions)
import numpy as np
import pytest
from shared import random_directions, sensor

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
