# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Wiring faults and wrong units are reported."""

from itertools import permutations, product
import json

from accel_calib.calibrate import ARBITRARY_HEADING, fit_poses, level, with_given_mounting
from accel_calib.errors import InputError
from accel_calib.logs import write_table
from accel_calib.table import Poses
from accel_calib.units import Units, units_of
from inside import (
    axes_of,
    fault_of,
    main,
    random_directions,
    rotation_from_rpy,
    simulate_poses,
    spread_directions,
)
import numpy as np
import pytest
from shared import sensor

G = units_of('g')
SWAP_XY = np.eye(3)[[1, 0, 2]]
ALL = [np.diag(signs) @ np.eye(3)[list(order)]
       for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]


def wired(mat_p, seed=1, count=16, units=G):
    """Return poses of known orientation whose axes are permuted by mat_p."""
    rng = np.random.default_rng(seed)
    directions = spread_directions(count) @ rotation_from_rpy(*rng.uniform(-3, 3, 3)).T
    poses = simulate_poses(sensor(rng, 'offset', 'axis_gain', 'cross_axis', 'misalignment'),
                           directions, rng)
    known = 1.0 if units.name == 'native' else units.per_g
    return poses.with_columns(reading=units.from_g(poses.reading @ mat_p.T),
                              std=units.from_g(poses['std']), reference=directions * known)


@pytest.mark.parametrize(('mat_p', 'words'), [
    (np.diag([-1.0, 1, 1]), 'the x axis has the wrong sign (x reads -x)'),
    (np.diag([1.0, 1, -1]), 'the z axis has the wrong sign (z reads -z)'),
    (-np.eye(3), 'all three axes have the wrong sign: the sensor reports gravity'),
    (SWAP_XY, 'x and y are swapped'),
    (np.eye(3)[[0, 2, 1]], 'y and z are swapped'),
    (np.diag([-1.0, -1, 1]) @ SWAP_XY,
     'the axes are permuted to a mirror image: x reads -y, y reads -x'),
    (np.diag([1.0, -1, 1]) @ SWAP_XY,
     'the sensor is rotated by 90° about z (x reads +y, y reads -x)'),
    (np.diag([-1.0, 1, 1]) @ SWAP_XY, 'the sensor is rotated by -90° about z'),
    (np.diag([-1.0, -1, 1]), 'the sensor is rotated by 180° about z (x reads -x, y reads -y)'),
    (rotation_from_rpy(0.0, 0.0, np.radians(45.0)).T, 'the sensor is rotated by 45° about z'),
    (rotation_from_rpy(0.0, 0.0, np.radians(45.0)) @ np.diag([1.0, 1, -1]),
     'the readings are a mirror image: an axis has the wrong sign')])
def test_a_wiring_fault_is_named_and_model_12_corrects_it(mat_p, words):
    poses = wired(mat_p)
    calibration = fit_poses(poses, G)
    assert calibration.name == '12'
    assert f'according to the known orientations, {words}' in calibration.warnings[0]
    assert 'model 12 corrects it' in calibration.warnings[0]
    np.testing.assert_allclose(calibration.correct(poses.reading), poses['reference'], atol=3e-3)


@pytest.mark.parametrize('seed', range(5))
def test_correct_wiring_causes_no_warning(seed):
    assert not fit_poses(wired(np.eye(3), seed), G).warnings
    tilted = wired(rotation_from_rpy(*np.radians((8.0, -5.0, 10.0))), seed)
    assert fault_of(axes_of(tilted.reading, tilted['reference'])) is None


def test_each_of_the_48_ways_is_told_apart_under_common_errors():
    faults = set()
    for number, mat_p in enumerate(ALL):
        poses = wired(mat_p, seed=number, count=8)
        faults.add(fault_of(axes_of(poses.reading, poses['reference'])))
    assert len(faults) == 48
    assert None in faults


@pytest.mark.parametrize('units', [units_of('m/s2'), Units('native', 4060.0)])
def test_a_wiring_fault_is_named_in_other_units(units):
    poses = wired(SWAP_XY, units=units)
    poses = poses.with_columns(reading=poses.reading + (5000.0 if units.name == 'native' else 0))
    calibration = fit_poses(poses, units_of(units.name))
    assert 'x and y are swapped' in calibration.warnings[0]


def test_model_10_does_not_correct_a_wiring_fault_and_warns():
    calibration = fit_poses(wired(SWAP_XY), G, model='10')
    assert 'x and y are swapped; model 10 does not correct it' in calibration.warnings[0]


def test_a_knocked_pose_does_not_hide_the_fault():
    poses = wired(np.diag([1.0, -1, 1]))
    reading = poses.reading.copy()
    reading[3] += 0.3
    calibration = fit_poses(poses.with_columns(reading=reading), G)
    assert 'the y axis has the wrong sign' in calibration.warnings[0]


def test_without_sufficient_known_orientations_there_is_no_wiring_warning():
    poses = wired(SWAP_XY)
    columns = {key: value for key, value in poses.columns.items() if key != 'reference'}
    assert not fit_poses(Poses(columns, poses.row), G).warnings
    flat = np.column_stack([poses['reference'][:, :2], np.zeros(len(poses))])
    assert axes_of(poses.reading, flat) is None


def levelled(up, frame='ros'):
    rng = np.random.default_rng(2)
    poses = simulate_poses(sensor(rng), random_directions(20, rng), rng)
    calibration = fit_poses(poses, G)
    up = np.array(up, float) / np.linalg.norm(up)
    return level(calibration, calibration.predict(up[np.newaxis])[0], frame)


@pytest.mark.parametrize(('up', 'frame', 'words'), [
    ((0, 0, -1), 'ros', 'reads -1.00 g on z, where a sensor that lies flat reads 1 g on +z: it is '
     'mounted upside down, or z (or every axis) has the wrong sign'),
    ((0, 0.1, 1), 'win8', 'reads +1.00 g on z, where a sensor that lies flat reads 1 g on -z'),
    ((0, 1, 0.1), 'ros', 'mounted with +y up, or y and z are swapped'),
    ((-1, 0, 0), 'ned', 'mounted with -x up, or x and z are swapped')])
def test_a_flat_pose_on_another_face_causes_a_warning(up, frame, words):
    warnings = [line for line in levelled(up, frame).warnings if line != ARBITRARY_HEADING]
    assert len(warnings) == 1
    assert warnings[0].startswith('the flat pose ')
    assert words in warnings[0]


@pytest.mark.parametrize(('up', 'frame'), [((0, 0, 1), 'ros'), ((0.5, -0.3, 1), 'ned'),
                                           ((0.1, 0, -1), 'win8')])
def test_an_expected_flat_pose_causes_no_warning(up, frame):
    assert not levelled(up, frame).warnings


@pytest.mark.parametrize(('up', 'frame', 'arbitrary'), [
    ((1, 0, 0), 'ros', True), ((-1, 0.1, 0.1), 'ned', True), ((1, 0.3, 0), 'ros', False),
    ((0, 1, 0), 'win8', True), ((0, 1, 0), 'ros', False), ((1, 0, 0), 'win8', False)])
def test_a_heading_near_its_singular_direction_is_called_arbitrary(up, frame, arbitrary):
    calibration = levelled(up, frame)
    assert (ARBITRARY_HEADING in calibration.warnings) is arbitrary
    again = level(calibration, calibration.predict(np.array([up]) / np.linalg.norm(up))[0], frame)
    assert ARBITRARY_HEADING not in again.warnings  # the heading of before is kept
    given = rotation_from_rpy(0.1, 0.2, 0.3)
    assert ARBITRARY_HEADING not in with_given_mounting(calibration, given).warnings


def test_a_given_mounting_keeps_a_measured_tilt_within_10_degrees():
    given = rotation_from_rpy(0.0, 0.0, 2.0).T
    for tilt, kept in ((0.1, True), (0.3, False)):
        up = given @ rotation_from_rpy(tilt, 0.0, 0.0) @ np.array([0.0, 0.0, 1.0])
        found = with_given_mounting(levelled(up), given).rotation
        np.testing.assert_allclose(found[:, 2], up if kept else given[:, 2], atol=1e-9)
        np.testing.assert_allclose(found[:, 0], given[:, 0], atol=0.02)


def test_levelling_again_removes_the_warning():
    turned = levelled((0, 0, -1))
    flat = turned.model.rotation.T @ np.array([0.0, 0.0, 1.0])
    assert not level(turned, turned.predict(flat[np.newaxis])[0], 'ros').warnings
    assert len(level(turned, turned.predict(np.array([[0, 0, 1.0]]))[0], 'ros').warnings) == 1


@pytest.mark.parametrize(('units', 'per_g', 'advice'), [
    ('m/s2', 1.0, 'set the units of the readings to g'),
    ('g', 9.8, 'set the units of the readings to m/s2'),
    ('m/s2', 1000.0, 'they look like cm/s2 or mg'),
    ('g', 1000.0, 'they look like cm/s2 or mg'),
    ('m/s2', 32.17, 'they look like ft/s2'),
    ('g', 4060.0, 'set the units of the readings to native'),
    ('m/s2', 16384.0, 'set the units of the readings to native')])
def test_readings_in_another_unit_are_refused(units, per_g, advice):
    poses = wired(np.eye(3), units=Units('native', per_g))
    for table in (poses, Poses({'reading': poses.reading}, poses.row)):
        with pytest.raises(InputError, match='length of the readings is about') as refused:
            fit_poses(table, units_of(units))
        assert advice in refused.value.advice


@pytest.mark.parametrize(('units', 'factor', 'message'), [
    (units_of('m/s2'), 1.0 / 9.80665, 'about 1, expected about 9.807 in m/s2'),
    (G, 9.80665, 'about 9.807, expected about 1 in g'),
    (Units('native', 4060.0), 9.80665,
     'about 9.807, expected about 1 in g, the unit of known forces'),
    (G, 0.0, 'is about 0, expected')])
def test_known_forces_in_another_unit_are_refused(units, factor, message):
    poses = wired(np.eye(3), units=units)
    poses = poses.with_columns(reference=poses['reference'] * factor)
    with pytest.raises(InputError, match=message):
        fit_poses(poses, units_of(units.name))


def test_native_readings_may_be_in_any_unit():
    assert fit_poses(wired(np.eye(3), units=Units('native', 9.8)), units_of('native')).units.per_g


def test_the_command_reports_the_wiring_fault(tmp_path, capsys):
    poses, path = wired(np.diag([1.0, 1, -1])), tmp_path / 'poses.csv'
    write_table(path, poses)
    assert main(['fit', str(path), '--units', 'g', '--json', '-']) == 0
    warnings = json.loads(capsys.readouterr().out)['warnings']
    assert 'the z axis has the wrong sign' in warnings[0]
    assert main(['fit', str(path), '--units', 'm/s2']) == 2
    assert 'set the units of the readings to g' in capsys.readouterr().err
