# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Binary files are read in a child process, and however it ends, the result is one line."""

from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
import os
from pathlib import Path
import signal
import subprocess
import sys
from typing import Any

from accel_calib.errors import InputError
from accel_calib.logs import BAG, parts_of
from bag_files import MAKES
from inside import open_log_parts, PATIENCE_WITH_A_CHILD, server_of_children
import numpy as np
import pytest
import shared

pytestmark = pytest.mark.usefixtures('in_time')


def misbehaving(path: Path, how: str) -> Generator[Any]:
    """Yield an array, and then do what no reader should."""
    yield np.arange(6.0).reshape(2, 3)
    sys.stdout.write('words of a library')
    sys.stdout.flush()
    if how == 'signal':
        os.kill(os.getpid(), signal.SIGSEGV)
    elif how == 'exit':
        os._exit(3)
    elif how == 'system exit':
        sys.exit('enough')
    elif how == 'error':
        raise KeyError('a\nb')
    elif how == 'memory':
        bytearray(1 << 33)
    elif how == 'file':
        os.truncate(path, 1 << 29)
    elif how == 'object':
        yield np.array([{}])
    while how == 'loop':
        pass
    while how == 'many':
        yield np.zeros(1 << 20)


@pytest.mark.parametrize(('how', 'words'), [
    ('signal', 'its reader ended by SIGSEGV'), ('exit', 'its reader ended with status 3'),
    ('system exit', 'its reader ended with status 1'), ('error', "KeyError 'a"),
    ('memory', 'needs more memory'), ('file', 'File too large'),
    ('loop', 'needed more than 4 s of processor time'),
    ('object', 'sends an array of object'), ('many', 'holds more than 2[0-9]+ bytes')])
def test_whatever_ends_a_child_is_one_line_that_names_the_file(
        how: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(*PATIENCE_WITH_A_CHILD, 3)
    path = tmp_path / 'log.mcap'
    path.write_bytes(b'12')
    with parts_of(BAG.file(path), misbehaving, how, in_child=True) as parts:
        assert next(parts).shape == (2, 3)
        with pytest.raises(InputError, match=words) as found:
            list(map(np.sum, parts))
    assert str(path) in str(found.value)
    assert '\n' not in str(found.value)
    assert capfd.readouterr() == ('', '')
    assert not readers()


def readers() -> list[int]:
    """Return the ids of the children that read files for this process."""
    return shared.children(server_of_children())


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
            'import test_child as t; from pathlib import Path\n'
            f'with t.parts_of(t.BAG.file(Path({str(path)!r})), t.endless, in_child=True) as parts:'
            '\n    next(parts); print(t.server_of_children(), *t.readers(), flush=True)\n'
            '    time.sleep(600)')
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE, text=True,
                          env={**os.environ, 'TMPDIR': str(tmp_path)}) as run:
        assert run.stdout is not None
        found = list(map(int, run.stdout.readline().split()))
        assert len(found) == 2
        run.kill()
    shared.wait(lambda: not any(map(is_running, found)))


def is_running(pid: int) -> bool:
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except FileNotFoundError:
        return False


def test_one_wrong_byte_of_a_matlab_file_does_not_end_the_command(
        capsys: pytest.CaptureFixture[str]) -> None:
    path = shared.data('foreign/one_byte.mat')
    for _ in range(2):
        error = shared.refused(capsys, 'calibrate', path)
        assert f'{path} is damaged (its reader ended by SIGSEGV), expected a MATLAB file' in error


def test_logs_of_several_threads_are_read_at_once(tmp_path: Path) -> None:
    path = MAKES['mcap'](tmp_path)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: open_log_parts(path, in_child=True), range(12)))
    assert found == [found[0]] * 12
