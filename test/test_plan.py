# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Plans of poses that separate a named effect from its rivals."""

from dataclasses import replace

from accel_calib.calibration import NextPose, PlannedPose, SessionPlan
from accel_calib.findings import rival_words
from accel_calib.refinement import refine
from inside import choose_levels, Guide, model_with, simulate_poses, step_of
import numpy as np
import pytest
from shared import G, poses_of, random_directions


def simulated(rng, up=None, *, noise_g, context=None, **effects):
    """Return poses of a sensor with an offset and these effects."""
    model = model_with({'offset': np.array([0.02, -0.01, 0.03]),
                        **{name: np.array(values) for name, values in effects.items()}})
    return simulate_poses(model, random_directions(24, rng) if up is None else up, rng,
                          noise_g=noise_g, context=context)


def test_voltages_of_a_plan_are_the_ends_and_the_middle_of_those_of_the_poses():
    rng = np.random.default_rng(0)
    time = np.arange(24) * 60.0
    supply = 3.2 + 0.2 * (time / time[-1] + 0.1 * rng.normal(size=24))
    poses = simulated(rng, noise_g=0.004, supply_ratio=[0.002, 0.04, -0.04, 0.04],
                      context={'time': time, 'supply_voltage': supply})
    planned = refine(poses, G, base='10').plan.poses
    low, high = np.min(supply), np.max(supply)
    assert planned
    for pose in planned:
        assert min(abs(pose.context['supply_voltage'] - each)
                   for each in (low, (low + high) / 2.0, high)) < 1e-9


@pytest.mark.parametrize(('taken', 'expected'), [
    ([20.0, 24.0, 30.0], [25.0, 20.0, 30.0, 15.0, 35.0]),
    ([-30.0, 90.0], [30.0, -30.0, 90.0, -30.0, 90.0]),
    ([-10.0, np.nan, 60.0], [25.0, -10.0, 60.0, -20.0, 70.0]),
    ([62.0, 66.0], [64.0, 62.0, 66.0, 60.0, 68.0])])
def test_temperatures_of_a_plan_are_those_of_the_poses_and_some_beyond(taken, expected):
    poses = poses_of(np.eye(3)[:len(taken)], temperature=taken)
    assert choose_levels('temperature', poses) == expected


def test_the_poses_of_the_plan_name_the_hidden_effect():
    rng, hidden = np.random.default_rng(11), {'cubic': [0.004, -0.003, 0.004], 'noise_g': 0.004}
    poses = simulated(rng, **hidden)
    before = refine(poses, G, base='10')
    planned = np.array([pose.up for pose in before.plan.poses])
    assert len(planned)
    taken = np.repeat(planned, 40, axis=0)
    taken = taken + 0.2 * rng.normal(size=taken.shape)  # by hand
    more = simulated(rng, taken / np.linalg.norm(taken, axis=1, keepdims=True), **hidden)
    joined = replace(poses, columns={key: np.concatenate([poses[key], more[key]])
                                     for key in poses.columns},
                     row=np.arange(1, len(poses) + len(more) + 1))
    after = refine(joined, G, base='10')
    assert after.steps[-1].probabilities['cubic'] > 0.95


@pytest.mark.parametrize(('seed', 'size'), [(3, 0.006), (7, 0.01)])
def test_a_plan_is_made_below_a_probability_of_95_percent_and_ends_there(seed, size):
    poses = simulated(np.random.default_rng(seed), noise_g=0.003,
                      cubic=size * np.array([1.0, -0.75, 1.0]))
    found = refine(poses, G, base='10')
    largest = max(found.steps[-1].data_probabilities.values())
    assert largest == pytest.approx(0.95, abs=0.015)
    expected = [pose.expected for pose in found.plan.poses]
    assert bool(expected) is (largest < 0.95)
    assert not expected or max(expected[:-1]) < 0.95 <= expected[-1] < 0.96


@pytest.mark.parametrize('seed', range(3))
def test_what_is_usual_does_not_replace_a_pose_that_would_show_it(seed):
    rng, count = np.random.default_rng(seed), 24
    at = np.arange(count, dtype=float)
    known = {'time': 30.0 * at, 'temperature': 20.0 + at / 2.0}  # a ramp: both are one line
    poses = simulated(rng, noise_g=0.003, context=known, offset_drift=[0.05, -0.04, 0.06, 0.0])
    found = refine(poses, G, base='7')
    step = found.steps[-1]
    assert {step.effect, *step.rivals} >= {'offset_temperature', 'offset_drift'}
    usual, by_data = ([chances[name] for name in ('offset_temperature', 'offset_drift')]
                      for chances in (step.probabilities, step.data_probabilities))
    assert usual[0] > 5.0 * usual[1]  # the drift is a hundred usual ones
    assert by_data[0] == pytest.approx(by_data[1], abs=0.1)
    assert any(words.count('%') == 2 for words in rival_words(step))
    assert found.plan.poses


def planned(up, **context):
    return PlannedPose(up, context, ('cubic', 'odd_quadratic'), 0.9)


def guide_at(guide, up):
    asked = NextPose(np.array([1.0, 0.0, 0.0]), 0.5, 12, True)
    return guide.choose(SessionPlan(asked, len(up), np.array(up, float).reshape(-1, 3), 1e-4, 0.5))


def test_the_node_asks_for_the_poses_of_the_plan_and_then_for_refine():
    guide = guide_at(Guide(planned=(
        planned((0.0, 0.0, 1.0)), planned((0.0, 1.0, 0.0), temperature=40.0)), begun=1), [
            (0, 0, -1)])
    assert guide.plan.asked.direction.tolist() == [0.0, 0.0, 1.0]
    guide = guide_at(guide, [(0, 0, -1), (0, 0.1, 1)])
    assert guide.plan.asked.direction.tolist() == [0.0, 1.0, 0.0]
    guide = guide_at(guide, [(0, 0, -1), (0, 0.1, 1), (0, 1, 0)])
    assert (step_of(guide).step, step_of(guide).command) == ('refine', 'refine')
    guide = guide_at(guide, [])
    assert (step_of(guide).step, step_of(guide).command) == ('poses', 'fit')
