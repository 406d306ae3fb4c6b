# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Tables and calibrations on disk: what is written is read, and what is overwritten."""

from dataclasses import replace
import os
import shutil
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
from shared import refused, run, sensor


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


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'is empty'), ('# only a comment\n\n', 'is empty'),
    ('ax,ay,az\n', 'a header line but no rows'),
    ('ax,ay\n1,2\n', 'lacks az'),
    ('ax,ay,az,ax\n1,2,3,4\n', '2 columns ax'),
    ('ax,ay,az\n1,2,three\n', "row 1, column az is 'three', expected a finite number"),
    ('ax,ay,az\n1,2,3\n1,nan,3\n', "row 2, column ay is 'nan'"),
    ('ax,ay,az\n1,2,3\n1,2,inf\n', "row 2, column az is 'inf'"),
    ('ax,ay,az\n1,2,3\n1,,3\n', "row 2, column ay is ''"),
    ('ax,ay,az\n1,2,3\n1,2\n4,5,6\n', 'row 2 has 2 values, expected 3'),
    ('ax,ay,az,count\n1,2,3,0\n', 'not above 0'),
    ('ax,ay,az,std_x,std_y,std_z\n1,2,3,1,1,-1\n', 'negative'),
    (b'\x80\x04\x95\xff\xfe', 'is not a text file'),
])
def test_a_bad_pose_table_is_refused_in_one_line(text, message, tmp_path):
    with pytest.raises(InputError, match=message) as refusal:
        read_poses(write(tmp_path, text))
    assert '\n' not in str(refusal.value)


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


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp('made')
    assert run('simulate', '-o', folder / 'rec.csv', '--recording', '--poses', 14, '--dwell', 2,
               '--rate', 50) == 0
    assert run('simulate', '-o', folder / 'poses.csv', '--poses', 14) == 0
    assert run('fit', folder / 'poses.csv', '-o', folder / 'cal.yaml') == 0
    (folder / 'notes.txt').write_text('my notes\n')
    (folder / 'old.json').write_text('{}')
    (folder / 'out').mkdir()
    (folder / 'more').mkdir()
    (folder / 'more' / 'poses.csv').write_bytes((folder / 'poses.csv').read_bytes())
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures('here')
@pytest.mark.parametrize('command', ['calibrate', 'fit', 'refine', 'verify', 'capture', 'apply'])
def test_a_calibration_in_place_of_a_log_is_named(command, capsys):
    used = ['-c', 'cal.yaml'] if command in ('verify', 'apply') else []
    stored = [] if command == 'verify' else ['-o', 'other']
    assert 'is a calibration' in refused(capsys, command, 'cal.yaml', *used, *stored)


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


@pytest.mark.parametrize('arguments', [
    ('capture', 'rec.csv', '-o', 'rec.csv'), ('capture', 'rec.csv', '-o', 'notes.txt'),
    ('apply', 'rec.csv', '-c', 'cal.yaml', '-o', 'cal.yaml'),
    ('apply', 'rec.csv', '-c', 'cal.yaml', '-o', 'rec.csv'),
    ('fit', 'poses.csv', '-o', 'poses.csv'), ('fit', 'poses.csv', '--json', 'cal.yaml'),
    ('fit', 'poses.csv', '--report', 'cal.yaml'),
    ('fit', 'poses.csv', '-o', 'new.yaml', '--json', 'new.yaml'),
    ('fit', 'poses.csv', '-o', 'new.yaml', '--json', 'nowhere/x.json'),
    ('verify', 'poses.csv', '-c', 'cal.yaml', '--json', 'cal.yaml'),
    ('refine', 'poses.csv', '-o', 'poses.csv'), ('refine', 'poses.csv', '--plan', 'cal.yaml'),
    ('simulate', '-o', 'cal.yaml'), ('simulate', '-o', 'notes.txt'),
    ('export', 'cal.yaml', '--to', 'c', '-o', 'cal.yaml'),
    ('export', 'cal.yaml', '--to', 'c', '-o', 'notes.txt'),
    ('calibrate', 'rec.csv', '-o', 'rec.csv'), ('calibrate', 'rec.csv', '-o', 'notes.txt'),
    ('fit', 'poses.csv', 'more/poses.csv', '-o', 'out'),
    ('fit', 'poses.csv', 'rec.csv', '-o', 'cal.yaml'),
    ('compare', 'cal.yaml', 'cal.yaml', '--json', 'cal.yaml'),
    *((command, *read, '--json', 'old.json', '--force') for command, *read in (
        ('fit', 'poses.csv', '--prior', 'old.json'), ('refine', 'poses.csv', '--also', 'old.json'),
        ('fleet', 'rec.csv', '@old.json', '-o', 'out'))),
], ids=' '.join)
def test_nothing_else_is_overwritten(arguments, here, capsys):
    before = contents(here)
    refused(capsys, *arguments)
    assert contents(here) == before


@pytest.mark.parametrize('arguments', [
    ('fit', 'poses.csv', '-o', 'cal.yaml'), ('capture', 'rec.csv', '-o', 'poses.csv'),
    ('simulate', '-o', 'poses.csv'), ('simulate', '-o', 'notes.txt', '--force'),
    ('fit', 'poses.csv', 'rec.csv', '-o', 'out')], ids=' '.join)
def test_a_file_of_the_same_kind_is_replaced(arguments, here):
    assert run(*arguments) == 0
    assert run(*arguments) == 0


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
