# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The measurement equation: correct is the inverse of predict."""

from accel_calib.effects import EFFECTS
from accel_calib.errors import InputError
from inside import (
    correct, linear_model, Model, model_with, parse_effect, predict, rotation_from_rpy,
    with_vector)
import numpy as np
import pytest
from shared import context_of, random_directions, table, values_of


@pytest.fixture
def rng():
    return np.random.default_rng(7)


ADDED = [name for name, effect in EFFECTS.items() if not effect.output]


@pytest.mark.parametrize('name', ADDED)
def test_basis_and_slope_are_the_derivatives_by_the_values_and_by_the_force(name, rng):
    effect, force, context = EFFECTS[name], random_directions(40, rng), context_of(rng, 40)
    values = values_of(name, 0.15 * rng.normal(size=18))
    basis = Model({name: values}).basis(force, context).full
    for k, part in enumerate(effect.values):
        if part in ('start', 'instant', 'of_sensor', 'form'):  # taken from the data, not fitted
            continue
        step = 1e-4 * max(abs(values[k]), 1.0) * (np.arange(len(values)) == k)
        change = (predict(Model({name: values + step}), force, context)
                  - predict(Model({name: values - step}), force, context)) / (2 * step[k])
        np.testing.assert_allclose(basis[:, :, k], change, atol=1e-9)
        assert np.any(np.abs(change) > 0)
    numeric = [(predict(Model({name: values}), force + 1e-6 * axis, context)
                - predict(Model({name: values}), force - 1e-6 * axis, context)) / 2e-6
               for axis in np.eye(3)]
    np.testing.assert_allclose(Model({name: values}).at(context).slope(force),
                               np.stack(numeric, axis=2), atol=1e-7)


def test_a_ratiometric_output_scales_all_gains_and_the_basis_is_its_derivative(rng):
    force, context = random_directions(40, rng), context_of(rng, 40)
    alone = dict(map(parse_effect, ('offset=0.1,0.2,-0.1', 'axis_gain=0.03,-0.02,0.01',
                                    'cross_axis=0.01,0.02,0.03', 'quadratic=0.02')))
    change = (context['supply_voltage'] / 3.3 - 1.0)[:, np.newaxis]
    whole = Model({**alone, **dict([parse_effect('supply_ratio=0.9,0.1,0,0')])})
    linear, bend = (Model({name: part for name, part in alone.items() if (name == 'quadratic') is
                           bends}) for bends in (False, True))
    gained = predict(linear, force, {}) - alone['offset']
    expected = (alone['offset'] + gained * (1.0 + 0.9 * change) + [0.1, 0.0, 0.0] * change
                + predict(bend, force, {}) - force)
    np.testing.assert_allclose(predict(whole, force, context), expected, atol=1e-14)
    np.testing.assert_allclose(correct(whole, expected, context), force, atol=1e-12)
    lagging = Model({**whole.values, 'gain_temperature': np.array([1e-3, 0.0, 2e-3, 40.0, 0.0])})
    vector, basis = lagging.vector, lagging.basis(force, context).full
    for k in np.flatnonzero(lagging.fitted):
        step = 1e-4 * max(abs(vector[k]), 1.0) * (np.arange(len(vector)) == k)
        slope = (predict(with_vector(lagging.effects, vector + step), force, context)
                 - predict(with_vector(lagging.effects, vector - step), force, context))
        np.testing.assert_allclose(basis[:, :, k], slope / (2 * step[k]), atol=1e-9)
        assert np.any(np.abs(slope) > 0)


def test_a_covariate_changes_the_offset_from_its_zero_on():
    model = model_with({'offset_covariate-current-2': [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 4.0]})
    added = predict(model, np.zeros((2, 3)), {'current': np.array([4.0, 6.0])})
    np.testing.assert_allclose(added, [[0.0, 0.0, 0.0], [2.4, 4.8, 7.2]])


def test_effects_of_the_output_act_on_the_whole_reading():
    force = np.array([[0.5, -0.96, 0.123]])
    offset = parse_effect('offset=0.01,-0.01,0.002')
    clipped = Model(dict([offset, parse_effect('saturation=0.95')]))
    np.testing.assert_allclose(predict(clipped, force, {}), [[0.51, -0.95, 0.125]])
    grid = Model(dict([offset, parse_effect('quantisation=0.02')]))
    np.testing.assert_allclose(predict(grid, force, {}), [[0.52, -0.96, 0.12]])


def test_effects_by_hand():
    force = np.array([[0.5, -2.0, 3.0]])
    context = {'temperature': np.array([35.0]), 'std': np.array([[0.1, 0.2, 0.3]]),
               'time': np.array([7300.0]), 'supply_voltage': np.array([3.63]),
               'rate': np.array([[0.0, 0.0, 2.0]]), 'previous': np.array([[0.6, 0.0, -0.8]]),
               'earlier': np.array([[0.0, 0.8, 0.6]]),
               'since_turn': np.array([20.0]), 'duration': np.array([10.0]),
               'temperature_rate': np.array([0.01])}
    cases = {
        **table('effects_by_hand'),
        'warm_up=1,2,3,100,7200': (np.exp(-1), 2 * np.exp(-1), 3 * np.exp(-1)),
        'creep=1,2,3,10': np.array([0.6, 0.0, -2.4]) * (np.exp(-2) - np.exp(-3))}
    assert {case.partition('=')[0] for case in cases} == set(ADDED)
    for text, added in cases.items():
        model = Model(dict([parse_effect(text)]))
        np.testing.assert_allclose(predict(model, force, context)[0] - force[0], added,
                                   atol=1e-12, err_msg=text)


def test_gain_and_offset_make_the_equation_of_an5286(rng):
    mat_w, vec_v = np.eye(3) + rng.normal(size=(3, 3)) * 0.1, rng.normal(size=3)
    rotation = rotation_from_rpy(0.1, 0.2, 0.3)
    model = Model(linear_model('12', mat_w, vec_v).values, rotation)
    force = random_directions(5, rng)
    np.testing.assert_allclose(predict(model, force, {}), force @ (mat_w @ rotation).T + vec_v)
    for found, given in zip(model.linear_part, (mat_w, vec_v), strict=True):
        np.testing.assert_allclose(found, given, atol=1e-15)


@pytest.mark.parametrize(('effect', 'message'), [
    ('offset_temperature', 'need temperature, which the input does not have'),
    ('quadratic', 'too large to be corrected')])
def test_a_reading_that_cannot_be_corrected_is_refused(effect, message):
    with pytest.raises(InputError, match=message):
        correct(Model({effect: np.full(3, 5.0)}), np.full((1, 3), -3.0), {})


@pytest.mark.parametrize('values', [{'offest': np.ones(3)}, {'offset': np.ones(2)}])
def test_model_refuses_what_is_not_in_the_catalogue(values):
    with pytest.raises(ValueError, match='off'):
        Model(values)


@pytest.mark.parametrize(('text', 'values'), [
    ('offset_temperature=1', [1, 1, 1, 0, 0]), ('offset_temperature=1,2,3', [1, 2, 3, 0, 0]),
    ('gain_temperature=1,2,3,60,1', [1, 2, 3, 60, 1]), ('hysteresis=1,2,3', [1, 2, 3, 0, 0]),
    ('hysteresis=1,2,3,1', [1, 2, 3, 1, 0]), ('hysteresis=1,2,3,1,0.5', [1, 2, 3, 1, 0.5])])
def test_shape_that_is_not_stated_has_its_usual_value(text, values):
    name, found = parse_effect(text)
    np.testing.assert_array_equal(found, values)
    stated = np.array(values[:len(text.split(','))] if ',' in text else values[:3], float)
    np.testing.assert_array_equal(Model({name: stated}).vector, values)
    shown = EFFECTS[name].shown(found)
    assert list(shown) == list(EFFECTS[name].values[:len(stated)])
