# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Empirical curves: their names, their form, the search for them, and their storage."""

import re

from accel_calib.calibration import fit_poses
from accel_calib.effects import (
    effect_named, EMPIRICAL, EmpiricalCurve, entry_of, formula_of, kind_of)
from accel_calib.findings import rate
from accel_calib.refinement import refine
from accel_calib.report import calibration_page
from inside import (
    beginning, best_curve, export, fitted_state, format_calibration, Model, model_with,
    parse_calibration, predict, simulate_poses)
import numpy as np
import pytest
from shared import G, random_directions, sensor, table

COUNT = 100
CURVES = {
    'empirical-offset.x-temperature-2-3': [4e-3, -2e-3, 15.0, 35.0],
    'empirical-gain-time-1-4': [*np.linspace(-4e-3, 5e-3, 6), 100.0, 3000.0],
    'empirical-force-std-1': [5e-3, 1e-3, 5e-3],
    'empirical-force-direction-3-5': np.linspace(-3e-3, 2e-3, 18)}


def with_curve(added_g, seed=1):
    """Return poses with an addition to the x axis over the temperature, and their sensor."""
    rng = np.random.default_rng(seed)
    context = {'time': np.arange(COUNT) * 30.0, 'temperature': rng.uniform(10.0, 40.0, COUNT)}
    model = sensor(rng)
    poses = simulate_poses(model, random_directions(COUNT, rng), rng, context=context)
    along = np.outer(added_g(context['temperature']), [1.0, 0.0, 0.0])
    return poses.with_columns(reading=poses.reading + along), model


def hump(temperature):
    """Return a hump of 8 mg at 28 °C, which no effect of the catalogue has."""
    return 8e-3 * np.exp(-0.5 * ((temperature - 28.0) / 4.0) ** 2)


def base_of(poses):
    return beginning(poses, Model({name: np.zeros(3)
                                   for name in ('offset', 'axis_gain', 'cross_axis')}))


@pytest.mark.parametrize('name', table('no_curves'))
def test_a_name_that_is_no_curve_is_refused(name):
    with pytest.raises(KeyError):
        effect_named(name)
    with pytest.raises(ValueError, match='expected one of'):
        Model({name: np.zeros(3)})


@pytest.mark.parametrize('name', [name for name in CURVES if entry_of(effect_named(name)).needs])
def test_a_curve_is_constant_outside_of_its_range(name):
    variable, (low, high) = effect_named(name).variable, CURVES[name][-2:]
    at = np.maximum([low - 1.0, low, high, 1e3 * high], 0.0)
    reading = predict(model_with({name: CURVES[name]}), np.tile([0.6, -0.48, 0.64], (4, 1)),
                      {variable: np.column_stack([at] * 3) if variable == 'std' else at})
    np.testing.assert_array_equal(reading[[0, 3]], reading[[1, 2]])
    assert np.max(np.abs(reading[2] - reading[1])) > 1e-3


def test_a_gain_that_depends_on_the_direction_has_the_forms_of_its_degrees():
    rng = np.random.default_rng(3)
    up, oblique = random_directions(200, rng), random_directions(1, rng)[0]
    for degree, factor in ((3, 2.5), (4, 35.0 / 8.0), (5, 63.0 / 8.0), (6, 231.0 / 16.0)):
        model = model_with({f'empirical-force-direction-{degree}': np.zeros(2 * degree + 1)})
        basis = model.basis(2.0 * up, {}).full
        gains = np.einsum('ni,nip->np', up, basis) / 2.0
        np.testing.assert_allclose(2.0 * up[:, :, np.newaxis] * gains[:, np.newaxis], basis,
                                   atol=1e-12)
        # Legendre's polynomial about any direction is a sum of them, and its highest power.
        lower = np.column_stack([gains, *(np.polynomial.legendre.legvander(
            up @ oblique, degree - 1).T)])
        power = factor * (up @ oblique) ** degree
        left = power - lower @ np.linalg.lstsq(lower, power, rcond=None)[0]
        assert np.max(np.abs(left)) < 1e-10
        assert np.linalg.cond(gains) < 6.0


@pytest.mark.parametrize(('oblique', 'form'), [
    ([0.6, 0.64, 0.48], lambda u: u ** 3), ([0.36, -0.48, 0.8], np.abs)])
def test_a_nonlinearity_along_an_oblique_axis_is_described(oblique, form):
    rng = np.random.default_rng(8)
    model, up = sensor(rng), random_directions(160, rng)
    bend = 8e-3 * np.outer(form(up @ oblique), [0.48, -0.6, 0.64])
    poses = simulate_poses(model, up, rng, noise_g=2e-4, context={})
    poses = poses.with_columns(reading=poses.reading + bend)
    shown, kept = poses.take(np.arange(80)), poses.take(np.arange(80, 160))
    found = refine(shown, G, base='10')
    step = found.steps[-1]
    assert (step.effect, step.variable) == ('empirical', 'direction')
    errors = [np.sqrt(np.mean((np.linalg.norm(each.correct(kept.reading), axis=1) - 1.0) ** 2))
              for each in (fit_poses(shown, G, model='10'), found.calibration)]
    assert errors[1] < 0.5 * errors[0]
    page = calibration_page(found.calibration, rate(found.calibration), '')
    assert re.search(r'<td>curve of force[^<]+</td><td>\d', page)


def test_a_curve_is_recovered_within_its_uncertainty():
    def form(temperature):
        share = (temperature - low) / (high - low)
        return 5e-3 * np.cos(2.0 * np.pi * share) - 4e-3 * np.cos(5.0 * np.pi * share)

    warm = with_curve(np.zeros_like)[0]['temperature']
    low, high = np.min(warm), np.max(warm)
    poses, truth = with_curve(form)
    state = base_of(poses)
    found = best_curve(state, poses, ())
    curve = found.name
    assert curve.changed in ('offset', 'offset.x')
    assert (curve.variable, {2, 5} <= set(curve.modes), found.out) == ('temperature', True, ())
    fit = fitted_state(Model({**state.model.values, curve: found.values}), poses).fit
    at = {'temperature': np.linspace(low, high, 21)}
    nothing = np.zeros((21, 3))
    error = predict(fit.model, nothing, at)[:, 0] - predict(truth, nothing, at)[:, 0] - form(
        at['temperature'])
    basis = fit.model.basis(nothing, at).full[:, 0]
    deviation = np.sqrt(np.einsum('np,pq,nq->n', basis, fit.covariance, basis))
    assert np.max(np.abs(error) / deviation) < 4.0
    assert np.max(deviation) < 5e-4


@pytest.mark.parametrize('scatter_g', [0.0, 2e-3])
def test_noise_and_poses_that_repeat_badly_have_no_curve(scatter_g):
    for seed in range(2):
        poses, _ = with_curve(np.zeros_like, seed)
        scatter = scatter_g * np.random.default_rng(seed).normal(size=(COUNT, 3))
        poses = poses.with_columns(reading=poses.reading + scatter)
        assert best_curve(base_of(poses), poses, ()) is None


def test_a_curve_that_leaves_most_of_the_gap_is_not_added():
    poses, _ = with_curve(hump)
    along = poses.reading / np.linalg.norm(poses.reading, axis=1, keepdims=True)
    unknown = np.random.default_rng(5).normal(size=(COUNT, 1)) * 2e-3 * along
    poses = poses.with_columns(reading=poses.reading + unknown)
    assert best_curve(base_of(poses), poses, ()) is not None
    found = refine(poses, G, base='10')
    assert (found.verdict, found.steps) == ('unexplained', ())


def test_a_hump_over_the_temperature_is_described_and_stored_and_read_with_all_digits():
    described = refine(with_curve(hump)[0], G, base='10')
    (step,) = described.steps
    assert (described.verdict, step.effect) == ('described', 'empirical')
    assert step.p_value < 1e-6
    assert step.held_out_after_mg < 0.5 * step.held_out_before_mg
    calibration = described.calibration
    name = next(name for name in calibration.model.values if kind_of(name) == EMPIRICAL)
    text = format_calibration(calibration)
    found = parse_calibration(text, 'calibration.yaml')
    assert f'  {name}: ' in text
    assert format_calibration(found) == text
    np.testing.assert_array_equal(found.model.vector, calibration.model.vector)
    at = {'temperature': np.array([5.0, 20.0, 28.0, 60.0])}
    reading = np.tile([0.1, 0.2, 0.97], (4, 1))
    np.testing.assert_array_equal(found.correct(reading, at), calibration.correct(reading, at))
    comment = ' '.join(export(found, 'c').text_or_bytes.replace(' * ', ' ').split())
    assert step.formula.replace('°C', 'degC') in comment


@pytest.mark.parametrize(('form', 'curve'), [
    ('', lambda s: 3.0 * s - 1.0), ('', lambda s: 4.0 * s ** 2),
    ('exp', lambda s: np.exp(-9.0 * s)), ('pow', lambda s: s ** 0.5),
    ('sin', lambda s: np.sin(9.0 * s + 1.0)),
    ('cos', lambda s: np.abs(np.sin(8.0 * s)))])
def test_the_formula_of_a_curve_has_its_form_and_its_values(form, curve):
    share = (np.arange(200) + 0.5) / 200
    waves = np.cos(np.pi * np.outer(np.arange(1, 11), share))
    sizes = np.linalg.lstsq(waves.T, curve(share) - np.mean(curve(share)), rcond=None)[0]
    scales = np.array([0.002, -0.001, 0.003])
    values = np.concatenate([np.outer(sizes, scales).ravel(), [12.0, 40.0]])
    words = formula_of(EmpiricalCurve('offset', 'temperature', tuple(range(1, 11))), values, {})
    assert words.endswith('t = temperature - 12, from 0 to 28 °C')
    assert {*re.findall(r'[a-z]+(?=\()', words)} == {form} - {''}
    expressions = re.findall(r'[xyz] = (.*?)(?=, [yz] = |; t)', words)
    t = 28.0 * share
    for expression, scale in zip(expressions, scales, strict=True):
        true = 1e3 * scale * (sizes @ waves)
        found = eval(expression, {'pow': np.power, 'exp': np.exp, 'sin': np.sin, 'cos': np.cos,
                                  't': t})
        assert np.sqrt(np.mean((found - true) ** 2)) <= 0.041 * np.ptp(true)
