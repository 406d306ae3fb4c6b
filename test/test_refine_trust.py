# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A refinement is stored only if the poses determine it, and a stored base is used as stored."""

from dataclasses import replace
import json
import re

import accel_calib as ac
from accel_calib.calibration import fit_poses, verify
from accel_calib.effects import add_history
from accel_calib.findings import rate, short_verdict
from accel_calib.logs import read_recording, write_table
from accel_calib.refinement import refine
from accel_calib.stored import write_calibration
from faults.sample import sample
import generator
from inside import (
    Model, model_with, remarks_on, rotation_from_rpy, search_effects, simulate_poses,
    spread_directions)
import numpy as np
import pandas as pd
import pytest
from shared import changed, data, G, random_directions, run, run_json, sensor

OFFSET = np.array([0.02, -0.01, 0.03])
WARM = np.array([6e-4, -4e-4, 5e-4])
TCO = {'offset_temperature': WARM}


def with_effects(rng, **effects):
    return model_with({**sensor(rng).values, **effects})


def poses_of(model, rng, up, **context):
    """Return poses of a sensor, with these directions or with this number of random ones."""
    up = random_directions(up, rng) if isinstance(up, int) else up
    return simulate_poses(model, up, rng, context=context)


def near_up(rng, degrees):
    """Return 30 poses within an angle of up, of a sensor with an effect of temperature."""
    near = random_directions(400, rng)
    near = near[near[:, 2] > np.cos(np.radians(degrees))][:30]
    return poses_of(with_effects(rng, **TCO), rng, near, temperature=rng.uniform(15, 35, 30))


def table(seed, hidden, **setup):
    """Return the table of the independent simulator with hidden effects of these sizes."""
    made = generator.simulate(np.random.default_rng(seed), hidden, generator.Setup(**setup))
    return pd.DataFrame(made.columns)


def names(found):
    return [step.effect for step in found.steps]


@pytest.mark.parametrize(('seed', 'is_refused'), [(1, True), (3, False)])
def test_a_temperature_that_is_not_recorded_leaves_no_absurd_offset(seed, is_refused):
    rng = np.random.default_rng(seed)
    time = np.arange(30) * 7.0
    warm = 30.0 + 12.0 * np.sin(time / 60.0)
    model = with_effects(rng, **TCO)
    poses = poses_of(model, rng, 30, temperature=warm, time=time)
    found = refine(poses.without_columns('temperature'), G)
    assert bool(found.refusal) is is_refused
    if not is_refused:
        at_the_middle = model.linear_part[1] + 5.0 * WARM
        np.testing.assert_allclose(found.calibration.offset, at_the_middle, atol=0.02)
        assert found.remaining_gap_mg > 0.01


@pytest.mark.parametrize('seed', [2, 3])
def test_a_refinement_states_the_largest_error_in_an_uncovered_region(seed):
    rng = np.random.default_rng(seed)
    poses = near_up(rng, 70.0)
    found = refine(poses, G, base='10').calibration
    assert 'offset_temperature' in found.model.effects
    text, = (each.text for each in found.noted if each.kind == 'not_covered')
    up = random_directions(2000, rng)
    covariance = found.force_covariance(up, found.typical_context(len(up)))
    largest = np.sqrt(np.max(np.einsum('ni,nij,nj->n', up, covariance, up)))
    stated = float(re.search(r'up to (\d+) times that of a pose', text)[1])
    assert stated == pytest.approx(largest / np.median(poses.noise), abs=0.5)


@pytest.mark.parametrize('structure', [{'taken_back': ('cubic',)}, {'added': ('offset_wander',)}])
def test_structure_that_is_not_understood_remains_a_gap(structure):
    rng = np.random.default_rng(1)
    poses = poses_of(with_effects(rng), rng, 60)
    scattered = changed(poses, plus=0.002 * rng.normal(size=(60, 3)))
    found = search_effects(add_history(scattered, Model({})),
                           fit_poses(poses, G, model='10').model)
    kinds = [{each.kind for each in remarks_on(what, (), (), 0, unexplained=True)}
             for what in (replace(found, **structure), found)]
    assert ['gap' in kinds[0], 'scatter' in kinds[0], 'scatter' in kinds[1]] == [True, False, True]


@pytest.mark.parametrize('seed', [1, 4])
def test_the_steps_of_a_thermometer_are_named_and_no_walk_or_curve_instead(seed):
    rng, time = np.random.default_rng(seed), 30.0 * np.arange(60)
    warm = 25.0 + 3.0 * np.sin(4.0 * np.pi * time / time[-1]) + 0.1 * rng.normal(size=60)
    effects = {'offset': OFFSET, 'offset_temperature': [0.016, -0.011, 0.0064]}
    found = refine(simulate_poses(model_with(effects), random_directions(60, rng), rng, context={
        'time': time, 'temperature': warm}, noise_g=0.003).with_columns(
            temperature=np.round(warm)), G)
    assert not {'offset_wander', 'empirical'}.intersection(step.effect for step in found.steps)
    assert found.verdict == 'unexplained'
    cause, = (each for each in found.calibration.noted if each.kind == 'coarse')
    assert 'steps of 1 °C' in cause.text
    assert any(cause.advice in line for line in found.advice)
    assert not any('clamp' in line for line in found.advice)


def test_poses_that_scatter_alike_hide_nothing_though_their_noise_differs():
    found = [ac.refine(table([6, seed], {'repeatability': 5.0}, shaking=30.0), base='10')
             for seed in range(4)]
    assert {each.verdict for each in found} == {'unexplained'}
    assert all(each.remaining_gap_mg == pytest.approx(each.gap_mg, rel=1e-6)
               for each in found if not each.steps)
    assert sum(bool(each.steps) for each in found) <= 1  # by chance; more in benchmarks/refine.py


@pytest.mark.parametrize('poses', [24, 12])
def test_successive_rows_of_one_orientation_show_no_hysteresis(poses):
    for seed in range(2):
        rng = np.random.default_rng((seed, poses))
        directions = np.repeat(random_directions(poses, rng), 5, axis=0)
        found = refine(poses_of(with_effects(rng), rng, directions,
                                time=np.arange(len(directions)) * 10.0), G)
        assert found.verdict == 'no_gap'


@pytest.fixture(scope='module')
def stored():
    """Return a sensor and its calibration from 14 poses at about 20 °C."""
    rng = np.random.default_rng(21)
    model = with_effects(rng)
    poses = poses_of(model, rng, random_directions(14, rng), temperature=rng.uniform(18, 22, 14))
    return model, fit_poses(poses, G, date='2026-11-02T00:00:00')


@pytest.mark.parametrize('seed', [21, 37])
def test_a_gain_that_few_attitudes_leave_open_is_not_named_as_an_effect(seed):
    found = ac.refine(table(seed, {}, poses=64, repeats=8))
    assert found.verdict == 'unexplained'
    assert set(names(found)) <= {'axis_gain', 'cross_axis'}


def test_an_effect_that_shows_within_few_attitudes_is_named():
    rng = np.random.default_rng(1)
    attitudes = np.repeat(random_directions(8, rng), 8, axis=0)
    hot = np.tile(np.linspace(15.0, 35.0, 8), 8)
    found = refine(poses_of(with_effects(rng, **TCO), rng, attitudes, temperature=hot), G)
    assert names(found) == ['offset_temperature']


def test_the_gap_of_a_stored_calibration_is_that_of_the_file_and_another_sensor_is_told(stored):
    model, base = stored
    rng = np.random.default_rng(22)
    for truth in (model, with_effects(rng, offset=np.array([0.08, -0.06, 0.05]))):
        new = poses_of(truth, rng, 16, temperature=np.full(16, 20.0))
        found = refine(new, G, base=base)
        assert found.gap_mg == pytest.approx(verify(base, new).rms_after_mg)
        assert len(set(found.poses_g.row.tolist())) == len(found.poses_g)
        assert (found.verdict == 'no_gap') is (truth is model)
    assert 'another sensor' in found.advice[0]


def test_hot_poses_beside_a_cold_calibration_name_the_temperature(stored):
    model, base = stored
    rng = np.random.default_rng(24)
    offset = model.values['offset'] + 5.0 * WARM  # the reading at 20 °C remains as it was
    truth = model_with({**model.values, 'offset': offset, **TCO})
    hot = poses_of(truth, rng, 16, temperature=rng.uniform(48.0, 52.0, 16))
    found = refine(hot, G, base=base)
    assert names(found) == ['offset_temperature']
    np.testing.assert_allclose([found.steps[0].parameters[axis] for axis in 'xyz'], WARM,
                               atol=5e-5)
    assert found.gap_mg > 5.0


def test_what_one_warm_attitude_showed_is_kept_beside_new_poses_at_one_temperature():
    rng = np.random.default_rng(25)
    truth, cold = with_effects(rng, **TCO), np.full(20, 20.0)
    up = np.vstack([random_directions(20, rng), np.repeat([[0.0, 0.0, 1.0]], 20, axis=0)])
    old = poses_of(truth, rng, up, temperature=np.append(cold, np.linspace(20.0, 50.0, 20)),
                   orientation=np.minimum(np.arange(40.0), 20.0))
    base = refine(old, G, date='2026-11-02').calibration
    for _ in range(2):  # what is stored keeps it, too
        found = refine(poses_of(truth, rng, 20, temperature=cold), G, base=base)
        base = found.calibration
        assert (found.verdict, rate(base, refinement=found).name) == ('no_gap', 'GOOD')
        assert rate(base, refinement=found).next.rows in ((), *((row,) for row in range(1, 21)))
        np.testing.assert_allclose(base.model.values['offset_temperature'][:3], WARM, atol=5e-5)


def test_a_stored_calibration_with_an_effect_of_time_is_compared_as_stored():
    rng = np.random.default_rng(26)
    time = np.arange(60) * 60.0
    truth = with_effects(rng, warm_up=np.array([0.02, -0.02, 0.02, 0.0, 900.0]))
    old = poses_of(truth, rng, 60, time=time)
    base = refine(old, G, base='10', date='2026-11-02').calibration
    assert 'warm_up' in base.model.values
    later = poses_of(truth, rng, 20, time=time[-20:] + 4000.0)
    assert refine(later, G, base=base).verdict == 'no_gap'
    moved = refine(changed(later, plus=[0.02, 0.0, 0.0]), G, base=base)
    assert moved.gap_mg > 5.0
    assert names(moved) == ['offset']
    assert moved.steps[0].parameters['x'] == pytest.approx(0.02, abs=2e-3)


def test_a_file_that_was_edited_is_compared_with_its_own_poses(stored, tmp_path, capsys):
    _, base = stored
    path, table = tmp_path / 'calibration.yaml', tmp_path / 'poses.csv'
    write_calibration(path, base)
    write_table(table, base.poses)
    offset = next(line for line in path.read_text().splitlines() if 'offset: {what' in line)
    x = float(offset.split('x: ')[1].split(',')[0])
    path.write_text(path.read_text().replace(f'x: {x!r}', f'x: {x + 0.05!r}', 1))
    assert run('refine', table, '-c', path, '--units', 'g', '--json', '-') == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result['gap_mg'] > 20.0
    assert [step['effect'] for step in result['steps']] == ['offset']
    assert result['steps'][0]['parameters']['x'] == pytest.approx(-0.05, abs=2e-3)
    _, verified = run_json(capsys, 'verify', table, '-c', path, '--units', 'g')
    assert 'edited' in [each['kind'] for each in verified['findings']]


@pytest.mark.parametrize('seed', [3, 10, 11, 22])
def test_without_a_gap_the_calibration_is_that_of_the_fit(seed):
    rng = np.random.default_rng([31, seed])
    poses = poses_of(with_effects(rng), rng, 30)
    shift = rng.normal(size=3) * 2.2e-3 * rng.uniform(0.5, 1.5)
    poses = changed(poses, plus=shift * (np.arange(30) == 4)[:, np.newaxis])
    found, fitted = refine(poses, G), fit_poses(poses, G)
    assert found.verdict == 'no_gap'
    np.testing.assert_array_equal(found.calibration.model.vector, fitted.model.vector)
    assert found.calibration.rejected == fitted.rejected
    assert found.calibration.quality == fitted.quality
    assert found.disturbed_poses == tuple(pose.row for pose in fitted.rejected)
    assert found.remaining_gap_mg == pytest.approx(fitted.quality.rms_after_mg)


def test_a_stored_curve_over_the_rate_of_temperature_is_compared_with_new_poses():
    rng = np.random.default_rng(77)
    model, axes = with_effects(rng), np.array([0.005, -0.004, 0.003])

    def taken(count, offset=0.0):
        time = np.cumsum(rng.uniform(10.0, 40.0, count))
        warm = 25.0 + 8.0 * np.sin(time / 300.0 + rng.uniform(0.0, 6.0))
        poses = poses_of(model, rng, count, temperature=warm, time=time)
        slow = np.tanh(np.gradient(warm, time) / 0.008)
        return changed(poses, plus=np.outer(slow, axes) + offset)

    first = refine(taken(80), G)
    assert [step.variable for step in first.steps] == ['temperature_rate']
    assert refine(taken(40), G, base=first.calibration).verdict == 'no_gap'
    assert names(refine(taken(40, axes), G, base=first.calibration)) == ['offset']


def test_a_walk_beside_an_effect_is_a_step_of_its_own_which_no_calibration_corrects():
    rng = np.random.default_rng([41, 2])
    model = with_effects(rng, quadratic=np.array([0.012, -0.009, 0.01]))
    poses = poses_of(model, rng, 60, time=np.arange(60) * 30.0)
    found = refine(changed(poses, plus=np.cumsum(rng.normal(size=(60, 3)), axis=0) * 1.5e-3), G)
    assert (found.verdict, names(found)) == ('drifts', ['quadratic', 'offset_wander'])
    first, second = found.steps
    assert second.gap_before_mg == pytest.approx(first.gap_after_mg)
    # What the neighbours predict of a walk of 1.5 mg a pose, and not what is left behind it.
    assert 1.5 / np.sqrt(2.0) < second.gap_after_mg < 0.5 * second.held_out_before_mg
    assert found.remaining_gap_mg == pytest.approx(second.gap_before_mg)


@pytest.mark.parametrize('seed', [0, 1, 8])
def test_a_swing_of_what_is_not_recorded_is_not_explained_by_several_slow_effects(seed):
    rng = np.random.default_rng([28, seed])
    time = np.linspace(0.0, 3600.0, 60)
    warm = 25.0 + 15.0 * np.sin(time / 1500.0 + rng.uniform(0.0, 6.0))
    poses = poses_of(with_effects(rng), rng, 60, time=time, temperature=warm)
    swing = np.sin(time / 500.0 + rng.uniform(0.0, 6.0))
    found = refine(changed(poses, plus=0.004 * np.outer(swing, random_directions(1, rng)[0])), G)
    assert (found.verdict, names(found)) == ('described', ['empirical'])


@pytest.mark.parametrize(('seed', 'effects'), sample([
    *((seed, {}) for seed in (6, 12, 13, 18, 20, 21)), *((seed, TCO) for seed in (8, 13, 20))], 4))
def test_what_is_not_recorded_is_not_taken_for_a_temperature_that_resembles_it(seed, effects):
    rng = np.random.default_rng([284, seed])
    share = np.linspace(0.0, 1.0, 100)
    waves = 2.0 * np.pi * np.outer(share, rng.uniform(1.5, 5.0, 3)) + rng.uniform(0.0, 6.0, 3)
    poses = poses_of(with_effects(rng, **effects), rng, 100, time=3000.0 * share,
                     temperature=25.0 + 5.0 * np.sum(np.sin(waves), axis=1))
    swing = np.sin(2.0 * np.pi * share / rng.uniform(0.1, 0.3) + rng.uniform(0.0, 6.0))
    found = refine(changed(poses, plus=0.004 * np.outer(swing, random_directions(1, rng)[0])), G)
    assert found.verdict in ('described', 'unexplained')
    assert {*names(found)} - {'empirical', 'offset_wander'} == {*effects}


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('degrees', [0.3, 2.0])
def test_a_turned_mount_is_named_where_the_orientation_is_known_beside_gains(seed, degrees):
    rng = np.random.default_rng([89, seed])
    turn = rotation_from_rpy(*(np.radians(degrees) * random_directions(1, rng)[0]))
    model, unturned = with_effects(rng), np.eye(3)

    def taken(model, rotation, *, known=True):
        up = random_directions(30, rng)
        poses = poses_of(model, rng, up @ rotation.T)
        return poses.with_columns(reference=up) if known else poses

    base = fit_poses(taken(model, unturned), G)
    found = refine(taken(model, turn), G, base=base)
    assert (found.verdict, names(found)) == ('explained', ['misalignment'])
    np.testing.assert_allclose(found.calibration.gain, model.linear_part[0] @ turn, atol=1e-3)
    angles = [found.steps[0].parameters[axis] for axis in 'xyz']
    assert np.linalg.norm(angles) == pytest.approx(np.radians(degrees), rel=0.1)
    assert refine(taken(model, unturned), G, base=base).verdict == 'no_gap'
    stretched = Model({**model.values, 'axis_gain': model.values['axis_gain'] + [4e-3, -3e-3, 0]})
    both = names(refine(taken(stretched, turn), G, base=base))
    assert {'misalignment', 'axis_gain'} <= {*both}
    blind = fit_poses(taken(model, unturned, known=False), G)
    advice = refine(taken(model, turn, known=False), G, base=blind).advice
    assert '(ref_x, ref_y, ref_z)' in ' '.join(advice)


@pytest.mark.parametrize('noisier', [2.0, 4.0])
def test_new_poses_noisier_than_stated_are_no_walk_and_a_wave_in_them_is_found(noisier):
    for seed in range(4):
        rng = np.random.default_rng([99, seed])
        model = with_effects(rng)
        base = fit_poses(poses_of(model, rng, 60), G)
        noise = 0.003 / 10.0  # of the mean of a pose [g]
        new = poses_of(model, rng, 40, time=np.arange(40) * 20.0)
        new = changed(new, plus=rng.normal(size=(40, 3)) * noise * np.sqrt(noisier ** 2 - 1.0))
        found = refine(new, G, base=base)
        assert found.steps == ()
        assert found.verdict != 'explained'
    wave = np.outer(np.sin(new['time'] / 150.0), [0.006, -0.005, 0.004])
    found = refine(changed(new, plus=wave), G, base=base)
    assert found.steps
    assert found.remaining_gap_mg < 0.5 * found.gap_mg


@pytest.mark.parametrize(('hidden', 'size', 'poses', 'seed'), [
    ('cubic', 5.0, 16, (9, 1013, 1, 0)), ('offset_drift', 5.0, 16, (9, 1013, 8, 1)),
    ('temperature_rate', 3.0, 16, (8, 13, 17, 0)), ('offset_wander', 3.0, 60, (9, 0, 10, 0))])
def test_each_step_is_the_most_probable_of_its_list_and_lowers_the_held_out_residual(
        hidden, size, poses, seed):
    found = ac.refine(table(seed, {hidden: size}, poses=poses), base='10')
    assert found.steps
    for step in found.steps:
        assert next(iter(step.probabilities)) == step.effect
        assert step.p_value < 0.05
        assert step.held_out_after_mg < step.held_out_before_mg


@pytest.mark.parametrize('seed', range(3))
def test_effects_of_twelve_poses_are_named_and_not_used(seed):
    rng = np.random.default_rng(seed)
    poses = simulate_poses(model_with({'offset': OFFSET, 'offset_temperature': 4.0 * WARM}),
                           spread_directions(12), rng, noise_g=0.001,
                           context={'temperature': rng.uniform(15.0, 35.0, 12)})
    found = refine(poses, G, base='7')
    assert (len(names(found)), found.verdict) == (1, 'unexplained')
    assert (len(found.refusal), found.undecided, found.steps[0].parameters_sd) == (2, True, {})
    assert short_verdict(found) == 'the refined calibration is refused'


def test_samples_of_a_board_that_hardly_turns_give_it_no_absurd_gain():
    samples = read_recording(data('sensehat_lsm9ds1_temperature.csv'))
    found = refine(ac.Poses(samples.columns, samples.row).take(np.arange(0, len(samples), 200)), G,
                   base='ideal')
    gains = np.linalg.svd(found.calibration.model.linear_part[0], compute_uv=False)
    assert 0.5 < gains[-1] <= gains[0] < 2.0
    assert np.linalg.norm(found.calibration.offset) < 0.3


def test_an_effect_that_the_stored_fit_has_absorbed_is_found_beside_its_changes():
    poses = table(9, {'offset_temperature': 60.0}, poses=27)
    found = ac.refine(poses, base=ac.fit(poses[:15], model='10'))
    assert found.verdict == 'explained'
    assert {step.effect for step in found.steps} == {
        'offset_temperature', 'offset', 'axis_gain', 'cross_axis'}


@pytest.mark.parametrize('seed', [0, 3, 6])
def test_few_changes_are_found_although_all_changes_at_once_are_nearly_as_good(seed):
    rng = np.random.default_rng([5, seed])
    model = with_effects(rng)
    base = fit_poses(poses_of(model, rng, 24), G, model='10')
    # New poses alone show a cubic mostly as a gain.
    changed = Model({**model.values, 'offset': model.values['offset'] + [0.02, -0.01, 0.03],
                     'cubic': np.array([2e-3, -1e-3, 1e-3])})
    found = refine(poses_of(changed, rng, 30), G, base=base)
    assert (found.verdict, {*names(found)}) == ('explained', {'offset', 'axis_gain'})


@pytest.mark.parametrize('count', [12, 24])
def test_the_change_of_each_axis_is_stated_with_its_own_uncertainty_and_date(count):
    away = []
    for seed in range(8):
        rng = np.random.default_rng([77, seed])
        model, moved = with_effects(rng), rng.normal(size=3) * 0.003
        base = fit_poses(poses_of(model, rng, 30), G, date='2026-11-02T00:00:00')
        truth = Model({**model.values, 'offset': model.values['offset'] + moved})
        found = refine(poses_of(truth, rng, count), G, base=base)
        assert names(found) == ['offset']
        np.testing.assert_allclose(found.calibration.offset, truth.linear_part[1], atol=1e-3)
        step, = found.steps
        words = re.search(r'has changed by \((.*)\) mg since 2026-11-02', step.where)[1]
        np.testing.assert_allclose(
            [float(change) for each in words.split(', ') for change in each.split(' ± ')],
            [1e3 * part[axis] for axis in 'xyz' for part in (step.parameters, step.parameters_sd)],
            rtol=0.05, atol=0.01)
        away += [(step.parameters[axis] - change) / step.parameters_sd[axis]
                 for axis, change in zip('xyz', moved)]
    assert 0.7 < np.sqrt(np.mean(np.square(away))) < 1.4  # chi² of 24 values: 0.72 to 1.28 at 95 %
    assert np.max(np.abs(away)) < 4.0


def test_a_curve_that_explains_outliers_is_placed_among_all_poses():
    found = ac.refine(table((5, 23, 6, 0), {'gain_temperature_quadratic': 8.0}), base='10')
    assert not found.disturbed_poses
    assert 'temperature' in found.steps[-1].where
