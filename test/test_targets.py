# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Files that are written: never onto an input or another kind of file, and never half."""

import os
import shutil
import stat

from accel_calib.disk import write_atomically
from accel_calib.errors import InputError
from inside import previous
import pytest
from shared import run


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp('made')
    assert run('simulate', '-o', folder / 'rec.csv', '--recording', '--poses', 14, '--dwell', 2,
               '--rate', 50) == 0
    assert run('simulate', '-o', folder / 'poses.csv', '--poses', 14) == 0
    assert run('fit', folder / 'poses.csv', '-o', folder / 'cal.yaml') == 0
    (folder / 'notes.txt').write_text('my notes\n')
    (folder / 'out').mkdir()
    (folder / 'more').mkdir()
    (folder / 'more' / 'poses.csv').write_bytes((folder / 'poses.csv').read_bytes())
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


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
], ids=' '.join)
def test_nothing_else_is_overwritten(arguments, here, capsys):
    before = contents(here)
    assert run(*arguments) == 2
    assert capsys.readouterr().err.count('\n') == 1
    assert contents(here) == before


@pytest.mark.parametrize('arguments', [
    ('fit', 'poses.csv', '-o', 'cal.yaml'), ('capture', 'rec.csv', '-o', 'poses.csv'),
    ('simulate', '-o', 'poses.csv'), ('simulate', '-o', 'notes.txt', '--force'),
    ('fit', 'poses.csv', 'rec.csv', '-o', 'out')], ids=' '.join)
def test_a_file_of_the_same_kind_is_replaced(arguments, here):
    assert run(*arguments) == 0
    assert run(*arguments) == 0


def write(path, text='new\n'):
    write_atomically(path, lambda file: file.write(text))


@pytest.mark.parametrize('mode', [0o600, 0o640, 0o644])
def test_the_permissions_are_kept(mode, tmp_path):
    path = tmp_path / 'file'
    path.write_text('old\n')
    path.chmod(mode)
    write_atomically(path, lambda file: file.write('new\n'), keep_before=True)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert previous(path).read_text() == 'old\n'
    assert stat.S_IMODE(previous(path).stat().st_mode) == mode


def test_a_new_file_has_the_permissions_of_the_process(tmp_path):
    before = os.umask(0o027)
    try:
        write(tmp_path / 'file')
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / 'file').stat().st_mode) == 0o640


def test_a_link_stays_and_its_target_is_replaced(tmp_path):
    (tmp_path / 'folder').mkdir()
    target, link = tmp_path / 'folder' / 'target', tmp_path / 'link'
    target.write_text('old\n')
    link.symlink_to(target)
    write(link)
    assert link.is_symlink()
    assert target.read_text() == 'new\n'
    assert sorted(each.name for each in tmp_path.iterdir()) == ['folder', 'link']


def test_only_a_regular_writable_file_is_replaced(tmp_path):
    fifo, protected = tmp_path / 'fifo', tmp_path / 'protected'
    os.mkfifo(fifo)
    protected.write_text('old\n')
    protected.chmod(0o444)
    for path, words in ((fifo, 'not a regular file'), (tmp_path, 'not a regular file'),
                        (protected, 'write-protected')):
        with pytest.raises(InputError, match=words):
            write(path)
    assert protected.read_text() == 'old\n'
    assert stat.S_ISFIFO(fifo.stat().st_mode)


def test_a_link_at_a_temporary_name_is_not_followed(tmp_path, monkeypatch):
    victim = tmp_path / 'victim'
    victim.write_text('mine\n')
    monkeypatch.setattr('secrets.token_hex', lambda size: 'known')
    (tmp_path / '.file.known.tmp').symlink_to(victim)
    with pytest.raises(FileExistsError):
        write(tmp_path / 'file')
    assert victim.read_text() == 'mine\n'


def test_leftovers_of_killed_processes_are_removed_and_new_ones_are_kept(tmp_path):
    old, young = tmp_path / '.file.1.tmp', tmp_path / '.file.2.tmp'
    for path in (old, young):
        path.write_text('half')
    os.utime(old, (0.0, 0.0))
    write(tmp_path / 'file')
    assert not old.exists()
    assert young.exists()


def test_a_leftover_that_cannot_be_removed_does_not_fail_the_write(tmp_path):
    folder, old = tmp_path / '.file.1.tmp', tmp_path / '.file.2.tmp'
    folder.mkdir()
    old.write_text('half')
    for path in (folder, old):
        os.utime(path, (0.0, 0.0))
    write(tmp_path / 'file')
    assert folder.exists()
    assert not old.exists()


def test_a_failed_write_leaves_the_file_unchanged(tmp_path):
    path = tmp_path / 'file'
    path.write_text('old\n')

    def fail(file):
        file.write('half')
        raise OSError(28, 'No space left on device')

    with pytest.raises(OSError, match='No space'):
        write_atomically(path, fail)
    assert path.read_text() == 'old\n'
    assert [each.name for each in tmp_path.iterdir()] == ['file']


def test_a_full_disk_has_its_own_advice(here, capsys, monkeypatch):
    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', full)
    assert run('simulate', '-o', 'x.csv') == 2
    assert 'free space on the disk' in capsys.readouterr().err
