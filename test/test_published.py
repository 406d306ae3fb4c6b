# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Closed forms and fits give the published numbers."""

from accel_calib.calibration import fit_poses, verify
from accel_calib.errors import RefusedFitError
from accel_calib.estimate import closed_form, faces, fit_12, sensing_axes
from accel_calib.logs import read_poses
from accel_calib.table import Poses
from accel_calib.units import units_of
from inside import MODELS, predict
import numpy as np
import pytest
from shared import data, random_directions, run_json, sensor

HUAWEI, SECOND, THIRD = (f'esgi95_dataset{name}.csv' for name in ('1_huawei', '2', '3_gt'))


def fit(name, first, last, gravity, model):
    table = read_poses(data(name))
    return fit_poses(table.take(slice(first - 1, last)), units_of('m/s2', gravity), model=model,
                     method='algebraic'), table


@pytest.mark.parametrize(('name', 'first', 'last', 'shifts', 'scales', 'angles'), [
    (HUAWEI, 1, 20, (0.304496, 0.321482, -1.08995), (1.00457, 1.00147, 0.989292),
     (1.57646, 1.57096, 1.57301)),
    (HUAWEI, 3, 23, (0.318321, 0.322794, -1.09059), None, (1.56932, 1.5709, 1.57296)),
    (SECOND, 1, 20, (-0.469784, 0.608425, 0.208206), (0.999573, 0.989443, 1.01176),
     (1.56219, 1.56969, 1.57057)),
])
def test_nine_parameters_are_those_of_the_report(name, first, last, shifts, scales, angles):
    calibration, _ = fit(name, first, last, 9.8061, '9')
    axes = sensing_axes(calibration.gain, calibration.offset)
    np.testing.assert_allclose(axes.shifts, shifts, atol=1e-3)
    if scales:
        np.testing.assert_allclose(axes.scales, scales, atol=5e-4)
    np.testing.assert_allclose((axes.phi, axes.psi, axes.theta), angles, atol=5e-4)


@pytest.mark.parametrize(('first', 'last', 'percent'), [(1, 20, 0.27), (3, 23, 0.99)])
def test_repeated_poses_bias_the_fit_as_the_report_found(first, last, percent):
    calibration, table = fit(THIRD, first, last, 9.81, '9')
    assert verify(calibration, table).max_after_percent == pytest.approx(percent, abs=0.005)


@pytest.mark.parametrize(('name', 'diagonal', 'shift', 'before', 'after'), [
    (HUAWEI, (1.00381, 1.00003, 0.98831), (0.35323, 0.36347, -1.18129), (17.3860, 12.2076),
     (1.0602, 3.1542)),
    (THIRD, (0.990908, 0.981047, 0.998542), (0.482181, 0.058771, 0.044096), None,
     (1.5846, 1.3898)),
])
def test_twelve_parameters_from_six_faces_are_those_of_the_report(name, diagonal, shift, before,
                                                                  after):
    calibration, table = fit(name, 1, 6, 9.81, '12')
    np.testing.assert_allclose(np.diag(calibration.gain), diagonal, atol=1e-5)
    np.testing.assert_allclose(calibration.offset, shift, atol=1e-5)
    found = calibration.quality, verify(calibration, table)  # of the six faces, of all rows
    assert [each.max_after_percent for each in found] == pytest.approx(after, abs=1e-4)
    if before:
        assert [each.max_before_percent for each in found] == pytest.approx(before, abs=1e-4)


def test_two_positions_of_the_rhd2000_note():
    volts = 1.775 + 0.3468 * np.vstack([np.eye(3), -np.eye(3)])
    calibration = fit_poses(Poses({'reading': volts}, np.arange(1, 7)), units_of('native'),
                            model='12')
    np.testing.assert_allclose(calibration.gain, 0.3468 * np.eye(3), atol=1e-6)
    np.testing.assert_allclose(calibration.offset, 1.775, atol=1e-6)


@pytest.mark.parametrize('method', ['ml', 'algebraic'])
@pytest.mark.parametrize(('name', 'units', 'count', 'limit_mg'), [
    ('mpu9150_imu0', 'm/s2', 21, 0.3), ('mpu9150_imu1', 'm/s2', 21, 0.3),
    ('xsens_mti_counts', 'native', 38, 0.115)])  # as well as imu_tk calibrates it
def test_a_real_recording_is_calibrated_to_its_noise(
        name, units, count, limit_mg, method, tmp_path, capsys):
    _, captured = run_json(capsys, 'capture', data(f'{name}.csv'), '-o', tmp_path / 'poses.csv',
                           '--units', units)
    _, fitted = run_json(capsys, 'fit', tmp_path / 'poses.csv', '--units', units, '--model', 10,
                         '--method', method)
    assert captured['poses'] == count
    assert fitted['poses_used'] + len(fitted['poses_rejected']) == count
    assert fitted['rms_before_mg'] > 8.0
    assert fitted['rms_after_mg'] <= limit_mg


NAMES = ('4', '7', '10')


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
    poses = Poses({'reading': reading}, np.arange(1, len(reading) + 1))
    with pytest.raises(RefusedFitError, match='not on an ellipsoid'):
        fit_poses(poses, units_of('g'), model='10', method=method)


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
