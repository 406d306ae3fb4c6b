# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Large and hostile logs, and a small log in each format, which is read as the same table.

Samples of the makers' layouts are read, captured and fitted, and the truth is found.

The golden cases `logs_…` read small ones of all dialects, what is refused, and what is special.

"""

from pathlib import Path
import tracemalloc
import zipfile

from accel_calib.calibration import fit_poses
from accel_calib.errors import InputError
from accel_calib.fleet import recordings
from accel_calib.logs import FORMATS, LogOptions, open_log, Piped, SUFFIXES
from accel_calib.stillness import capture
from accel_calib.table import Recording
from data.logs import make
from inside import model_with, read_log, simulate_recording, spread_directions
import numpy as np
import pytest
from shared import data, GRAVITY as G, little_memory, LOG_CORPUS, LOGS, options_of, run_json


def samples(poses: int) -> Recording:
    """Return a recording of some poses [m/s²]."""
    found = simulate_recording(model_with({'offset': [0.03, -0.02, 0.05]}),
                               spread_directions(poses), np.random.default_rng(1), noise_g=0.002)
    return found.with_columns(reading=G * found.reading)


def rows_of(*columns: np.ndarray, digits: str = '.9g') -> list[list[str]]:
    """Return the cells of rows, from columns of numbers."""
    parts = [[[format(value, digits) for value in row]
              for row in np.reshape(column, (len(column), -1)).tolist()] for column in columns]
    return [[cell for part in row for cell in part] for row in zip(*parts, strict=True)]


def text_of(rows: list[list[str]], header: str) -> str:
    return '\n'.join([header, *map(','.join, rows)]) + '\n'


WITHIN_SD = 5.0


def write(folder: Path, text: str, name: str = 'log.csv') -> Path:
    (folder / name).write_text(text, encoding='utf-8')
    return folder / name


def test_a_cut_last_line_is_left_out_and_noted_also_alone_in_its_block(tmp_path: Path) -> None:
    block = ''.join(f'{k / 100},0,0,9.8\n' for k in range(65536))
    for cut, count in (('655.36,0', 65536), ('655.36,0,0,9.8\n655.37,0,', 65537)):
        log = read_log(write(tmp_path, f'time,ax,ay,az\n{block}{cut}'))
        assert (len(log.table), len(log.notes)) == (count, 1)
        assert 'cut' in log.notes[0]


@pytest.mark.parametrize('text', [
    'ax,ay,az\n' + '"' * 200_000, 'ax,ay,az\n1,2,"' + '3' * 200_000 + '\n',
    'ax,ay,az\n1,2,3\n' + '"\n' * 3000])
def test_a_quote_that_does_not_end_is_refused_in_a_short_line(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refusal:
        read_log(write(tmp_path, text))
    assert '\n' not in str(refusal.value)
    assert len(str(refusal.value)) < 800


def test_a_table_of_100000_columns_is_read(tmp_path: Path) -> None:
    count = 100_000  # an effort that grows with the square of the number would take hours
    header = ','.join(['Time', 'AccX', 'AccY', 'AccZ', *(f'c{k}' for k in range(count))])
    rows = ''.join(','.join([f'{0.01 * k}', '0.1', '0.2', f'{9.8 + 0.01 * k}', *(['1'] * count)])
                   + '\n' for k in range(3))
    log = read_log(write(tmp_path, f'{header}\n{rows}'))
    np.testing.assert_allclose(log.table.reading[:, 2], [9.8, 9.81, 9.82])


def test_more_rows_than_a_person_poses_are_samples(tmp_path: Path) -> None:
    path, poses = tmp_path / 'log.csv', 9.80665 * spread_directions(1500)
    np.savetxt(path, poses, delimiter=',', header='ax,ay,az', comments='')
    with pytest.raises(InputError, match='look like samples'):
        read_log(path)
    np.savetxt(path, np.column_stack([np.arange(1500) * 5.0, poses]), delimiter=',',
               header='time,ax,ay,az', comments='')
    assert isinstance(read_log(path).table, Recording)


def test_a_long_log_is_read_in_blocks_of_flat_memory_as_at_once(tmp_path: Path) -> None:
    block = np.round(1000.0 * make.recording(1, rate_hz=100.0).reading, 3).tolist()
    peaks = []
    for times in (40, 80):
        lines = [f'{10 * k},{x},{y},{z}\n' for k, (x, y, z) in enumerate(block * times)]
        path = write(tmp_path, ''.join(['millis,accX,accY,accZ\n', *lines]))
        tracemalloc.start()
        with open_log(path) as log:
            rows = [len(each) for each in log.watched(lambda done, count: None)]
            assert log.samples == pytest.approx(sum(rows), rel=0.05)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert sum(rows) == len(lines)
        assert max(rows) <= 65536
    assert peaks[1] < 1.3 * peaks[0]
    whole = read_log(path).table
    with open_log(path) as log:
        parts = list(log.blocks)
    assert len(parts) > 1
    np.testing.assert_array_equal(np.concatenate([part.reading for part in parts]), whole.reading)
    assert whole['time'][-1] == pytest.approx((len(lines) - 1) * 0.01)
    assert whole.row[-1] == len(lines)


# A small log in each format


SAME = sorted(path for folder in ('formats', 'containers')
              for path in (LOG_CORPUS / folder).iterdir())
"""Logs of one table: the times and readings of `TABLE`; in native units, 8192 counts per g."""

NOT_READ = sorted((LOG_CORPUS / 'refused').iterdir())
TABLE = np.loadtxt(LOG_CORPUS / 'formats' / 'table.csv', delimiter=',', skiprows=1)
LIBRARIES = {'.parquet': 'pyarrow', '.feather': 'pyarrow', '.h5': 'h5py'}


@pytest.mark.parametrize('path', SAME, ids=lambda path: path.name)
def test_a_log_in_any_format_is_read_as_the_same_table(path: Path) -> None:
    pytest.importorskip(LIBRARIES.get(path.suffix, 'numpy'))
    options = LogOptions(**options_of(path)[0])
    expected = TABLE[:, 1:]
    if options.units == 'native':
        expected = np.round(expected / 9.80665 * 8192.0)
    for source in [path, Piped(path.read_bytes())][:1 + (path.suffix in ('.gz', '.bz2', '.xz'))]:
        table = read_log(source, options).table
        np.testing.assert_allclose(table.reading, expected, rtol=1e-6)
        np.testing.assert_allclose(np.diff(table['time']), np.diff(TABLE[:, 0]), atol=1e-6)


# Formats that other tests write: bags, flight logs, old Excel.
ELSEWHERE = {'.mcap', '.ulg', '.bin', '.log', '.xls', '.json'}


def test_every_format_is_tested_and_fleet_finds_what_is_read(tmp_path: Path) -> None:
    tested = {path.suffix.lower() for path in (*SAME, *NOT_READ)}
    assert not [each.name for each in FORMATS
                if each.suffixes and not {*each.suffixes} & (tested | ELSEWHERE)]
    names = [f'log{suffix}' for suffix in SUFFIXES]
    for name in (*names, 'notes.md', 'log.tlog'):
        (tmp_path / name).touch()
    assert sorted(each.inside for each in recordings([str(tmp_path)])) == sorted(names)


@pytest.mark.parametrize('path', [*NOT_READ, *sorted((LOG_CORPUS / 'damaged').iterdir())],
                         ids=lambda path: path.name)
def test_what_is_not_read_is_refused_in_one_line_with_little_memory(path: Path) -> None:
    with little_memory(), pytest.raises(InputError) as found:
        read_log(path)
    assert str(path) in found.value.message
    assert '\n' not in str(found.value)
    assert ('is damaged' in found.value.message) is (path.parent.name == 'damaged')


def test_a_long_name_in_a_damaged_archive_is_not_shown_whole(tmp_path: Path) -> None:
    path = tmp_path / 'log.zip'
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f'{60_000 * "a"}.csv', '1,2,3\n')
    path.write_bytes(path.read_bytes().replace(b'aaa', b'bbb', 1))
    with pytest.raises(InputError, match='is damaged') as caught:
        read_log(path)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(('name', 'poses'), [('arrays.npz', 14), ('gcdc_x16.csv', 14)])
def test_logs_of_others_become_poses(name: str, poses: int, tmp_path: Path,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    _, made = run_json(capsys, 'capture', data(f'logs/{name}'), '-o', tmp_path / 'poses.csv')
    assert made['poses'] == poses


@pytest.mark.parametrize(('column', 'hole'), [
    ('temperature', ''), ('supply_voltage', ''), ('humidity', ''), ('temperature', 'nan'),
    ('humidity', 'NaN')])
def test_a_column_with_holes_is_the_next_step_where_no_effect_explains(
        column, hole, tmp_path, capsys):
    rng = np.random.default_rng(6)
    other, mean = rng.uniform(-1.0, 1.0, 24), G * spread_directions(24)[rng.permutation(24)]
    mean = mean + 0.2 * np.outer(other, [1.0, -1.0, 0.5]) + 0.003 * rng.normal(size=(24, 3))
    rows = rows_of(mean, 20.0 + other, np.full((24, 3), 0.03), np.full(24, 100))
    rows[7][3] = hole
    path = write(tmp_path, text_of(rows, f'ax,ay,az,{column},std_x,std_y,std_z,count'))
    _, made = run_json(capsys, 'refine', path)
    cause = made['next']['text']
    assert cause.startswith(f'fill in the cells of {column}')
    about_the_gap = [line for line in made['advice'] if 'gap' in line or 'repeat' in line]
    assert [cause in line for line in about_the_gap] == [True]


@pytest.mark.parametrize(('header', 'rate_hz', 'parts'), [
    ('secs,nsecs', 100.0, 10 ** 9), ('Time,ms', 90.0, 1000), ('sec,usec', 1000.0, 10 ** 6),
    ('Uhrzeit', 25.0, 1)])
def test_whole_seconds_and_their_parts_are_one_clock(tmp_path, header, rate_hz, parts):
    made = samples(8)
    ticks = np.round(parts * (1769000000.0 + np.arange(len(made)) / rate_hz)).astype(np.int64)
    whole = [*map(str, ticks // parts)]
    if header[0] in 'TU':
        whole = np.datetime_as_string((ticks // parts).astype('M8[s]'), timezone='UTC')
        whole = [each[11:19] for each in whole]
    rows = [[one, *([str(part)] if parts > 1 else []), *row] for one, part, row in zip(
        whole, (ticks % parts).tolist(), rows_of(made.reading), strict=True)]
    log = read_log(write(tmp_path, text_of(rows, f'{header},accX,accY,accZ')))
    assert np.mean(np.diff(log.table['time'])) == pytest.approx(1.0 / rate_hz, rel=1e-3)
    assert f'{header.replace(",", " + ")}' in log.read_as
    assert f'({rate_hz:.3g} Hz)' in log.read_as


def test_a_wrong_number_is_named_by_its_row_and_no_temperature_is_beyond_a_sensor(tmp_path):
    block = ''.join(f'{k / 100},0,0,9.8,20\n' for k in range(65540))
    for row, fault, what in ((65540, '1e30,0,9.8,20', 'ax, ay, az holds the number 1e'),
                             (3, '0,0,9.8,-127', 'temperature holds the number -127, expected')):
        lines = block.splitlines(keepends=True)
        lines[row - 1] = f'{row / 100 - 0.01},{fault}\n'
        with pytest.raises(InputError, match=f'row {row} of {what}'):
            read_log(write(tmp_path, ''.join(['time,ax,ay,az,temperature\n', *lines])))


# Samples of the makers' layouts


@pytest.mark.parametrize('name', make.TRUTHS)
def test_the_truth_of_a_sample_is_found_without_options_and_with_its_format(name: str) -> None:
    for end, library in (('.ulg', 'pyulog'), ('.bin', 'pymavlink'), ('.xls', 'xlrd')):
        if name.endswith(end):
            pytest.importorskip(library)
    log, truth = read_log(LOGS / name), make.TRUTHS[name]
    assert isinstance(log.table, Recording)
    poses = capture(log.table, log.units).poses
    assert (log.units.name, len(poses)) == (truth.units, make.POSES)
    fitted = fit_poses(poses, log.units, model='10')
    assert np.all(np.abs(fitted.offset - truth.offset) < WITHIN_SD * fitted.offset_sd)
    assert np.all(np.abs(fitted.gain - truth.gain) < WITHIN_SD * fitted.gain_sd)
    assert ('temperature' in log.table) == truth.temperature
    if truth.rate:
        assert np.ptp(log.table['rate'], axis=0).max() > 1.0  # rad/s, in the turns
        assert np.abs(np.median(log.table['rate'], axis=0)).max() < 0.01
    if truth.temperature:
        assert np.ptp(log.table['temperature']) == pytest.approx(np.ptp(make.WARM), rel=0.05)
    assert log.table['time'][-1] - log.table['time'][0] == pytest.approx(44.75, abs=0.01)
    named = read_log(LOGS / name, LogOptions(format=name.split('/')[0]))
    assert named.units == log.units
    np.testing.assert_allclose(named.table.reading, log.table.reading, rtol=1e-12)
    np.testing.assert_allclose(named.table['time'], log.table['time'], rtol=1e-12)
