# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From poses to a calibration: known sensors within the stated uncertainty, and outliers."""

from dataclasses import astuple, replace
from itertools import product

import accel_calib as ac
from accel_calib.calibration import fit_poses, verify
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import (
    fit_robust, judge, NotConvergedError, outliers_among, Point, scatter_of, sensing_axes, solve,
    variance_factor)
from accel_calib.finding import has
from accel_calib.findings import outlook
from accel_calib.geometry import ATTITUDES
from accel_calib.table import numbered
from inside import (
    agreeing, Model, MODELS, predict, rotation_from_rpy, simulate_poses, spread_directions, unit)
import numpy as np
import pytest
from shared import attitudes, changed, error_mg, G, MPS2, poses_of, random_directions, sensor


def simulated(seed, count, *effects, known=False):
    """Return a random sensor with these effects, and its poses, of known orientation or not."""
    rng = np.random.default_rng(seed)
    model = sensor(rng, *effects)
    directions = attitudes(rng, count)
    return model, simulate_poses(model, directions, rng,
                                 context={'reference': directions} if known else None)


@pytest.mark.parametrize('name', ['4', '7', '10', '12'])
def test_auto_takes_the_model_of_the_sensor_and_its_deviations_contain_the_truth(name):
    pulls, chosen = [], []
    for seed in range(max(160 // int(name), 20)):  # 160 values or more
        model, poses = simulated(seed, 24, *MODELS[name].effects, known=name == '12')
        fit = fit_poses(poses, G, model=name)
        pulls.append((fit.model.vector - model.vector) / np.sqrt(np.diag(fit.covariance)))
        if seed < 12:
            chosen.append(fit_poses(poses, G).name)
    assert np.mean(np.abs(pulls) < 1.96) > 0.92
    assert np.std(pulls) == pytest.approx(1.0, abs=0.15)
    assert chosen.count(name) >= 10


def test_nine_parameters_are_ten_in_the_sensing_axes():
    poses = simulated(4, 20)[1]
    nine, ten = fit_poses(poses, G, model='9'), fit_poses(poses, G, model='10')
    np.testing.assert_allclose(nine.gain, np.linalg.cholesky(ten.gain @ ten.gain.T), atol=1e-7)
    own, axes = (np.hstack(astuple(sensing_axes(fit.gain, fit.offset))) for fit in (nine, ten))
    np.testing.assert_allclose(own, axes, atol=1e-9)
    assert np.linalg.matrix_rank(nine.covariance, tol=1e-14) == 9
    scatter = scattering(0, 7e-4)[1]
    nine, ten = (fit_poses(scatter, G, model=name) for name in ('9', '10'))
    assert nine.offset_sd == pytest.approx(ten.offset_sd, rel=0.02)


@pytest.mark.parametrize(('count', 'limit_mg'), [(12, 0.33), (36, 0.2)])
def test_a_knocked_pose_is_named_and_left_out(count, limit_mg):
    errors = []
    for seed in range(10):
        model, poses = simulated(seed, count)
        poses = changed(poses, 4, (0.95, 1.05)[seed % 2])
        calibration = fit_poses(poses, G, model='10')
        assert [rejected.row for rejected in calibration.rejected] == [5]
        errors.append(error_mg(calibration, model))
    assert np.median(errors) <= limit_mg


def test_noisy_poses_have_less_weight():
    model, poses = simulated(8, 30)
    rng = np.random.default_rng(8)
    std, worse = poses['std'], 1.0 + 29.0 * (np.arange(30) % 3 == 0)[:, np.newaxis]
    added = rng.normal(size=std.shape) * std * np.sqrt((worse ** 2 - 1.0) / 100)
    noisy = poses.with_columns(std=std * worse, reading=poses.reading + added)
    weighted, equal = (np.linalg.norm(fit_poses(each, G, model='10').model.vector - model.vector)
                       for each in (noisy, noisy.without_columns('std')))
    assert weighted < 0.5 * equal


def scattering(seed, scatter_g, count=60, differs=0.8):
    """Return a sensor and poses whose noise differs, and which scatter beyond it."""
    rng = np.random.default_rng(seed)
    model, noise = sensor(rng), 1.4e-4 * np.exp(differs * rng.normal(size=(count, 1)))
    up = random_directions(count, rng)
    poses = simulate_poses(model, up, rng, noise_g=1e-9, context={'reference': up})
    error = np.hypot(noise, scatter_g) * rng.normal(size=(count, 3))
    return model, poses.with_columns(reading=poses.reading + error,
                                     std=np.repeat(10.0 * noise, 3, axis=1))


@pytest.mark.parametrize(('name', 'count'), [('10', 60), ('12', 20)])
def test_poses_that_scatter_alike_have_weights_alike_and_true_deviations(name, count):
    pulls, lost = [], 0
    for seed in range(20):
        model, poses = scattering(seed, 7e-4, count)
        fit = fit_poses(poses, G, model=name)
        lost += len(fit.rejected)
        if fit.name == name:
            gain, offset = model.linear_part
            pulls += [np.diag(fit.gain - gain) / np.diag(fit.gain_sd),
                      (fit.offset - offset) / fit.offset_sd]
            assert fit.quality.chi2_per_dof > 4.0  # of the noise as stated
            assert has(fit.noted, 'beyond_noise')
    assert np.std(pulls) == pytest.approx(1.0, abs=0.2)
    assert lost <= (2 if name == '12' else 0)


@pytest.mark.parametrize('factor', [1.0, 3.0, 100.0])
def test_overstated_noise_is_noted(factor):
    poses = ac.simulate({'offset': [0.03, -0.02, 0.04]}, poses=40, seed=1)
    found = ac.fit(poses.with_columns(std=factor * poses['std']))
    assert ('below_noise' in [each.kind for each in found.findings]) == (factor > 1.0)


def test_few_poses_that_scatter_alike_are_no_outliers():
    lost = [len(fit_poses(scattering(seed, 7e-4, 14, differs)[1], G, model='10').rejected)
            for seed in range(20) for differs in (0.0, 0.8)]
    assert sum(lost) <= 10


def test_a_scatter_is_estimated_where_the_noise_differs_and_is_that_of_the_residuals_of_a_fit():
    sizes = []
    for seed in range(10):
        model, poses = scattering(seed, 7e-4)
        sizes.append(scatter_of(judge(model, poses)).size_g)
        fit, kept = fit_robust('10', poses)
        own = judge(fit.model, poses.take(kept))
        assert fit.poses_g['own_scatter'] == pytest.approx(scatter_of(own).size_g, rel=0.02)
    assert np.mean(sizes) == pytest.approx(7e-4, rel=0.1)
    twice = judge(own.model, own.poses_g, np.hstack([own.ties, own.ties]))
    assert scatter_of(twice) == pytest.approx(scatter_of(own), rel=1e-6)
    model, poses = scattering(0, 0.0)
    assert not scatter_of(judge(model, poses)).shows


def test_knocked_poses_are_left_out_beside_a_scatter():
    for seed in range(5):
        poses = scattering(seed, 7e-4)[1]
        fit = fit_poses(changed(poses, [7, 30, 51], 1.02), G, model='10')
        assert [each.row for each in fit.rejected] == [8, 31, 52]


def test_unknown_noise_is_estimated_from_the_residuals():
    poses = simulated(9, 60)[1]
    known = fit_poses(poses, G, model='10')
    unknown = fit_poses(poses.without_columns('std'), G, model='10')
    assert unknown.quality.noise_floor_mg is None
    np.testing.assert_allclose(unknown.offset_sd, known.offset_sd, rtol=0.4)
    assert [has(fit.noted, 'noise_not_known') for fit in (known, unknown)] == [False, True]


@pytest.mark.parametrize('repeats', [1, 4])
def test_held_out_residual_is_that_of_a_fit_without_the_orientation(repeats):
    up = np.tile(spread_directions(16), (repeats, 1))
    poses = ac.simulate({'offset': [0.02, -0.01, 0.03], 'cubic': [0.004, -0.003, 0.005]},
                        directions=up, units='g', seed=10).without_columns('std')
    own = [np.arange(len(up)) % 16 == k for k in range(16)]
    errors = [verify(fit_poses(poses.take(~each), G, model='7'), poses.take(each)).rms_after_mg
              for each in own]
    held_out = fit_poses(poses, G, model='7').quality.held_out_rms_mg
    assert held_out == pytest.approx(np.sqrt(np.mean(np.square(errors))), rel=0.02)


def test_repeats_of_orientations_that_the_fit_needs_do_not_check_it():
    up = np.tile(spread_directions(9), (5, 1))
    quality = fit_poses(ac.simulate({}, directions=up, units='g', seed=3), G, model='10').quality
    assert quality.rms_after_mg < 1.0
    assert quality.held_out_rms_mg is None or quality.held_out_rms_mg > 20.0


def test_noise_floor_is_the_residual_of_the_correct_model():
    found = [fit_poses(simulated(seed, 24)[1], G, model='10').quality for seed in range(30)]
    gap, floor = np.mean([(each.rms_after_mg ** 2, each.noise_floor_mg ** 2) for each in found], 0)
    assert np.sqrt(gap) == pytest.approx(np.sqrt(floor), rel=0.1)


def placed(seed, degrees, **settings):
    """Return a sensor, and poses that are rotated from their stated orientation."""
    rng = np.random.default_rng(seed)
    stated = np.vstack([ATTITUDES[:6], spread_directions(6)])
    across = unit(np.cross(stated, random_directions(12, rng)))
    real = stated * np.cos(np.radians(degrees)) + np.sin(np.radians(degrees)) * across
    model = sensor(rng, *MODELS['12'].effects)
    return model, simulate_poses(model, real, rng, **settings).with_columns(reference=stated)


@pytest.mark.parametrize('model', ['auto', '12'])
def test_badly_placed_orientations_are_replaced_by_a_fit_of_the_norm(model):
    errors, turned = [], []
    for seed in range(8):
        truth, poses = placed(seed, 2.0)
        calibration = fit_poses(poses, G, model=model)
        assert calibration.name == '10'
        errors.append(error_mg(calibration, truth))
        across = calibration.correct(predict(truth, np.eye(3), {}))
        turned.append(np.degrees(np.max(np.abs(across - across.T)) / 2))
    assert calibration.noted[0].kind == 'placement'
    assert calibration.noted[0].text == calibration.reason
    assert np.median(errors) < 0.4
    assert np.median(turned) < 1.0  # the axes follow the orientations, on average


def test_one_misplaced_pose_is_named_and_does_not_rotate_the_axes():
    truth, poses = placed(3, 0.0)
    reference = poses['reference'].copy()
    reference[4] = rotation_from_rpy(0.0, 0.0, 0.2) @ reference[4]
    poses = poses.with_columns(reference=reference)
    calibration = fit_poses(poses, G)
    assert ' row 5 (' in calibration.reason
    np.testing.assert_allclose(calibration.correct(predict(truth, np.eye(3), {})), np.eye(3),
                               atol=4e-3)


def test_well_placed_orientations_are_used_and_model_12_needs_them():
    for seed, noise_g in product(range(10), (0.0003, 0.003, 0.03)):
        fit = fit_poses(placed(seed, 0.0, noise_g=noise_g)[1], G)
        assert (fit.name, has(fit.noted, 'placement')) == ('12', False)
    with pytest.raises(RefusedFitError, match='needs known orientations'):
        fit_poses(simulated(15, 20)[1], G, model='12')


def test_force_covariance_is_that_of_repeated_fits():
    force, rng = np.array([[0.6, 0.0, 0.8]]), np.random.default_rng(17)
    model = sensor(rng)
    reading = predict(model, force, {})
    fits = [fit_poses(simulate_poses(model, spread_directions(14), rng), G, model='10')
            for _ in range(80)]
    scatter = np.cov(np.vstack([fit.correct(reading) for fit in fits]).T)
    stated = np.mean([fit.force_covariance(force)[0] for fit in fits], axis=0)
    np.testing.assert_allclose(np.diag(stated), np.diag(scatter), rtol=0.4)


def test_a_reader_cannot_change_a_calibration():
    calibration = fit_poses(simulated(18, 20)[1], G)
    for name in ('offset', 'gain', 'rotation', 'offset_sd', 'gain_sd'):
        before = getattr(calibration, name).copy()
        getattr(calibration, name)[:] = 9.0
        np.testing.assert_array_equal(getattr(calibration, name), before)
    with pytest.raises(ValueError, match='read-only'):
        calibration.covariance[0, 0] = 9.0


@pytest.mark.parametrize('model', ['4', '7', '10', 'auto'])
def test_readings_without_any_noise_are_fitted(model):
    edges = poses_of(ATTITUDES[6:18] * MPS2.per_g + [0.3, 0.0, 0.0])
    calibration = fit_poses(edges, MPS2, model=model)
    np.testing.assert_allclose(calibration.offset, [0.3, 0.0, 0.0], atol=1e-12)
    assert outlook(calibration, model).uncertainty_mg == pytest.approx(0.0, abs=1e-9)


def stalled(slope):
    """Return a solve whose ten other residuals are 1 and whose step never lowers the cost."""
    residual = np.append(slope, np.ones(10))
    columns = np.append(1.0, np.zeros(10))[:, np.newaxis]
    return solve(lambda values: Point(residual, columns), np.zeros(1), np.array([-np.inf]),
                 np.array([np.inf]))


def test_a_stalled_fit_has_converged_if_its_step_is_small_beside_one_degree_of_freedom():
    assert stalled(np.sqrt(0.9e-3))[0] == 0.0
    with pytest.raises(NotConvergedError):
        stalled(np.sqrt(1.2e-3))


def test_a_fit_ends_at_a_kink_where_no_step_lowers_the_cost():
    tried = []

    def point_at(values):  # |x| has no slope of 0 at its minimum, so steps go too far
        tried.append(values)
        kink = np.abs(values) + 1.0
        return Point(np.append(10.0, 0.01 * kink), np.array([[0.0], -0.01 * np.sign(values)]))

    values, _ = solve(point_at, np.full(1, 0.3), np.full(1, -np.inf), np.full(1, np.inf))
    assert values == 0.3
    assert len(tried) == 3


def test_a_fit_without_any_residual_has_converged():
    zero = Point(np.zeros(3), np.eye(3)[:, :1])
    assert solve(lambda values: zero, np.ones(1), np.zeros(1), np.full(1, 2.0)) == (1.0, zero)


@pytest.mark.parametrize('is_nan', ['residual', 'columns'])
def test_a_step_to_where_residual_or_derivative_is_not_finite_is_not_taken(is_nan):
    def point_at(values):  # the first full step goes to 1.67, where the cost is lower
        parts = {'residual': 1.0 - values, 'columns': np.full((1, 1), 0.6)}
        return Point(**{**parts, is_nan: parts[is_nan] * np.where(values > 1.5, np.nan, 1.0)})

    values, _ = solve(point_at, np.zeros(1), np.full(1, -np.inf), np.full(1, np.inf))
    assert values == pytest.approx(1.0, abs=1e-3)


def share_held(ratio, dof, noise_known):
    """Return the share of values within 1.96 standard deviations, for noise of this variance."""
    rng = np.random.default_rng(dof)
    chi2, value = ratio * rng.chisquare(dof, 4000), np.sqrt(ratio) * rng.normal(size=4000)
    factor = [variance_factor(each, dof, noise_known) for each in chi2]
    return np.mean(np.abs(value) < 1.96 * np.sqrt(factor))


@pytest.mark.parametrize(('ratio', 'dof', 'noise_known'), [
    *product((1.0, 9.0), (27, 91), [True]), (1.0, 3, True), (0.04, 91, True),
    *product((0.04, 1.0, 25.0), (3, 27), [False])])
def test_intervals_contain_the_truth_if_noise_or_residuals_determine_it(ratio, dof, noise_known):
    tolerance = 0.02 if noise_known else 0.01
    assert share_held(ratio, dof, noise_known) == pytest.approx(0.95, abs=tolerance)


def knocked(seed, count, bad):
    """Return poses of which the first `bad` are shifted by 50 mg, outwards or inwards."""
    rng = np.random.default_rng(seed)
    poses = simulate_poses(sensor(rng), spread_directions(count), rng)
    by = 1.0 + rng.choice([-0.05, 0.05], (bad, 1))
    return changed(poses, slice(bad), by)


def left_out(poses):
    return {each.row for each in fit_poses(poses, G, model='10').rejected}


def test_few_clean_poses_are_left_out_instead_of_two_knocked_ones_of_twelve():
    found = [left_out(knocked(seed, 12, 2)) for seed in range(20)]
    assert sum(bool(each - {1, 2}) for each in found) <= 3


@pytest.mark.parametrize(('count', 'stated', 'sets'), [(24, 1.0, 20), (36, 0.33, 3),
                                                       (400, 0.33, 3)])
def test_clean_poses_are_kept_even_if_their_noise_is_underestimated(count, stated, sets):
    poses = [knocked(seed, count, 0) for seed in range(sets)]
    lost = [left_out(each.with_columns(std=each['std'] * stated)) for each in poses]
    assert sum(map(bool, lost)) <= sets // 20


@pytest.mark.parametrize(('count', 'bad'), [(100, 20), (400, 80), (2500, 3)])
def test_all_knocked_poses_are_left_out_but_at_most_a_quarter(count, bad):
    poses = knocked(7, count, bad)
    found = left_out(poses)
    assert set(poses.row[:bad].tolist()) <= found
    assert len(found) <= bad + count // 500
    # A third agrees with another offset.
    shifted = changed(knocked(8, count, 0), np.s_[::3], plus=[0.1, 0.0, 0.0])
    assert len(left_out(shifted)) <= count // 4


@pytest.mark.parametrize(('name', 'count', 'factors'), [
    *((name, 24, [0.9, 0.95, 1.05, 1.1]) for name in ('4', '7', '10')),
    ('10', 1000, np.linspace(0.6, 0.95, 240))])
def test_the_poses_that_agree_best_are_those_that_are_not_knocked(name, count, factors):
    poses, bad = simulated(19, count, *MODELS[name].effects)[1], len(factors)
    poses = changed(poses, slice(bad), np.array(factors)[:, np.newaxis])
    assert list(agreeing(name, poses, bad)) == list(range(bad, count))


@pytest.mark.parametrize(('poses', 'rows'), [(40, 1), (40, 3), (300, 1)])
def test_several_fits_together_have_the_outliers_of_each_alone(poses, rows):
    rng = np.random.default_rng(poses + rows)
    knocked = [(), (3,), (7, 11, 30), (3, 20)]
    basis = np.array([np.linalg.qr(rng.normal(size=(poses * rows, 8)))[0] for _ in knocked])
    residual = rng.normal(size=(len(knocked), poses * rows, 1))
    for own, out in zip(residual.reshape(-1, poses, rows), knocked, strict=True):
        own[list(out)] += 12.0
    residual -= basis @ (basis.swapaxes(1, 2) @ residual)
    residual, basis = (each.reshape(len(knocked), poses, rows, -1) for each in (residual, basis))
    found = outliers_among(residual[..., 0], basis, np.full(poses, rows),
                           [poses * rows - 8] * len(knocked), poses, noise_known=True)
    assert [tuple(out.tolist()) for out in found] == knocked


def with_copies(poses, rows):
    """Return poses followed by exact copies of these rows, 0-based."""
    every = poses.take(np.concatenate([np.arange(len(poses)), rows]).astype(int))
    return replace(every, row=numbered(every.columns))


@pytest.mark.parametrize('copies', [[2], [2, 2, 2, 2, 2], [0, 3, 5, 7, 8, 10], range(12)])
@pytest.mark.parametrize(('lacks', 'apart'), [  # the noise is 1e-5 g
    (['temperature'], 0.0), (['temperature'], 2e-7), (['temperature', 'std', 'count'], 0.0)])
def test_copies_of_a_pose_make_no_pose_an_outlier(copies, lacks, apart):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        model = Model({**sensor(rng).values, 'offset_temperature': 0.0005 * rng.normal(size=3)})
        poses = simulate_poses(model, spread_directions(12), rng, noise_g=1e-4, context={
            'temperature': rng.uniform(15.0, 45.0, 12)}).without_columns(*lacks)
        by = apart * rng.normal(size=(len(copies), 3))
        again = changed(with_copies(poses, copies), slice(12, None), plus=by)
        once, found = (fit_poses(each, G, model='10') for each in (poses, again))
        assert {each.row for each in found.rejected if each.row <= 12} == {
            each.row for each in once.rejected}
        np.testing.assert_allclose(found.model.vector, once.model.vector, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found.covariance, once.covariance, rtol=1e-6)
        assert found.quality.held_out_rms_mg == pytest.approx(once.quality.held_out_rms_mg)
        assert found.quality.chi2_per_dof == pytest.approx(once.quality.chi2_per_dof)


def test_poses_that_count_once_are_too_few_for_the_model():
    with pytest.raises(RefusedFitError, match='14 poses have 8 directions'):
        fit_poses(with_copies(knocked(6, 8, 0), range(6)), G, model='10')
