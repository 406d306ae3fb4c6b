# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rating: GOOD can be trusted, and USABLE and BAD say why and what to do."""

from dataclasses import replace

import accel_calib as ac
from accel_calib.calibrate import fit_partial, mounting_only
from accel_calib.finding import NextStep
from accel_calib.findings import (
    Expected, GOOD_MG, rate, rate_comparison, rate_refinement, rate_verification)
from accel_calib.units import units_of
from inside import number, spread_directions
import numpy as np
import pytest
from shared import random_directions

MS2, NATIVE = units_of('m/s2'), units_of('native')
COMMON = {'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.02, 0.015],
          'cross_axis': [0.006, -0.004, 0.005]}
FACES = np.vstack([np.eye(3), -np.eye(3)])
TIME = 20.0 * np.arange(30)
WARM = 27.0 + 3.5 * np.sin(TIME / 60.0)


def poses_of(effects=COMMON, **options):
    return ac.simulate(effects, **options)


def true_error_mg(calibration, effects=COMMON, **context):
    up = random_directions(500, np.random.default_rng(5))
    new = poses_of(effects, directions=up, noise=1e-9, **{
        key: np.full(500, value) for key, value in context.items()})
    force = calibration.correct(new.reading, new.columns)
    lengths = np.linalg.norm(force, axis=1) / calibration.force_per_g
    return 1e3 * float(np.sqrt(np.mean((lengths - 1.0) ** 2)))


def moved(poses, rows, by):
    reading = poses.reading.copy()
    reading[np.asarray(rows) - 1] += by
    return poses.with_columns(reading=reading)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(('poses', 'noise'), [(12, 0.001), (18, 0.01), (40, 0.02)])
def test_the_error_of_a_good_calibration_is_below_the_stated_one(poses, noise, seed):
    up = np.random.default_rng(seed).permutation(spread_directions(poses))
    calibration = ac.fit(poses_of(directions=up, noise=noise, seed=seed), model='10')
    rating = rate(calibration)
    assert rating.name == 'GOOD', rating
    stated = Expected(calibration).error_mg
    assert f'right to {stated:.2g} mg' in rating.reason
    assert true_error_mg(calibration) < min(1.2 * stated, GOOD_MG)


def test_a_model_without_cross_axis_is_usable_if_the_poses_do_not_determine_it():
    up = np.vstack([FACES, FACES[[0, 1, 2]]]) + 1e-3
    rating = rate(ac.fit(poses_of(directions=up / np.linalg.norm(up, axis=1, keepdims=True))))
    assert rating.name == 'USABLE'
    assert 'model 7 omits' in rating.reason


def test_half_of_the_sphere_is_not_good_because_nothing_checks_the_model_in_the_other():
    up = spread_directions(60)
    calibration = ac.fit(poses_of(directions=up[up[:, 2] > 0.0], noise=0.001))
    rating = rate(calibration)
    assert true_error_mg(calibration) < GOOD_MG
    assert rating.name == 'USABLE'
    assert 'far from all poses' in rating.reason
    assert rating.next.kind == 'poses'


@pytest.mark.parametrize(('effects', 'context'), [
    ({'quadratic': [0.03, -0.02, 0.02]}, {}),
    ({'offset_temperature': [2e-3, -1e-3, 1e-3]}, {'temperature': WARM, 'time': TIME})])
def test_a_hidden_effect_makes_a_fit_usable_and_its_refinement_good(effects, context):
    table = poses_of({**COMMON, **effects}, poses=30, **context)
    rating = rate(ac.fit(table))
    assert rating.name == 'USABLE'
    assert 'are not noise' in rating.reason
    assert rating.next.kind == 'refine'
    result = ac.refine(table)
    assert [step.effect for step in result.steps] == list(effects)
    assert rate_refinement(result).name == 'GOOD'
    base = rate(ac.fit(table), refinement=result)
    assert base.name == 'USABLE'
    assert next(iter(effects)) in base.reason
    assert base.next.kind == 'refine'


def test_a_residual_far_above_the_noise_is_ignored_below_a_milli_g():
    table = poses_of({**COMMON, 'quadratic': [0.0015, -0.001, 0.001]}, poses=30, noise=1e-4)
    calibration = ac.fit(table)
    assert calibration.quality.chi2_per_dof > 400.0
    assert Expected(calibration).hidden_mg < 1.0
    assert rate(calibration).name == 'GOOD'


def test_a_fit_beside_a_refused_refinement_is_not_bad():
    table = poses_of({'offset': [0.02, 0.0, 0.0], 'quadratic': [0.005, 0.004, -0.005]}, poses=60)
    result = ac.refine(table)
    assert result.steps
    refused = replace(result, refusal=('the poses do not determine it', 'take more poses'))
    rating = rate(ac.fit(table), refinement=refused)
    assert rating.name == 'USABLE'
    assert 'quadratic is missing' in rating.reason
    assert rating.next == NextStep('poses', 'take more poses')
    assert rate_refinement(refused).name == 'BAD'


def test_many_knocked_poses_are_usable_and_one_of_many_is_good():
    table = poses_of(poses=24)
    one = moved(table, [7], 0.3)
    many = moved(table, [2, 7, 9, 14, 20], [[0.3], [-0.25], [0.4], [0.2], [-0.35]])
    assert len(ac.fit(one).rejected) == 1
    assert rate(ac.fit(one)).name == 'GOOD'
    rating = rate(ac.fit(many))
    assert rating.name == 'USABLE'
    assert rating.next.kind == 'poses'


def test_a_calibration_that_is_worse_than_none_is_bad():
    ideal = {'offset': [0.001, -0.001, 0.0005]}
    calibration = ac.fit(poses_of(ideal, poses=11, noise=0.25, seed=2), model='10')
    assert true_error_mg(calibration, ideal) > 5.0
    rating = rate(calibration)
    assert rating.name == 'BAD'
    assert 'without the calibration' in rating.reason


@pytest.mark.parametrize(('noise', 'expected'), [(0.001, 'GOOD'), (0.02, 'USABLE')])
def test_a_sensor_that_was_right_before_is_good_if_the_error_does_not_matter(noise, expected):
    rating = rate(ac.fit(poses_of({'offset': [1e-4, 0.0, -1e-4]}, poses=12, noise=noise)))
    assert rating.name == expected
    assert ('without the calibration' in rating.reason) == (expected == 'USABLE')


def tilted():
    up = np.array([[0, 0, 1], [0.2, 0, 1], [-0.2, 0, 1], [0, 0.2, 1], [0, -0.2, 1]])
    return poses_of(directions=up / np.linalg.norm(up, axis=1, keepdims=True))


@pytest.mark.parametrize('fitted', [fit_partial, mounting_only])
def test_what_a_robot_cannot_determine_is_stated_once(fitted):
    kinds = [each.kind for each in rate(fitted(tilted(), MS2)).findings]
    assert 'open' in kinds
    assert not {'omitted', 'new_orientations', 'far_from_poses'} & {*kinds}


@pytest.mark.parametrize(('value', 'expected'), [
    (0.0009, '0'), (0.001, '0.001'), (9.94, '9.9'), (10.0, '10.0'), (99.9, '99.9'),
    (100.0, '100')])
def test_numbers_have_two_digits_and_one_after_the_point_from_10_to_100(value, expected):
    assert number(value) == expected


def test_a_calibration_of_another_sensor_is_bad_on_new_poses():
    calibration = ac.fit(poses_of(poses=24))
    other = poses_of({'offset': [-0.01, 0.005, -0.005]}, poses=12, seed=9)
    rating = rate_verification(ac.verify(other, calibration), calibration)
    assert rating.name == 'BAD'


def test_a_verification_of_few_directions_does_not_improve_the_rating():
    calibration = ac.fit(poses_of(directions=FACES))
    near = FACES[[0]] + 0.1 * random_directions(12, np.random.default_rng(3))
    new = poses_of(directions=near / np.linalg.norm(near, axis=1, keepdims=True), seed=9)
    checked = ac.verify(new, calibration)
    assert rate_verification(checked, calibration, new).name == 'USABLE'


def test_poses_that_are_too_noisy_do_not_verify():
    calibration = ac.fit(poses_of(poses=24))
    rating = rate_verification(ac.verify(poses_of(poses=12, noise=0.1, seed=9), calibration),
                               calibration)
    assert rating.name == 'USABLE'


@pytest.mark.parametrize(('offset', 'expected'), [(0.03, 'GOOD'), (0.032, 'USABLE'),
                                                  (0.06, 'BAD')])
def test_calibrations_that_differ_are_usable_or_bad(offset, expected):
    runs = [ac.fit(poses_of(poses=24)),
            ac.fit(poses_of({**COMMON, 'offset': [offset, -0.02, 0.04]}, poses=24, seed=7))]
    rating = rate_comparison(ac.compare(runs))
    assert rating.name == expected
    assert '2 calibrations' in rating.figures


def test_calibrations_that_are_too_uncertain_to_differ_are_usable():
    runs = [ac.fit(poses_of(poses=10, noise=0.15, seed=seed)) for seed in (1, 2)]
    comparison = ac.compare(runs)
    assert comparison.agree
    assert rate_comparison(comparison).name == 'USABLE'
