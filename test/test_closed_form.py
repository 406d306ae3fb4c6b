# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Closed forms recover a sensor exactly, in any unit."""

from accel_calib.calibrate import fit_poses
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import closed_form, faces, fit_12
from accel_calib.table import Poses
from accel_calib.units import units_of
from inside import MODELS, predict, spread_directions
import numpy as np
import pytest
from shared import random_directions, sensor

NAMES = ('4', '7', '10')


@pytest.mark.parametrize('name', NAMES)
@pytest.mark.parametrize(('scale', 'shift'), [(1.0, 0.0), (9.81, 0.0), (4060.0, 33000.0),
                                              (0.3468, 1.775), (1e-6, 5e-6)])
def test_exact_poses_recover_the_sensor_in_any_unit(name, scale, shift):
    model = sensor(np.random.default_rng(4), *MODELS[name].effects)
    reading = predict(model, spread_directions(14), {}) * scale + shift
    mat_w, vec_v = closed_form(name, reading)
    true_w, true_v = model.linear_part
    np.testing.assert_allclose(mat_w / scale, true_w, atol=1e-10)
    np.testing.assert_allclose((vec_v - shift) / scale, true_v, atol=1e-10)


@pytest.mark.parametrize('name', NAMES)
def test_repeated_poses_give_the_result_of_one_of_each(name):
    rng = np.random.default_rng(6)
    reading = predict(sensor(rng, *MODELS[name].effects), random_directions(30, rng), {})
    reading = reading + rng.normal(size=reading.shape) * 0.002
    once, often = closed_form(name, reading), closed_form(name, np.tile(reading, (600, 1)))
    np.testing.assert_allclose(often[0], once[0], atol=1e-9)
    np.testing.assert_allclose(often[1], once[1], atol=1e-9)


@pytest.mark.parametrize('method', ['ml', 'algebraic'])
def test_poses_on_a_hyperboloid_are_refused(method):
    grid = np.linspace(-1.0, 1.0, 7)
    x, y = (part.ravel() for part in np.meshgrid(grid, grid))
    surface = np.column_stack([x, y, np.sqrt(0.5 + x ** 2 - 0.3 * y ** 2 + 0.3)])
    reading = np.vstack([surface, surface * [1, 1, -1]])
    assert not np.any(np.isfinite(closed_form('10', reading)[0]))
    poses = Poses({'reading': reading}, np.arange(1, len(reading) + 1))
    with pytest.raises(RefusedFitError, match='not on an ellipsoid'):
        fit_poses(poses, units_of('g'), model='10', method=method)


def test_known_orientations_in_a_plane_are_refused():
    angle = np.linspace(0, 6, 12)
    reference = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    with pytest.raises(RefusedFitError, match='lie in a plane'):
        fit_12(reference, reference)


def test_six_faces_are_recognised_in_any_order_and_unit():
    up = np.vstack([np.eye(3), -np.eye(3)])[[4, 0, 2, 1, 5, 3]]
    tilted = up + 0.1 * np.random.default_rng(1).normal(size=(6, 3))
    np.testing.assert_array_equal(faces(tilted * 400 + 2000), up)
    assert faces(tilted[:5]) is None
    assert faces(random_directions(6, np.random.default_rng(2))) is None
