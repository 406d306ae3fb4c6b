# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A fleet is fitted as its sensors are one by one."""

from accel_calib.calibrate import fit_many, fit_poses
from accel_calib.errors import RefusedFitError
from accel_calib.model import predict
from accel_calib.sphere import random_directions, spread_directions
from accel_calib.table import numbered, Poses
from accel_calib.units import Units, units_of
import numpy as np
import pytest
from shared import sensor

COUNT = 14


def fleet(seed, sensors=12, per_g=1.0):
    """Draw pose means and their noise of several sensors; every third has a knocked pose."""
    rng = np.random.default_rng(seed)
    directions = [spread_directions(COUNT) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
                  for _ in range(sensors)]
    reading = np.stack([predict(sensor(rng), each, {}) for each in directions])
    noise = 3e-4 * np.exp(0.3 * rng.normal(size=reading.shape))
    reading += noise * rng.normal(size=reading.shape)
    reading[::3, 5] *= 1.04
    return reading * per_g, noise * per_g


def one(reading, noise):
    """Make the pose table of one sensor."""
    columns = {'reading': reading, 'std': noise, 'count': np.ones(len(reading))}
    return Poses(columns, numbered(columns))


@pytest.mark.parametrize('units', [units_of('g'), units_of('m/s2'), units_of('native')])
@pytest.mark.parametrize('model', ['4', '7', '10'])
@pytest.mark.parametrize('method', ['ml', 'algebraic'])
def test_each_sensor_is_fitted_as_alone(units, model, method):
    per_g = {'g': 1.0, 'm/s2': 9.80665, 'native': 4096.0}[units.name]
    reading, noise = fleet(1, per_g=per_g)
    found = fit_many(reading, units, model=model, method=method, noise=noise)
    assert np.all(found.fitted)
    for k in range(len(reading)):
        alone = fit_poses(one(reading[k], noise[k]), units, model=model, method=method)
        scale = alone.units.per_g
        np.testing.assert_allclose(found.offset[k] / scale, alone.offset / scale, atol=3e-5)
        np.testing.assert_allclose(found.gain[k], alone.gain, rtol=3e-5, atol=3e-5 * scale)
        np.testing.assert_allclose(found.covariance[k], alone.covariance, rtol=0.05, atol=1e-12)
        rejected = [each.row for each in alone.rejected]
        assert list(np.flatnonzero(found.rejected[k]) + 1) == rejected
        assert found.rms_mg[k] == pytest.approx(alone.quality.rms_after_mg, rel=1e-2)


def test_noise_that_is_not_known_comes_from_the_residuals():
    reading, noise = fleet(2)
    found = fit_many(reading, units_of('g'))
    for k in range(len(reading)):
        poses = one(reading[k], noise[k])
        alone = fit_poses(Poses({'reading': poses.reading}, poses.row), units_of('g'), model='10')
        np.testing.assert_allclose(found.offset[k], alone.offset, atol=3e-5)
        np.testing.assert_allclose(found.covariance[k], alone.covariance, rtol=0.05, atol=1e-12)


def test_a_sensor_whose_poses_do_not_carry_the_model_does_not_touch_the_others():
    reading, noise = fleet(3)
    flat = reading.copy()
    flat[4] = random_directions(COUNT, np.random.default_rng(0)) * [1.0, 1.0, 0.0]
    flat[7] = reading[7, :1]
    found, expected = (fit_many(each, units_of('g'), noise=noise) for each in (flat, reading))
    assert list(np.flatnonzero(~found.fitted)) == [4, 7]
    assert np.all(np.isnan(found.offset[[4, 7]]))
    assert np.all(np.isnan(found.gain[[4, 7]]))
    assert np.all(np.isinf(found.dilution[[4, 7]]))
    others = np.delete(np.arange(len(reading)), [4, 7])
    np.testing.assert_array_equal(found.offset[others], expected.offset[others])


def test_more_sensors_than_a_block_stay_in_order():
    reading, noise = fleet(4, sensors=6)
    many = np.tile(reading, (200, 1, 1))
    found = fit_many(many, Units('m/s2', 1.0), noise=np.tile(noise, (200, 1, 1)))
    assert found.offset.shape == (1200, 3)
    np.testing.assert_allclose(found.offset.reshape(200, 6, 3),
                               np.broadcast_to(found.offset[:6], (200, 6, 3)), atol=1e-12)


def test_too_few_poses_are_refused():
    with pytest.raises(RefusedFitError, match='8 poses a sensor, model 10 needs at least 9'):
        fit_many(np.ones((5, 8, 3)), units_of('g'))
