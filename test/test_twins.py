# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A bag and a table of the same samples get the same answers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import accel_calib as ac
from accel_calib.logs import LogOptions, read_log, read_recording, write_table
from accel_calib.stored import write_calibration
from accel_calib.table import Recording
from accel_calib.units import STANDARD_GRAVITY
from bag_files import write_bag
from inside import main, model_with, simulate_recording, spread_directions
import numpy as np
import pytest

COMMANDS = {
    'capture': ['capture', '{log}', '-o', '{out}.csv'],
    'fit': ['fit', '{log}', '-o', '{out}.yaml'],
    'refine': ['refine', '{log}', '-o', '{out}.yaml'],
    'calibrate': ['calibrate', '{log}', '-o', '{out}.yaml'],
    'verify': ['verify', '{log}', '-c', '{calibration}'],
    'noise': ['noise', '{log}'],
    'apply': ['apply', '{log}', '-c', '{calibration}', '-o', '{out}{end}']}
WITH_JSON = [name for name in COMMANDS if name != 'apply']


@pytest.fixture(scope='module')
def twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a recording in g as a bag and as a table, and its calibration for m/s²."""
    folder = tmp_path_factory.mktemp('twins')
    model = model_with({'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.02, 0.005]})
    made = simulate_recording(model, spread_directions(12), np.random.default_rng(5),
                              rate_hz=50.0)
    columns = {key: made[key] for key in ('time', 'reading', 'rate')}
    made = Recording({**columns, 'temperature': np.full(len(made), 25.0)}, made.row)
    # The helper writes the readings times 1 g.
    write_bag(folder / 'log', 'sqlite3', made.with_columns(
        reading=made.reading / STANDARD_GRAVITY))
    made = read_log(folder / 'log', LogOptions(units='g')).table
    rows = np.column_stack([made[key] for key in ('time', 'reading', 'rate', 'temperature')])
    np.savetxt(folder / 'log.csv', rows, '%.17g', ',', comments='',
               header='time,ax,ay,az,gx,gy,gz,temperature')
    known = made.with_columns(reading=made.reading * STANDARD_GRAVITY)
    write_table(folder / 'right.csv', known)
    write_calibration(folder / 'calibration.yaml', ac.fit(folder / 'right.csv'))
    return folder


def run(twins: Path, name: str, log: str, out: Path, *given: str) -> int:
    names = {'log': twins / log, 'out': out, 'calibration': twins / 'calibration.yaml',
             'end': Path(log).suffix}
    return main([*(part.format(**names) for part in COMMANDS[name]), *given])


@pytest.mark.parametrize('name', COMMANDS)
def test_readings_in_another_unit_are_refused_in_the_same_words(
        name: str, twins: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for log, given in (('log', []), ('log.csv', ['--units', 'm/s2'])):
        assert run(twins, name, log, tmp_path / 'out', *given) == 2
        said.append(capsys.readouterr().err.replace(str(twins / log), 'LOG'))
    assert said[0] == said[1]
    assert 'the length of the readings is about 1' in said[0]
    assert 'set the units of the readings to g' in said[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', WITH_JSON)
def test_in_the_unit_that_is_advised_the_results_are_equal(
        name: str, twins: Path, tmp_path: Path) -> None:
    found: list[Any] = []
    for log in ('log', 'log.csv'):
        out = tmp_path / f'{log}.json'
        assert run(twins, name, log, tmp_path / 'out', '--units', 'g', '--json', str(out)) == 0
        found.append(json.loads(out.read_text()))
    alike(*found)


def alike(one: Any, other: Any) -> None:
    """Compare figures; a bag has no columns to be recognised, and its times are of the receipt."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one.keys() - {'read_as', 'read_lines', 'notes', 'source', 'recording'}:
            alike(one[key], other[key])
    elif isinstance(one, float):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-9)
    elif isinstance(one, list):
        assert len(one) == len(other)
        for pair in zip(one, other, strict=True):
            alike(*pair)


def test_a_bag_in_g_is_corrected_like_its_twin_and_gets_the_unit_of_imu_messages(
        twins: Path, tmp_path: Path) -> None:
    for log in ('log', 'log.csv'):
        assert run(twins, 'apply', log, tmp_path / 'out', '--units', 'g') == 0
    bag, table = (read_recording(tmp_path / name) for name in ('out', 'out.csv'))
    np.testing.assert_allclose(bag.reading, table.reading * STANDARD_GRAVITY, atol=1e-6)
