# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Constants that decide results: each test fails if its constant changes by a factor of ten."""

from itertools import pairwise

from accel_calib.capture import capture
from accel_calib.effects import EFFECTS
from accel_calib.model import Model
from accel_calib.refine import refine
from accel_calib.refine.linear import Block, Linear, linearised, outside, WORTH
from accel_calib.refine.sets import accepted, is_significant
from accel_calib.refine.state import beginning
from accel_calib.refine.wander import process_of, SIGNIFICANT, walk_beside
from accel_calib.simulate import model_with, simulate_poses
from accel_calib.sphere import random_directions
from accel_calib.table import Recording
from accel_calib.units import units_of
import numpy as np
import pytest
from scipy.special import betaincinv

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


def problem(blocks, left=1.0, worth=0.0, sizes=1e6):
    """
    Return equations in which each effect explains a part of the residual sum of squares.

    `blocks` are names, parts and numbers of values; `left` is what no effect explains.

    """
    residual, found, at = np.zeros(COUNT), [], 0
    for name, part, width in blocks:
        residual[at] = np.sqrt(part)
        found.append(Block(name, np.zeros(0), slice(at, at + width)))
        at += width
    residual[at:at + 50] = np.sqrt(left / 50)
    return Linear(np.zeros((COUNT, 0)), residual, np.arange(COUNT), tuple(found),
                  np.eye(COUNT)[:, :at], np.full(at, sizes), worth, COUNT,
                  float(residual @ residual), np.zeros((COUNT, 3)), 0.0)


def part_for(gain):
    """Return the part of a residual sum of squares of 1 whose removal gains this much."""
    return 1.0 - np.exp(-gain / COUNT)


@pytest.mark.parametrize(('ahead', 'chosen'), [(1.0, 0), (9.0, 1)])
def test_among_equally_good_effects_the_smaller_one_is_chosen(ahead, chosen):
    """``_AS_GOOD``."""
    one = problem([('supply_ratio', 0.4, 4), ('cross_coupling', 0.4, 6)], left=0.2)
    more = one.made((1,)).score - one.made((0,)).score
    part = 0.4 + 0.6 * part_for(ahead - more)
    linear = problem([('supply_ratio', 0.4, 4), ('cross_coupling', part, 6)], left=0.6 - part)
    sets = [linear.made((0,)), linear.made((1,))]
    assert sets[1].score - sets[0].score == pytest.approx(ahead)
    assert next(accepted(linear, sets)).blocks == (chosen,)


@pytest.mark.parametrize(('p_value', 'named'), [(0.004, True), (0.03, False)])
def test_an_effect_is_named_only_if_noise_is_an_unlikely_cause(p_value, named):
    """``LEVEL``."""
    gain = betaincinv(0.5, (COUNT - 1) / 2.0, 1.0 - p_value)  # of the sum of squares
    linear = problem([('supply_ratio', gain, 1)], left=1.0 - gain)
    assert linear.probability(linear.made((0,)), 0) == pytest.approx(p_value)
    assert is_significant(linear, linear.made((0,))) is named


@pytest.mark.parametrize(('gain', 'left', 'named'), [(16.0, 0.0, True), (2.5, 0.0, False),
                                                     (63.0, 360.0, False), (70.0, 20.0, True)])
def test_few_residuals_are_judged_by_the_measured_noise_too(gain, left, named):
    """``WORTH``: with 8 equations, which repeat better or worse than their noise."""
    residual = np.sqrt([gain, *np.full(7, left / 7.0)])
    linear = Linear(np.zeros((8, 0)), residual, np.arange(8),
                    (Block('supply_ratio', np.zeros(0), slice(0, 1)),), np.eye(8)[:, :1],
                    np.full(1, 1e6), WORTH, 8, gain + left, np.zeros((8, 3)), 0.0)
    assert is_significant(linear, linear.made((0,))) is named


@pytest.mark.parametrize(('part', 'rank'), [(0.06, 1), (0.006, 0)])
def test_a_column_that_the_model_nearly_contains_is_not_judged(part, rank):
    """``_SEEN``."""
    column = np.array([np.sqrt(1.0 - part ** 2), part, 0.0])[:, np.newaxis]
    onto = np.eye(3)[:, :1]
    assert outside(column, onto).shape[1] == rank
    linear = Linear(onto, np.array([0.0, 1.0, 1.0]), np.arange(3),
                    (Block('quadratic', np.zeros(0), slice(0, 1)),),
                    column - onto @ (onto.T @ column), np.ones(1), 4.0, 2, 2.0, np.zeros((3, 3)),
                    0.0)
    assert linear.gains(linear.made())[1] == [rank]


@pytest.mark.parametrize(('times', 'ahead', 'chosen'), [
    (10.0, 0.8, 0), (10.0, 4.0, 1), (1e4, 3.0, 0), (1e4, 12.0, 1)])
def test_a_larger_gain_makes_up_for_an_unusual_size(times, ahead, chosen):
    """``_USUAL`` at ten times the typical size, ``_MOST_UNUSUAL`` far beyond it."""
    part = 0.3 + 0.7 * part_for(ahead)
    usual = problem([('supply_ratio', 0.3, 1), ('quadratic', part, 1)], left=0.7 - part)
    sizes = np.array([1e6, np.sqrt(part) / (times * EFFECTS['quadratic'].typical)])
    linear = Linear(**{**vars(usual), 'sizes': sizes})
    assert usual.made((1,)).score - usual.made((0,)).score == pytest.approx(ahead)
    scores = [linear.made((block,)).score for block in (0, 1)]
    assert int(np.argmax(scores)) == chosen


@pytest.mark.parametrize(('gain', 'out'), [(18.0, False), (30.0, True)])
def test_a_pose_is_left_out_of_a_set_only_for_a_clear_gain(gain, out):
    """``_RARE``."""
    linear = problem([('supply_ratio', part_for(gain), 1)], left=1.0 - part_for(gain))
    assert (linear.made((), (0,)).score > 0.0) is out


def linear_of(count, name, rng):
    """Return poses of an ideal sensor, and the problem with the shapes of an effect."""
    poses = simulate_poses(model_with({}), random_directions(count, rng), rng,
                           context={'time': np.arange(count) * 60.0})
    state = beginning(poses, Model({key: np.zeros(3)
                                    for key in ('offset', 'axis_gain', 'cross_axis')}))
    return poses, linearised(state.fit, state.model.effects, (name,))


def test_noise_names_no_shape_more_often_than_stated():
    """``_SHAPES_ALIKE``."""
    rng = np.random.default_rng(1)
    _, linear = linear_of(60, 'gain_step', rng)
    below = []
    for _ in range(300):
        noise = rng.normal(size=60)
        noise -= linear.onto @ (linear.onto.T @ noise)
        drawn = Linear(**{**{key: each for key, each in vars(linear).items() if key != 'along'},
                          'residual': noise, 'base_rss': float(noise @ noise)})
        best = int(np.argmax(drawn.gains(drawn.made())[0]))
        below.append(drawn.probability(drawn.made((best,)), best) < 0.1)
    assert 0.01 < np.mean(below) < 0.1


@pytest.mark.parametrize(('count', 'least', 'most'), [(600, 100, 400), (1200, 30, 100)])
def test_many_instants_are_tried_at_a_distance(count, least, most):
    """``_SHAPES_AT_ONCE``; ``_MANY_POSES`` and ``_FEW_SHAPES``."""
    _, linear = linear_of(count, 'offset_step', np.random.default_rng(2))
    assert least < len(linear.blocks) < most


def test_noise_is_no_walk_and_a_small_walk_is_one():
    """``SIGNIFICANT``."""
    def likelihoods(size_g):
        found = []
        for seed in range(20):
            rng = np.random.default_rng(seed)
            poses, _ = linear_of(60, 'offset_drift', rng)
            walk = np.cumsum(rng.normal(size=(60, 3)), axis=0) * size_g
            poses = poses.with_columns(reading=poses.reading + walk)
            state = beginning(poses, Model({key: np.zeros(3) for key in (
                'offset', 'axis_gain', 'cross_axis')}))
            linear = linearised(state.fit, state.model.effects, ())
            found.append(walk_beside(linear, linear.made(),
                                     process_of(linear, poses)).likelihood_ratio)
        return np.array(found)

    noise, walks = likelihoods(0.0), likelihoods(3e-4)
    assert np.all(noise < SIGNIFICANT)
    assert np.all(walks > SIGNIFICANT)


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
