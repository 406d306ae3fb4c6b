# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Every change of a file may fail or be the last one: nothing stored is torn or lost."""

from __future__ import annotations

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from accel_calib.cli.main import main
from accel_calib.files import read_calibration
from accel_calib.session.store import Identity, Store
import pytest

HERE = Path(__file__).parent
ERRORS = ('eio', 'enospc')
TASKS = ('fit', 'capture', 'apply', 'export', 'save', 'step_back')


@pytest.fixture(scope='module')
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with poses, a recording, and the files of a node after two fits."""
    folder = tmp_path_factory.mktemp('start')
    run('simulate', '-o', folder / 'poses.csv', '--effect', 'offset=0.02')
    run('simulate', '-o', folder / 'recording.csv', '--recording', '--poses', 14, '--dwell', 2,
        '--rate', 50)
    run('fit', folder / 'poses.csv', '-o', folder / 'imu.yaml', '--sensor', 'imu')
    run('simulate', '-o', folder / 'others.csv', '--effect', 'offset=0.03', '--seed', 2)
    run('fit', folder / 'others.csv', '-o', folder / 'new.yaml', '--sensor', 'imu')
    store = Store(folder / 'imu.yaml', Identity('imu', '/imu'), 'm/s2')
    store.save_calibration(read_calibration(folder / 'new.yaml'))
    store.save_calibration(read_calibration(folder / 'imu.yaml.before1'))
    return folder


def run(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope='module')
def trials(start: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Return the outcome of all trials."""
    compiler = shutil.which('cc')
    if compiler is None or not sys.platform.startswith('linux'):
        pytest.skip('the shim needs a C compiler and Linux')
    folder = tmp_path_factory.mktemp('work')
    shim = folder / 'shim.so'
    subprocess.run([compiler, '-shared', '-fPIC', '-o', shim, HERE / 'shim.c', '-ldl'], check=True)
    pairs = [f'{task}:{kind}' for task in TASKS for kind in ('kill', 'torn', *ERRORS)]
    done = subprocess.run(
        [sys.executable, HERE / 'trials.py', start, folder / 'trial', *pairs], check=False,
        capture_output=True, text=True, timeout=600, cwd=HERE.parents[1],
        env={**os.environ, 'LD_PRELOAD': str(shim), 'OPENBLAS_NUM_THREADS': '1',
             'PYTHONPATH': str(HERE.parents[1])})
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def of(trials: list[dict[str, Any]], *kinds: str) -> list[dict[str, Any]]:
    """Return the trials of some kinds in which a change failed."""
    return [each for each in trials if each['kind'] in kinds
            and (each['status'] < 0 or each['at'] < each['changes'])]


def test_every_change_of_every_task_fails_once(trials: list[dict[str, Any]]) -> None:
    for task in TASKS:
        for kind in ('kill', *ERRORS):
            assert len([each for each in of(trials, kind) if each['task'] == task]) >= 4


def test_no_file_is_torn_or_lost(trials: list[dict[str, Any]]) -> None:
    moved = {'step_back': {'imu.yaml.before2'}}  # it becomes imu.yaml
    for each in trials:
        assert not each['bad'], each
        assert set(each['lost']) <= moved.get(each['task'], set()), each


def test_only_the_files_of_the_task_change(trials: list[dict[str, Any]]) -> None:
    own = {'fit': {'imu.yaml'}, 'save': {'imu.yaml'}, 'step_back': {'imu.yaml'}}
    for each in trials:
        assert set(each['changed']) <= own.get(each['task'], set()), each


def test_an_error_is_one_line_with_status_2_and_leaves_nothing(
        trials: list[dict[str, Any]]) -> None:
    for each in of(trials, *ERRORS):
        if each['status'] == 0:
            continue  # removing an old temporary file may fail
        assert each['status'] == 2, each
        assert each['error'].count('\n') == 1, each
        assert 'internal error' not in each['error'], each


def test_after_any_failure_the_task_runs_again(trials: list[dict[str, Any]]) -> None:
    assert {each['again'] for each in trials} == {0}
