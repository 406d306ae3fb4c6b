# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Imu messages: one frame, and the conventions of their covariances."""

from accel_calib import imu
from accel_calib.calibrate import fit_poses, level
from accel_calib.model import predict
from accel_calib.simulate import simulate_poses
from accel_calib.sphere import random_directions, rotation_from_rpy, spread_directions
from accel_calib.units import units_of
import numpy as np
import pytest
from shared import sensor

UNITS = units_of('m/s2')


@pytest.fixture
def calibration():
    rng = np.random.default_rng(1)
    poses = simulate_poses(sensor(rng), spread_directions(20), rng)
    poses = poses.with_columns(reading=UNITS.from_g(poses.reading), std=UNITS.from_g(poses['std']))
    return fit_poses(poses, UNITS)


@pytest.fixture
def levelled(calibration):
    flat = rotation_from_rpy(0.4, 0.2, -1.0) @ np.array([0, 0, 1.0])
    return level(calibration, calibration.predict(flat[np.newaxis] * UNITS.per_g)[0], 'ros')


def messages(count=6):
    fields = np.random.default_rng(2).normal(size=(count, imu.FIELDS))
    for part in (imu.ANGULAR_VELOCITY_COVARIANCE, imu.ACCELERATION_COVARIANCE):
        root = fields[:, part].reshape(-1, 3, 3) * 0.01
        fields[:, part] = (root @ np.swapaxes(root, 1, 2)).reshape(-1, 9)
    return fields


def test_without_a_mounting_only_the_acceleration_changes(calibration):
    fields = messages()
    found = imu.corrected(calibration, fields)
    np.testing.assert_allclose(found[:, imu.ACCELERATION],
                               calibration.correct(fields[:, imu.ACCELERATION]))
    rest = np.r_[0:imu.ACCELERATION.start]
    np.testing.assert_array_equal(found[:, rest], fields[:, rest])


def test_with_a_mounting_the_message_speaks_of_one_frame(levelled):
    fields, rotation = messages(), levelled.model.rotation
    found = imu.corrected(levelled, fields)
    np.testing.assert_allclose(found[:, imu.ANGULAR_VELOCITY],
                               fields[:, imu.ANGULAR_VELOCITY] @ rotation)
    turned = found[:, imu.ANGULAR_VELOCITY_COVARIANCE].reshape(-1, 3, 3)
    given = fields[:, imu.ANGULAR_VELOCITY_COVARIANCE].reshape(-1, 3, 3)
    np.testing.assert_allclose(rotation @ turned @ rotation.T, given, atol=1e-15)
    kept = np.r_[imu.ORIENTATION, imu.ORIENTATION_COVARIANCE]
    np.testing.assert_array_equal(found[:, kept], fields[:, kept])


def test_a_known_covariance_is_transformed_and_grows_by_that_of_the_calibration(levelled):
    fields = messages()
    found = imu.corrected(levelled, fields)
    inverse = levelled.model.rotation.T @ np.linalg.inv(levelled.gain)
    own = inverse @ fields[:, imu.ACCELERATION_COVARIANCE].reshape(-1, 3, 3) @ inverse.T
    added = found[:, imu.ACCELERATION_COVARIANCE].reshape(-1, 3, 3) - own
    np.testing.assert_allclose(added, levelled.force_covariance(found[:, imu.ACCELERATION]),
                               atol=1e-15)
    assert np.all(np.linalg.eigvalsh(added) > 0)


@pytest.mark.parametrize('first', [-1.0, 0.0])
def test_conventions_for_no_covariance_are_kept(levelled, first):
    fields = messages()
    for part in (imu.ANGULAR_VELOCITY_COVARIANCE, imu.ACCELERATION_COVARIANCE):
        fields[:, part] = 0.0
        fields[:, part.start] = first
    found = imu.corrected(levelled, fields)
    for part in (imu.ANGULAR_VELOCITY_COVARIANCE, imu.ACCELERATION_COVARIANCE):
        np.testing.assert_array_equal(found[:, part], fields[:, part])


def test_the_given_messages_are_left_as_they_were(levelled):
    fields = messages()
    before = fields.copy()
    imu.corrected(levelled, fields)
    np.testing.assert_array_equal(fields, before)


def test_corrected_readings_are_the_force(calibration):
    force = random_directions(5, np.random.default_rng(3)) * UNITS.per_g
    fields = messages(5)
    fields[:, imu.ACCELERATION] = UNITS.from_g(
        predict(calibration.model, UNITS.to_g(force), {}))
    np.testing.assert_allclose(imu.corrected(calibration, fields)[:, imu.ACCELERATION], force,
                               atol=1e-12)
