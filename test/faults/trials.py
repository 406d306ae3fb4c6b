# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Trials of a task in which one change of a file fails.

``python test/faults/trials.py START WORK TASK...`` runs with ``LD_PRELOAD`` set to the compiled
shim.c. Each trial is a fork of this process, so that a trial takes milliseconds. It prints one
line of JSON per trial.

"""

from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
import ctypes
import errno
import io
import json
import os
from pathlib import Path
import re
import shutil
import sys
from typing import Any

from accel_calib.stored import read_calibration
from faults.sample import FACTOR, sample
from inside import main as command, SensorStore

KINDS = {'kill': (1, 0), 'torn': (2, 0), 'eio': (3, errno.EIO), 'enospc': (3, errno.ENOSPC)}
ERRORS = ('eio', 'enospc')
FEW = 1
"""Trials per task in `make test`."""

_NEVER = -1
_REFUSAL = ['advice', 'error']
"""Keys of the JSON of a command that has failed."""

_DATE = re.compile(rb'\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d')


def _command(*arguments: str) -> Callable[[Path], int]:
    return lambda folder: command([each.replace('{}', str(folder)) for each in arguments])


def _store(folder: Path) -> SensorStore:
    return SensorStore(folder / 'imu.yaml', 'imu', '/imu', 'm/s2')


def _save(folder: Path) -> int:
    """Store a calibration and poses, as the node does after a fit."""
    store = _store(folder)
    calibration = read_calibration(folder / 'new.yaml')
    store.save_poses(calibration.poses)
    store.write(store.prepared(calibration))
    return 0


def _step_back(folder: Path) -> int:
    """Return to the calibration before, as ~/undo does."""
    _store(folder).step_back()
    return 0


COMMANDS: dict[str, Callable[[Path], int]] = {
    'fit': _command('fit', '{}/poses.csv', '-o', '{}/imu.yaml', '--json', '{}/fit.json'),
    'capture': _command('capture', '{}/recording.csv', '-o', '{}/captured.csv'),
    'apply': _command('apply', '{}/recording.csv', '-c', '{}/imu.yaml', '-o', '{}/out.csv'),
    'export': _command('export', '{}/imu.yaml', '--to', 'c', '-o', '{}/imu.h'),
    'calibrate': _command('calibrate', '{}/recording.csv', '-o', '{}/new.yaml', '--no-refine')}
"""Commands by name. Each writes files in a folder and returns an exit status."""

TASKS = {**COMMANDS, 'save': _save, 'step_back': _step_back}
"""The commands, and what the node does to its own files."""


def trial(task: str, work: Path, kind: str = 'kill', at: int = _NEVER) -> dict[str, Any]:
    """Run a task in a folder; change number `at` fails. Return how the task ended."""
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
    except Exception:  # any: the status shows it
        status = 99
    count = shim.fault_count()
    shim.fault_arm(None, -1, 0, 0)
    os.write(writer, f'{count}\n{sys.stderr.getvalue()}'.encode())  # type: ignore[attr-defined]
    os._exit(status)


def contents(folder: Path) -> dict[str, object]:
    """Return what must be equal in complete files; temporary files are left out."""
    return {path.name: _content(path) for path in folder.iterdir()
            if not path.name.startswith('.')}


def _content(path: Path) -> object:
    """Return all but the date of a file; of a calibration its values and warnings of damage."""
    if path.suffix == '.json' and b'"error"' in path.read_bytes():
        return sorted({*json.loads(path.read_bytes())} & {*_REFUSAL})
    if '.yaml' not in path.name:
        return _DATE.sub(b'', path.read_bytes())
    try:
        found = read_calibration(path)
    except Exception as err:  # any: the test shows it
        return str(err)
    return found.model.vector.tolist(), found.warnings


def main() -> None:
    """Run the trials of each task."""
    start, work = Path(sys.argv[1]), Path(sys.argv[2])
    before = contents(start)
    for seed, task in enumerate(sys.argv[3:]):
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            TASKS[task](_copied(start, work))  # so that the forks need not import what it uses
        changes = trial(task, _copied(start, work))['changes']
        complete = contents(work)
        kinds = [*KINDS] if FACTOR > 1 else [[*KINDS][seed % len(KINDS)]]
        cases = [(kind, at) for kind in kinds for at in range(changes)]
        for kind, at in sample(cases, FEW, seed):
            found = trial(task, _copied(start, work), kind, at)
            after = contents(work)
            refusal = [_REFUSAL] if found['status'] == 2 else []
            found['torn'] = [name for name in {*before, *after} if after.get(name) not in (
                before.get(name), complete.get(name), *refusal)]
            found['left'] = [path.name for path in work.iterdir() if path.name[0] == '.']
            found['again'] = trial(task, work)['status']
            after = contents(work)
            found['undone'] = [name for name in complete if task in COMMANDS
                               and not name.endswith('.before') and after[name] != complete[name]]
            sys.__stdout__.write(f'{json.dumps(found)}\n')  # type: ignore[union-attr]


def _copied(start: Path, work: Path) -> Path:
    shutil.rmtree(work, ignore_errors=True)
    return Path(shutil.copytree(start, work))


if __name__ == '__main__':
    main()
