# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Any change of a file may fail or be the last one: each file is the old or the complete new."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from accel_calib.stored import read_calibration
from faults.trials import command, COMMANDS, ERRORS, FEW, KINDS, TASKS
from inside import SensorStore
import pytest

HERE = Path(__file__).parent
KILLED = -9


def fill(folder: Path) -> None:
    """Write inputs, outputs of other inputs, and the files of a node after two fits."""
    for seed, offset in ((2, 0.03), (1, 0.02)):
        run('simulate', '-o', folder / 'poses.csv', '--effect', f'offset={offset}', '--seed', seed)
        run('simulate', '-o', folder / 'recording.csv', '--recording', '--poses', 12, '--dwell', 2,
            '--rate', 50, '--seed', seed)
        if seed == 2:
            run('fit', folder / 'poses.csv', '-o', folder / 'new.yaml', '--sensor', 'imu')
            run('fit', folder / 'poses.csv', '-o', folder / 'imu.yaml', '--sensor', 'imu')
            for task in COMMANDS:
                assert COMMANDS[task](folder) == 0
    run('fit', folder / 'poses.csv', '-o', folder / 'imu.yaml', '--sensor', 'imu')
    store = SensorStore(folder / 'imu.yaml', 'imu', '/imu', 'm/s2')
    store.write(store.prepared(read_calibration(folder / 'new.yaml')))
    store.write(store.prepared(read_calibration(folder / 'imu.yaml.before1')))


def run(*arguments: object) -> None:
    assert command([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope='module')
def trials(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Return the outcome of all trials."""
    compiler = shutil.which('cc')
    if compiler is None or not sys.platform.startswith('linux'):
        pytest.skip('the shim needs a C compiler and Linux')
    start, folder = map(tmp_path_factory.mktemp, ('start', 'work'))
    fill(start)
    shim = folder / 'shim.so'
    subprocess.run([compiler, '-shared', '-fPIC', '-o', shim, HERE / 'shim.c', '-ldl'], check=True)
    done = subprocess.run(
        [sys.executable, HERE / 'trials.py', start, folder / 'trial', *TASKS], check=False,
        capture_output=True, text=True, cwd=HERE.parents[1],
        env={**os.environ, 'LD_PRELOAD': str(shim), 'OPENBLAS_NUM_THREADS': '1',
             'PYTHONPATH': os.pathsep.join(map(str, (HERE.parents[1], HERE.parent)))})
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_changes_of_each_task_fail_in_each_way(trials: list[dict[str, Any]]) -> None:
    assert {each['kind'] for each in trials} == {*KINDS}
    for task in TASKS:
        assert len([each for each in trials if each['task'] == task]) >= FEW
    for each in trials:
        failed = each['at'] < each['changes'] if each['kind'] in ERRORS else (
            each['status'] == KILLED)
        assert failed, each


def test_each_file_is_the_old_or_the_complete_new_one(trials: list[dict[str, Any]]) -> None:
    assert not [each for each in trials if each['torn']]


def test_an_error_is_one_line_with_status_2_and_leaves_nothing(
        trials: list[dict[str, Any]]) -> None:
    for each in trials:
        if each['kind'] not in ERRORS or each['status'] == 0:
            continue  # removing an old temporary file may fail
        assert each['status'] == 2, each
        assert each['error'].count('\n') == 1, each
        assert 'internal error' not in each['error'], each
        assert not each['left'], each


def test_after_any_failure_the_task_is_done_again(trials: list[dict[str, Any]]) -> None:
    assert not [each for each in trials if each['again'] or each['undone']]
