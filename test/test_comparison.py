# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations, or rests, of one sensor agree, and those of a changed sensor do not."""

from dataclasses import replace
from typing import Any

from accel_calib.calibration import Calibration, fit_poses
from accel_calib.comparison import compare, compared, Drift, rest_errors, status
from accel_calib.effects import effect_named
from accel_calib.errors import InputError
from accel_calib.estimate import estimate
from accel_calib.logs import read_recording
from accel_calib.stillness import capture
from accel_calib.stored import OF_FILE
from accel_calib.table import Floats, Poses
from accel_calib.units import units_of
from inside import DRIFT_MEMORY, model_with, predict, simulate_poses, spread_directions, unit
import numpy as np
import pytest
from shared import attitudes, data, FACES, G, random_directions, sensor


def runs_of(model, rng, count, poses=12, name='10'):
    return [fit_poses(simulate_poses(model, attitudes(rng, poses), rng), G, model=name)
            for _ in range(count)]


@pytest.mark.parametrize(('models', 'sets', 'measured'), [
    (['10'] * 2, 20, True), (['10'] * 2, 20, False), (['10'] * 5, 10, True),
    (['10'] * 5, 10, False), (['9', '10'], 10, True), (['12', '10'], 10, True),
    (['12', '9'], 10, True)])
def test_runs_of_one_sensor_agree_also_with_models_of_other_axes(models, sets, measured):
    alarms = 0
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        model, runs = sensor(rng, 'offset', 'axis_gain', 'cross_axis', 'misalignment'), []
        for name in models:
            up = attitudes(rng, 12)
            known = {'reference': up} if name == '12' else {}
            poses = simulate_poses(model, up, rng, context=known)
            poses = poses if measured else Poses({'reading': poses.reading}, poses.row)
            runs.append(fit_poses(poses, G, model=name))
        found = compare(runs)
        alarms += not found.agree
        assert found.dof == 9 * (len(models) - 1)
    assert alarms <= 0.1 * sets


def test_what_limits_a_comparison_is_said():
    rng = np.random.default_rng(0)
    first, second = runs_of(sensor(rng), rng, 2)
    edited = replace(second, noted=(*second.noted, OF_FILE['edited']))
    assert 'the file of run 2 was edited by hand since it was stored' in compare(
        [first, edited]).notes
    alone = replace(first, name='ideal', method='prior')
    with pytest.raises(InputError, match='run 2 is an offset over temperature alone'):
        compare([first, alone])


def scattering_runs(seed, count, differs):
    """Return two runs whose poses scatter by 5 times their noise, which differs."""
    rng = np.random.default_rng(seed)
    model, runs = sensor(rng), []
    for _ in range(2):
        noise = 1e-4 * np.exp(differs * rng.normal(size=(count, 1)))
        poses = simulate_poses(model, attitudes(rng, count), rng, noise_g=1e-9)
        error = np.hypot(noise, 5e-4) * rng.normal(size=(count, 3))
        poses = poses.with_columns(reading=poses.reading + error,
                                   std=np.repeat(10.0 * noise, 3, axis=1))
        runs.append(fit_poses(poses, G, model='10'))
    return runs


@pytest.mark.parametrize(('count', 'differs'), [(14, 0.0), (20, 1.0)])
def test_runs_whose_poses_repeat_worse_than_their_samples_agree(count, differs):
    alarms = sum(not compare(scattering_runs(seed, count, differs)).agree for seed in range(20))
    assert alarms <= 2


def test_the_spread_of_twenty_runs_matches_their_uncertainty():
    rng = np.random.default_rng(1001)
    found = compare(runs_of(sensor(rng), rng, 20, 24))
    assert found.agree
    assert found.dof == 19 * 9
    assert found.chi2 == pytest.approx(found.dof, rel=0.4)
    assert np.mean([one.ratio for one in found.parameters]) == pytest.approx(1.0, abs=0.2)
    assert np.mean([run.rms_mg / run.expected_mg for run in found.runs]) == pytest.approx(
        1.0, abs=0.2)


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_a_change_of_1_mg_in_one_run_is_found_and_the_run_is_named(axis):
    rng = np.random.default_rng(axis)
    model = sensor(rng)
    runs = runs_of(model, rng, 5, 20)
    moved = model.values['offset'] + 1e-3 * np.eye(3)[axis]
    runs[3], = runs_of(model_with({**model.values, 'offset': moved}), rng, 1, 20)
    found = compare(runs)
    assert not found.agree
    assert found.outlier == 3
    assert min(found.runs, key=lambda run: run.p_value) is found.runs[3]
    assert abs(found.runs[3].direction[axis]) > 0.8
    assert found.runs[3].largest_mg == pytest.approx(1.0, abs=0.6)


@pytest.mark.parametrize(('column', 'effect', 'zero'), [
    ('temperature', 'offset_temperature', ()),
    ('motor_current', 'offset_covariate-motor_current', (25.0,))])
def test_runs_in_another_context_agree_when_they_correct_for_it(column, effect, zero):
    rng = np.random.default_rng(10)
    effects = {**sensor(rng).values, effect_named(effect): np.array([5e-4, -4e-4, 3e-4, *zero])}
    model = model_with(effects)

    def run(middle):
        warm = {column: rng.uniform(middle - 10.0, middle + 10.0, 30)}
        poses = simulate_poses(model, attitudes(rng, 30), rng, context=warm)
        plain = fit_poses(poses, G, model='10')
        fit = estimate(model, poses)
        return plain, replace(plain, model=fit.model, covariance=fit.covariance)

    cold, warm = run(15.0), run(35.0)
    assert compare([cold[1], warm[1]]).agree
    assert not compare([cold[0], warm[0]]).agree


LEAST, NOISE = 0.001, 0.0003
UP = np.array([0.0, 0.6, 0.8])


class Watched:
    """A random sensor with its calibration of 100 samples a pose, and the state of the monitor."""

    def __init__(self, seed: int, *, poses: int = 12, noise: float = NOISE,
                 directions: Floats | None = None, **columns: Any) -> None:
        self.rng, self.noise = np.random.default_rng(seed), noise
        self.truth = sensor(self.rng)
        up = spread_directions(poses) if directions is None else directions
        table = simulate_poses(self.truth, up, self.rng, noise_g=10.0 * noise, samples=100)
        self.calibration = fit_poses(table.with_columns(**columns), G, model='10')
        self.state = Drift(self.calibration)

    def rest(self, up: Any, shift: Any = 0.0, **context: float) -> Drift:
        """Return the state after one rest in each orientation, with shifted readings [g]."""
        mean = predict(self.truth, np.atleast_2d(np.asarray(up, float)), {}) + shift
        mean = mean + self.noise * self.rng.normal(size=mean.shape)
        self.state = after(self.state, self.calibration, mean, np.full(mean.shape, self.noise),
                           {key: np.full(len(mean), value) for key, value in context.items()})
        return self.state


def after(state: Drift, calibration: Calibration, reading: Floats, noise: Floats,
          context: Any) -> Drift:
    """Return the state after rests with these mean readings."""
    for rest in rest_errors(calibration, reading, noise, context):
        state = compared(state, rest, LEAST)
    return state


@pytest.mark.parametrize('noise', [0.0001, 0.0003, 0.0005])
@pytest.mark.parametrize('seed', range(5))
def test_shift_of_5_mg_is_reported_at_the_third_rest(noise: float, seed: int) -> None:
    watched = Watched(seed, noise=noise, poses=24)
    watched.rest([UP] * 4)
    assert watched.rest([UP] * 2, 0.005 * UP).change is None
    state = watched.rest(UP, 0.005 * UP)
    assert state.change is not None
    assert state.change.error == pytest.approx(0.005, abs=4.0 * noise)
    assert (state.since, state.lasted) == (5, 3)


@pytest.mark.parametrize('directions', [
    [UP] * 800, random_directions(800, np.random.default_rng(1))], ids=['one', 'all'])
def test_noise_and_uncertainty_of_the_calibration_are_not_a_change(directions: Any) -> None:
    state = Watched(1).rest(directions)
    assert (state.change, state.count, len(state.rests)) == (None, 800, DRIFT_MEMORY)


def test_undetermined_parameters_are_not_a_change() -> None:
    apart = 0.04 * np.random.default_rng(3).normal(size=(18, 3))
    watched = Watched(3, noise=0.001, directions=unit(np.tile(FACES, (3, 1)) + apart))
    fresh, between = watched.state, np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    state = watched.rest(between)
    assert state.stated > 0.003
    off = (3.0 * state.stated - state.rests[0].error) * between
    for times, changed in ((1.0, False), (4.0, True)):
        watched.state = fresh
        assert (watched.rest([between] * 50, times * off).change is not None) is changed


def test_offset_and_gain_are_distinguished_where_the_attitudes_allow() -> None:
    watched, moved = Watched(4, poses=36), np.array([0.004, -0.006, 0.005])
    fresh = watched.state
    for up, shift, true, words in (
            ([UP] * 5, 0.005 * UP, None, 'the offset or the gain has changed'),
            (1.006 * FACES, 0.0, [0.006], 'the gain has changed by +'),
            (FACES, moved, moved, 'the offset has changed by (+')):
        watched.state = fresh
        state = watched.rest(up, shift)
        assert state.change is not None
        assert state.change.clear is (true is not None)
        assert words in status(state)
        if true is not None:
            np.testing.assert_allclose(state.change.shift, true, atol=0.0008)


def test_change_clears_only_when_rests_clearly_read_1_g_again() -> None:
    watched, z = Watched(5), np.array([0.0, 0.0, 1.0])
    watched.rest([z] * 3, 0.005 * z)
    state = watched.rest([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]] * 20, 0.005 * z)
    assert state.change is not None
    assert state.lasted == 43
    for count in (1, 5):
        assert watched.rest([z] * count).change is not None
    state = watched.rest([z] * 6)
    assert (state.change, state.since, state.lasted) == (None, 0, 0)


@pytest.mark.parametrize('seed', range(5))
def test_a_lasting_change_is_reported_once_and_with_one_cause(seed: int) -> None:
    watched, reports, clear = Watched(seed), 0, set()
    for up in random_directions(60, watched.rng):
        before = watched.state.change
        change = watched.rest(1.015 * up).change
        reports += (before is None) is not (change is None)
        if change is not None and change.clear:
            clear.add(change.kind)
    assert reports == 1
    assert clear <= {'gain'}


def test_sensor_that_repeats_worse_than_stated_is_not_reported_as_changed() -> None:
    watched = Watched(6, noise=0.0001)
    for up in random_directions(1000, watched.rng):
        shift = np.sqrt(0.0003 ** 2 - 0.0001 ** 2) * watched.rng.normal(size=3)
        assert watched.rest(up, shift).change is None
    assert watched.state.scatter == pytest.approx(2.5, rel=0.5)


@pytest.mark.parametrize(('name', 'unit_name'), [
    ('mpu9150_imu0', 'm/s2'), ('mpu9150_imu1', 'm/s2'), ('xsens_mti_counts', 'native')])
def test_real_rests_are_not_a_change_unless_shifted(name: str, unit_name: Any) -> None:
    units = units_of(unit_name)
    poses = capture(read_recording(data(f'{name}.csv')), units).poses
    odd = np.arange(len(poses)) % 2 == 1
    calibration, rests = fit_poses(poses.take(~odd), units, model='10'), poses.take(odd)
    force = calibration.correct(rests.reading)
    shift = calibration.predict(1.005 * force) - calibration.predict(force)
    state = Drift(calibration)
    for k in range(len(rests)):
        state = after(state, calibration, rests.reading[k:k + 1], rests.noise[k:k + 1], {})
        assert state.change is None
    state = after(state, calibration, (rests.reading + shift)[:3], rests.noise[:3], {})
    assert state.change is not None
    assert state.lasted == 3
