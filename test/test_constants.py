# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Constants that decide results: each test fails if its constant changes by a factor of ten."""

from itertools import pairwise

from accel_calib.capture import capture
from accel_calib.effects import EFFECTS
from accel_calib.refine import refine
from accel_calib.refine.candidates import best_of, Candidate, fall_of, Projected
from accel_calib.simulate import model_with, simulate_poses
from accel_calib.sphere import random_directions
from accel_calib.table import Recording
from accel_calib.units import units_of
import numpy as np
import pytest

COUNT = 200


@pytest.mark.parametrize(('slope_g', 'poses'), [(6e-4, 1), (3e-3, 0)])
def test_a_dwell_may_settle_but_not_turn(slope_g, poses):
    """``DWELL_SLOPE_G``."""
    rng = np.random.default_rng(1)
    time = np.arange(1000) / 100.0
    angle = slope_g * time
    force = np.column_stack([np.sin(angle), np.zeros(1000), np.cos(angle)])
    reading = force + 5e-4 * rng.normal(size=force.shape)
    found = capture(Recording({'time': time, 'reading': reading}, np.arange(1000) + 1),
                    units_of('g'))
    assert len(found.poses) == poses


def candidate(name, falls_by, parameters):
    """Return a candidate whose criterion falls by this much, and its equations."""
    left = np.exp(-(falls_by + parameters * np.log(COUNT)) / COUNT)
    columns = np.zeros((COUNT, parameters))
    columns[np.arange(parameters), np.arange(parameters)] = 1.0
    return Candidate(name, np.zeros(0), columns, 1.0, 1.0), 1.0 - left


@pytest.mark.parametrize(('ahead', 'chosen'), [(3.0, 'supply_ratio'), (7.5, 'cross_coupling')])
def test_among_equally_good_effects_the_smaller_one_is_chosen(ahead, chosen):
    """``_AS_GOOD``."""
    small, part = candidate('supply_ratio', 50.0, 4)
    large, whole = candidate('cross_coupling', 50.0 + ahead, 6)
    residual = np.zeros(COUNT)
    residual[0], residual[4], residual[10] = np.sqrt(part), np.sqrt(whole - part), 0.0
    residual[10] = np.sqrt(1.0 - whole)
    fitted = Projected(np.zeros((COUNT, 0)), residual)
    found = {'supply_ratio': small, 'cross_coupling': large}
    falls = {name: fall_of(each, fitted, COUNT) for name, each in found.items()}
    assert falls['cross_coupling'] - falls['supply_ratio'] == pytest.approx(ahead)
    assert best_of(found, fitted, COUNT).effect == chosen


def test_time_constants_are_tried_closely_and_not_more_closely():
    """``_TAUS``: the nearest one leaves less than 0.1 % of the variance, and no tenth of it."""
    time = np.arange(60) * 60.0
    shapes = list(EFFECTS['warm_up'].shapes({'time': time}))
    taus = np.array([shape[1] for shape in shapes])
    worst = 0.0
    for one, other in pairwise(taus):
        if one < 300.0 or other > 1800.0:
            continue
        true = np.exp(-time / np.sqrt(one * other))
        columns = np.column_stack([np.exp(-time / one), np.ones(60)])
        left = true - columns @ np.linalg.lstsq(columns, true, rcond=None)[0]
        worst = max(worst, float(left @ left / np.sum((true - true.mean()) ** 2)))
    assert 1e-5 < worst < 1e-3


@pytest.mark.parametrize(('unknown_mg', 'named'), [(1.0, ['quadratic']), (2.5, [])])
def test_effects_that_explain_a_small_part_of_a_gap_are_removed(unknown_mg, named):
    """``_LEAST_SHARE``."""
    rng = np.random.default_rng(4)
    model = model_with({'offset': [0.02, -0.01, 0.03], 'quadratic': [0.005, -0.005, 0.005]})
    directions = random_directions(150, rng)
    poses = simulate_poses(model, directions, rng)
    unknown = directions * rng.normal(size=(150, 1)) * unknown_mg * 1e-3
    found = refine(poses.with_columns(reading=poses.reading + unknown), units_of('g'), base='10')
    assert found.verdict == 'unexplained'
    assert [step.effect for step in found.steps] == named
