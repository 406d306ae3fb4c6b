# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Commands that are killed at random times: an output is the old file or the complete new one."""

from __future__ import annotations

from collections.abc import Sequence
import os
from pathlib import Path
import shutil
import subprocess
import sys
import time

from accel_calib.cli.main import main
from accel_calib.files import read_calibration
from faults.trials import sound
import numpy as np
import pytest

KILLS = 3 * int(os.environ.get('ACCEL_CALIB_TRIALS', '1'))
COMMANDS = {
    'fit': (['fit', 'poses.csv', '-o', 'out.yaml', '--json', 'out.json'],
            ['out.yaml', 'out.json']),
    'capture': (['capture', 'recording.csv', '-o', 'out_poses.csv'], ['out_poses.csv']),
    'apply': (['apply', 'recording.csv', '-c', 'imu.yaml', '-o', 'out.csv'], ['out.csv']),
    'calibrate': (['calibrate', 'recording.csv', '-o', 'out.yaml', '--no-refine'], ['out.yaml'])}
"""Arguments and outputs of each command."""


@pytest.fixture(scope='module')
def start(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with inputs, and with outputs of other inputs."""
    folder = tmp_path_factory.mktemp('start')
    here = Path.cwd()
    os.chdir(folder)
    try:
        for seed, offset in ((2, 0.03), (1, 0.02)):
            run('simulate', '-o', 'poses.csv', '--effect', f'offset={offset}', '--seed', seed)
            run('simulate', '-o', 'recording.csv', '--recording', '--poses', 14, '--dwell', 2,
                '--rate', 50, '--seed', seed)
            if seed == 2:
                run('fit', 'poses.csv', '-o', 'imu.yaml')
                for name in ('fit', 'capture', 'apply'):
                    run(*COMMANDS[name][0])
    finally:
        os.chdir(here)
    return folder


def run(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


def started(arguments: Sequence[str], folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, '-m', 'accel_calib.cli.main', *arguments], cwd=folder,
        env={**os.environ, 'OPENBLAS_NUM_THREADS': '1', 'PYTHONDONTWRITEBYTECODE': '1'},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def content(path: Path) -> object:
    """Return what must be equal in a complete file: of a calibration, all but its date."""
    if path.suffix == '.yaml':
        return read_calibration(path).model.vector.tolist()
    return path.read_bytes()


@pytest.mark.parametrize('name', COMMANDS)
def test_a_killed_command_leaves_the_old_or_the_complete_new_file(
        name: str, start: Path, tmp_path: Path) -> None:
    arguments, outputs = COMMANDS[name]
    complete = tmp_path / 'complete'
    shutil.copytree(start, complete)
    begun = time.monotonic()
    assert started(arguments, complete).wait() == 0
    whole = time.monotonic() - begun
    rng = np.random.default_rng(sum(map(ord, name)))
    killed = 0
    for k in range(KILLS):
        folder = tmp_path / f'kill{k}'
        shutil.copytree(start, folder)
        process = started(arguments, folder)
        time.sleep(whole * rng.uniform(0.5, 1.1))  # before, Python is loading modules
        process.kill()
        killed += process.wait() < 0
        assert not sound(folder)
        for output in outputs:
            found = content(folder / output)
            assert found in (content(start / output), content(complete / output)), output
        if k == KILLS - 1:
            assert started(arguments, folder).wait() == 0
            assert [content(folder / each) for each in outputs] == [
                content(complete / each) for each in outputs]
        shutil.rmtree(folder)
    sys.stdout.write(f'{name}: {killed} of {KILLS} processes were killed before their end\n')
