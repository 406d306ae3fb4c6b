# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""`apply`, block by block, and samples outside of the range of a calibration."""

from dataclasses import replace
import re
import tracemalloc

from accel_calib.calibration import outside
from accel_calib.effects import context_of_samples
from accel_calib.findings import outside_words
from accel_calib.logs import read_recording, write_blocks, write_table
from accel_calib.stored import write_calibration
from bag_files import write_bag
from driven import Driver
from inside import (
    Correction, model_with, Poses, ROWS_OF_A_TEXT, simulate_recording, spread_directions)
import numpy as np
import pytest
from shared import known, MPS2, refused, run, samples_of, with_effects

LOW, HIGH = 20.0, 30.0


def calibrated(values):
    """Return a calibration of poses at 20 to 30 °C, with these further effects."""
    return with_effects(known(), values, temperature=np.linspace(LOW, HIGH, 20),
                        time=100.0 + 30.0 * np.arange(20))


TCO = {'offset_temperature': np.array([1e-3, 0.0, 0.0])}


@pytest.fixture
def recording():
    """Return samples in g whose temperature rises from 25 to 41 °C."""
    return simulate_recording(
        model_with({'offset': np.array([0.03, -0.02, 0.04])}), spread_directions(8),
        np.random.default_rng(7), rate_hz=50.0, dwell=2.0, temperatures=(25.0, 41.0))


def write_si(path, recording):
    """Write samples in g as a table in m/s²."""
    columns = {key: MPS2.from_g(recording[key]) for key in ('reading', 'reference')}
    write_table(path, replace(recording.with_columns(**columns), units='m/s2'))


def test_quantities_outside_are_counted_over_blocks_and_those_inside_are_not():
    calibration = calibrated(TCO)
    warm = np.array([25.0, 29.0, 35.0, np.nan, 41.0])
    whole = outside(calibration, {'temperature': warm})
    correction = Correction(calibration, calibration.units, '')
    for part in (warm[:0], warm[:2], warm[2:]):
        correction.context(Poses({'reading': np.zeros((len(part), 3)), 'temperature': part},
                                 np.arange(len(part))))
    found = whole['temperature']
    assert (found.count, found.samples) == (2, 4)
    noted, = correction.notes
    assert noted.startswith('2 of 4 samples ')
    assert outside_words(found) in noted
    assert (found.least, found.most) == (25.0, 41.0)
    assert outside(calibration, {'temperature': np.array([LOW, HIGH])})['temperature'].count == 0
    assert not outside(calibration, {'temperature': np.array([np.nan])})
    assert not outside(calibrated({}), {'temperature': np.array([80.0])})


@pytest.mark.parametrize(('name', 'values', 'known', 'stated'), [
    ('temperature_rate', [0.02, 0.0, 0.0], {'temperature_rate': np.array([0.5])}, '30 °C/min'),
    ('offset_drift', [1e-3, 0.0, 0.0, 100.0], {'time': np.array([7300.0])}, '2 h 0.1583 h'),
    ('empirical-offset.x-std-1', [1e-3, 0.001, 0.02], {'std': np.zeros((1, 3))}, '0 mg 20 mg')])
def test_each_quantity_is_described_in_its_unit(name, values, known, stated):
    calibration = calibrated({name: np.array(values)})
    words, = (outside_words(each) for each in outside(calibration, known).values() if each.count)
    assert ' '.join(re.findall(r'[\d.]+ (?:°C/min|h|mg)', words)).startswith(stated)


@pytest.mark.parametrize(('kind', 'within'), [('table', 0), ('mcap', 60)])
def test_apply_says_once_how_many_samples_leave_the_range(kind, within, recording, tmp_path,
                                                          capsys):
    calibration, path = tmp_path / 'calibration.yaml', tmp_path / 'recording.csv'
    write_calibration(calibration, calibrated(TCO))
    write_si(path, recording)
    if kind == 'mcap':
        path = write_bag(tmp_path / 'recording', kind, recording)
    applied(path, calibration, tmp_path / f'out{path.suffix}')
    (stated, total), = re.findall(r'note: (\d+) of (\d+)', capsys.readouterr().out)
    assert int(total) == len(recording)
    assert int(stated) == pytest.approx(np.sum(recording['temperature'] > HIGH), abs=within)
    write_si(tmp_path / 'inside.csv', recording.take(recording['temperature'] < HIGH))
    applied(tmp_path / 'inside.csv', calibration, tmp_path / 'o.csv')
    assert 'note:' not in capsys.readouterr().out


def test_session_logs_once_for_each_leaving(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    path = tmp_path / 'calibration.yaml'
    write_calibration(path, calibrated({**TCO, 'temperature_rate': np.array([0.0, 0.02, 0.0])}))
    driver, told = Driver(calibration_file=str(path)), []
    for warm in (25.0, 35.0, 36.0, 37.0, 29.0, 29.0, 36.0):
        driver.feed([[0.0, 0.0, 9.81]], temperature=warm)
        driver.log.clear()
        driver.stamp += 3000.0
        driver.tick(61.0)
        told.append([line.words for line in driver.log
                     if line.words.startswith('temperature is ')])
    assert [len(each) for each in told] == [0, 1, 0, 0, 0, 0, 1]


RATE_HZ = 100.0
EFFECTS = {'offset_temperature': np.array([2e-3, -1e-3, 1e-3, 60.0, 0.0]),
           'gain_temperature': np.array([5e-4, 3e-4, -4e-4, 40.0, 1.0]),
           'temperature_rate': np.array([0.02, -0.03, 0.01])}


def waving(count):
    """Return samples in m/s² whose temperature rises and falls."""
    rng, time = np.random.default_rng(5), 100.0 + np.arange(count) / RATE_HZ
    return samples_of(time, rng.normal([0.2, -0.3, 9.8], 0.01, (count, 3)), 'm/s2',
                      temperature=25.0 + 3.0 * np.sin(time / 20.0),
                      rate=rng.normal(0.0, 0.01, (count, 3)))


@pytest.fixture(scope='module')
def calibration():
    return calibrated(EFFECTS)


@pytest.fixture(scope='module')
def stored(calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp('stored') / 'calibration.yaml'
    write_calibration(path, calibration)
    return path


def applied(path, stored, out):
    """Return the copy that the command writes."""
    assert run('apply', path, '-c', stored, '-o', out) == 0
    return out


def test_blocks_give_the_same_as_the_whole(calibration, stored, tmp_path, monkeypatch, capsys):
    samples, path, rows = waving(6000), tmp_path / 'recording.csv', 700
    write_table(path, samples)
    whole = read_recording(applied(path, stored, tmp_path / 'whole.csv'))
    printed = capsys.readouterr().out.replace('whole.csv', '')
    monkeypatch.setattr(*ROWS_OF_A_TEXT, rows)
    blocks = read_recording(applied(path, stored, tmp_path / 'blocks.csv'))
    assert capsys.readouterr().out.replace('blocks.csv', '') == printed
    expected = calibration.correct(samples.reading, context_of_samples(
        samples.columns, len(samples), calibration.model))
    for found in (whole, blocks):
        np.testing.assert_allclose(found.reading, expected, rtol=0.0, atol=1e-9)
        for key in ('time', 'temperature', 'rate'):
            np.testing.assert_allclose(found[key], samples[key], rtol=1e-10)
    parts = [samples.take(slice(k, k + rows)) for k in range(0, len(samples), rows)]
    alone = np.concatenate([calibration.correct(part.reading, context_of_samples(
        part.columns, len(part), calibration.model)) for part in parts])
    assert np.max(np.abs(alone - expected)) > 1e-3  # the state at the start of a block matters


def test_the_memory_does_not_grow_with_the_length(stored, tmp_path, monkeypatch):
    monkeypatch.setattr(*ROWS_OF_A_TEXT, 1000)
    path, peaks = tmp_path / 'recording.csv', []
    for count in (4000, 12_000):
        write_table(path, waving(count))
        tracemalloc.start()
        applied(path, stored, tmp_path / 'out.csv')
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]
    assert len(read_recording(tmp_path / 'out.csv')) == 12_000


def test_an_error_in_a_late_block_leaves_the_earlier_file(stored, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(*ROWS_OF_A_TEXT, 1000)
    path, out = tmp_path / 'recording.csv', tmp_path / 'out.csv'
    write_table(path, waving(5000))
    lines = path.read_text().splitlines(keepends=True)
    lines[4500] = 'a' + lines[4500]
    path.write_text(''.join(lines))
    write_table(out, waving(10))
    before = out.read_bytes()
    assert 'line 4501' in refused(capsys, 'apply', path, '-c', stored, '-o', out)
    assert out.read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ['out.csv', 'recording.csv']


def test_blocks_are_written_as_one_table(tmp_path):
    samples = replace(waving(100), sensor='imu "1"')
    write_table(tmp_path / 'whole.csv', samples)
    parts = (samples.take(slice(k, k + 30)) for k in range(0, 100, 30))
    assert write_blocks(tmp_path / 'blocks.csv', parts) == 100
    assert (tmp_path / 'blocks.csv').read_bytes() == (tmp_path / 'whole.csv').read_bytes()
