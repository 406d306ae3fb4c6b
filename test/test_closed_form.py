# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Closed forms recover a sensor exactly, in any unit."""

from accel_calib.calibrate import closed_form
from accel_calib.errors import RefusedFitError
from accel_calib.model import predict
from accel_calib.sphere import random_directions, spread_directions
import numpy as np
import pytest
from shared import sensor

FITS = {'4': (closed_form.fit_4, ('offset', 'gain')),
        '7': (closed_form.fit_7, ('offset', 'axis_gain')),
        '10': (closed_form.fit_10, ('offset', 'axis_gain', 'cross_axis'))}


@pytest.mark.parametrize('name', FITS)
@pytest.mark.parametrize(('scale', 'shift'), [(1.0, 0.0), (9.81, 0.0), (4060.0, 33000.0),
                                              (0.3468, 1.775), (1e-6, 5e-6)])
def test_exact_poses_give_the_sensor_back_in_any_unit(name, scale, shift):
    fit, effects = FITS[name]
    model = sensor(np.random.default_rng(4), *effects)
    reading = predict(model, spread_directions(14), {}) * scale + shift
    mat_w, vec_v = fit(reading)
    true_w, true_v = model.linear_part
    np.testing.assert_allclose(mat_w / scale, true_w, atol=1e-10)
    np.testing.assert_allclose((vec_v - shift) / scale, true_v, atol=1e-10)


@pytest.mark.parametrize('name', FITS)
def test_noisy_poses_give_the_same_result_in_counts_and_in_g(name):
    fit, effects = FITS[name]
    rng = np.random.default_rng(5)
    reading = predict(sensor(rng, *effects), random_directions(30, rng), {})
    reading = reading + rng.normal(size=reading.shape) * 0.002
    (w_g, v_g), (w_counts, v_counts) = fit(reading), fit(reading * 16384 + 30000)
    np.testing.assert_allclose(w_counts / 16384, w_g, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose((v_counts - 30000) / 16384, v_g, rtol=1e-9, atol=1e-9)


def test_poses_on_a_hyperboloid_are_refused():
    grid = np.linspace(-1.0, 1.0, 7)
    x, y = (part.ravel() for part in np.meshgrid(grid, grid))
    surface = np.column_stack([x, y, np.sqrt(0.5 + x ** 2 - 0.3 * y ** 2 + 0.3)])
    with pytest.raises(RefusedFitError, match='lie on no'):
        closed_form.fit_10(np.vstack([surface, surface * [1, 1, -1]]))


def test_known_orientations_in_a_plane_are_refused():
    angle = np.linspace(0, 6, 12)
    reference = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    with pytest.raises(RefusedFitError, match='lie in a plane'):
        closed_form.fit_12(reference, reference)


def test_six_faces_are_recognised_in_any_order_and_unit():
    faces = np.vstack([np.eye(3), -np.eye(3)])[[4, 0, 2, 1, 5, 3]]
    tilted = faces + 0.1 * np.random.default_rng(1).normal(size=(6, 3))
    np.testing.assert_array_equal(closed_form.faces(tilted * 400 + 2000), faces)
    assert closed_form.faces(tilted[:5]) is None
    assert closed_form.faces(random_directions(6, np.random.default_rng(2))) is None
