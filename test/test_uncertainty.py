# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Intervals by the stated variance contain 95 %, also if the stated noise is wrong."""

from accel_calib.estimate import variance_factor
import numpy as np
import pytest

SETS = 4000


def share_held(ratio, dof, noise_known):
    """Return the share of values within 1.96 standard deviations, for noise of this variance."""
    rng = np.random.default_rng(dof)
    chi2 = ratio * rng.chisquare(dof, SETS)
    value = np.sqrt(ratio) * rng.normal(size=SETS)
    factor = [variance_factor(each, dof, noise_known) for each in chi2]
    return np.mean(np.abs(value) < 1.96 * np.sqrt(factor))


@pytest.mark.parametrize('ratio', [1.0, 9.0])
@pytest.mark.parametrize('dof', [27, 91])
def test_intervals_contain_the_truth_if_residuals_determine_the_noise(ratio, dof):
    assert share_held(ratio, dof, noise_known=True) == pytest.approx(0.95, abs=0.02)


def test_intervals_with_correct_noise_contain_the_truth_with_few_residuals():
    assert share_held(1.0, 3, noise_known=True) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize('ratio', [0.04, 1.0, 25.0])
@pytest.mark.parametrize('dof', [3, 27])
def test_unknown_noise_is_estimated_from_the_residuals_alone(ratio, dof):
    assert share_held(ratio, dof, noise_known=False) == pytest.approx(0.95, abs=0.01)


def test_poses_that_repeat_better_than_stated_are_believed():
    assert variance_factor(0.04 * 91, 91, True) < 0.1
    assert share_held(0.04, 91, noise_known=True) > 0.93


def test_without_residuals_measured_noise_is_used_and_assumed_noise_is_increased():
    assert variance_factor(0.0, 0, True) == 1.0
    assert variance_factor(0.0, 0, False) > 2.0
