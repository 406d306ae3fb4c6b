# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Text logs of any dialect: the same numbers are read, and what is assumed is said."""

from __future__ import annotations

import csv
from datetime import datetime, timezone
import io
from pathlib import Path
import tracemalloc
from typing import Any

import accel_calib as ac
from accel_calib.calibrate import fit_poses
from accel_calib.capture import capture
from accel_calib.errors import InputError
from accel_calib.logs import LogOptions, open_log, read_log
from accel_calib.table import Poses, Recording
from inside import meaning, spread_directions, unit_of
import numpy as np
import pytest

G = 9.80665
RATE_HZ = 100.0
OFFSET = np.array([0.03, -0.02, 0.05])
GAIN = np.array([1.01, 0.98, 1.02])
NOISE = 0.002


def motion(rng: np.random.Generator, poses: int = 12, rest: int = 200, turn: int = 80
           ) -> tuple[np.ndarray, np.ndarray]:
    """Return forces [g] and rates [rad/s] of a sensor that is turned through poses by hand."""
    ups = spread_directions(poses)[rng.permutation(poses)]
    parts, rates = [], []
    for one, two in zip(ups, np.roll(ups, -1, axis=0)):
        share = np.linspace(0.0, 1.0, turn)[:, np.newaxis]
        path = (1.0 - share) * one + share * two + 1e-6
        parts += [np.tile(one, (rest, 1)), path / np.linalg.norm(path, axis=1)[:, np.newaxis]]
        rates += [np.zeros((rest, 3)), np.full((turn, 3), 2.0) * np.sin(np.pi * share)]
    forces = np.concatenate(parts)
    return forces, np.concatenate(rates) + 0.001 * rng.normal(size=forces.shape)


def samples(seed: int = 1, per_g: float = 1.0, **settings: int) -> dict[str, np.ndarray]:
    """Return time [s], readings with `per_g` to the g, and rates [rad/s] of a recording."""
    rng = np.random.default_rng(seed)
    forces, rates = motion(rng, **settings)
    reading = per_g * (forces * GAIN + OFFSET + NOISE * rng.normal(size=forces.shape))
    return {'time': np.arange(len(forces)) / RATE_HZ, 'reading': reading, 'rate': rates}


def rows_of(*columns: np.ndarray, digits: str = '.9g') -> list[list[str]]:
    table = np.column_stack(columns)
    return [[format(value, digits) for value in row] for row in table.tolist()]


def text_of(rows: list[list[str]], header: str = '', delimiter: str = ',') -> str:
    lines = [delimiter.join(row) for row in rows]
    return '\n'.join([header, *lines] if header else lines) + '\n'


def write(folder: Path, text: str | bytes, name: str = 'log.csv') -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def log_text(header: str = 'time,ax,ay,az', per_g: float = G, **settings: int) -> str:
    made = samples(per_g=per_g, **settings)
    return text_of(rows_of(made['time'], made['reading']), header)


# --------------------------------------------------------------------------------- dialects

DELIMITERS = (',', ';', '\t', '|', ' ', '  ')
ENCODINGS = ('utf-8', 'utf-8-sig', 'utf-16', 'utf-16-le', 'utf-16-be')
NAMES = ('time,ax,ay,az', 'timestamp,accX,accY,accZ', 'Time (s),Acceleration x (m/s^2),'
         'Acceleration y (m/s^2),Acceleration z (m/s^2)', 't_s,a_x,a_y,a_z',
         '', 't [s],linear_acceleration.x,linear_acceleration.y,linear_acceleration.z')


@pytest.mark.parametrize('seed', range(20))
def test_a_table_is_read_the_same_in_any_dialect(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    made = samples(seed, G, poses=8, rest=20, turn=5)
    delimiter, encoding = rng.choice(DELIMITERS), rng.choice(ENCODINGS)
    header = str(rng.choice(NAMES))
    comma = bool(rng.integers(2))
    quoted = bool(rng.integers(2)) or (comma and delimiter == ',')
    if delimiter.isspace() and delimiter != '\t' and ' ' in header:
        header = NAMES[1]
    rows = rows_of(made['time'], made['reading'])
    if comma:
        rows = [[cell.replace('.', ',') for cell in row] for row in rows]
    names = [header.split(',')] if header else []
    file = io.StringIO()
    quoting = csv.QUOTE_ALL if quoted else csv.QUOTE_MINIMAL
    writer = csv.writer(file, delimiter=delimiter[0], quoting=quoting,
                        lineterminator=str(rng.choice(['\n', '\r\n', '\r'])))
    comments = ['# recorded on Monday; x, y, z', ''] if rng.integers(2) else []
    if delimiter == '  ':
        quote = '"' if quoted else ''
        file.write(''.join(delimiter.join(f'{quote}{cell}{quote}' for cell in row) + '\n'
                           for row in [*names, *rows]))
    else:
        writer.writerows([*names, *rows])
    text = '\n'.join([*comments, file.getvalue()])
    log = read_log(write(tmp_path, text.encode(encoding)))
    assert isinstance(log.table, Recording)
    assert log.units.name == 'm/s2'
    np.testing.assert_allclose(log.table['time'], made['time'], rtol=1e-8)
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    assert list(log.table.row) == list(range(1, len(rows) + 1))


def test_one_line_says_how_the_log_of_a_microcontroller_is_read(tmp_path: Path) -> None:
    made = samples(per_g=16512.0)
    rows = rows_of(made['time'] * 1e3, made['reading'].round(), digits='.0f')
    log = read_log(write(tmp_path, text_of(rows, 'timestamp_ms;accX;accY;accZ', ';')))
    assert log.read_as.startswith("';', timestamp_ms -> s, accX/Y/Z, 16 ")
    assert log.read_as.endswith(' counts = 1 g (native)')
    assert float(log.read_as[-26:-22].replace(' ', '')) > 0
    assert log.units.name == 'native'
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)
    poses = capture(log.table, log.units).poses  # type: ignore[arg-type]
    calibration = fit_poses(poses, log.units, model='7')
    np.testing.assert_allclose(np.diag(calibration.gain) / 16512.0, GAIN, rtol=1e-3)


def test_boot_messages_are_passed_over_and_noted(tmp_path: Path) -> None:
    boot = (b'ets Jul 29 2019 12:21:46\r\n\r\nrst:0x1 (POWERON_RESET),boot:0x13\n'
            b'\x00\xff\xf0\x9d\n'
            b'I (312) cpu_start: Pro cpu up.\nconfigsip: 0, SPIWP:0xee\n'
            b'clk_drv:0x00,q_drv:0x00,d_drv:0x00,cs0_drv:0x00,hd_drv:0x00,wp_drv:0x00\n')
    for header in ('millis,accX,accY,accZ', ''):
        text = log_text(header)
        if header:
            made = samples(per_g=G)
            text = text_of(rows_of(made['time'] * 1e3, made['reading']), header)
        log = read_log(write(tmp_path, boot + text.encode()))
        np.testing.assert_allclose(log.table['time'], samples()['time'], atol=1e-9)
        assert len(log.notes) == 1
        assert 'skipped 6 lines before the table' in log.notes[0]
        assert 'ets Jul 29 2019' in log.notes[0]


def test_a_cut_last_line_is_left_out_and_noted(tmp_path: Path) -> None:
    text = log_text('time;accX;accY;accZ'.replace(';', ','))
    whole = read_log(write(tmp_path, text))
    assert not whole.notes
    for cut in (12, 20, 30):
        log = read_log(write(tmp_path, text[:-cut]))
        assert len(log.table) == len(whole.table) - 1
        assert [note for note in log.notes if 'cut' in note]
        np.testing.assert_array_equal(log.table.reading, whole.table.reading[:-1])


@pytest.mark.parametrize('bad', [
    '1,2,3', '1,2,3,4,5', '1,2,three,4', '1,,3,4', 'nan,1,2,3', 'I (99) wifi: lost', '1,2"3,4',
    '1,2,inf,4', '1,2,0x10,4', '1,2,1_0,4', '1,2,١,4', '1,"2,3', '1,2\x00,3,4'])
def test_a_bad_line_is_an_error_with_its_number_or_is_skipped(bad: str, tmp_path: Path) -> None:
    lines = log_text().splitlines(keepends=True)
    path = write(tmp_path, ''.join(['# a comment\n', *lines[:1500], f'{bad}\n', *lines[1500:]]))
    with pytest.raises(InputError, match='line 1502: row 1500') as refusal:
        read_log(path)
    assert '\n' not in str(refusal.value)
    assert '--skip-bad' in refusal.value.advice
    log = read_log(path, LogOptions(skip_bad=True))
    assert len(log.table) == len(lines) - 1
    assert 'skipped 1 bad line: line 1502: row 1500' in log.notes[0]
    assert 1500 not in log.table.row
    assert log.table.row[-1] == len(lines)


@pytest.mark.parametrize('text', [
    '', '\n\n', '# nothing\n', 'hello\n', 'hello world\nthis is no table\n', '"', '"\n"\n',
    ',,,\n',
    'time,ax,ay,az\n', 'time,ax,ay,az\n"', '\x00' * 100, 'ax,ay,az\n\x00,1,2\n', 'a\n1\n2\n',
    'ax,ay,az\n' + '"' * 200_000, 'ax,ay,az\n1,2,"' + '3' * 200_000 + '\n', '1,2\n3,4\n',
    'ax,ay,az\n1,2,3\n' + '"\n' * 3000, '{"a": [1, 2, 3]}\n', '<html><body>1,2,3</body></html>',
    ';;;\n;;;\n', 'ax,ay,az\n1e999,1,1\n', '1,2,3,4,5,6\n' * 9])
def test_what_is_no_table_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
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


@pytest.mark.parametrize('line', ['12:00:{:06.3f} -> {}', 'plot'])
def test_the_serial_monitor_and_plotter_of_arduino_are_read(line: str, tmp_path: Path) -> None:
    made = samples(per_g=G, poses=8, rest=30, turn=8)
    made['time'] = made['time'] % 59.0
    rows = rows_of(made['reading'])
    if line == 'plot':
        text = ''.join(f'ax:{x}\tay:{y}\taz:{z}\n' for x, y, z in rows)
    else:
        text = ''.join(line.format(when, ','.join(row)) + '\n'
                       for when, row in zip(made['time'], rows))
    rate = 100.0 if line == 'plot' else None
    log = read_log(write(tmp_path, text), LogOptions(rate=rate))
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    if line != 'plot':
        np.testing.assert_allclose(np.diff(log.table['time']), np.diff(made['time']), atol=1e-6)


# ------------------------------------------------------------------------------------ names

@pytest.mark.parametrize(('x', 'unit'), [
    ('accX', ''), ('acc_x', ''), ('accelX', ''), ('a_x', ''), ('Acceleration x (m/s^2)', 'm/s2'),
    ('linear_acceleration.x', ''), ('accelerometer_m_s2[0]', 'm/s2'), ('AccX', ''),
    ('ax [g]', 'g'), ('acc_x_mg', 'mg'), ('ACCEL X (m/s²)', 'm/s2'), ('AcX', ''), ('xacc', ''),
    ('imu/accel/x', ''), ('Accel_LN_X_CAL', ''), ('x-axis (g)', 'g'), ('gFx', ''),
    ('accel_g_x', 'g'),
    ('a_RS_S_x [m s^-2]', 'm/s2'), ('accSmooth[0]', ''), ('ACCX', ''),
    ('Accélération x (m/s²)', 'm/s2')])
def test_names_of_accelerations_are_known_with_their_units(x: str, unit: str) -> None:
    known = meaning(x)
    assert (known.quantity, known.axis) == ('reading', 0)
    found = unit_of('reading', known.unit)
    words = {None: '', ('g', 1e-3): 'mg'}.get(found, found[0] if found else '')
    assert words == unit


@pytest.mark.parametrize('name', [
    'mag_x', 'gravity_x', 'orientation.x', 'linear_acceleration_covariance_0', 'ax_std', 'roll',
    'position_x', 'ref_x', 'gx', 'temperature', 'label', 'count', 'baro_pressure', 'x [uT]'])
def test_names_of_other_quantities_are_no_accelerations(name: str) -> None:
    assert meaning(name).quantity != 'reading'


@pytest.mark.parametrize(('header', 'found', 'advice', 'chosen'), [
    ('t,imu0_ax,imu0_ay,imu0_az,imu1_ax,imu1_ay,imu1_az', 'imu0_ax, imu0_ay, imu0_az and imu1_ax',
     '--columns', {'ax': 'imu1_ax', 'ay': 'imu1_ay', 'az': 'imu1_az'}),
    ('t,x,y,z,x,y,z', '2 accelerometers', 'ax=2,ay=3,az=4', {'ax': '5', 'ay': '6', 'az': '7'})])
def test_two_accelerometers_are_an_error_and_chosen_by_name_or_number(
        header: str, found: str, advice: str, chosen: dict[str, str], tmp_path: Path) -> None:
    made = samples(per_g=G)
    path = write(tmp_path, text_of(rows_of(made['time'], made['reading'], -made['reading']),
                                   header))
    with pytest.raises(InputError, match=found) as refusal:
        read_log(path)
    assert advice in refusal.value.advice
    log = read_log(path, LogOptions(columns=chosen))
    np.testing.assert_allclose(log.table.reading, -made['reading'], rtol=1e-8)


def test_a_column_of_text_that_looks_like_a_temperature_does_not_stand_in_the_way(
        tmp_path: Path) -> None:
    made = samples(per_g=G)
    rows = [[*row, '' if k % 10 else '25.0'] for k, row in
            enumerate(rows_of(made['time'], made['reading']))]
    log = read_log(write(tmp_path, text_of(rows, 'time,ax,ay,az,temp')))
    assert 'temperature' not in log.table
    assert any('temperature=temp' in note for note in log.notes)


def test_four_columns_without_header_and_times_are_refused(tmp_path: Path) -> None:
    made = samples(per_g=G)
    with pytest.raises(InputError, match='column 1 does not increase'):
        read_log(write(tmp_path, text_of(rows_of(made['reading'], made['time']))))


def test_columns_are_given_by_name_or_number(tmp_path: Path) -> None:
    made = samples(per_g=G)
    text = text_of(rows_of(made['reading'][:, ::-1], made['time'] * 1e6, digits='.12g'),
                   'first,second,third,fourth_us')
    path = write(tmp_path, text)
    with pytest.raises(InputError, match='expected three of an accelerometer'):
        read_log(path)
    given = {'ax': 'third', 'ay': '2', 'az': 'First', 'time': 'fourth_us'}
    log = read_log(path, LogOptions(columns=given))
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)
    for wrong, message in (({'ax': 'fifth'}, "no column 'fifth'"), ({'ax': '9'}, "column '9'"),
                           ({'bx': '1'}, "names 'bx'"), ({'ax': '1'}, 'expected ax, ay and az')):
        with pytest.raises(InputError, match=message):
            read_log(path, LogOptions(columns=wrong))


@pytest.mark.parametrize('width', [3, 4, 5, 7, 8])
def test_a_table_without_header_is_read_by_its_number_of_columns(width: int, tmp_path: Path
                                                                 ) -> None:
    made = samples(per_g=G)
    warm = np.linspace(20.0, 30.0, len(made['time']))
    parts = [made['time'], made['reading'], made['rate'], warm]
    rows = rows_of(*(parts[1:2] if width == 3 else parts), digits='.9g')
    rate = 100.0 if width == 3 else None
    cut = [[*row[:4], row[7]] if width == 5 else row[:width] for row in rows]
    log = read_log(write(tmp_path, text_of(cut)), LogOptions(rate=rate))
    assert 'no header' in log.read_as
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    assert ('rate' in log.table) == (width > 5)
    assert ('temperature' in log.table) == (width in (5, 8))
    if width > 5:
        np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7)


def test_a_header_in_a_comment_is_read(tmp_path: Path) -> None:
    text = log_text('# time [s], acc_x [m/s^2], acc_y [m/s^2], acc_z [m/s^2]')
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.table['time'], samples()['time'], atol=1e-9)
    assert 'acc_x/y/z [m/s^2] in m/s2' in log.read_as


def test_units_in_a_row_below_the_header_are_read(tmp_path: Path) -> None:
    made = samples(per_g=1000.0)
    text = text_of([['ms', 'mg', 'mg', 'mg'], *rows_of(made['time'] * 1e3, made['reading'])],
                   'time,accX,accY,accZ')
    log = read_log(write(tmp_path, text))
    assert log.units.name == 'g'
    np.testing.assert_allclose(log.table.reading, made['reading'] / 1e3, rtol=1e-8)
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)


def test_own_columns_keep_their_names_and_nothing_is_assumed(tmp_path: Path) -> None:
    rows = 'ax,ay,az,std_x,std_y,std_z,count,orientation,label\n' + ''.join(
        f'{x},{y},{z},0.01,0.01,0.01,50,{k},side {k}\n'
        for k, (x, y, z) in enumerate((G * spread_directions(9)).tolist()))
    log = read_log(write(tmp_path, rows))
    assert isinstance(log.table, Poses)
    assert log.read_as == ''
    assert log.notes == ()
    assert list(log.table['label'][:2]) == ['side 0', 'side 1']
    assert {'std', 'count', 'orientation'} <= set(log.table.columns)


# ------------------------------------------------------------------------------------- time

@pytest.mark.parametrize(('name', 'unit', 'start'), [
    ('timestamp_ms', 1e-3, 5.0), ('t_us', 1e-6, 5.0), ('time [ns]', 1e-9, 5.0),
    ('t (s)', 1.0, 5.0),
    ('timestamp', 1e-3, 0.0), ('timestamp', 1e-6, 0.0), ('timestamp', 1e-9, 0.0),
    ('timestamp', 1.0, 0.0), ('t', 1.0, 1.7e9), ('t', 1e-3, 1.7e9), ('t', 1e-6, 1.7e9),
    ('t', 1e-9, 1.7e9), ('time', 1e-3, 0.0), ('time', 1e-6, 12.0)])
def test_times_in_any_unit_become_seconds(name: str, unit: float, start: float, tmp_path: Path
                                          ) -> None:
    made = samples(per_g=G)
    stamps = (made['time'] + start) / unit
    text = text_of([[format(stamp, '.19g' if unit == 1.0 else '.0f'), *row] for stamp, row
                    in zip(stamps.tolist(), rows_of(made['reading']))], f'{name},accX,accY,accZ')
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.table['time'] - start, made['time'], atol=2e-6)
    assert '/' in log.read_as
    words = {1e-3: 'ms', 1e-6: 'us µs', 1e-9: 'ns', 1.0: 's'}[unit]
    assert any(word in log.read_as for word in words.split())


@pytest.mark.parametrize('form', ['%Y-%m-%dT%H:%M:%S.%fZ', '%Y-%m-%d %H:%M:%S.%f',
                                  '%Y/%m/%d %H:%M:%S.%f', '%d-%b-%Y %H:%M:%S.%f',
                                  '%Y-%m-%dT%H:%M:%S.%f+00:00', '%H:%M:%S.%f'])
def test_dates_become_seconds(form: str, tmp_path: Path) -> None:
    made = samples(per_g=G)
    start = datetime(2026, 1, 31, 23, 59, 45, tzinfo=timezone.utc).timestamp()
    texts = [datetime.fromtimestamp(start + each, timezone.utc).strftime(form)
             for each in made['time'].tolist()]
    rows = [[text, *row] for text, row in zip(texts, rows_of(made['reading']))]
    log = read_log(write(tmp_path, text_of(rows, 'Timestamp,AccX,AccY,AccZ')))
    np.testing.assert_allclose(np.diff(log.table['time']), np.diff(made['time']), atol=2e-6)
    if '%d' in form:
        assert log.table['time'][0] == pytest.approx(start, abs=1e-5)


def test_a_bad_date_is_an_error_with_its_line_or_is_skipped(tmp_path: Path) -> None:
    rows = rows_of(samples(per_g=G)['reading'])
    lines = [f'2026-01-01T12:{k // 6000:02d}:{k / 100 % 60:05.2f},{",".join(row)}\n'
             for k, row in enumerate(rows)]
    bad = '2026-13-45T99:00,1,2,3\n'
    for words in (bad, 'yesterday,1,2,3\n'):
        path = write(tmp_path, ''.join(['time,accX,accY,accZ\n', *lines[:99], words, *lines[99:]]))
        with pytest.raises(InputError, match='row 100') as refusal:
            read_log(path)
        assert words.split(',')[0] in refusal.value.message
    log = read_log(path, LogOptions(skip_bad=True))
    assert len(log.table) == len(lines)


def test_a_cut_line_that_is_alone_in_the_last_block_is_left_out(tmp_path: Path) -> None:
    text = ''.join(f'{k / 100},0,0,9.8\n' for k in range(65536))
    log = read_log(write(tmp_path, f'time,ax,ay,az\n{text}655.36,0'))
    assert len(log.table) == 65536
    assert 'cut' in log.notes[0]


@pytest.mark.parametrize(('unit', 'name'), [(1e-6, 't_us'), (1e-3, 'timestamp_ms'),
                                            (1e-6, 'micros'), (1e-6, 'timestamp')])
def test_a_counter_that_starts_again_is_continued_and_noted(unit: float, name: str,
                                                            tmp_path: Path) -> None:
    made = samples(per_g=G)
    ticks = (np.round((made['time'] - 10.0) / unit).astype(np.int64) % 2**32).tolist()
    text = text_of([[str(tick), *row] for tick, row in zip(ticks, rows_of(made['reading']))],
                   f'{name},accX,accY,accZ')
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(np.diff(log.table['time']), 1.0 / RATE_HZ, atol=2e-6)
    assert any('starts again once' in note for note in log.notes)


def test_a_time_that_jumps_back_is_left_as_it_is(tmp_path: Path) -> None:
    made = samples(per_g=G)
    made['time'][1000:] -= 5.0
    text = text_of(rows_of(made['time'], made['reading']), 'time,ax,ay,az')
    np.testing.assert_allclose(read_log(write(tmp_path, text)).table['time'], made['time'])


def test_a_log_each_ten_seconds_stays_in_seconds(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    still = np.array([0.1, 0.2, G]) + 0.01 * rng.normal(size=(6000, 3))
    text = text_of(rows_of(np.arange(6000) * 10.0, still), 'time,ax,ay,az')
    log = read_log(write(tmp_path, text))
    assert log.table['time'][-1] == 59_990.0
    assert isinstance(log.table, Recording)


# ------------------------------------------------------------------------------------ units

@pytest.mark.parametrize(('header', 'per_g', 'units', 'factor'), [
    ('', G, 'm/s2', 1.0), ('', 1.0, 'g', 1.0), ('', 256.0, 'native', 1.0),
    *(('time,accX,accY,accZ', *each) for each in (
        (G, 'm/s2', 1.0), (1.0, 'g', 1.0), (1000.0, 'g', 1e-3), (16384.0, 'native', 1.0),
        (2048.0, 'native', 1.0), (256.0, 'native', 1.0), (0.3, 'native', 1.0)))])
def test_the_unit_is_recognised_at_rest(header: str, per_g: float, units: str, factor: float,
                                        tmp_path: Path) -> None:
    made = samples(per_g=per_g)
    log = read_log(write(tmp_path, text_of(rows_of(made['time'], made['reading']), header)))
    assert log.units.name == units
    np.testing.assert_allclose(log.table.reading, made['reading'] * factor, rtol=1e-8)
    assert ('native' if units == 'native' else units) in log.read_as


def test_counts_with_large_offsets_are_native_and_their_scale_is_said(tmp_path: Path) -> None:
    made = samples(per_g=400.0)
    log = read_log(write(tmp_path, text_of(rows_of(made['time'], (made['reading'] + 512).round()),
                                           'time,x,y,z')))
    assert log.units.name == 'native'
    value = float(log.read_as.split(', ')[-1].split(' counts')[0].replace(' ', ''))
    assert value == pytest.approx(400.0, rel=0.05)


@pytest.mark.parametrize(('header', 'per_g', 'advice'), [
    ('t,ax [g],ay [g],az [g]', G, '--units m/s2'),
    ('t,ax [m/s^2],ay [m/s^2],az [m/s^2]', 1.0, '--units g'),
    ('t,acc_x_mg,acc_y_mg,acc_z_mg', 16384.0, 'correct the name')])
def test_a_name_that_contradicts_the_readings_is_an_error(header: str, per_g: float, advice: str,
                                                          tmp_path: Path) -> None:
    path = write(tmp_path, log_text(header, per_g))
    with pytest.raises(InputError, match='states readings in') as refusal:
        read_log(path)
    assert advice in refusal.value.advice
    assert '\n' not in str(refusal.value)
    assert read_log(path, LogOptions(units='native')).units.name == 'native'


def test_the_unit_that_the_user_states_goes_first(tmp_path: Path) -> None:
    made = samples(per_g=G)
    path = write(tmp_path, log_text('t,ax [g],ay [g],az [g]'))
    log = read_log(path, LogOptions(units='m/s2', gravity=9.81))
    assert (log.units.name, log.units.per_g) == ('m/s2', 9.81)
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    stated = write(tmp_path, '# units: "g"\n' + log_text(), 'stated.csv')
    with pytest.raises(InputError, match='is in g, but --units is m/s2'):
        read_log(stated, LogOptions(units='m/s2'))


@pytest.mark.parametrize(('header', 'per_g'), [
    ('time,ax,ay,az', G), ('time,ax,ay,az', 1.0), ('Time (s),Linear Acceleration x (m/s^2),'
                                                   'Linear Acceleration y (m/s^2),'
                                                   'Linear Acceleration z (m/s^2)', G),
    ('t,userAccelX(g),userAccelY(g),userAccelZ(g)', 1.0)])
def test_a_log_without_gravity_is_refused_in_those_words(header: str, per_g: float, tmp_path: Path
                                                         ) -> None:
    rng = np.random.default_rng(7)
    forces, rates = motion(rng)
    moving = np.abs(rates).max(axis=1) > 0.1
    free = 0.004 * rng.normal(size=forces.shape) + 0.005
    free[moving] += 0.4 * rng.normal(size=(int(moving.sum()), 3))
    text = text_of(rows_of(np.arange(len(free)) / 100.0, free * per_g), header)
    for units in ('', 'm/s2' if per_g == G else 'g'):
        with pytest.raises(InputError, match='linear acceleration, gravity removed') as refusal:
            read_log(write(tmp_path, text), LogOptions(units=units))  # type: ignore[arg-type]
        assert 'native' not in str(refusal.value)
        assert 'with g' in refusal.value.advice


@pytest.mark.parametrize(('per_g', 'offset'), [
    (0.02, 0.0), (0.02, 5.0), (0.33, 0.8), (1.0, 0.8), (G, 5.0), (300.0, 0.8), (1000.0, 5.0)])
def test_readings_with_gravity_are_never_taken_for_linear_acceleration(per_g: float, offset: float,
                                                                       tmp_path: Path) -> None:
    made = samples(int(10 * per_g + offset), per_g)
    reading = made['reading'] + offset * per_g * np.array([1.0, -0.6, 0.3])
    read_log(write(tmp_path, text_of(rows_of(made['time'], reading), 'time,accX,accY,accZ')))


def test_a_free_fall_is_no_rest(tmp_path: Path) -> None:
    made = samples(per_g=G)
    made['reading'][200:260] = 0.01 * made['reading'][200:260]
    log = read_log(write(tmp_path, text_of(rows_of(made['time'], made['reading']),
                                           'time,accX,accY,accZ')))
    assert log.units.name == 'm/s2'


# ---------------------------------------------------------------------------------- context

@pytest.mark.parametrize(('names', 'factor', 'said'), [
    ('gyroX_dps,gyroY_dps,gyroZ_dps', 180.0 / np.pi, '°/s -> rad/s'),
    ('gyro_x (rad/s),gyro_y (rad/s),gyro_z (rad/s)', 1.0, 'rad/s'),
    ('GyX,GyY,GyZ', 180.0 / np.pi, '°/s -> rad/s (assumed)'),
    ('gyr_x,gyr_y,gyr_z', 1.0, 'rad/s (assumed)')])
def test_angular_rates_become_rad_per_s(names: str, factor: float, said: str, tmp_path: Path
                                        ) -> None:
    made = samples(per_g=G)
    text = text_of(rows_of(made['time'], made['reading'], made['rate'] * factor),
                   f'time,accX,accY,accZ,{names}')
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7)
    assert said in log.read_as


def test_angular_rates_and_temperatures_in_counts_are_not_used_and_noted(tmp_path: Path) -> None:
    made = samples(per_g=16384.0)
    text = text_of(rows_of(made['time'], made['reading'], made['rate'] * 7506.0,
                           2000.0 + made['time']), 'time,accX,accY,accZ,gyroX,gyroY,gyroZ,temp')
    log = read_log(write(tmp_path, text))
    own = text.replace('gyroX,gyroY,gyroZ', 'gx,gy,gz')
    assert not {'rate', 'temperature'} & {*log.table.columns}
    assert 'rate' not in read_log(write(tmp_path, own)).table
    for words in ('gyroX/Y/Z look like counts', 'temp has values of about 20'):
        assert any(words in note for note in log.notes)


@pytest.mark.parametrize(('name', 'factor', 'zero'), [
    ('temp', 1.0, 0.0), ('Temperature (°C)', 1.0, 0.0), ('temp_f', 1.8, 32.0),
    ('temperature_K', 1.0, 273.15)])
def test_temperatures_become_degrees_celsius(name: str, factor: float, zero: float, tmp_path: Path
                                             ) -> None:
    made = samples(per_g=G)
    warm = np.linspace(20.0, 30.0, len(made['time']))
    for encoding in ('utf-8', 'cp1252'):
        text = text_of(rows_of(made['time'], made['reading'], warm * factor + zero),
                       f'time,accX,accY,accZ,{name}')
        log = read_log(write(tmp_path, text.encode(encoding)))
        np.testing.assert_allclose(log.table['temperature'], warm, atol=1e-5)


# ----------------------------------------------------------------------------- large logs

def test_a_long_log_is_read_in_blocks_of_flat_memory(tmp_path: Path) -> None:
    block = log_text(poses=10, rest=400, turn=100).splitlines(keepends=True)
    peaks = []
    for times in (40, 100):
        path = write(tmp_path, ''.join([block[0], *(block[1:] * times)]))
        tracemalloc.start()
        with open_log(path) as log:
            rows = [len(each) for each in log.watched(lambda done, count: None)]
            assert log.samples == pytest.approx(sum(rows), rel=0.05)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert sum(rows) == (len(block) - 1) * times
        assert max(rows) <= 65536
    assert peaks[1] < 1.3 * peaks[0]


def test_a_log_is_read_the_same_in_blocks_and_at_once(tmp_path: Path) -> None:
    block = rows_of(samples(per_g=1000.0)['reading'], digits='.6g')
    count = 150_000 // len(block) + 1
    rows = [[str(k * 10), *row] for k, row in enumerate(block * count)]
    path = write(tmp_path, text_of(rows, 'millis,accX,accY,accZ'))
    log = read_log(path)
    with open_log(path) as opened:
        parts: list[Any] = list(opened.blocks)
    assert len(parts) > 1
    np.testing.assert_array_equal(np.concatenate([part.reading for part in parts]),
                                  log.table.reading)
    assert log.table['time'][-1] == pytest.approx((len(rows) - 1) * 0.01)
    assert log.table.row[-1] == len(rows)


def test_samples_without_times_need_their_rate(tmp_path):
    recording = ac.simulate({}, recording=True, poses=8, rate=50.0)
    path = tmp_path / 'log.csv'
    np.savetxt(path, recording.reading, delimiter=',', header='ax,ay,az', comments='')
    with pytest.raises(InputError, match='--rate HZ'):
        read_log(path)
    found = read_log(path, LogOptions(rate=50.0))
    assert isinstance(found.table, Recording)
    np.testing.assert_allclose(found.table['time'], np.arange(len(recording)) / 50.0)
    assert '50 Hz (stated)' in found.read_as
    np.savetxt(path, np.column_stack([recording['time'], recording.reading]), delimiter=',',
               header='time,ax,ay,az', comments='')
    with pytest.raises(InputError, match='has times, but --rate is 50'):
        read_log(path, LogOptions(rate=50.0))


def test_many_poses_without_times_are_poses(tmp_path):
    poses = ac.simulate({}, poses=400)
    path = tmp_path / 'poses.csv'
    np.savetxt(path, poses.reading, delimiter=',', header='ax,ay,az', comments='')
    assert isinstance(read_log(path).table, Poses)


# -------------------------------------------------------------------- tables of real loggers

def counted(made: dict[str, Any], start: int = 65_000, bits: int = 16) -> np.ndarray:
    """Return the numbers of the samples by a counter of this width."""
    return (start + np.arange(len(made['time']))) % 2**bits


@pytest.mark.parametrize('comment', ['// Sample rate: 100.0Hz', '// Update Rate: 100.0Hz',
                                     '# Config: data_rate = 100.0 Hz, filter = 48 Hz',
                                     'Acquisition frequency: 100 Hz',
                                     '--- Data File Created at 100 Hz ---', 'OutputRate:,0.1kHz'])
@pytest.mark.parametrize('name', ['Counter', 'PacketCounter', 'Packet number', ''])
def test_samples_without_times_have_the_rate_that_the_file_states(comment: str, name: str,
                                                                  tmp_path: Path) -> None:
    made = samples(per_g=G)
    rows = rows_of(counted(made), made['reading'], made['rate'])
    kept = np.arange(len(rows)) % 37 != 5 if name else np.ones(len(rows), bool)
    first = 0 if name else 1  # without a counter, no sample is missing
    text = text_of([row[first:] for row, keep in zip(rows, kept) if keep],
                   ','.join([name, 'Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z']).lstrip(','))
    log = read_log(write(tmp_path, f'{comment}\n{text}'))
    assert isinstance(log.table, Recording)
    when = log.table['time'] - log.table['time'][0]
    np.testing.assert_allclose(when, np.flatnonzero(kept) / 100.0, atol=1e-9)
    assert '100 Hz (stated)' in log.read_as


@pytest.mark.parametrize('count', [300, 953])
def test_a_table_with_angular_rates_or_of_one_direction_is_not_taken_for_poses(
        count: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    turned = np.column_stack([G * spread_directions(count), rng.normal(size=(count, 3))])
    still = np.array([0.1, 0.2, G]) + 0.01 * rng.normal(size=(count, 3))
    for values, header in ((turned, 'Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z'), (still, 'ax,ay,az')):
        path = write(tmp_path, text_of(rows_of(values), header))
        with pytest.raises(InputError, match='look like samples'):
            read_log(path)
        assert isinstance(read_log(path, LogOptions(rate=50.0)).table, Recording)


def test_more_rows_than_a_person_poses_are_samples(tmp_path: Path) -> None:
    poses = G * spread_directions(1500)
    path = write(tmp_path, text_of(rows_of(poses), 'ax,ay,az'))
    with pytest.raises(InputError, match='look like samples'):
        read_log(path)
    marked = write(tmp_path, text_of(rows_of(poses, np.arange(1500)), 'ax,ay,az,orientation'))
    assert isinstance(read_log(marked).table, Poses)
    timed = write(tmp_path, text_of(rows_of(np.arange(1500) * 5.0, poses), 'time,ax,ay,az'))
    with open_log(timed) as log:
        assert log.poses is None


@pytest.mark.parametrize(('tick', 'rate_hz'), [(1e-4, 400.0), (1e-4, 60.0), (1e-6, 60.0),
                                               (1e-4, 100.0), (1e-6, 120.0)])
def test_the_clock_of_xsens_is_in_ticks_of_its_own(tick: float, rate_hz: float, tmp_path: Path
                                                   ) -> None:
    made = samples(per_g=G)
    times = np.arange(len(made['time'])) / rate_hz
    stamps = 12_000_000 + np.round(times / tick)
    text = text_of(rows_of(counted(made), stamps, made['reading'], digits='.12g'),
                   'PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z')
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.table['time'] - log.table['time'][0], times, atol=tick)
    assert ('100 µs' if tick == 1e-4 else 'SampleTimeFine in µs') in log.read_as


@pytest.mark.parametrize('beside', ['comment', 'seconds', 'counter'])
def test_a_unit_of_time_is_that_which_agrees_with_what_else_the_file_states(
        beside: str, tmp_path: Path) -> None:
    made = samples(per_g=G)
    slow = 8.0  # rows per second; in µs, 100 Hz would be as plausible
    times = np.arange(len(made['time'])) / slow
    stamps = np.round(times * 1e3)
    columns: list[Any] = [stamps, made['reading']]
    header, first = 'stamp,accX,accY,accZ', ''
    if beside == 'seconds':
        columns, header = [*columns, times], f'{header},elapsed_s_time'
    if beside == 'comment':
        first = '# Rate: 8 Hz\n'
    if beside == 'counter':
        first = '# Rate: 80 Hz\n'
        columns, header = [10 * np.arange(len(times)), *columns], f'Counter,{header}'
    log = read_log(write(tmp_path, first + text_of(rows_of(*columns, digits='.12g'), header)))
    np.testing.assert_allclose(log.table['time'] - log.table['time'][0], times, atol=1e-3)


def test_stamps_that_contradict_the_stated_rate_are_noted(tmp_path: Path) -> None:
    made = samples(per_g=G)
    text = text_of(rows_of(made['time'] * 1e3, made['reading']), 't_ms,accX,accY,accZ')
    log = read_log(write(tmp_path, f'# Sample rate: 400 Hz\n{text}'))
    assert any('t_ms has 100 samples per second, but the file states 400 Hz' in note
               for note in log.notes)
    log = read_log(write(tmp_path, f'# Sample rate: 100 Hz\n{text}'))
    assert not log.notes


@pytest.mark.parametrize(('header', 'first', 'second'), [
    ('Date,Timestamp', '2026-01-31 12:00:00', ''), ('time,millis', '12:00:{}', ''),
    ('time,t_ms', '17', ''), ('Second,stamp', '', '')])
def test_the_clock_that_runs_finest_is_read(header: str, first: str, second: str, tmp_path: Path
                                            ) -> None:
    made = samples(per_g=G)
    rows = [[first.format(f'{int(when) % 60:02d}'), f'{when * 1e3:.0f}', *row]
            for when, row in zip(made['time'], rows_of(made['reading']))]
    log = read_log(write(tmp_path, text_of(rows, f'{header},accX,accY,accZ')))
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-3)


def test_seconds_and_nanoseconds_of_ros_are_read_together(tmp_path: Path) -> None:
    made = samples(per_g=G)
    fraction = np.round(made['time'] % 1.0 * 1e9)
    text = text_of(rows_of(np.floor(made['time']), fraction, made['reading'], digits='.12g'),
                   'stamp.secs,stamp.nsecs,accX,accY,accZ')
    np.testing.assert_allclose(read_log(write(tmp_path, text)).table['time'], made['time'],
                               atol=1e-8)


@pytest.mark.parametrize('blank', [',,,', '"","","",""', ' , ,,'])
def test_rows_without_any_value_are_ignored(blank: str, tmp_path: Path) -> None:
    text = log_text('time,ax,ay,az') + f'{blank}\n' * 20
    log = read_log(write(tmp_path, text))
    assert len(log.table) == len(samples()['time'])
    assert log.notes == ()


def test_columns_with_gravity_of_one_maker_go_before_those_without_it(tmp_path: Path) -> None:
    made = samples(per_g=1.0)
    free = 0.3 + 0.01 * made['reading'] * G
    text = text_of(rows_of(made['time'], made['reading'], free, made['rate']),
                   'time,gFx,gFy,gFz,ax,ay,az,wx,wy,wz')
    log = read_log(write(tmp_path, f'\n{text}'))
    assert log.units.name == 'g'
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)
    np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7, atol=1e-9)
    assert 'gFx/y/z' in log.read_as


@pytest.mark.parametrize(('free', 'whole'), [
    ('Accelerometer_{}', 'TotalAcceleration_{}'), ('accelerometer_{}', 'totalacceleration_{}'),
    ('acceleration.{}', 'accelerationIncludingGravity.{}')])
def test_an_acceleration_with_gravity_by_its_name_goes_before_one_without(
        free: str, whole: str, tmp_path: Path) -> None:
    made = samples(per_g=G)
    names = [name.format(axis) for name in (free, whole) for axis in 'xyz']
    text = text_of(rows_of(made['time'], 0.01 * made['reading'], made['reading']),
                   ','.join(('time', *names)))
    log = read_log(write(tmp_path, text))
    np.testing.assert_allclose(log.table.reading, made['reading'], rtol=1e-8)


def test_the_start_and_the_rate_above_the_samples_of_a_wristband_are_read(tmp_path: Path) -> None:
    made = samples(per_g=64.0)
    begin = '1544027300.000000, 1544027300.000000, 1544027300.000000\n50.0, 50.0, 50.0\n'
    log = read_log(write(tmp_path, begin + text_of(rows_of(np.round(made['reading'])), '')))
    assert len(log.table) == len(made['time'])
    np.testing.assert_allclose(np.diff(log.table['time']), 0.02, atol=1e-9)
    np.testing.assert_array_equal(log.table.reading[0], np.round(made['reading'][0]))


def test_an_acceleration_that_is_free_of_gravity_by_its_name_is_refused(tmp_path: Path) -> None:
    made = samples(per_g=G)
    path = write(tmp_path, text_of(rows_of(made['time'], made['reading']),
                                   't,FreeAcc_X,FreeAcc_Y,FreeAcc_Z'))
    with pytest.raises(InputError, match='FreeAcc_X, FreeAcc_Y, FreeAcc_Z only, linear'):
        read_log(path)
    given = {'ax': 'FreeAcc_X', 'ay': 'FreeAcc_Y', 'az': 'FreeAcc_Z'}
    assert read_log(path, LogOptions(columns=given)).units.name == 'm/s2'


@pytest.mark.parametrize('header', ['', 'time,x,y,z'])
def test_numbers_of_which_nothing_says_what_they_are_are_noted(header: str, tmp_path: Path
                                                               ) -> None:
    made = samples(per_g=48.0)  # the field of the Earth, in µT
    text = text_of(rows_of(made['time'], made['reading']), header)
    assert any('magnetometer' in note for note in read_log(write(tmp_path, text)).notes)
    for named in (text_of(rows_of(made['time'], made['reading']), 'time,accX,accY,accZ'),
                  text_of(rows_of(made['time'], made['reading'] / 48.0), header)):
        assert not any('magnetometer' in note for note in read_log(write(tmp_path, named)).notes)


@pytest.mark.parametrize('header', ['Time (s),W,X,Y,Z', 't,w,x,y,z'])
def test_a_quaternion_is_not_taken_for_an_accelerometer(header: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    turns = rng.normal(size=(400, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, np.newaxis]
    text = text_of(rows_of(np.arange(400) / 50.0, turns), header)
    with pytest.raises(InputError, match='expected three of an accelerometer'):
        read_log(write(tmp_path, text))


def test_rows_of_a_moving_sensor_without_times_are_not_taken_for_poses(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    moving = 1000.0 * (spread_directions(900) + rng.normal(size=(900, 3)))
    path = write(tmp_path, text_of(rows_of(np.round(moving)), 'acc_x[mg],acc_y[mg],acc_z[mg]'))
    with pytest.raises(InputError, match='look like samples'):
        read_log(path)


def test_a_recording_with_two_rows_per_second_holds_samples(tmp_path: Path) -> None:
    made = samples(per_g=G, rest=10, turn=4)
    half_seconds = np.arange(len(made['time'])) * 500.0
    log = read_log(write(tmp_path, text_of(rows_of(made['reading'], half_seconds),
                                           'ACCELEROMETER X (m/s²);ACCELEROMETER Y (m/s²);'
                                           'ACCELEROMETER Z (m/s²);Time since start in ms '
                                           .replace(';', ','))))
    assert isinstance(log.table, Recording)
