# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Hidden effects are named and no others, on data of an independent generator."""

import re

import accel_calib as ac
from accel_calib.effects import between_steps
from accel_calib.logs import read_poses
from accel_calib.refinement import refine
import generator
from inside import LARGEST_SAMPLE, model_with, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import G, MPS2, random_directions, SENSOR, sensor

LADDER = ('offset', 'gain', 'axis_gain', 'cross_axis')
WITHOUT_NAME = {'offset_wander', 'empirical'}
"""Steps that say where a gap is, and not what causes it."""

ALIKE = {'quartic': {'quadratic', 'gain_asymmetry'},
         'gain_temperature_steep': {'gain_temperature'},
         'offset_temperature_knee': {'offset_temperature'}}
"""Known effects that have a part of the form of an effect outside of the catalogue."""


@pytest.fixture
def taken(tmp_path):
    """Return poses of a simulated sensor, read from a file, which a refinement cannot change."""
    def take(seed, hidden=None, **setup):
        made = generator.simulate(np.random.default_rng(seed), hidden or {},
                                  generator.Setup(**setup))
        generator.write_csv(tmp_path / 'poses.csv', made.columns)
        poses = read_poses(tmp_path / 'poses.csv')
        for values in poses.columns.values():
            values.flags.writeable = False
        return poses, made
    return take


def names(found):
    return [step.effect for step in found.steps if step.effect not in LADDER]


@pytest.mark.parametrize('effect', [name for name in generator.EFFECTS
                                    if name not in generator.OUTSIDE])
def test_each_hidden_effect_is_named_with_its_values(effect, taken):
    poses, made = taken(11, {effect: 5.0}, poses=60)
    found = refine(poses, MPS2, base='10')
    assert names(found) == [effect]
    step = next(step for step in found.steps if step.effect == effect)
    assert found.verdict == ('drifts' if effect == 'offset_wander' else 'explained')
    if effect != 'quantisation':  # a grid cannot be corrected
        assert step.gap_after_mg < 0.6 * step.gap_before_mg
        assert step.held_out_after_mg < 0.7 * step.held_out_before_mg
        assert (found.remaining_gap_mg < 1.5 * found.noise_floor_mg) is (
            effect != 'offset_wander')  # no calibration corrects it
    assert effect == 'offset_wander' or found.steps[-1].gap_after_mg == pytest.approx(
        found.remaining_gap_mg, rel=1e-6)
    assert step.p_value < 0.005
    assert any(letter.isdigit() for letter in step.where)
    truth, calibration = made.truth[effect], found.calibration
    for k, name in enumerate(calibration.parameters):
        owner, _, part = name.partition('.')
        if owner == effect and part in truth and part != 'instant':
            deviation = np.sqrt(calibration.covariance[k, k])
            assert abs(calibration.model.vector[k] - truth[part]) < 4.0 * deviation, name


@pytest.mark.parametrize(('seed', 'poses'), [(0, 24), (1, 24), (0, 60)])
def test_nothing_is_named_where_nothing_is_hidden(seed, poses, taken):
    found = refine(taken(seed, poses=poses)[0], MPS2)  # benchmarks/refine.py: in many sets
    assert (found.verdict, names(found)) == ('no_gap', [])


@pytest.mark.parametrize(('hidden', 'seed', 'base', 'setup'), [
    *(({effect: 1.5}, [1, seed], '10', {'poses': 24}) for effect, seed in (  # just a gap
        ('offset_drift', 5), ('cross_coupling', 4), ('gain_drift', 4), ('offset_wander', 2))),
    ({'quadratic': 6.0, 'offset_temperature': 6.0}, 0, '10', {}),
    ({'hysteresis': 6.0, 'supply_ratio': 6.0}, 2, '10', {}),
    *(({'supply_ratio': 100.0, 'offset_temperature': 3.0}, [5, seed], '10', {'noise_mg': 1.0})
      for seed in range(3)),
    *(({'quadratic': 10.0, 'cubic': 6.0}, [3, seed], 'auto', {}) for seed in range(3))])
def test_a_small_effect_and_both_of_two_effects_are_named_with_the_values_of_the_final_model(
        hidden, seed, base, setup, taken):
    found = refine(taken(seed, hidden, **{'poses': 60, **setup})[0], MPS2, base=base)
    assert sorted(names(found)) == sorted(hidden)
    assert len(hidden) == 1 or (found.verdict, found.one_curve) == ('explained', ())
    final = found.calibration
    values, deviations = (dict(zip(final.parameters, each, strict=True)) for each in (
        final.model.vector, np.sqrt(np.diag(final.covariance))))
    for step in found.steps:
        for part, value in step.parameters.items():
            assert value == values[f'{step.effect}.{part}']
        for part, deviation in step.parameters_sd.items():
            assert deviation == pytest.approx(deviations[f'{step.effect}.{part}'])


@pytest.mark.parametrize(('size', 'memory'), [
    (0.003, 0.0), (0.07, 0.0), (0.003, 0.6), (0.02, 0.6)])
@pytest.mark.parametrize('form', [0.0, 1.0])
def test_a_hysteresis_of_any_size_leaves_the_noise_in_new_poses(size, form, memory):
    hidden = {'hysteresis': [size, -size, 0.7 * size, form, memory]}
    poses, fresh = (ac.simulate({**SENSOR, **hidden}, seed=count, poses=count)
                    for count in (48, 200))
    found = ac.refine(poses, base='10')
    assert (found.verdict, names(found)) == ('explained', ['hysteresis'])
    assert ac.verify(fresh, found.calibration).rms_after_mg < 0.45  # the noise is 0.3


@pytest.mark.parametrize('lasting', [False, True])
def test_a_relaxation_after_turns_is_named_with_its_time_constant(lasting):
    rng, tables = np.random.default_rng(3), []
    for count in (50, 120):
        waits = rng.lognormal(3.4, 1.0, count)  # from turn to turn, about 30 s
        known = {'time': np.cumsum(waits)} if not lasting else {
            'time': np.cumsum(waits) - waits / 2.0, 'duration': waits}
        tables.append(ac.simulate({**SENSOR, 'creep': [0.02, -0.01, 0.02, 40.0]}, seed=count,
                                  poses=count, **known))
    found = ac.refine(tables[0], base='10')
    assert names(found) == ['creep']
    assert found.steps[0].parameters['tau'] == pytest.approx(40.0, abs=4.0)
    assert ac.verify(tables[1], found.calibration).rms_after_mg < 0.5


def stepped(seed, true, step=1.0, warming=lambda t: 12.0 * t):
    """Return 60 poses of a board that warms up beside a thermometer with steps [°C]."""
    share = np.sort(np.random.default_rng(seed).uniform(size=60))
    temperature = 20.3 + warming(share)
    poses = ac.simulate({**SENSOR, 'offset_temperature': true}, poses=60, seed=seed,
                        time=3600.0 * share, temperature=temperature)
    return poses.with_columns(temperature=step * np.round(temperature / step))


@pytest.mark.parametrize(('warming', 'step'), [
    (lambda t: 12.0 * t, 0.5), (lambda t: 12.0 * t, 1.0),
    (lambda t: 16.0 - 16.0 * np.exp(-3.0 * t), 0.5)])
@pytest.mark.parametrize('seed', range(2))
def test_a_thermometer_with_steps_beside_a_ramp_does_not_hide_the_cause(seed, step, warming):
    found = ac.refine(stepped(seed, [2e-3, -1e-3, 1e-3], step, warming), base='10')
    only, = found.steps
    assert found.verdict == 'explained'
    assert 'offset_temperature' in (only.effect, *only.rivals)
    assert found.remaining_gap_mg < 0.35  # the noise is 0.3, the steps are as much or more


def test_intervals_beside_a_thermometer_with_steps_contain_the_truth():
    """The errors of neighbouring poses are alike: they do not average out."""
    true, away = np.array([16e-3, -8e-3, 8e-3]), []
    for seed in range(6):
        step, = ac.refine(stepped(seed, true), base='10').steps
        if step.effect == 'offset_temperature':  # else a drift, which explains a ramp as well
            away += [(step.parameters[axis] - each) / step.parameters_sd[axis]
                     for axis, each in zip('xyz', true)]
    assert np.mean(np.abs(away) < 1.96) > 0.9


@pytest.mark.parametrize('other', ['humidity', 'temperature'])
def test_a_product_of_two_columns_is_named_and_stored(other, tmp_path):
    rng = np.random.default_rng(8)
    known = {'pressure': rng.normal(1000.0, 8.0, 160), other: rng.normal(30.0, 5.0, 160)}
    poses = ac.simulate(SENSOR, poses=160, seed=1, time=np.arange(160) * 60.0, **known)
    product = (known['pressure'] - 1000.0) * (known[other] - 30.0) / 40.0
    poses = poses.with_columns(reading=poses.reading + np.outer(product, [0.03, -0.02, 0.04]))
    taken, fresh = poses.take(slice(60)), poses.take(slice(60, None))
    found = ac.refine(taken, base='10')
    assert f'offset_covariate-{"*".join(sorted(["pressure", other]))}' in {
        str(step.name) for step in found.steps}
    found.calibration.save(tmp_path / 'c.yaml')
    stored = ac.load(tmp_path / 'c.yaml')
    assert stored.parameters == found.calibration.parameters
    assert ac.verify(fresh, stored).rms_after_mg < 0.45  # the noise is 0.3


@pytest.mark.parametrize('step', [0.0, 0.01, 0.5, 1.0, 5.0])
def test_a_temperature_in_steps_is_estimated_within_half_a_step(step):
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.0, 3600.0, 60))
    jumps, twice, later = rng.uniform(20.0, 40.0, 60), [10, 30, 30], [11, 31, 32]
    time[later], jumps[later] = time[twice] + [1e-9, 0.0, 1e-7], jumps[twice]  # at almost one time
    for true, left in ((20.0 + time / 500.0, 0.5), (jumps, 1.1)):
        stated = np.round(true / step) * step if step else true
        found = between_steps(time, stated)
        assert np.max(np.abs(found - stated)) <= step / 2.0
        if step in (0.5, 1.0):
            assert np.std(found - true) < left * np.std(stated - true)
        else:  # exact, or the temperatures of a chamber
            np.testing.assert_allclose(found, stated, atol=0.01)


@pytest.mark.parametrize(('effect', 'size', 'poses'), [
    *((effect, 6.0, 60) for effect in (
        'repeatability', 'quartic', 'dead_zone', 'gain_temperature_steep',
        'offset_temperature_knee', 'wander_1f')),
    ('quintic', 8.0, 60), ('oblique_hinge', 8.0, 200)])
def test_a_gap_that_no_effect_explains_is_described_or_unexplained(effect, size, poses, taken):
    found = refine(taken(3, {effect: size}, poses=poses)[0], MPS2, base='10')
    assert {*names(found)} - WITHOUT_NAME <= ALIKE.get(effect, set())
    if effect != 'wander_1f' or 'offset_wander' not in names(found):
        assert found.verdict in ('described', 'unexplained')
    if effect == 'quartic':  # at 1 g, quadratic and gain_asymmetry together imitate it
        assert (found.undecided, found.one_curve) == (True, ('quadratic', 'gain_asymmetry'))
    assert ('empirical' in names(found)) or found.verdict != 'described'
    for step in found.steps:  # each is significant beside the others
        assert step.p_value < 0.01
        assert step.probabilities[step.effect] == max(step.probabilities.values())


@pytest.mark.parametrize(('effect', 'columns'), [
    ('offset_temperature', ('temperature',)), ('supply_ratio', ('supply_voltage',)),
    ('lever_arm', ('gx', 'gy', 'gz'))])
def test_an_effect_whose_column_is_missing_gets_no_other_name(effect, columns, taken):
    found = refine(taken(4, {effect: 6.0}, poses=60, dropped=columns)[0], MPS2, base='10')
    assert {*names(found)} <= WITHOUT_NAME
    assert found.verdict != 'no_gap'
    assert (effect, ', '.join(columns)) in found.not_testable


@pytest.mark.parametrize(('unknown_mg', 'named'), [(1.0, ['quadratic']), (2.5, [])])
def test_effects_that_explain_a_small_part_of_a_gap_are_removed(unknown_mg, named):
    rng = np.random.default_rng(4)
    model = model_with({'offset': [0.02, -0.01, 0.03], 'quadratic': [0.005, -0.005, 0.005]})
    directions = random_directions(150, rng)
    poses = simulate_poses(model, directions, rng)
    unknown = directions * rng.normal(size=(150, 1)) * unknown_mg * 1e-3
    found = refine(poses.with_columns(reading=poses.reading + unknown), G, base='10')
    assert found.verdict == 'unexplained'
    assert names(found) == named


@pytest.mark.parametrize(('count', 'place'), [(300, 114), (3000, 1234)])
def test_a_step_is_found_among_more_instants_than_are_tried(count, place):
    rng = np.random.default_rng(0)
    time = 12.0 * np.arange(count)
    model = model_with({'offset_step': [0.006, -0.004, 0.008, time[place] + 2.0]})
    poses = simulate_poses(model, random_directions(count, rng), rng, noise_g=5e-4,
                           context={'time': time})
    found = refine(poses, G, base='10')
    assert names(found) == ['offset_step']
    assert time[place] < found.steps[-1].parameters['instant'] <= time[place + 1]
    assert not found.calibration.rejected


def test_known_orientation_shows_what_the_norm_does_not():
    rng, directions = np.random.default_rng(7), spread_directions(30)
    model = sensor(rng, 'offset', 'axis_gain', 'cross_axis', 'misalignment')
    poses = simulate_poses(model, directions, rng, context={'reference': directions})
    found = refine(poses, G, base='10')
    assert [step.effect for step in found.steps] == ['misalignment']
    assert refine(poses, G).verdict == 'no_gap'


def test_shared_orientation_shows_temperature_across_gravity():
    rng = np.random.default_rng(8)
    directions = np.repeat(random_directions(3, rng), 20, axis=0)
    temperature = 25.0 + 8.0 * np.sin(np.arange(60.0))
    model = model_with({'offset_temperature': np.array([5e-4, 4e-4, -4e-4])})
    poses = simulate_poses(model, directions, rng, context={
        'temperature': temperature, 'time': np.arange(60.0) * 3600.0,
        'orientation': np.repeat(np.arange(3.0), 20)})
    found = refine(poses, G)
    assert names(found) == ['offset_temperature']
    values = found.calibration.model.values['offset_temperature']
    np.testing.assert_allclose(values, [5e-4, 4e-4, -4e-4, 0.0, 0.0], atol=3e-5)  # without lag


def test_a_row_with_the_number_of_another_orientation_is_left_out_for_its_vector():
    rng, shared = np.random.default_rng(8), np.repeat(np.arange(8.0), 4)
    poses = simulate_poses(sensor(rng), spread_directions(8)[shared.astype(int)], rng, context={
        'orientation': np.where(np.arange(32) == 5, 6.0, shared)})
    found = {each.row: each.reason for each in refine(poses, G).calibration.rejected}
    away = re.search(r'the force differs by (\d+)\.', found[6])
    assert float(away[1]) > 100.0


def test_a_standard_deviation_that_is_too_small_is_no_drift(taken):
    tables = [taken(seed, poses=24)[0] for seed in range(6)]
    found = [refine(each.with_columns(std=0.03 * each['std']), MPS2) for each in tables]
    assert sum(each.verdict == 'drifts' for each in found) <= 1


def test_a_long_table_is_refined_from_a_sample_and_says_so(monkeypatch):
    monkeypatch.setattr(*LARGEST_SAMPLE, 400)
    rng = np.random.default_rng(4)
    truth = model_with({'offset': np.array([0.03, -0.02, 0.04]),
                        'quadratic': np.array([2e-3, -1e-3, 3e-3])})
    found = refine(simulate_poses(truth, random_directions(1000, rng), rng), G)
    assert 'quadratic' in names(found)
    assert '400 of 1000' in found.calibration.warnings[0]
    np.testing.assert_allclose(found.calibration.model.values['quadratic'],
                               truth.values['quadratic'], atol=5e-4)
