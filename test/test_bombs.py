# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A small file can't take much memory or work: it ends in one line, or in a result.

Binary files are read in a child process; however it ends, the result is one line.

"""

from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
import itertools
import os
from pathlib import Path
import shutil
import signal
import socket
import subprocess
import sys
from typing import Any

from accel_calib.errors import InputError
from accel_calib.logs import BAG, parts_of, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from bag_files import COUNT, MAKES, McapFile, raw_messages, rosbag2 as folder_of, TOPICS
from inside import (
    check_regular, open_bag, open_log_parts, PATIENCE_WITH_A_CHILD, server_of_children)
import numpy as np
import pytest
from rosbags import rosbag2
from rosbags.rosbag2 import StoragePlugin
from shared import children, data, known, little_memory, LOG_CORPUS, refused, table, wait

pytestmark = pytest.mark.usefixtures('in_time')

RAWS = raw_messages()
BOMBS = LOG_CORPUS / 'bombs'
"""Small logs that would take 130 MB to 2 GB, or endless work, if they were read as a whole."""


@pytest.mark.parametrize('bomb', sorted(BOMBS.iterdir()), ids=lambda path: path.name)
def test_a_bomb_ends_in_one_line_with_little_memory(bomb: Path, tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_WITH_A_CHILD, 2)
    copy = shutil.copytree if bomb.is_dir() else shutil.copy
    path = Path(copy(bomb, tmp_path / bomb.name))
    before = {*tmp_path.rglob('*')}
    with little_memory(), pytest.raises(InputError) as found:
        read_recording(path)
    assert str(path) in str(found.value)
    assert '\n' not in str(found.value)
    assert {*tmp_path.rglob('*')} == before


def test_a_json_file_is_read_up_to_a_size(tmp_path: Path) -> None:
    path = tmp_path / 'log.json'
    path.write_bytes(b'[{"a": 1}]')
    os.truncate(path, (1 << 25) + 1)
    with little_memory(), pytest.raises(InputError, match='JSON file of at most'):
        read_recording(path)


def test_blocks_of_large_messages_are_short(tmp_path: Path) -> None:
    large = [(2, RAWS[0][1] + k, bytes(1 << 19)) for k in range(80)]
    path = McapFile(TOPICS, 'zstd', chunk=16 << 20).write(tmp_path / 'bag.mcap', large)
    with open_bag(path) as bag:
        sizes = [len(block) for block in bag.blocks()]
    assert sum(sizes) == 80
    assert max(sizes) <= 64


def test_data_that_compress_well_are_read(tmp_path: Path) -> None:
    black = [(2, RAWS[0][1] + k, bytes(8 << 20)) for k in range(4)]  # pictures
    path = McapFile(TOPICS, 'zstd', chunk=16 << 20).write(tmp_path / 'bag.mcap', [*RAWS, *black])
    assert len(read_recording(path)) == COUNT
    assert correct_bag(path, known(), tmp_path / 'out') == COUNT


def test_a_copy_that_lacks_messages_is_refused(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, count = rosbag2.Writer.write, iter(range(10 ** 6))

    def losing(self: Any, *message: Any) -> None:
        if next(count) != 20:
            write(self, *message)

    path = folder_of(StoragePlugin.SQLITE3)(tmp_path)
    monkeypatch.setattr(rosbag2.Writer, 'write', losing)
    with pytest.raises(InputError, match='the copy holds 83 of 84 messages'):
        correct_bag(path, known(), tmp_path / 'out')
    assert [*tmp_path.iterdir()] == [path]


# ----------------------------------------------------------------------------- regular files

def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'fifo')
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / 'socket'))
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'fifo')
    for name, kind in (('fifo', 'a pipe'), ('socket', 'a socket'), ('folder', 'a folder'),
                       ('/dev/zero', 'a character device'), ('link', 'a pipe')):
        with pytest.raises(InputError, match=f'is {kind}.*, expected a regular file; (sto|choo)'):
            check_regular(tmp_path / name)
    (tmp_path / 'file').write_text('')
    (tmp_path / 'right').symlink_to(tmp_path / 'file')
    check_regular(tmp_path / 'right')
    with pytest.raises(FileNotFoundError):
        check_regular(tmp_path / 'missing')


@pytest.mark.parametrize(('command', 'suffix'), [
    *((command, '') for command in table('commands_of_one_file')),
    *(('capture {} -o {out}', suffix) for suffix in ('.bag', '.mcap', '.db3', '.ulg', '.bin'))])
def test_a_pipe_ends_every_command_in_one_line(
        command: str, suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe, stored, out = tmp_path / f'pipe{suffix}', tmp_path / 'c.yaml', tmp_path / 'out'
    os.mkfifo(pipe)
    write_calibration(stored, known())
    given = [each.replace('{out}', str(out)).replace('{yaml}', str(stored)).replace(
        '{}', str(pipe)) for each in command.split()]
    assert '(FIFO)' in refused(capsys, *given).partition(str(pipe))[2]
    assert not out.exists()


@pytest.mark.parametrize('name', ['bag.mcap', 'metadata.yaml'])
def test_a_pipe_in_the_folder_of_a_bag_is_refused(name: str, tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.MCAP)(tmp_path)
    (path / name).unlink()
    os.mkfifo(path / name)
    with pytest.raises(InputError, match=f'{name} is a pipe'):
        read_recording(path)


# The child process that reads binary files


def loop(path: Path) -> None:
    while True:
        pass


MISBEHAVIOUR: dict[str, tuple[Callable[[Path], Any], str]] = {
    'signal': (lambda path: os.kill(os.getpid(), signal.SIGSEGV), 'SIGSEGV'),
    'exit': (lambda path: os._exit(3), 'status 3'),
    'system exit': (lambda path: sys.exit('enough'), 'status 1'),
    'error': (lambda path: {}['a\nb'], "KeyError 'a"), 'loop': (loop, '4 s'),
    'memory': (lambda path: bytearray(1 << 33), 'more memory'),
    'file': (lambda path: os.truncate(path, 1 << 29), 'File too large'),
    'object': (lambda path: [np.array([{}])], 'array of object'),
    'many': (lambda path: itertools.repeat(np.zeros(1 << 20)), 'more than 2[0-9]+ bytes')}
"""What no reader should do, perhaps what it yields then, and words of the error."""


def misbehaving(path: Path, how: str) -> Generator[Any]:
    """Yield an array, and then do what no reader should."""
    yield np.arange(6.0).reshape(2, 3)
    sys.stdout.write('words of a library')
    sys.stdout.flush()
    yield from MISBEHAVIOUR[how][0](path)


@pytest.mark.parametrize('how', MISBEHAVIOUR)
def test_whatever_ends_a_child_is_one_line_that_names_the_file(
        how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(*PATIENCE_WITH_A_CHILD, 3)
    path = tmp_path / 'log.mcap'
    path.write_bytes(b'12')
    with parts_of(BAG.file(path), misbehaving, how, in_child=True) as parts:
        assert next(parts).shape == (2, 3)
        with pytest.raises(InputError, match=MISBEHAVIOUR[how][1]) as found:
            list(map(np.sum, parts))
    assert str(path) in str(found.value)
    assert '\n' not in str(found.value)
    assert capfd.readouterr() == ('', '')
    assert not readers()


def readers() -> list[int]:
    """Return the ids of the children that read files for this process."""
    return children(server_of_children())


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
def test_a_child_reads_what_this_process_reads(kind: str, tmp_path: Path) -> None:
    path = MAKES[kind](tmp_path)
    assert open_log_parts(path, in_child=True) == open_log_parts(path, in_child=False)
    with pytest.raises(PermissionError) if os.geteuid() else pytest.raises(InputError):
        open_log_parts(without_rights(path), in_child=True)


def test_a_path_is_that_of_the_folder_in_which_this_process_is(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('one', 'two'):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(MAKES['mcap'](tmp_path / name).parent)
        assert open_log_parts(Path('bag.mcap'), in_child=True)


def without_rights(path: Path) -> Path:
    """Return a bag that may not be read; root, who may read all, gets an empty one."""
    for each in path.iterdir() if path.is_dir() else [path]:
        each.write_bytes(b'')
        each.chmod(0)
    return path


@pytest.mark.parametrize('how', [None, KeyboardInterrupt, ValueError])
def test_a_log_that_is_left_early_ends_its_child(how: Any, tmp_path: Path) -> None:
    path = MAKES['mcap'](tmp_path)
    before = readers()
    try:
        with parts_of(BAG.file(path), endless, in_child=True) as parts:
            next(parts)
            assert len(readers()) == len(before) + 1
            if how is not None:
                raise how
    except (KeyboardInterrupt, ValueError):
        pass
    assert readers() == before


def endless(path: Path) -> Iterator[int]:
    """Yield a number without end, with more and more work between."""
    for k in range(1 << 40):
        yield sum(range(k))


def test_no_process_outlives_one_that_is_killed(tmp_path: Path) -> None:
    path = MAKES['mcap'](tmp_path)
    code = (f'import sys, time; sys.path[:] = {sys.path!r}\n'
            'import test_bombs as t; from pathlib import Path\n'
            f'with t.parts_of(t.BAG.file(Path({str(path)!r})), t.endless, in_child=True) as parts:'
            '\n    next(parts); print(t.server_of_children(), *t.readers(), flush=True)\n'
            '    time.sleep(600)')
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True,
                          env={**os.environ, 'TMPDIR': str(tmp_path)}) as run:
        assert run.stdout is not None
        found = list(map(int, run.stdout.readline().split()))
        assert len(found) == 2
        run.kill()
    wait(lambda: not any(map(is_running, found)))


def is_running(pid: int) -> bool:
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False


def test_one_wrong_byte_of_a_matlab_file_does_not_end_the_command(
        capsys: pytest.CaptureFixture[str]) -> None:
    path = data('foreign/one_byte.mat')
    for _ in range(2):
        error = refused(capsys, 'calibrate', path)
        assert f'{path} is damaged (its reader ended by SIGSEGV), expected a MATLAB file' in error


def test_logs_of_several_threads_are_read_at_once(tmp_path: Path) -> None:
    path = MAKES['mcap'](tmp_path)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: open_log_parts(path, in_child=True), range(12)))
    assert found == [found[0]] * 12
