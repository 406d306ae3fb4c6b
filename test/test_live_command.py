# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The command ``accel-calib live`` in a process of its own, and a viewer of its page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import signal
import subprocess
import sys

from accel_calib.stored import read_calibration
from inside import COMMAND, main
from live_bench import TurnedSensor
import numpy as np
import pytest
from serial_board import board
from viewer import Viewer, wait

COUNTS = 16384.0 / 9.80665
PATIENCE = 120.0


def lines_of(sensor: TurnedSensor) -> Iterator[str]:
    """Yield what a board sends: a greeting, a header, and a line of counts for each sample."""
    yield 'boot ok\r\n'
    yield 't_ms;accX;accY;accZ;temp_C\r\n'
    for block in sensor.blocks:
        yield ''  # the board can end between two blocks
        for row in block:
            x, y, z = np.round(row[1:4] * COUNTS)
            yield f'{1000.0 * row[0]:.1f};{x:g};{y:g};{z:g};24.5\r\n'


@contextmanager
def live(*arguments: str) -> Iterator[tuple[str, list[str], subprocess.Popen[str]]]:
    """Run the command, and yield the link that it prints, its lines, and the process."""
    process = subprocess.Popen([sys.executable, *COMMAND, 'live', '--port', '0', *arguments],
                               stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines: list[str] = []
    try:
        for line in process.stdout:
            lines.append(line.strip())
            if line.startswith('live page: '):
                break
        assert lines, 'the command has ended'
        yield lines[-1].removeprefix('live page: '), lines, process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def follow(viewer: Viewer, sensor: TurnedSensor) -> None:
    """Turn a sensor as the page asks, until it asks for the fit."""
    wait(lambda: viewer.of('progress') and viewer.of('progress')[-1]['direction'])
    while direction := (now := viewer.of('progress')[-1])['direction']:
        sensor.turn_to(np.array(direction))
        wait(lambda poses=now['poses']: viewer.of('progress')[-1]['poses'] > poses)
    assert '~/fit' in now['advice']


def test_a_board_on_a_serial_port_is_calibrated(tmp_path: Path) -> None:
    sensor, stored = TurnedSensor(speed=5.0), tmp_path / 'board.yaml'
    with (board(lines_of(sensor)) as port,
          live(port, '-o', str(stored)) as (link, lines, run)):
        viewer = Viewer(link)
        follow(viewer, sensor)
        wait(lambda: viewer.of('progress')[-1]['up'])  # also before the zero is fitted
        assert viewer.ask('fit')['success']
        wait(lambda: viewer.state['preview'] and viewer.state['rating'])
        assert viewer.state['rating']['rating'] == 'GOOD'
        assert viewer.ask('save')['success']
        viewer.close()
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE) == 0
    assert any(line.startswith("read as: ';'") for line in lines)
    calibration = read_calibration(stored)
    assert calibration.units.name == 'native'
    offset = calibration.units.to_g(calibration.offset)
    np.testing.assert_allclose(offset, (0.03, -0.02, 0.04), atol=0.002)


def test_a_recording_is_played_to_its_end_and_the_page_remains(tmp_path: Path) -> None:
    recording = tmp_path / 'short.csv'
    stamps = np.arange(300) / 100.0
    rows = np.column_stack([stamps, np.tile([0.1, 0.2, 9.8], (300, 1))
                            + 0.01 * np.random.default_rng(1).normal(size=(300, 3))])
    np.savetxt(recording, rows, delimiter=',', header='time,ax,ay,az', comments='')
    with live(str(recording), '-o', str(tmp_path / 'c.yaml'), '--speed', '10') as (link, _, run):
        viewer = Viewer(link)
        wait(lambda: viewer.of('state') and 'short.csv has ended' in viewer.state['problem'])
        wait(lambda: viewer.of('progress') and viewer.of('progress')[-1]['poses'] == 1)
        viewer.close()
        run.send_signal(signal.SIGTERM)
        assert run.wait(PATIENCE) == 0


def test_a_missing_recording_or_port_is_one_line_and_status_2(
        tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for source in (tmp_path / 'missing.csv', '/dev/ttyUSB97'):
        assert main(['live', str(source)]) == 2
        assert capsys.readouterr().err.count('\n') == 1
