# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Outliers are found, and clean poses are kept."""

import accel_calib as ac
from accel_calib.calibrate import fit_poses
from accel_calib.errors import RefusedFitError
from accel_calib.finding import has
from accel_calib.table import Poses
from accel_calib.units import units_of
from inside import Model, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import sensor

G = units_of('g')


def knocked(seed, count, bad):
    """Return poses of which the first `bad` are shifted by 50 mg, outwards or inwards."""
    rng = np.random.default_rng(seed)
    poses = simulate_poses(sensor(rng), spread_directions(count), rng)
    reading = poses.reading.copy()
    reading[:bad] *= 1.0 + rng.choice([-0.05, 0.05], (bad, 1))
    return poses.with_columns(reading=reading)


def left_out(poses, **settings):
    return {each.row for each in fit_poses(poses, G, model='10', **settings).rejected}


def test_two_knocked_poses_of_twelve_are_found_with_few_clean_poses_lost():
    clean = [len(left_out(knocked(seed, 12, 2)) - {1, 2}) for seed in range(20)]
    assert np.count_nonzero(clean) <= 3


@pytest.mark.parametrize('count', [36, 400])
def test_underestimated_noise_makes_no_outliers(count):
    for seed in range(3):
        poses = knocked(seed, count, 0)
        assert not left_out(poses.with_columns(std=poses['std'] / 3.0))


@pytest.mark.parametrize('count', [100, 400])
def test_all_outliers_are_found_if_a_fifth_of_the_poses_is_knocked(count):
    bad = count // 5
    poses = knocked(7, count, bad)
    assert left_out(poses) == set(poses.row[:bad].tolist())


@pytest.mark.parametrize('count', [40, 400])
def test_at_most_a_quarter_of_the_poses_is_left_out(count):
    poses = knocked(8, count, 2 * count // 5)
    assert len(left_out(poses)) <= count // 4


def with_copies(poses, rows):
    """Return poses followed by exact copies of these rows, 0-based."""
    again = np.concatenate([np.arange(len(poses)), rows]).astype(int)
    kept = ('reading', 'std', 'count', 'temperature')
    return Poses({key: poses[key][again] for key in kept if key in poses},
                 np.arange(1, len(again) + 1))


def lacking(seed, count, effect):
    """Return poses of a sensor with an effect that no model of `fit` has."""
    rng = np.random.default_rng(seed)
    values = {**sensor(rng).values, effect: 0.0005 * rng.normal(size=3)}
    return simulate_poses(Model(values), spread_directions(count), rng, noise_g=1e-4,
                          context={'temperature': rng.uniform(15.0, 45.0, count)})


@pytest.mark.parametrize('copies', [[2], [2, 2, 2, 2, 2], [0, 3, 5, 7, 8, 10], range(12)])
@pytest.mark.parametrize('apart', [0.0, 2e-7])
@pytest.mark.parametrize('measured', [True, False])
def test_copies_of_a_pose_make_no_pose_an_outlier(copies, measured, apart):
    for seed in range(3):
        poses = lacking(seed, 12, 'offset_temperature')
        poses = Poses({key: poses[key] for key in ('reading', 'std', 'count')[:3 if measured
                                                                              else 1]}, poses.row)
        once = fit_poses(poses, G, model='10')
        again = with_copies(poses, copies)
        if measured:  # the noise is 1e-5 g
            again.reading[12:] += apart * np.random.default_rng(seed).normal(
                size=again.reading[12:].shape)
        found = fit_poses(again, G, model='10')
        assert {each.row for each in found.rejected if each.row <= 12} == {
            each.row for each in once.rejected}
        np.testing.assert_allclose(found.model.vector, once.model.vector, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found.covariance, once.covariance, rtol=1e-6)
        assert found.quality.held_out_rms_mg == pytest.approx(once.quality.held_out_rms_mg)
        assert found.quality.chi2_per_dof == pytest.approx(once.quality.chi2_per_dof)


def test_readings_that_were_measured_again_are_not_copies():
    poses = knocked(5, 18, 0)
    again = with_copies(poses, range(18))
    again.reading[18:] += np.random.default_rng(5).normal(size=(18, 3)) * 3e-4
    found = fit_poses(again, G, model='10')
    once = fit_poses(poses, G, model='10')
    assert not [line for line in found.warnings if 'equal' in line]
    assert np.trace(found.covariance) < 0.75 * np.trace(once.covariance)


def test_poses_that_count_once_are_too_few_for_the_model():
    poses = knocked(6, 8, 0)
    with pytest.raises(RefusedFitError, match='14 poses have 8 directions'):
        fit_poses(with_copies(poses, [0, 1, 2, 3, 4, 5]), G, model='10')


def test_a_region_that_only_outliers_cover_is_named():
    up = spread_directions(60)
    up = np.vstack([up[up[:, 2] < -0.2], [[0.0, 0.0, 1.0]]])
    poses = ac.simulate({'offset': [0.03, -0.02, 0.04]}, directions=up, units='g')
    poses.reading[-1] *= 1.2
    found = fit_poses(poses, G, model='10')
    assert [each.row for each in found.rejected] == [len(up)]
    assert has(found.noted, 'not_covered')
