# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Trials of a task in which one change of a file fails.

The main function runs with ``LD_PRELOAD`` set to the compiled shim.c. Each trial is a fork of this
process, so that a trial takes milliseconds. It prints one line of JSON per trial.

"""

from __future__ import annotations

from collections.abc import Callable
import ctypes
import errno
import io
import json
import os
from pathlib import Path
import shutil
import sys

from accel_calib.cli.main import main as command
from accel_calib.files import read_calibration, read_poses
from accel_calib.session.store import Identity, Store

KINDS = {'kill': (1, 0), 'torn': (2, 0), 'eio': (3, errno.EIO), 'enospc': (3, errno.ENOSPC)}
_MOST = 10_000


def _command(*arguments: str) -> Callable[[Path], int]:
    return lambda folder: command([each.replace('{}', str(folder)) for each in arguments])


def _store(folder: Path) -> Store:
    return Store(folder / 'imu.yaml', Identity('imu', '/imu'), 'm/s2')


def _save(folder: Path) -> int:
    """Store a calibration and poses, as the node does after a fit."""
    store = _store(folder)
    calibration = read_calibration(folder / 'new.yaml')
    store.save_poses(calibration.poses)
    store.save_calibration(calibration)
    return 0


def _step_back(folder: Path) -> int:
    """Return to the calibration before, as ~/undo does."""
    _store(folder).step_back()
    return 0


TASKS: dict[str, Callable[[Path], int]] = {
    'fit': _command('fit', '{}/poses.csv', '-o', '{}/imu.yaml', '--json', '{}/fit.json'),
    'capture': _command('capture', '{}/recording.csv', '-o', '{}/captured.csv'),
    'apply': _command('apply', '{}/recording.csv', '-c', '{}/imu.yaml', '-o', '{}/out.csv'),
    'export': _command('export', '{}/imu.yaml', '--to', 'c', '-o', '{}/imu.h'),
    'save': _save, 'step_back': _step_back}
"""Tasks by name. Each changes files in a folder and returns an exit status."""


def trial(task: str, start: Path, work: Path, kind: str, at: int) -> dict[str, object]:
    """Run a task in a copy of a folder; change number `at` fails. Return what is then there."""
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(start, work)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        _child(task, work, kind, at, writer)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    changes, _, error = said.partition('\n')
    return {'task': task, 'kind': kind, 'at': at, 'status': status, 'error': error,
            'changes': int(changes or 0)}


def _child(task: str, work: Path, kind: str, at: int, writer: int) -> None:
    """Run the task, write the number of changes and standard error to the pipe, and exit."""
    shim = ctypes.CDLL(None)
    sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
    how, code = KINDS[kind]
    shim.fault_arm(os.fsencode(work), at, how, code)
    try:
        status = TASKS[task](work)
    except OSError as err:
        status, sys.stderr = 2, io.StringIO(f'{err.strerror}\n')
    count = shim.fault_count()
    shim.fault_arm(None, -1, 0, 0)
    os.write(writer, f'{count}\n{sys.stderr.getvalue()}'.encode())  # type: ignore[attr-defined]
    os._exit(status)


def sound(folder: Path) -> list[str]:
    """Return the names of the files of a folder that cannot be read; leftovers are not read."""
    readers = {'.yaml': read_calibration, '.csv': read_poses, '.json': _json, '.h': _header}
    bad = []
    for path in sorted(folder.iterdir()):
        reader = readers.get(path.suffix)
        if reader is not None and path.stat().st_size and not path.name.startswith('.'):
            try:
                reader(path)
            except Exception as err:  # any: the test shows it
                bad.append(f'{path.name}: {err}')
        elif reader is not None and not path.name.startswith('.'):
            bad.append(f'{path.name} is empty')
    return bad


def _json(path: Path) -> object:
    return json.loads(path.read_text(encoding='utf-8'))


def _header(path: Path) -> None:
    if not path.read_text(encoding='utf-8').rstrip().endswith('*/'):
        raise ValueError('cut')


def main() -> None:
    """Run all trials: START and WORK folder, then TASK:KIND pairs."""
    start, work = Path(sys.argv[1]), Path(sys.argv[2])
    before = {path.name: path.read_bytes() for path in start.iterdir()}
    for pair in sys.argv[3:]:
        task, _, kind = pair.partition(':')
        for at in range(_MOST):
            found = trial(task, start, work, kind, at)
            found['bad'] = sound(work)
            found['left'] = [path.name for path in work.iterdir() if path.name.startswith('.')]
            found['lost'] = [name for name in before if not (work / name).exists()]
            found['changed'] = [name for name in before if (work / name).exists()
                                and (work / name).read_bytes() != before[name]]
            found['again'] = trial_again(task, work)
            sys.__stdout__.write(f'{json.dumps(found)}\n')  # type: ignore[union-attr]
            if found['status'] >= 0 and found['changes'] <= at:  # type: ignore[operator]
                break


def trial_again(task: str, work: Path) -> int:
    """Return the exit status of the task in the folder as the failure left it."""
    child = os.fork()
    if not child:
        sys.stdout, sys.stderr = io.StringIO(), io.StringIO()
        try:
            os._exit(TASKS[task](work))
        except Exception:  # any: the status shows it
            os._exit(99)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


if __name__ == '__main__':
    main()
