# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The command ``accel-calib live`` in a process of its own, and its page in Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
import re
import signal
import subprocess
import sys

from accel_calib.files import read_calibration
from live_bench import chromium, follow, PATIENCE, TurnedSensor, Viewers
import numpy as np
from playwright.sync_api import expect, sync_playwright
import pytest
from serial_board import board

GAINS = {'m/s2': 1.0, 'counts': 16384.0 / 9.80665}


def lines_of(sensor: TurnedSensor, per_unit: float) -> Iterator[str]:
    """Yield what a board sends: a greeting, a header, and a line for each sample."""
    yield 'boot ok\r\n'
    yield 't_ms;accX;accY;accZ;temp_C\r\n'
    for block in sensor.blocks:
        yield ''  # the board can end between two blocks
        for row in block:
            x, y, z = np.round(row[1:4] * per_unit, 4 if per_unit == 1.0 else 0)
            yield f'{1000.0 * row[0]:.1f};{x:g};{y:g};{z:g};24.5\r\n'


@contextmanager
def live(*arguments: str) -> Iterator[tuple[str, list[str], subprocess.Popen[str]]]:
    """Run the command, and yield the link that it prints, its lines, and the process."""
    process = subprocess.Popen([sys.executable, '-m', 'accel_calib.cli.main', 'live', '--port',
                                '0', *arguments], stdout=subprocess.PIPE, text=True)
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


@pytest.mark.parametrize('unit', GAINS)
def test_a_board_on_a_serial_port_is_calibrated_in_the_browser(unit: str, tmp_path: Path) -> None:
    sensor, stored = TurnedSensor(speed=5.0), tmp_path / 'board.yaml'
    with (board(lines_of(sensor, GAINS[unit])) as port,
          live(port, '-o', str(stored)) as (link, lines, run), sync_playwright() as playwright):
        browser = chromium(playwright)
        viewers = Viewers(browser)
        page = viewers.visit(link)
        follow(page, sensor.turn_to)
        expect(page.locator('#box-now')).to_have_attribute(  # also before the zero is fitted
            'aria-label', re.compile(r'\w+ (side|edge|corner) up$'), timeout=PATIENCE)
        page.get_by_role('button', name='Fit', exact=True).click()
        expect(page.locator('#offer')).to_be_visible(timeout=PATIENCE)
        expect(page.locator('#verdict strong')).to_have_text('GOOD', timeout=PATIENCE)
        page.get_by_role('button', name='Accept', exact=True).click()
        expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)
        assert viewers.complaints == []
        viewers.close()
        browser.close()
        run.send_signal(signal.SIGINT)
        assert run.wait(20.0) == 0
    assert any(line.startswith("read as: ';'") for line in lines)
    calibration = read_calibration(stored)
    assert calibration.units.name == ('m/s2' if unit == 'm/s2' else 'native')
    offset = calibration.units.to_g(calibration.offset)
    np.testing.assert_allclose(offset, (0.03, -0.02, 0.04), atol=0.002)


def test_a_recording_is_played_to_its_end_and_the_page_remains(tmp_path: Path) -> None:
    recording = tmp_path / 'short.csv'
    stamps = np.arange(300) / 100.0
    rows = np.column_stack([stamps, np.tile([0.1, 0.2, 9.8], (300, 1))
                            + 0.01 * np.random.default_rng(1).normal(size=(300, 3))])
    np.savetxt(recording, rows, delimiter=',', header='time,ax,ay,az', comments='')
    with (live(str(recording), '-o', str(tmp_path / 'c.yaml'), '--speed', '10') as (link, _, run),
          sync_playwright() as playwright):
        browser = chromium(playwright)
        page = Viewers(browser).visit(link)
        expect(page.locator('body')).to_contain_text(re.compile('short.csv has ended'),
                                                     timeout=PATIENCE)
        expect(page.locator('#poses')).to_have_text(re.compile(r'^1\b'), timeout=PATIENCE)
        browser.close()
        run.send_signal(signal.SIGTERM)
        assert run.wait(20.0) == 0


def test_a_port_in_use_and_a_missing_recording_are_one_line_and_status_2(tmp_path: Path) -> None:
    for arguments in ((str(tmp_path / 'missing.csv'),), ('/dev/ttyUSB97',)):
        done = subprocess.run([sys.executable, '-m', 'accel_calib.cli.main', 'live', *arguments],
                              capture_output=True, text=True)
        assert done.returncode == 2
        assert done.stderr.count('\n') == 1
        assert 'Traceback' not in done.stderr
