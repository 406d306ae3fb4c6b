# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""`apply` corrects a table block by block: the same numbers as at once, in constant memory."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
import tracemalloc
from typing import Any

from accel_calib.calibrate import of_samples
from accel_calib.logs import read_recording, write_blocks, write_table
from accel_calib.stored import write_calibration
from accel_calib.table import numbered, Recording
from inside import main, ROWS_OF_A_TEXT
import numpy as np
import pytest
from test_outside import calibrated

RATE_HZ = 100.0
EFFECTS = {'offset_temperature': np.array([2e-3, -1e-3, 1e-3, 60.0, 0.0]),
           'gain_temperature': np.array([5e-4, 3e-4, -4e-4, 40.0, 1.0]),
           'temperature_rate': np.array([0.02, -0.03, 0.01])}


def recording(count: int) -> Recording:
    """Return samples in m/s² whose temperature rises and falls."""
    rng, time = np.random.default_rng(5), 100.0 + np.arange(count) / RATE_HZ
    columns = {'time': time, 'reading': rng.normal([0.2, -0.3, 9.8], 0.01, (count, 3)),
               'temperature': 25.0 + 3.0 * np.sin(time / 20.0),
               'rate': rng.normal(0.0, 0.01, (count, 3))}
    return Recording(columns, numbered(columns), 'm/s2')


@pytest.fixture(scope='module')
def calibration() -> Any:
    return calibrated(EFFECTS)


@pytest.fixture(scope='module')
def stored(calibration: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('stored') / 'calibration.yaml'
    write_calibration(path, calibration)
    return path


def applied(path: Path, stored: Path, out: Path) -> Path:
    assert main(['apply', str(path), '-c', str(stored), '-o', str(out)]) == 0
    return out


def test_blocks_give_the_same_as_the_whole(calibration: Any, stored: Path,
                                           tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                           capsys: pytest.CaptureFixture[str]) -> None:
    samples, path, rows = recording(6000), tmp_path / 'recording.csv', 700
    write_table(path, samples)
    whole = read_recording(applied(path, stored, tmp_path / 'whole.csv'))
    printed = capsys.readouterr().out.replace('whole.csv', '')
    monkeypatch.setattr(*ROWS_OF_A_TEXT, rows)
    blocks = read_recording(applied(path, stored, tmp_path / 'blocks.csv'))
    assert capsys.readouterr().out.replace('blocks.csv', '') == printed
    expected = calibration.correct(samples.reading, of_samples(
        samples.columns, len(samples), calibration.model))
    for found in (whole, blocks):
        np.testing.assert_allclose(found.reading, expected, rtol=0.0, atol=1e-9)
        for key in ('time', 'temperature', 'rate'):
            np.testing.assert_allclose(found[key], samples[key], rtol=1e-10)
    parts = [samples.take(slice(k, k + rows)) for k in range(0, len(samples), rows)]
    alone = np.concatenate([calibration.correct(part.reading, of_samples(
        part.columns, len(part), calibration.model)) for part in parts])
    assert np.max(np.abs(alone - expected)) > 1e-3  # the state at the start of a block matters


def test_the_memory_does_not_grow_with_the_length(stored: Path, tmp_path: Path,
                                                  monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*ROWS_OF_A_TEXT, 2000)
    path, peaks = tmp_path / 'recording.csv', []
    for count in (8000, 24_000):
        write_table(path, recording(count))
        tracemalloc.start()
        applied(path, stored, tmp_path / 'out.csv')
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]
    assert len(read_recording(tmp_path / 'out.csv')) == 24_000


def test_an_error_in_a_late_block_leaves_the_earlier_file(
        stored: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(*ROWS_OF_A_TEXT, 1000)
    path, out = tmp_path / 'recording.csv', tmp_path / 'out.csv'
    write_table(path, recording(5000))
    lines = path.read_text().splitlines(keepends=True)
    lines[4500] = 'a' + lines[4500]
    path.write_text(''.join(lines))
    write_table(out, recording(10))
    before = out.read_bytes()
    assert main(['apply', str(path), '-c', str(stored), '-o', str(out)]) == 2
    assert 'line 4501' in ' '.join(capsys.readouterr().err.split())
    assert out.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ['out.csv', 'recording.csv']


def test_blocks_are_written_as_one_table(tmp_path: Path) -> None:
    samples = replace(recording(100), sensor='imu "1"')
    write_table(tmp_path / 'whole.csv', samples)
    parts = (samples.take(slice(k, k + 30)) for k in range(0, 100, 30))
    assert write_blocks(tmp_path / 'blocks.csv', parts) == 100
    assert (tmp_path / 'blocks.csv').read_bytes() == (tmp_path / 'whole.csv').read_bytes()
