# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What is refused, what is found, and what to do next, the same on all surfaces.

Bad rows, absurd numbers and edited files never lead to a wrong calibration.

"""

from dataclasses import replace
import json
from pathlib import Path
import shlex

import accel_calib as ac
from accel_calib.calibration import fit_poses, gated, refused as calibration_refused, Rejected
from accel_calib.errors import RefusedFitError
from accel_calib.finding import Finding, KINDS, NextStep, rated, without
from accel_calib.findings import Expected, GOOD_MG, rate, rate_comparison, rate_verification
from accel_calib.logs import write_table
from accel_calib.stored import OF_FILE, read_calibration
from inside import (
    format_calibration, main, Model, model_with, parse_calibration, simulate_poses,
    spread_directions)
import numpy as np
import pytest
from shared import changed, error_mg, FACES, G, MPS2, poses_of, random_directions, sensor, table

TIME = 20.0 * np.arange(30)
WARM = 27.0 + 3.5 * np.sin(TIME / 60.0)
COMMON = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.02, 0.015],
          'cross_axis': [0.006, -0.004, 0.005]}
HIDDEN = {**COMMON, 'quadratic': [0.03, -0.02, 0.02]}


def simulated(effects=COMMON, **options):
    return ac.simulate(effects, **options)


def test_findings_are_ranked_by_level_and_then_by_kind():
    first, other, *_, last = KINDS
    note, usable = Finding(first, 'a'), Finding(last, 'b', level='USABLE')
    better, bad = Finding(other, 'c', level='USABLE'), Finding(last, 'd', level='BAD')
    ranks = rated([note, usable, better, bad], '', '', NextStep('done', '')).findings
    assert ranks == (bad, better, usable, note)
    assert without([note, bad], first) == (bad,)


def test_findings_and_steps_have_a_listed_kind_and_a_finding_has_the_step_of_its_kind():
    assert Finding('flat_pose', 'turned', 'turn it').next == NextStep('level', 'turn it')
    assert Finding('error', 'large', 'look for it', step='refine').next.kind == 'refine'
    with pytest.raises(ValueError, match="'surprise'"):
        Finding('surprise', 'what')
    with pytest.raises(ValueError, match="'wait'"):
        NextStep('wait', 'what')


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(('poses', 'noise'), [(12, 0.001), (18, 0.01), (40, 0.02)])
def test_the_error_of_a_good_calibration_is_below_the_stated_one(poses, noise, seed):
    up = np.random.default_rng(seed).permutation(spread_directions(poses))
    calibration = ac.fit(simulated(directions=up, noise=noise, seed=seed), model='10')
    rating = rate(calibration)
    assert rating.name == 'GOOD', rating
    stated = Expected(calibration).error_mg
    assert error_mg(calibration, model_with(COMMON)) < min(1.2 * stated, GOOD_MG)


def test_the_stated_error_is_a_bound_where_the_noise_is_not_known():
    below = []
    for seed in range(60):
        up = random_directions(13, np.random.default_rng(seed))
        poses = simulated(directions=up, noise=0.02, seed=100 + seed)
        calibration = ac.fit(poses.without_columns('std', 'count'), model='10')
        if not calibration.rejected:
            error = error_mg(calibration, model_with(COMMON))
            below.append(error < Expected(calibration).error_mg)
    assert np.mean(below) > 0.95


def test_a_calibration_that_holds_at_a_temperature_is_not_said_to_end_before_it():
    calibration = ac.fit(simulated(temperature=[26.0, 27.0]), flat=1)
    poses = simulated(temperature=[30.0, 30.4], seed=3)
    rating = rate_verification(ac.verify(poses, calibration), calibration, poses)
    assert rating.next.text.endswith('fit again when the temperature leaves 26..31 °C')


UP = spread_directions(60)
CORNERS = np.repeat([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], 2, axis=0) / 3.0**0.5
SLIGHT = {**COMMON, 'quadratic': [0.0015, -0.001, 0.001]}
RATED = {
    'the poses do not determine the cross-axis gain': (
        simulated(directions=np.vstack([FACES, FACES[:3]]) + 1e-3), 'auto', 'USABLE', ''),
    'nothing checks the model in the other half of the sphere': (
        simulated(directions=UP[UP[:, 2] > 0.0], noise=0.001), 'auto', 'USABLE', 'not_covered'),
    'a residual far above the noise and below 1 mg': (
        simulated(SLIGHT, poses=30, noise=1e-4), 'auto', 'GOOD', ''),
    'one knocked pose': (changed(simulated(poses=24), 6, plus=0.3), 'auto', 'GOOD', ''),
    'many knocked poses': (
        changed(simulated(poses=24), [1, 6, 8, 13, 19],
                plus=[[0.3], [-0.25], [0.4], [0.2], [-0.35]]), 'auto', 'USABLE', 'outliers'),
    'worse than none': (simulated({'offset': [0.001, -0.001, 0.0005]}, poses=11, noise=0.25,
                                  seed=2), '10', 'BAD', 'no_gain'),
    'right before': (simulated({'offset': [1e-4, 0.0, -1e-4]}, poses=12, noise=0.001), 'auto',
                     'GOOD', ''),
    'right before, and noisy': (simulated({'offset': [1e-4, 0.0, -1e-4]}, poses=12, noise=0.02),
                                'auto', 'USABLE', ''),
    'each orientation twice': (simulated({'offset': COMMON['offset']}, directions=CORNERS), '4',
                               'USABLE', 'not_covered'),
    'each orientation twice, which differ': (
        changed(simulated({'offset': COMMON['offset']}, directions=CORNERS), [0, 2], plus=0.04),
        '4', 'BAD', 'no_check')}
"""Poses, the model of their fit, and its rating, perhaps with the first finding."""


@pytest.mark.parametrize('case', RATED)
def test_a_fit_is_rated_by_what_its_poses_show(case):
    poses, model, name, kind = RATED[case]
    rating = rate(ac.fit(poses, model=model))
    assert rating.name == name
    assert not kind or rating.findings[0].kind == kind


@pytest.mark.parametrize(('kind', 'figures', 'outliers'), [
    ('held_out', {'held_out_rms_mg': 31.0}, ()),
    ('far_off', {'rms_after_mg': 12.0, 'noise_floor_mg': 0.3}, (3, 4, 5)),
    ('too_exact', {'rms_after_mg': 0.0, 'noise_floor_mg': 0.3}, ())])
def test_a_figure_that_no_useful_calibration_has_makes_it_bad(kind, figures, outliers):
    calibration = ac.fit(simulated())
    rating = rate(replace(
        calibration, quality=replace(calibration.quality, **figures),
        rejected=tuple(Rejected(row, 'outlier', 'outlier') for row in outliers)))
    assert rating.name == 'BAD'
    assert kind in [each.kind for each in rating.findings if each.level == 'BAD']


@pytest.mark.parametrize(('effects', 'context'), [
    ({'quadratic': [0.03, -0.02, 0.02]}, {}),
    ({'offset_temperature': [2e-3, -1e-3, 1e-3]}, {'temperature': WARM, 'time': TIME})])
def test_a_hidden_effect_makes_a_fit_usable_and_its_refinement_good(effects, context):
    table = simulated({**COMMON, **effects}, poses=30, **context)
    rating = rate(ac.fit(table))
    assert (rating.name, rating.next.kind) == ('USABLE', 'refine')
    result = ac.refine(table)
    assert [step.effect for step in result.steps] == list(effects)
    assert rate(result.calibration, refinement=result).name == 'GOOD'
    base = rate(ac.fit(table), refinement=result)
    assert (base.name, base.next.kind) == ('USABLE', 'refine')
    assert next(iter(effects)) in base.reason


def test_a_fit_beside_a_refused_refinement_is_not_bad():
    table = simulated({'offset': [0.02, 0.0, 0.0], 'quadratic': [0.005, 0.004, -0.005]}, poses=60)
    result = ac.refine(table)
    assert result.steps
    refused = replace(result, calibration=calibration_refused(
        result.calibration, 'the poses do not determine it', 'take more poses'))
    rating = rate(ac.fit(table), refinement=refused)
    assert rating.name == 'USABLE'
    assert rating.next == NextStep('poses', 'take more poses')
    assert rate(refused.calibration, refinement=refused).name == 'BAD'
    assert refused.calibration.rating.name == 'BAD'
    with pytest.raises(RefusedFitError, match='do not determine it'):
        refused.calibration.save('refused.yaml')


NEAR = FACES[[0]] + 0.1 * random_directions(12, np.random.default_rng(3))


@pytest.mark.parametrize(('fitted', 'new', 'expected'), [
    ({'poses': 24}, {'effects': {'offset': [-0.01, 0.005, -0.005]}, 'poses': 12}, 'BAD'),
    ({'poses': 24}, {'poses': 12, 'noise': 0.1}, 'USABLE'),
    ({'directions': FACES}, {'directions': NEAR}, 'USABLE')])
def test_poses_of_another_sensor_are_bad_and_noisy_or_similar_ones_do_not_verify(
        fitted, new, expected):
    calibration, poses = ac.fit(simulated(**fitted)), simulated(**new, seed=9)
    rating = rate_verification(ac.verify(poses, calibration), calibration, poses)
    assert rating.name == expected


@pytest.mark.parametrize(('offset', 'options', 'agree', 'expected'), [
    (0.03, {'poses': 24}, True, 'GOOD'), (0.032, {'poses': 24}, False, 'USABLE'),
    (0.06, {'poses': 24}, False, 'BAD'), (0.03, {'poses': 10, 'noise': 0.15}, True, 'USABLE')])
def test_calibrations_that_differ_or_are_too_uncertain_to_differ_are_not_good(
        offset, options, agree, expected):
    comparison = ac.compare([
        ac.fit(simulated({**COMMON, 'offset': [each, -0.02, 0.04]}, seed=seed, **options))
        for seed, each in ((1, 0.03), (2, offset))])
    assert (comparison.agree, rate_comparison(comparison).name) == (agree, expected)


def written(path, effects, poses=40):
    write_table(path, simulated(effects, poses=poses, units='g', seed=5))
    return path


def result_of(line, folder):
    target = folder / 'result.json'
    assert main([*shlex.split(line)[1:], '--json', str(target)]) == 0, line
    return json.loads(target.read_text(encoding='utf-8'))


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize(('effects', 'kinds'), [
    (COMMON, ['level', 'done']), (HIDDEN, ['refine', 'level', 'done'])])
@pytest.mark.parametrize('command', ['fit', 'calibrate --no-refine'])
def test_the_commands_of_the_next_steps_lead_to_the_end(effects, kinds, command, tmp_path):
    poses, stored = written(tmp_path / 'my poses.csv', effects), tmp_path / 'c.yaml'
    line, seen = f"accel-calib {command} '{poses}' -o {stored} --units g", []
    while line:
        step = result_of(line.replace('ROW', '1'), tmp_path)['next']
        assert set(step) == {'kind', 'text', 'command'}
        seen.append(step['kind'])
        line = step['command']
    assert seen == kinds
    calibration = ac.load(stored)
    assert calibration.is_levelled
    assert calibration.rating.name == 'GOOD'
    assert set(calibration.model.effects) >= set(effects)


@pytest.mark.parametrize(('effects', 'poses'), [(COMMON, 40), (HIDDEN, 40), (COMMON, 8)])
def test_the_same_poses_have_the_same_verdict_and_next_step_everywhere(effects, poses, tmp_path):
    table, stored = written(tmp_path / 'poses.csv', effects, poses), tmp_path / 'c.yaml'
    keys = ('rating', 'rating_reason', 'findings')
    fit, calibrate = (result_of(f'accel-calib {command} {table} -o {stored} --units g', tmp_path)
                      for command in ('fit', 'calibrate --no-refine'))
    assert [fit[key] for key in keys] == [calibrate[key] for key in keys]
    for key in ('kind', 'text'):
        assert fit['next'][key] == calibrate['next'][key]
    rating = ac.fit(table, units='g').rating
    assert (rating.name, rating.reason) == (fit['rating'], fit['rating_reason'])
    assert (rating.next.kind, rating.next.text) == (fit['next']['kind'], fit['next']['text'])
    page = (tmp_path / 'c.html').read_text(encoding='utf-8')
    assert rating.next.text.replace("'", '&#x27;')[1:] in page


# The gate: bad rows, absurd numbers and edited files


STORED, TWELVE = Path(__file__).parent / 'data', table('twelve_readings')


@pytest.mark.parametrize('row', [
    (0.0, 0.0, 0.0), *((7.6, value, 6.2) for value in (1e150, -1e300, 1e20, 1e6))])
@pytest.mark.parametrize('model', ['auto', '4', '7', '9', '10'])
def test_an_impossible_reading_is_left_out_and_named(model, row):
    expected = fit_poses(poses_of(TWELVE), MPS2, model=model)
    found = fit_poses(poses_of([*TWELVE, row]), MPS2, model=model)
    assert [each.row for each in found.rejected] == [13]
    np.testing.assert_allclose(found.offset, expected.offset, rtol=1e-6)
    np.testing.assert_allclose(found.gain, expected.gain, rtol=1e-6)


@pytest.fixture(scope='module')
def calibration():
    poses = simulate_poses(sensor(np.random.default_rng(5)), spread_directions(14),
                           np.random.default_rng(6))
    return fit_poses(poses, G, model='10', sensor='imu')


@pytest.mark.parametrize('values', table('overflowing_effects'))
def test_values_that_overflow_and_a_residual_that_is_no_number_are_refused(values, calibration):
    model = Model({name: np.array(part) for name, part in {
        **calibration.model.values, **values}.items()})
    covariance = np.zeros((len(model.vector),) * 2)
    with pytest.raises(RefusedFitError):
        gated(replace(calibration, model=model, covariance=covariance))
    with pytest.raises(RefusedFitError, match='the residual is nan mg'):
        gated(replace(calibration, quality=replace(calibration.quality, rms_after_mg=np.nan)))


def test_a_file_edited_by_hand_is_used_with_a_warning_and_its_effects_count(calibration):
    text, matrix = format_calibration(calibration), calibration.matrix
    for old, new, kinds in (
            ('sensor: imu', 'sensor: imu', []), ('sensor: imu', 'sensor: other', ['edited']),
            (f'[{matrix[0, 0]!s},', '[1.5,', ['edited', 'correction_in_file'])):
        assert old in text
        found = parse_calibration(text.replace(old, new, 1), 'x.yaml')
        assert [each.kind for each in found.noted if each.kind in OF_FILE] == kinds
        np.testing.assert_array_equal(found.matrix, matrix)
        assert found.sensor == ('other' if 'other' in new else 'imu')
        again = parse_calibration(format_calibration(found), 'x.yaml')
        assert not {each.kind for each in again.noted} & {*OF_FILE}


def test_stored_calibrations_still_load_and_correct_as_they_did():
    corrected = json.loads((STORED / 'calibration_corrected.json').read_text())
    assert len(corrected) == 4
    context = {'temperature': np.array([22.0]), 'time': np.array([600.0])}
    for name, force in corrected.items():
        found = read_calibration(STORED / name)
        reading = np.array([[0.3, -0.4, 0.8]]) * found.units.per_g
        np.testing.assert_allclose(found.correct(reading, context)[0], force, rtol=1e-9)
        assert np.all(np.isfinite(found.covariance))
        assert parse_calibration(format_calibration(found), name).model.effects == (
            found.model.effects)
