# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Outliers are found, and clean poses are kept."""

from accel_calib.calibrate import fit_poses
from accel_calib.simulate import simulate_poses
from accel_calib.sphere import spread_directions
from accel_calib.units import units_of
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
    clean = [len(left_out(knocked(seed, 12, 2)) - {1, 2}) for seed in range(40)]
    assert np.count_nonzero(clean) <= 6


@pytest.mark.parametrize('count', [36, 400])
def test_underestimated_noise_makes_no_outliers(count):
    thrown = []
    for seed in range(10):
        poses = knocked(seed, count, 0)
        thrown.append(len(left_out(poses.with_columns(std=poses['std'] / 3.0))))
    assert sum(thrown) <= 1


@pytest.mark.parametrize('count', [100, 400])
def test_all_outliers_are_found_if_a_fifth_of_the_poses_is_knocked(count):
    bad = count // 5
    poses = knocked(7, count, bad)
    assert left_out(poses) == set(poses.row[:bad].tolist())


@pytest.mark.parametrize('count', [40, 400])
def test_at_most_a_quarter_of_the_poses_is_left_out(count):
    poses = knocked(8, count, 2 * count // 5)
    assert len(left_out(poses)) <= count // 4
