# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A sensor that cannot be turned over gets what its poses carry, with an honest uncertainty."""

from dataclasses import replace

from accel_calib.calibration import (
    directions_of, fit_partial, fit_poses, gated, level, lies_in_cone, mounting_only, PRIOR,
    verify)
from accel_calib.errors import InputError, RefusedFitError
from accel_calib.refinement import refine
from faults.sample import sample
from inside import (
    calibrated_by, common_sensors, FitPlan, Model, MODELS, predict, sensor_force, simulate_poses,
    spread_directions, unit, with_vector, without_knocked)
import numpy as np
import pytest
from shared import changed, G, NATIVE, poses_of, rms

UP, Z = spread_directions(200), np.array([[0.0, 0.0, 1.0]])
SPREAD = np.sqrt(np.diag(common_sensors().covariance))


def near_up(rng, count, degrees, axis=(0.0, 0.0, 1.0)):
    """Return random directions within this angle of an axis, which is a face of the sensor."""
    cosine = rng.uniform(np.cos(np.radians(degrees)), 1.0, count)
    heading, sine = rng.uniform(0.0, 2.0 * np.pi, count), np.sqrt(1.0 - cosine ** 2)
    about_z = np.column_stack([sine * np.cos(heading), sine * np.sin(heading), cosine])
    return np.roll(about_z, int(np.argmax(axis)) - 2, axis=1)


def common_sensor(rng):
    """Return a random sensor with values as the prior has them."""
    return with_vector(MODELS['10'].effects, rng.normal(size=9) * SPREAD)


def tilting(seed, count=7, degrees=10.0, noise_g=0.003):
    """Return a common sensor, and poses of a robot that tilts; 0.3 mg of noise per pose."""
    rng = np.random.default_rng(seed)
    model = common_sensor(rng)
    return model, simulate_poses(model, near_up(rng, count, degrees), rng, noise_g=noise_g)


def errors(calibration, model, up):
    """Return the errors of the corrected |a|, and their stated standard deviations [g]."""
    force = calibration.correct(predict(model, up, {}))
    stated = np.einsum('ni,nij,nj->n', up, calibration.force_covariance(up), up)
    return np.linalg.norm(force, axis=1) - 1.0, np.sqrt(stated)


@pytest.mark.parametrize('count', [1, 7])
def test_stated_uncertainties_of_values_tilt_and_all_directions_hold(count):
    held, ratios, tilts = [], [], []
    for seed in range(50):
        model, poses = tilting((seed, count), count)
        found = fit_partial(poses, G)
        error, stated = errors(found, model, UP)
        held.append(np.abs(error) < 1.96 * stated)
        ratios.append((found.model.vector - model.vector) / np.sqrt(np.diag(found.covariance)))
        seen = unit(sensor_force(found.model, predict(model, Z, {}), {}))[0]
        tilts.append(seen[:2] / np.sqrt(np.diag(found.force_covariance(Z)[0])[:2]))
    assert 0.9 < np.mean(held) < 0.995
    np.testing.assert_allclose(rms(ratios, axis=0), 1.0, atol=0.28)
    assert 0.7 < rms(tilts) < 1.15


@pytest.mark.parametrize('count', [10, 20])
def test_poses_of_a_robot_that_turns_on_one_axis_hold_in_their_plane(count):
    held, turn = [], np.radians(np.arange(0, 360, 6))
    around = np.column_stack([np.zeros(60), np.cos(turn), np.sin(turn)])
    for seed in range(15):
        rng = np.random.default_rng((seed, count))
        model, up = common_sensor(rng), around[::60 // count]
        up = unit(up + np.outer(rng.uniform(-0.1, 0.1, len(up)), np.eye(3)[0]))
        poses = simulate_poses(model, up, rng, noise_g=0.003)
        outcome = calibrated_by(poses, G, FitPlan())
        found = outcome.calibration
        assert (found.method, outcome.refinement) == (PRIOR, None)
        error, stated = errors(found, model, around)
        held.append(np.mean(np.abs(error) < 1.96 * stated))
    assert np.mean(held) > 0.88
    assert np.max(stated) < 0.01


def test_clean_poses_are_kept_and_a_knocked_pose_is_left_out():
    for seed in sample(range(10), 5):
        model, poses = tilting((seed, 3), 9, 15.0)
        assert not fit_partial(poses, G).rejected
        poses = changed(poses, 4, 1.05)
        found = fit_partial(poses, G)
        assert [each.row for each in found.rejected] == [5]
        error, stated = errors(found, model, UP)
        assert np.mean(np.abs(error) < 4.0 * stated) > 0.95


def test_a_pose_among_many_is_left_out_from_six_deviations_on():
    for seed in range(1, 5):
        poses = tilting((seed, 30), 30)[1]
        for deviations, rows in ((4.0, []), (6.0, [5])):
            found = fit_partial(changed(poses, 4, 1.0 + deviations * 3e-4), G)
            assert [each.row for each in found.rejected] == rows


@pytest.mark.parametrize('seed', [4, 5])
def test_the_variance_is_at_least_the_most_probable_one_and_less_where_the_noise_is_overstated(
        seed):
    poses = tilting((seed, 20), 20)[1]
    under, over = (without_knocked(poses.with_columns(std=poses['std'] * times), np.arange(20),
                                   common_sensors(), 0.1, 0.25) for times in (0.3, 10.0))
    assert under.fit.factor >= under.factor > 1.0
    assert over.fit.factor < over.factor == 1.0


def test_result_does_not_depend_on_the_axis_that_points_up():
    for axis in np.eye(3):
        rng = np.random.default_rng(8)
        poses = simulate_poses(Model({}), near_up(rng, 3, 1.0, axis), rng)
        found, own = fit_partial(poses, G), int(np.argmax(axis))
        gain = found.parameters.index(f'axis_gain.{"xyz"[own]}')
        assert found.offset_sd[own] == pytest.approx(0.0287, rel=0.1)
        assert np.sqrt(found.covariance[gain, gain]) == pytest.approx(0.0287, rel=0.1)


def test_poses_of_a_cone_are_for_the_partial_fit_and_those_of_the_sphere_for_the_full_one():
    model, poses = tilting(8, 12)
    with pytest.raises(RefusedFitError, match='within .*° of one direction'):
        fit_poses(poses, G, model='10')
    assert lies_in_cone(directions_of(poses, G))
    assert fit_partial(poses, G).method == PRIOR
    with pytest.raises(ValueError, match='use fit_poses'):
        fit_partial(simulate_poses(model, spread_directions(12), np.random.default_rng(2)), G)


@pytest.mark.parametrize('make', [fit_partial, mounting_only])
def test_native_readings_and_a_sensor_that_was_never_at_rest_are_refused(make):
    _, poses = tilting(10)
    with pytest.raises(InputError, match='native units.*expected readings in m/s2 or g'):
        make(poses, NATIVE)
    moved = poses.with_columns(std=np.full_like(poses.reading, 100.0))
    with pytest.raises(RefusedFitError, match='found 0 sound poses of 7 rows'):
        make(moved, G)


def test_a_reading_of_another_length_is_left_out_and_named():
    _, poses = tilting(10)
    expected = fit_partial(poses.take(poses.row != 3), G)
    poses = changed(poses, 2, 0.0)
    found = fit_partial(poses, G)
    assert [each.row for each in found.rejected] == [3]
    np.testing.assert_allclose(found.model.vector, expected.model.vector)


def test_a_mounting_levels_the_raw_reading():
    tilt = np.radians(12.0)
    reading = 1.07 * np.array([[np.sin(tilt), 0.0, np.cos(tilt)]])
    found = level(mounting_only(poses_of(reading), G), reading[0], 'ros')
    np.testing.assert_allclose(found.correct(reading), [[0.0, 0.0, 1.07]], atol=1e-12)
    others = np.random.default_rng(12).normal(size=(5, 3))
    np.testing.assert_allclose(np.linalg.norm(found.correct(others), axis=1),
                               np.linalg.norm(others, axis=1))
    assert found.name == 'ideal'
    assert not found.model.effects
    assert any('not calibrated' in line and '100 mg' in line and '6°' in line
               for line in found.warnings)


def test_level_and_the_offset_along_gravity_come_from_one_rest():
    _, poses = tilting(13, 1, 0.1)
    found = level(fit_partial(poses, G), poses.reading[0], 'ros')
    np.testing.assert_allclose(found.correct(poses.reading), [[0.0, 0.0, 1.0]], atol=1e-3)


@pytest.mark.parametrize('make', [fit_partial, mounting_only])
def test_the_gate_accepts_both_and_refuses_readings_that_no_sensor_has(make):
    _, poses = tilting(15)
    found = make(poses, G)
    assert gated(found).warnings == found.warnings
    mirrored = replace(found, model=Model(found.model.values, -np.eye(3)))
    with pytest.raises(RefusedFitError, match='rotation'):
        gated(mirrored)


@pytest.mark.parametrize(('gain', 'words'), [
    ((-1.0, 1.0, 1.0), 'mirror image'), ((1e-9, 1.0, 1.0), 'not on an ellipsoid'),
    ((-1e-9, 1.0, 1.0), 'not on an ellipsoid')])
def test_the_gate_names_a_gain_out_of_range_before_its_sign(gain, words):
    found = fit_poses(simulate_poses(Model({}), spread_directions(24), np.random.default_rng(1)),
                      G, model='10')
    values = {**found.model.values, 'axis_gain': np.array(gain) - 1.0}
    with pytest.raises(RefusedFitError, match=words):
        gated(replace(found, model=Model(values)))


def test_a_partial_fit_is_better_than_none_and_refine_completes_it():
    model, poses = tilting(17)
    far = simulate_poses(model, spread_directions(24), np.random.default_rng(17))
    partial, mounting = fit_partial(poses, G), mounting_only(poses, G)
    assert verify(partial, far).rms_after_mg < verify(mounting, far).rms_after_mg
    found = refine(far, G, base=partial)
    assert not found.refusal
    assert found.remaining_gap_mg < 0.5
    assert verify(found.calibration, far).rms_after_mg < 0.5


def test_a_partial_fit_has_the_name_that_is_given_or_that_of_the_poses():
    poses = replace(tilting(18)[1], sensor='left')
    assert fit_partial(poses, G).sensor == 'left'
    assert fit_partial(poses, G, sensor='right').sensor == 'right'


def test_poses_of_which_a_few_leave_a_plane_have_a_full_fit():
    turn = np.radians(np.arange(0, 360, 12))
    flat = np.column_stack([np.zeros(30), np.cos(turn), np.sin(turn)])
    beside = [(x, *each) for x in (-1.0, 1.0) for each in [*np.eye(2), *-np.eye(2), (0.0, 0.0)]]
    poses = simulate_poses(Model({}), unit(np.vstack([*[flat] * 20, beside])),
                           np.random.default_rng(1))
    assert calibrated_by(poses, G, FitPlan(refined=False)).calibration.method != PRIOR


def test_a_short_arc_is_refused_as_any_poses_that_determine_no_model():
    turn = np.radians(np.linspace(-40.0, 40.0, 11))
    up = np.column_stack([np.zeros(11), np.sin(turn), np.cos(turn)])
    with pytest.raises(RefusedFitError):
        calibrated_by(simulate_poses(Model({}), up, np.random.default_rng(1)), G, FitPlan())
