# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The correction of one reading equals that of arrays, for every effect of the catalogue."""

from dataclasses import replace

from accel_calib.calibrate import fit_poses
from accel_calib.effects import EFFECTS
from accel_calib.errors import InputError
from accel_calib.units import units_of
from inside import Model, OneReading, rotation_from_rpy, simulate_poses, spread_directions
import numpy as np
import pytest
from shared import random_directions, sensor

OTHERS = [name for name, effect in EFFECTS.items() if not effect.linear]
KNOWN = {'temperature': 31.0, 'supply_voltage': 3.1, 'time': 4000.0, 'rate': (1.0, -2.0, 0.5),
         'std': (0.01, 0.02, 0.03), 'previous': (0.0, 0.6, -0.8)}
OWN = [4e-8, 1e-8, -1e-8, 1e-8, 5e-8, 2e-8, -1e-8, 2e-8, 6e-8]
SHAPES = {'start': 1000.0, 'tau': 1800.0, 'instant': 3000.0, 'lag': 0.0, 'of_sensor': 0.0,
          'form': 0.0}
SIZES = {'g/h': 1.0, 'm': 0.1, 'g': 0.01, '1/°C': 1e-3, 'g/°C': 1e-3}


def calibration_with(*names, unit='m/s2', seed=1, levelled=True):
    """Return a calibration with a linear fit and these effects, and a covariance of all values."""
    rng = np.random.default_rng(seed)
    units = units_of(unit)
    poses = simulate_poses(sensor(rng), spread_directions(20), rng)
    poses = poses.with_columns(reading=units.from_g(poses.reading),
                               std=units.from_g(poses['std']))
    fitted = fit_poses(poses, units, model='10')
    values = dict(fitted.model.values)
    for name in names:
        effect = EFFECTS[name]
        own = rng.normal(size=len(effect.parameters)) * SIZES.get(effect.unit, 0.003)
        values[name] = np.concatenate([own, [SHAPES[part] for part in effect.shape]])
    rotation = rotation_from_rpy(0.3, -0.2, 1.0) if levelled else np.eye(3)
    model = Model(values, rotation)
    root = rng.normal(size=(len(model.vector), len(model.vector))) * 1e-4
    return replace(fitted, model=model, covariance=root @ root.T)


def arrays():
    return {key: np.array([value]) for key, value in KNOWN.items()}


def check(calibration, scale):
    """Compare forces and covariances at readings of 0.1 to 3 g."""
    here = OneReading(calibration, scale).at(KNOWN)
    rng = np.random.default_rng(5)
    for reading in random_directions(20, rng) * rng.uniform(0.1, 3.0, (20, 1)):
        reading = calibration.units.from_g(reading)
        force = calibration.correct(reading[np.newaxis], arrays())
        found = here.correct(*reading.tolist())
        np.testing.assert_allclose(found, force[0] * scale, rtol=0, atol=1e-12)
        expected = calibration.force_covariance(force, arrays())[0] * scale ** 2
        spreads = here.with_spread(found, [0.0] * 9), here.with_spread(found, OWN)
        np.testing.assert_allclose(np.reshape(spreads[0], (3, 3)), expected, rtol=1e-9,
                                   atol=1e-18)
        np.testing.assert_allclose(np.subtract(*spreads), -np.array(OWN), atol=1e-18)


@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize(('unit', 'scale'), [('m/s2', 1.0), ('g', 9.80665), ('native', 9.81)])
def test_linear_calibration_is_that_of_the_arrays(unit, scale, levelled):
    check(calibration_with(unit=unit, levelled=levelled), scale)


@pytest.mark.parametrize('name', OTHERS)
def test_each_effect_is_that_of_the_catalogue(name):
    check(calibration_with(name), 1.0)


@pytest.mark.parametrize('seed', range(5))
def test_models_of_several_effects_are_those_of_the_arrays(seed):
    rng = np.random.default_rng(seed)
    names = rng.choice(OTHERS, size=4, replace=False)
    check(calibration_with(*names, unit='g', seed=seed), 9.80665)


def test_acting_temperature_is_limited_to_its_range_at_the_poses():
    calibration = calibration_with('offset_temperature')
    values = dict(calibration.model.values)
    values['offset_temperature'] = np.array([*values['offset_temperature'][:3], 50.0, 1.0])
    count = len(calibration.poses)
    poses = calibration.poses.with_columns(temperature=20.0 + np.arange(count),
                                           time=100.0 * np.arange(count))
    calibration = replace(calibration, model=Model(values), poses=poses)
    low, high = calibration.ranges['temperature_of_offset']
    assert (low, high) == pytest.approx((20.5, 19.5 + count), abs=0.02)
    assert 'time' not in calibration.ranges
    at = [calibration.apply([[0.0, 0.0, 9.8]] * 200, time=1e6 + np.arange(200.0),
                            temperature=np.full(200, each))[-1] for each in (high, 90.0, 25.0)]
    np.testing.assert_allclose(at[0], at[1], atol=1e-6)
    assert np.max(np.abs(at[0] - at[2])) > 1e-3


def test_context_of_one_reading_is_limited_to_the_ranges():
    calibration = calibration_with('offset_temperature')
    poses = calibration.poses.with_columns(temperature=np.linspace(20.0, 30.0, 20))
    calibration = replace(calibration, poses=poses)
    reader = OneReading(calibration)
    for temperature, edge in ((80.0, 30.0), (-40.0, 20.0)):
        beyond, at_edge = (reader.at({'temperature': each}).correct(1.0, 2.0, 9.0)
                           for each in (temperature, edge))
        assert beyond == at_edge
        context = {'temperature': np.array([temperature])}
        np.testing.assert_allclose(beyond, calibration.correct(np.array([[1.0, 2.0, 9.0]]),
                                                               context)[0], atol=1e-12)


def test_effects_too_large_to_be_corrected_are_refused():
    calibration = calibration_with()
    model = Model({**calibration.model.values, 'cubic': np.full(3, -0.5)})
    large = replace(calibration, model=model,
                    covariance=np.zeros((len(model.vector), len(model.vector))))
    with pytest.raises(InputError, match='too large'):
        OneReading(large).at({}).correct(30.0, 0.0, 0.0)
