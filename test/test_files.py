# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Tables and calibrations on disk: what is written is read, and what is overwritten."""

from dataclasses import replace
import os
import stat

from accel_calib.calibration import fit_poses
from accel_calib.disk import write_atomically
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


def write(folder, text):
    path = folder / 'table.csv'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def every_column(count=4):
    rng = np.random.default_rng(1)
    columns = {key: rng.uniform(1, 2, count if len(column.names) == 1 else (count, 3))
               for key, column in COLUMNS.items() if not column.made}
    columns['reference'] /= np.linalg.norm(columns['reference'], axis=1, keepdims=True)
    columns['label'] = np.array(['flat', 'left, side up', 'nose "down"', ''])
    columns['time'] = 1.7e9 + np.arange(count) * 0.0025
    return Poses(columns, numbered(columns))


def test_every_column_is_read_as_it_was_written(tmp_path):
    table = every_column()
    write_table(tmp_path / 'poses.csv', table)
    found = read_poses(tmp_path / 'poses.csv')
    assert set(found.columns) == set(table.columns)
    assert found['label'].tolist() == table['label'].tolist()
    for key in table.columns.keys() - {'label'}:
        np.testing.assert_allclose(found[key], table[key], rtol=1e-11)
    np.testing.assert_allclose(np.diff(found['time']), 0.0025, atol=5e-7)


def test_a_recording_needs_times_and_a_missing_file_is_an_error_of_the_system(tmp_path):
    with pytest.raises(InputError, match='no column time'):
        read_recording(write(tmp_path, 'ax,ay,az\n1,2,3\n4,5,6\n'))
    with pytest.raises(FileNotFoundError):
        read_poses(tmp_path / 'none.csv')


@pytest.fixture(params=['4', '9', '10', '12'])
def calibration(request):
    rng, directions = np.random.default_rng(2), spread_directions(16)
    context = {'reference': directions} if request.param == '12' else {}
    poses = simulate_poses(sensor(rng), directions, rng, context=context)
    return fit_poses(poses, units_of('g'), model=request.param, sensor='imu_link',
                     date='2026-11-21T00:00:00+00:00')


def test_a_stored_calibration_is_read_with_all_digits_and_the_previous_one_is_kept(
        calibration, tmp_path):
    path = tmp_path / 'calibration.yaml'
    path.write_text('the one before')
    write_calibration(path, calibration)
    assert previous(path).read_text() == 'the one before'
    assert {*tmp_path.iterdir()} == {path, previous(path)}
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


def put(path, text='new\n'):
    write_atomically(path, lambda file: file.write(text))


@pytest.mark.parametrize('mode', [0o600, 0o640, 0o644])
def test_the_permissions_are_kept_and_those_of_a_new_file_are_of_the_process(mode, tmp_path):
    path, new = tmp_path / 'file', tmp_path / 'new'
    path.write_text('old\n')
    path.chmod(mode)
    before = os.umask(0o027)
    try:
        write_atomically(path, lambda file: file.write('new\n'), keep_before=True)
        put(new)
    finally:
        os.umask(before)
    assert previous(path).read_text() == 'old\n'
    modes = [stat.S_IMODE(each.stat().st_mode) for each in (path, previous(path), new)]
    assert modes == [mode, mode, 0o640]


def test_a_link_stays_and_its_target_is_replaced(tmp_path):
    (tmp_path / 'folder').mkdir()
    target, link = tmp_path / 'folder' / 'target', tmp_path / 'link'
    target.write_text('old\n')
    link.symlink_to(target)
    put(link)
    assert link.is_symlink()
    assert target.read_text() == 'new\n'
    assert {*tmp_path.iterdir()} == {target.parent, link}


def test_only_a_regular_writable_file_is_replaced(tmp_path):
    fifo, protected = tmp_path / 'fifo', tmp_path / 'protected'
    os.mkfifo(fifo)
    protected.write_text('old\n')
    protected.chmod(0o444)
    for path, words in ((fifo, 'not a regular file'), (tmp_path, 'not a regular file'),
                        (protected, 'write-protected')):
        with pytest.raises(InputError, match=words):
            put(path)
    assert protected.read_text() == 'old\n'
    assert stat.S_ISFIFO(fifo.stat().st_mode)


def test_a_link_at_a_temporary_name_is_not_followed(tmp_path, monkeypatch):
    victim = tmp_path / 'victim'
    victim.write_text('mine\n')
    monkeypatch.setattr('secrets.token_hex', lambda size: 'known')
    (tmp_path / '.file.known.tmp').symlink_to(victim)
    with pytest.raises(FileExistsError):
        put(tmp_path / 'file')
    assert victim.read_text() == 'mine\n'


def test_leftovers_of_killed_processes_are_removed_if_they_are_old_and_can_be(tmp_path):
    folder, old, young = (tmp_path / f'.file.{k}.tmp' for k in range(3))
    folder.mkdir()
    for path in (old, young):
        path.write_text('half')
    for path in (folder, old):
        os.utime(path, (0.0, 0.0))
    put(tmp_path / 'file')
    assert [each.exists() for each in (folder, old, young)] == [True, False, True]
