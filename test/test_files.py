# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Tables and calibrations on disk: what is written is read, and errors are one line."""

from dataclasses import replace

from accel_calib.calibrate import fit_poses
from accel_calib.errors import InputError
from accel_calib.logs import read_poses, read_recording, write_table
from accel_calib.stored import read_calibration, write_calibration
from accel_calib.table import COLUMNS, numbered, Poses
from accel_calib.units import units_of
from inside import (
    format_calibration, Model, parse_calibration, previous, simulate_poses, spread_directions)
import numpy as np
import pytest
from shared import sensor

GOOD = '# a comment\nax,ay,az\n1,2,3\n4,5,6\n'


def write(folder, text):
    path = folder / 'table.csv'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def every_column(count=4):
    rng = np.random.default_rng(1)
    columns = {key: rng.uniform(1, 2, count if len(column.names) == 1 else (count, 3))
               for key, column in COLUMNS.items() if not column.made}
    columns['label'] = np.array(['flat', 'left, side up', 'nose "down"', ''])
    columns['time'] = 1.7e9 + np.arange(count) * 0.0025
    return Poses(columns, numbered(columns))


def test_every_column_is_read_as_it_was_written(tmp_path):
    table = every_column()
    write_table(tmp_path / 'poses.csv', table)
    found = read_poses(tmp_path / 'poses.csv')
    assert set(found.columns) == set(table.columns)
    for key, values in table.columns.items():
        if key == 'label':
            assert found[key].tolist() == values.tolist()
        else:
            np.testing.assert_allclose(found[key], values, rtol=1e-11)
    np.testing.assert_allclose(np.diff(found['time']), 0.0025, atol=5e-7)


def test_columns_may_come_in_any_order_among_others(tmp_path):
    poses = read_poses(write(tmp_path, 'az,what,ay,ax\n3,x,2,1\n6,y,5,4\n'))
    np.testing.assert_array_equal(poses.reading, [[1, 2, 3], [4, 5, 6]])
    assert list(poses.row) == [1, 2]


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'is empty'), ('# only a comment\n\n', 'is empty'),
    ('ax,ay,az\n', 'a header line but no rows'),
    ('ax,ay\n1,2\n', 'lacks az'), ('x,y,z\n1,2,3\n', 'lacks ax, ay, az'),
    ('1,2,3\n4,5,6\n', 'lacks ax, ay, az'),
    ('ax,ay,az,std_x\n1,2,3,4\n', 'lacks std_y, std_z'),
    ('ax,ay,az,ax\n1,2,3,4\n', '2 columns ax'),
    ('ax,ay,az\n1,2,three\n', "row 1, column az is 'three', expected a finite number"),
    ('ax,ay,az\n1,2,3\n1,nan,3\n', "row 2, column ay is 'nan'"),
    ('ax,ay,az\n1,2,3\n1,2,inf\n', "row 2, column az is 'inf'"),
    ('ax,ay,az\n1,2,3\n1,,3\n', "row 2, column ay is ''"),
    ('ax,ay,az\n1,2,3\n1,2\n', 'row 2 has 2 values, expected 3'),
    ('ax,ay,az,count\n1,2,3,0\n', 'not above 0'),
    ('ax,ay,az,std_x,std_y,std_z\n1,2,3,1,1,-1\n', 'negative'),
    (b'\x80\x04\x95\xff\xfe', 'is not a text file'),
])
def test_a_bad_pose_table_is_refused_in_one_line(text, message, tmp_path):
    with pytest.raises(InputError, match=message) as refusal:
        read_poses(write(tmp_path, text))
    assert '\n' not in str(refusal.value)


def test_a_recording_needs_times(tmp_path):
    with pytest.raises(InputError, match='no column time'):
        read_recording(write(tmp_path, GOOD))


def test_a_missing_file_raises_the_error_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_poses(tmp_path / 'none.csv')


@pytest.fixture(params=['4', '9', '10', '12'])
def calibration(request):
    rng, directions = np.random.default_rng(2), spread_directions(16)
    context = {'reference': directions} if request.param == '12' else {}
    poses = simulate_poses(sensor(rng), directions, rng, context=context)
    return fit_poses(poses, units_of('g'), model=request.param, sensor='imu_link',
                     date='2026-11-21T00:00:00+00:00')


def test_a_stored_calibration_is_read_with_all_digits(calibration, tmp_path):
    path = tmp_path / 'calibration.yaml'
    write_calibration(path, calibration)
    found = read_calibration(path)
    assert format_calibration(found) == format_calibration(calibration)
    reading = np.random.default_rng(3).normal(size=(5, 3))
    np.testing.assert_array_equal(found.correct(reading), calibration.correct(reading))
    np.testing.assert_array_equal(found.gain_sd, calibration.gain_sd)


@pytest.mark.parametrize(('values', 'text'), [
    ([1e-3, 2e-3, -1e-3], 'x: 0.001, y: 0.002, z: -0.001}'),
    ([1e-3, 2e-3, -1e-3, 60.0, 0.0], 'z: -0.001, lag: 60.0}'),
    ([1e-3, 2e-3, -1e-3, 60.0, 1.0], 'z: -0.001, lag: 60.0, of_sensor: 1.0}')])
def test_shape_at_its_usual_value_is_not_stored(values, text, calibration):
    model = Model({**calibration.model.values, 'offset_temperature': np.array(values)})
    size = len(calibration.covariance) + (4 if len(values) == 5 else 3) + (values[-1] == 1.0)
    root = np.random.default_rng(1).normal(size=(size, size)) * 1e-6
    given = replace(calibration, model=model, covariance=root @ root.T)
    stored = format_calibration(given)
    assert text in ' '.join(stored.split())
    found = parse_calibration(stored, 'calibration.yaml')
    np.testing.assert_array_equal(found.model.vector, model.vector)
    np.testing.assert_array_equal(found.covariance, given.covariance)
    again = format_calibration(found)
    assert format_calibration(parse_calibration(again, 'calibration.yaml')) == again


def test_the_previous_calibration_is_kept(calibration, tmp_path):
    path = tmp_path / 'calibration.yaml'
    path.write_text('the one before')
    write_calibration(path, calibration)
    assert previous(path).read_text() == 'the one before'
    assert sorted(item.name for item in tmp_path.iterdir()) == [path.name, previous(path).name]
