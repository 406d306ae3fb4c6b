# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Calibrations and readings in g and m/s², and a bag and a table of the same samples."""

from dataclasses import replace
import json
from pathlib import Path
import re
from typing import Any

import accel_calib as ac
from accel_calib.errors import InputError
from accel_calib.logs import LogOptions, read_recording, write_table
from accel_calib.stored import write_calibration
from accel_calib.table import Poses, Table
from accel_calib.units import STANDARD_GRAVITY as GRAVITY, Units
from bag_files import write_bag
from golden.record import differences
from inside import in_units_of, model_with, read_log, simulate_recording, spread_directions
import numpy as np
import pytest
from shared import run, SENSOR

METRIC = ('g', 'm/s2')


def other(name: str) -> str:
    return 'm/s2' if name == 'g' else 'g'


def poses(units: str, seed: int = 1, **more: object) -> Poses:
    return ac.simulate(SENSOR, units=units, seed=seed, noise=0.001, **more)


def unstated(table: Table) -> Table:
    return replace(table, units='')


@pytest.mark.parametrize('units', METRIC)
def test_conversion_of_a_calibration_and_its_poses_is_exact_and_goes_back(units: str) -> None:
    calibration = ac.fit(poses(units, reference=True, temperature=(20.0, 30.0)))
    assert calibration.name == '12'
    there = calibration.in_units(other(units))
    factor = there.units.per_g / calibration.units.per_g
    reading = np.random.default_rng(2).normal(size=(20, 3)) * calibration.units.per_g
    np.testing.assert_allclose(there.correct(reading * factor),
                               calibration.correct(reading) * factor, rtol=1e-13)
    assert there.poses.units == other(units)
    for key, times in (('reading', factor), ('std', factor), ('reference', factor),
                       ('count', 1.0), ('temperature', 1.0)):
        np.testing.assert_allclose(there.poses[key], calibration.poses[key] * times, rtol=1e-13)
    assert ac.verify(there.poses, calibration).rms_after_mg == pytest.approx(
        ac.verify(calibration.poses, calibration).rms_after_mg, rel=1e-9)
    back = there.in_units(units)
    assert back.units == calibration.units
    np.testing.assert_allclose(back.poses.reading, calibration.poses.reading, rtol=1e-15)
    assert calibration.in_units(units) is calibration
    assert calibration.in_units(Units(other(units), 9.7)).units == there.units


def test_the_local_gravity_of_a_calibration_is_kept() -> None:
    calibration = ac.fit(poses('m/s2', gravity=9.78), gravity=9.78)
    found = calibration.in_units('g')
    assert found.units.per_g == pytest.approx(9.78 / GRAVITY, rel=1e-15)
    reading = calibration.poses.reading[:1]
    np.testing.assert_allclose(found.correct(reading / GRAVITY) * GRAVITY,
                               calibration.correct(reading), rtol=1e-13)
    assert found.in_units('m/s2').units.per_g == pytest.approx(9.78, rel=1e-15)


@pytest.mark.parametrize(('before', 'after'), [
    ('native', 'g'), ('native', 'm/s2'), ('g', 'native'), ('m/s2', 'native')])
def test_native_units_stay_native(before: str, after: str) -> None:
    calibration = ac.fit(poses(before))
    with pytest.raises(InputError, match='scale of native units is not known'):
        calibration.in_units(after)
    assert calibration.in_units(before) is calibration
    assert in_units_of(calibration, unstated(poses(before))) is calibration
    with pytest.raises(InputError, match='scale of native units is not known'):
        ac.verify(poses(after), calibration)


@pytest.mark.parametrize('units', METRIC)
def test_an_unstated_unit_is_that_of_the_length_of_the_readings(units: str) -> None:
    calibration = ac.fit(poses(units))
    assert in_units_of(calibration, unstated(poses(units))) is calibration
    found = in_units_of(calibration, unstated(poses(other(units))))
    assert found.units.name == other(units)
    # A stated unit wins over the length.
    lying = replace(poses(other(units)), units=units)
    assert in_units_of(calibration, lying) is calibration


def test_verify_takes_the_unit_that_the_caller_states() -> None:
    calibration, table = ac.fit(poses('g')), unstated(poses('m/s2', seed=2))
    assert ac.verify(table, calibration, units='m/s2').rms_after_mg < 1.0
    with pytest.raises(InputError, match='set the units of the readings to m/s2'):
        ac.verify(table, calibration, units='g')
    with pytest.raises(InputError, match="is in m/s2, expected g; set units='m/s2'"):
        ac.verify(poses('m/s2'), calibration, units='g')


def test_refine_starts_from_a_calibration_in_the_other_unit() -> None:
    rng = np.random.default_rng(5)
    hidden = {**SENSOR, 'offset_temperature': (0.002, -0.001, 0.0015)}
    base = ac.fit(poses('g'))
    warm = rng.uniform(10.0, 50.0, 40)
    found = [ac.refine(ac.simulate(hidden, poses=40, units=each, seed=6, noise=0.001,
                                   temperature=warm), base=base) for each in METRIC]
    assert [each.calibration.units.name for each in found] == list(METRIC)
    assert [[step.effect for step in each.steps] for each in found] == [['offset_temperature']] * 2
    np.testing.assert_allclose(found[0].gap_mg, found[1].gap_mg, rtol=1e-6)
    np.testing.assert_allclose(found[0].calibration.model.vector,
                               found[1].calibration.model.vector, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize('stated', [True, False])
@pytest.mark.parametrize('units', METRIC)
def test_apply_corrects_a_table_in_the_other_unit(units: str, stated: bool, tmp_path: Path
                                                  ) -> None:
    recording = ac.simulate(SENSOR, recording=True, poses=6, units=other(units), seed=3)
    write_table(tmp_path / 'r.csv', recording if stated else replace(recording, units=''))
    calibration = ac.fit(poses(units))
    calibration.save(tmp_path / 'c.yaml')
    assert run('apply', tmp_path / 'r.csv', '-c', tmp_path / 'c.yaml', '-o',
               tmp_path / 'out.csv') == 0
    found = read_recording(tmp_path / 'out.csv')
    assert found.units == other(units)
    factor = GRAVITY if units == 'm/s2' else 1.0 / GRAVITY
    np.testing.assert_allclose(found.reading, calibration.correct(recording.reading * factor)
                               / factor, rtol=1e-9, atol=1e-9)


WITH_JSON = ('capture', 'fit', 'refine', 'calibrate', 'verify', 'noise')


@pytest.fixture(scope='module')
def twins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a recording in g as a bag and as a table, and its calibration for m/s²."""
    folder = tmp_path_factory.mktemp('twins')
    model = model_with({'offset': [0.03, -0.02, 0.04], 'axis_gain': [0.01, -0.02, 0.005]})
    made = simulate_recording(model, spread_directions(12), np.random.default_rng(5), rate_hz=50.0)
    # The helper writes the readings times 1 g.
    write_bag(folder / 'log', 'sqlite3', made.with_columns(
        reading=made.reading / GRAVITY, temperature=np.full(len(made), 25.0)))
    made = read_log(folder / 'log', LogOptions(units='g')).table
    rows = np.column_stack([made[key] for key in ('time', 'reading', 'rate', 'temperature')])
    np.savetxt(folder / 'log.csv', rows, '%.17g', ',', comments='',
               header='time,ax,ay,az,gx,gy,gz,temperature')
    write_table(folder / 'right.csv', made.with_columns(reading=made.reading * GRAVITY))
    write_calibration(folder / 'calibration.yaml', ac.fit(folder / 'right.csv'))
    return folder


def run_on(twins: Path, name: str, log: str, out: Path, *given: object) -> int:
    """Run a command on one of the twins, and return the exit status."""
    stored = ('-c', twins / 'calibration.yaml')
    more = {'capture': ('-o', f'{out}.csv'), 'verify': stored, 'noise': (),
            'apply': (*stored, '-o', f'{out}{Path(log).suffix}')}
    return run(name, twins / log, *more.get(name, ('-o', f'{out}.yaml')), *given)


@pytest.mark.parametrize('name', [*WITH_JSON, 'apply'])
def test_readings_in_another_unit_are_refused_in_the_same_words(
        name: str, twins: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = []
    for log, given in (('log', []), ('log.csv', ['--units', 'm/s2'])):
        assert run_on(twins, name, log, tmp_path / 'out', *given) == 2
        said.append(capsys.readouterr().err.replace(str(twins / log), 'LOG'))
    assert said[0] == said[1]
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize('name', WITH_JSON)
def test_in_the_unit_that_is_advised_the_results_are_equal(
        name: str, twins: Path, tmp_path: Path) -> None:
    found: list[Any] = []
    for log in ('log', 'log.csv'):
        out = tmp_path / f'{log}.json'
        assert run_on(twins, name, log, tmp_path / 'out', '--units', 'g', '--json', out) == 0
        found.append(json.loads(out.read_text().replace('log.csv', 'log')))
    # A bag names its sensor, has no columns to be recognised, and times of the receipt.
    assert not [each for each in differences(*found)
                if not re.match(r'/(read_as|read_lines|notes|sensor|source|recording)\b', each)]


def test_a_bag_in_g_is_corrected_like_its_twin_and_gets_the_unit_of_imu_messages(
        twins: Path, tmp_path: Path) -> None:
    for log in ('log', 'log.csv'):
        assert run_on(twins, 'apply', log, tmp_path / 'out', '--units', 'g') == 0
    bag, table = (read_recording(tmp_path / name) for name in ('out', 'out.csv'))
    np.testing.assert_allclose(bag.reading, table.reading * GRAVITY, atol=1e-6)
