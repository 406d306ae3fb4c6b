# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Closed forms and fits give the published numbers."""

from accel_calib.calibration import fit_poses, verify
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import closed_form, faces, fit_12, sensing_axes
from accel_calib.logs import read_poses
from accel_calib.units import units_of
from inside import MODELS, predict, spread_directions
import numpy as np
import pytest
from shared import data, poses_of, random_directions, sensor, table


def fit(name, first, last, gravity, model):
    poses = read_poses(data(name))
    return fit_poses(poses.take(slice(first - 1, last)), units_of('m/s2', gravity), model=model,
                     method='algebraic'), poses


@pytest.mark.parametrize(('name', 'first', 'last', 'shifts', 'scales', 'angles'),
                         table('published_nine'))
def test_nine_parameters_are_those_of_the_report(name, first, last, shifts, scales, angles):
    calibration, _ = fit(name, first, last, 9.8061, '9')
    axes = sensing_axes(calibration.gain, calibration.offset)
    np.testing.assert_allclose(axes.shifts, shifts, atol=1e-3)
    if scales:
        np.testing.assert_allclose(axes.scales, scales, atol=5e-4)
    np.testing.assert_allclose((axes.phi, axes.psi, axes.theta), angles, atol=5e-4)


@pytest.mark.parametrize(('first', 'last', 'percent'), [(1, 20, 0.27), (3, 23, 0.99)])
def test_repeated_poses_bias_the_fit_as_the_report_found(first, last, percent):
    calibration, poses = fit('esgi95_dataset3_gt.csv', first, last, 9.81, '9')
    assert verify(calibration, poses).max_after_percent == pytest.approx(percent, abs=0.005)


@pytest.mark.parametrize(('name', 'diagonal', 'shift', 'before', 'after'),
                         table('published_twelve'))
def test_twelve_parameters_from_six_faces_are_those_of_the_report(name, diagonal, shift, before,
                                                                  after):
    calibration, poses = fit(name, 1, 6, 9.81, '12')
    np.testing.assert_allclose(np.diag(calibration.gain), diagonal, atol=1e-5)
    np.testing.assert_allclose(calibration.offset, shift, atol=1e-5)
    found = calibration.quality, verify(calibration, poses)  # of the six faces, of all rows
    assert [each.max_after_percent for each in found] == pytest.approx(after, abs=1e-4)
    if before:
        assert [each.max_before_percent for each in found] == pytest.approx(before, abs=1e-4)


def test_two_positions_of_the_rhd2000_note():
    volts = 1.775 + 0.3468 * np.vstack([np.eye(3), -np.eye(3)])
    calibration = fit_poses(poses_of(volts), units_of('native'), model='12')
    np.testing.assert_allclose(calibration.gain, 0.3468 * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(calibration.offset, 1.775, atol=1e-6)


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
    for one, other in zip(once, often, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-9)


@pytest.mark.parametrize('method', ['ml', 'algebraic'])
def test_poses_on_a_hyperboloid_are_refused(method):
    grid = np.linspace(-1.0, 1.0, 7)
    x, y = (part.ravel() for part in np.meshgrid(grid, grid))
    surface = np.column_stack([x, y, np.sqrt(0.5 + x ** 2 - 0.3 * y ** 2 + 0.3)])
    reading = np.vstack([surface, surface * [1, 1, -1]])
    assert not np.any(np.isfinite(closed_form('10', reading)[0]))
    with pytest.raises(RefusedFitError, match='not on an ellipsoid'):
        fit_poses(poses_of(reading), units_of('g'), model='10', method=method)


def test_known_orientations_in_a_plane_are_refused():
    reference = random_directions(12, np.random.default_rng(1)) * [1, 1, 0]
    with pytest.raises(RefusedFitError, match='lie in a plane'):
        fit_12(reference, reference)


def test_six_faces_are_recognised_in_any_order_and_unit():
    up = np.vstack([np.eye(3), -np.eye(3)])[[4, 0, 2, 1, 5, 3]]
    tilted = up + 0.1 * np.random.default_rng(1).normal(size=(6, 3))
    np.testing.assert_array_equal(faces(tilted * 400 + 2000), up)
    assert faces(tilted[:5]) is None
    assert faces(random_directions(6, np.random.default_rng(2))) is None
