# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The linear problem, the search over sets of effects and outliers, and the random walk."""

from dataclasses import replace
import math

from accel_calib.effects import EFFECTS, EmpiricalCurve
from inside import (
    accepted, beginning, Block, candidates, explored, fitted_state, FoundCurve, grown_curve,
    is_better_than_walk, less, Linear, linearised, Model, Near, outside_of, probabilities, Process,
    process_of, RARE, REFINE_LEVEL, reshaped, rss_beside, search_effects, Set, SIGNIFICANT,
    simulate_poses, spread_directions, Walk, walk_beside, WORTH)
import numpy as np
import pytest
from scipy.optimize import brentq
from shared import changed, random_directions, sensor

COUNT = 60
BASE = ('offset', 'axis_gain', 'cross_axis')


def poses_of(hidden, seed=1, knocked=(), oriented=False, **context):
    """Return poses of a random sensor with hidden effects, and some knocked by 20 mg."""
    rng = np.random.default_rng(seed)
    directions = random_directions(COUNT, rng)
    known = {'time': np.arange(COUNT) * 30.0, 'temperature': rng.uniform(10.0, 40.0, COUNT),
             **({'reference': directions} if oriented else {}), **context}
    model = Model({**sensor(rng).values,
                   **{name: np.array(values, float) for name, values in hidden.items()}})
    poses = simulate_poses(model, directions, rng, context=known)
    return changed(poses, list(knocked), plus=0.02 * directions[list(knocked)])


def problem_of(poses, *names):
    """Return the fitted base and the linear problem with these candidates."""
    state = beginning(poses, Model({name: np.zeros(3) for name in BASE}))
    return state, linearised(state.fit, BASE, candidates(names, state.poses_g))


def by_hand(residual, columns, names, worth=WORTH, choice=0.0, tried=1.0, size=1e6):
    """Return a linear problem with one column for each effect, and no base."""
    count = len(residual)
    blocks = tuple(Block(name, np.zeros(0), slice(k, k + 1), EFFECTS[name], 0, tried)
                   for k, name in enumerate(names))
    return Linear(np.zeros((count, 0)), np.arange(count), blocks, np.vstack([columns.T, residual]),
                  np.full(len(names), size), worth, count, float(residual @ residual),
                  np.zeros((count, 3)), choice)


def test_a_column_whose_squares_underflow_is_a_column_of_zeros():
    columns, sizes = outside_of(np.zeros((3, 0)), np.outer([1.0, 2.0, 3.0], [1.0, 1e-200]))
    assert (sizes[1], *columns[:, 1]) == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(('name', 'values'), [
    ('quadratic', [2e-3, -1e-3, 1e-3]), ('cross_coupling', [1e-3, 0, -1e-3, 0, 1e-3, 2e-3]),
    ('offset_temperature', [2e-4, 1e-4, -2e-4]), ('gain_temperature', [1e-4, -1e-4, 1e-4]),
    ('offset_step', [3e-3, -2e-3, 2e-3, 900.0])])
def test_the_gain_of_an_effect_is_that_of_a_fit_with_it(name, values):
    state, linear = problem_of(poses_of({name: values}), name)
    gain, _ = Set.of(linear).gains()
    best = int(np.argmax(gain))
    if name.endswith('temperature'):  # a fit would change the lag, too
        best = next(k for k, block in enumerate(linear.blocks) if not block.searched)
    parameters = len(EFFECTS[name].parameters)
    start = np.concatenate([np.zeros(parameters), linear.blocks[best].shape])
    after = fitted_state(Model({**state.model.values, name: start}), state.poses_g)
    assert gain[best] > 50.0
    assert gain[best] == pytest.approx(state.fit.chi2 - after.fit.chi2, rel=0.01)
    chosen = Set.of(linear, (best,))
    assert linear.base_rss - chosen.rss == pytest.approx(gain[best], rel=1e-9)
    np.testing.assert_allclose(chosen.parts[best], after.model.values[name][:parameters],
                               atol=0.02 * np.max(np.abs(values[:3])))


@pytest.mark.parametrize('known', [False, True])
@pytest.mark.parametrize('out', [(7,), (3, 20, 41)])
def test_a_set_without_a_pose_is_the_fit_without_it(out, known):
    state, linear = problem_of(poses_of({}, knocked=out, oriented=known), 'quadratic')
    chosen = Set.of(linear, (), out)
    after = fitted_state(state.model, state.poses_g.take(np.delete(np.arange(COUNT), out)))
    assert chosen.parameters == len(out) * (3 if known else 1)
    assert chosen.rss == pytest.approx(after.fit.chi2, rel=1e-3)
    kept = ~np.isin(linear.pose, out)
    onto, residual = chosen.spanned
    np.testing.assert_allclose(onto.T @ onto, np.eye(onto.shape[1]), atol=1e-9)
    np.testing.assert_allclose(residual[kept], after.fit.residual, atol=0.02)
    np.testing.assert_allclose(residual[~kept], 0.0, atol=1e-9)
    assert linear.base_rss > 10.0 * chosen.rss


def test_the_score_counts_values_shapes_choice_and_size():
    residual = np.zeros(40)
    residual[:3] = 6.0, 8.0, 2.0
    columns = np.eye(40)[:, :2]
    linear = by_hand(residual, columns, ['supply_ratio', 'quadratic'], choice=3.0, tried=5.0)
    one, both = Set.of(linear, (0,)), Set.of(linear, (0, 1))

    def expected(rss, values, charge):
        whole = WORTH + 40.0
        return (whole * math.log((WORTH + 104.0) / (WORTH + rss))
                - values * math.log(40.0) * whole / (whole - values - 1.0) - charge)

    assert Set.of(linear).score == 0.0
    assert one.score == pytest.approx(expected(68.0, 1.0, 3.0 + 2.0 * math.log(5.0)))
    assert both.score == pytest.approx(expected(4.0, 2.0, 2.0 * (3.0 + 2.0 * math.log(5.0))))
    assert one.scores_beside[1] == pytest.approx(both.score)
    assert [both.without(effect).blocks for effect in both.effects] == [(1,), (0,)]
    left_out = Set.of(linear, (), (0, 1))
    assert left_out.score == pytest.approx(expected(4.0, 2.0, 2.0 * (2.0 * math.log(40.0) + RARE)))


NAMES = ('supply_ratio', 'quadratic', 'cubic', 'offset_drift', 'warm_up', 'gain_drift')


def test_the_search_goes_on_while_the_score_rises_and_two_effects_further():
    rng = np.random.default_rng(4)
    columns, noise = np.linalg.qr(rng.normal(size=(60, 6)))[0], rng.normal(size=60)
    for count in (1, 3):
        linear = by_hand(columns[:, :count] @ np.full(count, 20.0) + noise, columns, NAMES)
        visited = explored(linear)
        assert sorted(visited[0].blocks) == list(range(count))
        assert max(len(chosen.blocks) for chosen in visited) == min(count + 2, 5)


@pytest.mark.parametrize(('count', 'cosines'), [(2, {0, 1}), (3, set())])
def test_a_curve_of_two_cosines_is_found_where_neither_alone_is_useful(count, cosines):
    axes, slope = np.eye(40), 0.2
    side = math.sqrt(1.0 - slope ** 2)
    columns = np.array([axes[0], side * axes[0] + slope * axes[1],
                        side * axes[1] + slope * axes[2]]).T[:, :count]
    linear = by_hand(math.sqrt(200.0) * axes[count - 1], columns, NAMES[:count])
    assert set(grown_curve(linear, 0.0, 0.0).blocks) == cosines


@pytest.mark.parametrize('count', [1, 2, 6])
def test_no_curve_has_a_larger_score_than_its_bound(count):
    rng = np.random.default_rng(count)
    for _ in range(20):
        columns = rng.normal(size=(40, count)) + 2.0 * rng.normal(size=(40, 1))  # correlated
        columns /= np.linalg.norm(columns, axis=0)
        residual = columns @ rng.normal(size=count) * 8.0 + rng.normal(size=40)
        linear = by_hand(residual, columns, NAMES[:count])
        least_rss = rss_beside(linear, slice(None))
        best = grown_curve(linear, least_rss, 0.0).score
        assert best == grown_curve(linear, 0.0, 0.0).score
        bound = max(linear.score(least_rss, 1.0, 0.0), 0.0)
        assert best <= bound + 1e-6
        assert count > 1 or best == pytest.approx(bound, abs=1e-6)


def test_noise_alone_is_significant_as_often_as_stated():
    names = ('supply_ratio', 'quadratic', 'cubic', 'offset_drift')
    best = []
    for seed in range(600):
        residual = np.random.default_rng(seed).normal(size=30)
        linear = by_hand(residual, np.eye(30)[:, :4], names)
        best.append(min(Set.of(linear, (k,)).probability(names[k]) for k in range(4)))
    assert np.mean(np.array(best) < 0.1) == pytest.approx(0.1, abs=0.03)
    assert np.mean(np.array(best) < REFINE_LEVEL) == pytest.approx(REFINE_LEVEL, abs=0.009)


def test_two_effects_are_found_where_neither_alone_is_significant():
    time = np.arange(COUNT) * 60.0
    warm = 20.0 + 15.0 * (1.0 - np.exp(-time / 2500.0))
    slope = np.polyfit(time / 3600.0, warm, 1)[0]  # the drift hides the effect of temperature
    size = 0.002 * np.array([1.0, -1.0, 1.0])
    hidden = {'offset_temperature': size, 'offset_drift': [*(-slope * size), 0.0]}
    _, linear = problem_of(  # a cubic beside a warm-up imitates both
        poses_of(hidden, time=time, temperature=warm), *{*EFFECTS} - {'offset_temperature_cubic'})
    for block, each in enumerate(linear.blocks):
        if each.effect in hidden:
            assert Set.of(linear, (block,)).probability(each.effect) > REFINE_LEVEL
    best = next(accepted(explored(linear)))
    assert set(best.effects) == set(hidden)
    assert all(best.probability(name) < REFINE_LEVEL for name in best.effects)


@pytest.mark.parametrize(('better', 'preferred'), [(1.9, 'quadratic'), (2.1, 'cubic')])
def test_of_sets_that_are_almost_as_good_the_one_with_fewest_values_is_preferred(
        better, preferred):
    def sets_at(side):
        linear = by_hand(np.array([16.0, 16.0, side, *np.zeros(37)]), np.eye(40)[:, :3],
                         ('quadratic', 'cubic', 'cubic'))
        one, two, _ = linear.blocks
        linear = replace(linear, blocks=(one, two._replace(columns=slice(1, 3))))
        return [Set.of(linear, (k,)) for k in (1, 0)]

    side = brentq(lambda side: np.diff([each.score for each in sets_at(side)])[0] + better, 0, 30)
    assert next(accepted(sets_at(side))).effects == (preferred,)


@pytest.mark.parametrize(('noise', 'size', 'probability', 'is_accepted'), [
    (1.0, 7.0, 0.04, True), (1.0, 7.0, 0.06, False),  # explains all of a gap
    (1.25, 7.0, 0.04, False), (1.25, 7.0, 0.009, True),  # leaves more than the noise
    (1.0, 3.0, 0.04, False), (1.0, 3.0, 0.009, True)])  # there is no gap
def test_an_effect_that_explains_all_of_a_gap_needs_less(noise, size, probability, is_accepted):
    residual = np.array([size, *np.full(39, noise)])
    alone = Set.of(by_hand(residual, np.eye(40)[:, :1], ['quadratic']), (0,))
    tried = probability / alone.probability('quadratic')
    chosen = Set.of(by_hand(residual, np.eye(40)[:, :1], ['quadratic'], tried=tried), (0,))
    assert chosen.probability('quadratic') == pytest.approx(probability)
    assert list(accepted([chosen])) == [chosen] * is_accepted


def test_a_reshaped_set_has_all_other_effects_and_the_best_shape():
    time = np.arange(COUNT) * 30.0
    size, lag, turn = np.array([4e-4, -4e-4, 4e-4]), 240.0, time / 400.0
    poses = poses_of({}, time=time, temperature=25.0 + 10.0 * np.sin(turn))
    behind = np.sin(turn - np.arctan(lag / 400.0)) / np.hypot(1.0, lag / 400.0)
    poses = poses.with_columns(reading=poses.reading + 10.0 * behind[:, np.newaxis] * size)
    names = ('cross_coupling', 'offset_temperature', 'temperature_rate', 'quadratic')
    _, linear = problem_of(poses, *names)
    chosen = Set.of(linear, [int(linear.numbers_of[name][0]) for name in names])
    found, = (each for each in reshaped(chosen)
              if set(each.effects) == {*names} - {'temperature_rate'})
    shape, = (linear.blocks[each].shape for each in found.blocks
              if linear.blocks[each].effect == 'offset_temperature')
    assert shape == pytest.approx([lag, 0.0], rel=0.3)


def test_the_rivals_of_an_effect_of_the_ladder_are_of_the_ladder_and_those_of_others_are_all():
    names, axes = ['axis_gain', 'cross_axis', 'quadratic', 'cubic'], np.eye(40)
    columns = np.column_stack([0.96 * axes[0] + 0.28 * other for other in axes[1:5]])
    noise = np.where(np.arange(40) > 4, np.cos(np.arange(40.0)), 0.0)
    linear = by_hand(5.0 * columns.sum(axis=1) + noise, columns, names)
    for block, rivals in ((0, names[:2]), (2, names)):
        chosen = Set.of(linear, (block,))
        found = probabilities(*chosen.effects, Near(chosen, linear, None, None))
        assert sorted(found) == sorted(rivals)


def random_walk(count, modes, ratio, rng):
    """Return random modes with decreasing variances as a walk, and the variance of residuals."""
    axes, values = np.linalg.qr(rng.normal(size=(count, modes)))[0], 1.0 / np.arange(1, modes + 1)
    return (Walk(Process(axes, values ** 2), ratio, 0.0, 0.0),
            np.eye(count) + ratio * (axes * values ** 2) @ axes.T)


def test_whitened_equations_are_those_of_generalised_least_squares():
    rng = np.random.default_rng(3)
    residual, columns = rng.normal(size=20), rng.normal(size=(20, 2))
    linear = by_hand(residual, columns, ['supply_ratio', 'offset_drift'], size=1.0)
    walk, variance = random_walk(20, 4, 50.0, rng)
    white, inverse = walk.whitened(linear), np.linalg.inv(variance)
    both = np.column_stack([columns, residual])
    products = np.vstack([*white.products_with((0, 1)), white.with_residual])
    np.testing.assert_allclose(products, both.T @ inverse @ both)
    onto, left = Set.of(white).spanned
    assert onto.shape == (20, 0)
    assert left @ left == pytest.approx(residual @ inverse @ residual)
    values = np.linalg.solve(columns.T @ inverse @ columns, columns.T @ inverse @ residual)
    found = Set.of(white, (0, 1)).parts
    np.testing.assert_allclose([found[0][0], found[1][0]], values)
    flat = replace(walk, ratio=0.0).whitened(linear)
    np.testing.assert_array_equal(Set.of(flat).spanned[1], residual)
    assert white.penalty - flat.penalty == pytest.approx(np.linalg.slogdet(variance)[1])


@pytest.mark.parametrize('chosen', [(), (0,)])
@pytest.mark.parametrize('repeats', [1, 3])
def test_a_held_out_residual_beside_a_walk_is_predicted_by_the_other_orientations(chosen, repeats):
    rng, ratio = np.random.default_rng(6), 30.0
    base, axes = np.split(np.linalg.qr(rng.normal(size=(15, 5)))[0], [1], axis=1)
    process = Process(axes, 1.0 / np.arange(1, 5) ** 2)
    variance = np.eye(15) + ratio * (axes * process.values) @ axes.T
    both = rng.normal(size=(15, 2))
    residual, column = np.split(both - base @ (base.T @ both), 2, axis=1)
    linear = replace(by_hand(residual[:, 0], column, ['supply_ratio']), onto=base)
    left, held_out = Walk(process, ratio, 0.0, 0.0).residuals(
        Set.of(linear, chosen), np.tile(spread_directions(15 // repeats), (repeats, 1)))
    design = np.column_stack([base, column[:, :len(chosen)]])

    def beside(rows):
        inverse = np.linalg.inv(variance[np.ix_(rows, rows)])
        normal = design[rows].T @ inverse
        return residual[:, 0] - design @ np.linalg.solve(
            normal @ design[rows], normal @ residual[rows, 0])

    for k in range(15):
        others = np.flatnonzero((np.arange(15) - k) % (15 // repeats))
        own, row = beside(others), variance[k, others]
        expected = own[k] - row @ np.linalg.solve(variance[np.ix_(others, others)], own[others])
        assert held_out[k] == pytest.approx(expected)
    np.testing.assert_allclose(left, np.linalg.solve(variance, beside(np.arange(15))))


@pytest.mark.parametrize('seed', [2, 8])
def test_an_effect_that_a_walk_hides_is_found_beside_the_walk(seed):
    steps = np.random.default_rng(seed).normal(size=(COUNT, 3))
    poses = poses_of({'offset_temperature': [3e-4, -2.1e-4, 2.1e-4]}, seed=seed)
    poses = poses.with_columns(reading=poses.reading + np.cumsum(steps * 3e-3, axis=0))
    found = search_effects(poses, Model({name: np.zeros(3) for name in BASE}))
    assert found.added == ('offset_temperature', 'offset_wander')


@pytest.mark.parametrize(('seed', 'stays'), [(5, True), (3, False)])
def test_a_walk_is_estimated_anew_beside_fewer_effects(seed, stays):
    steps = np.random.default_rng(seed).normal(size=(COUNT, 3))
    poses = poses_of({'offset_temperature': [9e-4, -6e-4, 6e-4]}, seed=seed)
    poses = poses.with_columns(reading=poses.reading + np.cumsum(steps * 2e-3, axis=0))
    found = search_effects(poses, Model({name: np.zeros(3) for name in BASE}))
    assert found.added == ('offset_temperature', 'offset_wander')
    fewer = less(found, ['offset_temperature'])
    final = fewer.final.linear
    anew = walk_beside(Set.of(final), process_of(final, fewer.final.poses_g))
    assert (anew.likelihood_ratio > SIGNIFICANT) == stays
    assert 'offset_temperature' not in fewer.final.model.values
    assert (fewer.walk and fewer.walk.ratio) == (anew.ratio if stays else None)
    assert (fewer.near.chosen.linear.white is not None) == stays
    assert fewer.near.chosen.score < found.near.chosen.score


@pytest.mark.parametrize(('size', 'worth', 'values', 'least', 'most'), [
    (5.0, 0.0, 0, 5.0, 150.0), (100.0, 0.0, 0, 1e3, 1e3), (30.0, WORTH, 30, 1e3, 5e3)])
def test_the_variance_of_a_walk_is_bounded_by_the_noise_or_where_that_is_not_known(
        size, worth, values, least, most):
    rng = np.random.default_rng(3)
    process = random_walk(60, 6, 1.0, rng)[0].process
    along = np.sqrt(process.values) * rng.normal(size=6) * size
    linear = by_hand(process.axes @ along + rng.normal(size=60), np.eye(60)[:, :30],
                     ['supply_ratio'] * 30, worth=worth)
    ratio = walk_beside(Set.of(linear, range(values)), process).ratio
    assert least * (1.0 - 1e-9) <= ratio <= most * (1.0 + 1e-9)


@pytest.mark.parametrize(('variable', 'score', 'better'), [
    ('temperature', 19.9, False), ('temperature', 20.1, True), ('time', 49.9, False),
    ('time', 50.1, True)])
def test_a_curve_over_time_must_be_clearly_better_than_a_walk(variable, score, better):
    rng = np.random.default_rng(3)
    linear = by_hand(rng.normal(size=20), np.eye(20)[:, :1], ['supply_ratio'])
    nothing = Set.of(linear)
    walk = Walk(random_walk(20, 4, 1.0, rng)[0].process, 1.0, nothing.score + 20.0, 50.0)
    curve = FoundCurve(EmpiricalCurve('offset', variable, (1,)), np.zeros(5), score, (), 0.0, 1.0)
    assert is_better_than_walk(curve, Near(nothing, linear, walk, None)) == better
