# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Text logs of any dialect: the same numbers are read, and what is assumed is said."""

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
import re
import sys
import tracemalloc
from typing import Any

import accel_calib as ac
from accel_calib.calibration import fit_poses
from accel_calib.errors import InputError
from accel_calib.logs import LogOptions, open_log
from accel_calib.stillness import capture
from accel_calib.table import Poses, Recording
from inside import meaning, model_with, read_log, simulate_recording, spread_directions, unit_of
import numpy as np
import pytest

G = 9.80665
RATE_HZ = 100.0
OFFSET = np.array([0.03, -0.02, 0.05])
GAIN = np.array([1.01, 0.98, 1.02])
NOISE = 0.002

Reads = Callable[..., Any]


def samples(seed: int = 1, per_g: float = G, *, poses: int = 12, rest: int = 200, turn: int = 80
            ) -> dict[str, np.ndarray]:
    """Return time [s], readings with `per_g` to the g, and rates [rad/s] of a recording."""
    rng = np.random.default_rng(seed)
    made = simulate_recording(
        model_with({'offset': OFFSET, 'axis_gain': GAIN - 1.0}),
        spread_directions(poses)[rng.permutation(poses)], rng, noise_g=NOISE, rate_hz=RATE_HZ,
        dwell=rest / RATE_HZ, turn=turn / RATE_HZ, gyro_noise=0.001)
    return {'time': made['time'].copy(), 'reading': per_g * made.reading, 'rate': made['rate']}


def rows_of(*columns: np.ndarray | list[str], digits: str = '.9g') -> list[list[str]]:
    """Return the cells of rows, from columns of numbers and of texts."""
    parts = [[[text] for text in column] if isinstance(column, list) else
             [[format(value, digits) for value in row]
              for row in np.reshape(column, (len(column), -1)).tolist()] for column in columns]
    return [[cell for part in row for cell in part] for row in zip(*parts, strict=True)]


def text_of(rows: list[list[str]], header: str = '', delimiter: str = ',') -> str:
    lines = [delimiter.join(row) for row in rows]
    return '\n'.join([header, *lines] if header else lines) + '\n'


def write(folder: Path, content: Any, name: str = 'log.csv') -> Path:
    """Write text, bytes, or what a function of the path writes."""
    path = folder / name
    if callable(content):
        content(path)
    else:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def log_text(header: str = 'time,ax,ay,az', per_g: float = G, **settings: int) -> str:
    made = samples(per_g=per_g, **settings)
    return text_of(rows_of(made['time'], made['reading']), header)


@pytest.fixture
def reads(tmp_path: Path) -> Reads:
    """Return a function that writes columns below a header, and reads them with options."""
    def read(header: str, *columns: Any, before: str = '', digits: str = '.9g', **options: Any
             ) -> Any:
        text = before + text_of(rows_of(*columns, digits=digits), header)
        return read_log(write(tmp_path, text), LogOptions(**options))

    return read


def check(log: Any, reading: np.ndarray | None = None, time: np.ndarray | None = None,
          within_s: float = 1e-9) -> None:
    """Compare what is read with what was written, and the times since the first sample [s]."""
    if reading is not None:
        np.testing.assert_allclose(log.table.reading, reading, rtol=1e-8)
    if time is not None:
        np.testing.assert_allclose(log.table['time'] - log.table['time'][0], time - time[0],
                                   atol=within_s)


# --------------------------------------------------------------------------------- dialects

DELIMITERS = (',', ';', '\t', '|', ' ', '  ')
ENCODINGS = ('utf-8', 'utf-8-sig', 'utf-16', 'utf-16-le', 'utf-16-be')
NAMES = ('time,ax,ay,az', 'timestamp,accX,accY,accZ', 'Time (s),Acceleration x (m/s^2),'
         'Acceleration y (m/s^2),Acceleration z (m/s^2)', 't_s,a_x,a_y,a_z',
         '', 't [s],linear_acceleration.x,linear_acceleration.y,linear_acceleration.z')


@pytest.mark.parametrize('seed', range(20))
def test_a_table_is_read_the_same_in_any_dialect(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    made = samples(seed, poses=8, rest=20, turn=5)
    delimiter, encoding = rng.choice(DELIMITERS), rng.choice(ENCODINGS)
    header = str(rng.choice(NAMES))
    comma = bool(rng.integers(2))
    quote = '"' if rng.integers(2) or (comma and delimiter == ',') else ''
    if delimiter in (' ', '  ') and ' ' in header:
        header = NAMES[1]
    rows = rows_of(made['time'], made['reading'])
    if comma:
        rows = [[cell.replace('.', ',') for cell in row] for row in rows]
    lines = [delimiter.join(f'{quote}{cell}{quote}' for cell in row)
             for row in [*([header.split(',')] if header else []), *rows]]
    end = str(rng.choice(['\n', '\r\n', '\r']))
    comments = ['# recorded on Monday; x, y, z', ''] if rng.integers(2) else []
    text = '\n'.join([*comments, end.join([*lines, ''])])
    log = read_log(write(tmp_path, text.encode(encoding)))
    assert isinstance(log.table, Recording)
    assert log.units.name == 'm/s2'
    np.testing.assert_allclose(log.table['time'], made['time'], rtol=1e-8)
    check(log, made['reading'])
    assert list(log.table.row) == list(range(1, len(rows) + 1))


def test_one_line_says_how_the_log_of_a_microcontroller_is_read(tmp_path: Path) -> None:
    made = samples(per_g=16512.0)
    rows = rows_of(made['time'] * 1e3, made['reading'], digits='.0f')
    log = read_log(write(tmp_path, text_of(rows, 'timestamp_ms;accX;accY;accZ', ';')))
    assert re.fullmatch(r"';', timestamp_ms in ms \(100 Hz\) -> s, accX/Y/Z, "
                        r'16 \d{3} counts = 1 g \(native\)', log.read_as)
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
    made = samples()
    for header, unit in (('millis,accX,accY,accZ', 1e3), ('', 1.0)):
        text = text_of(rows_of(made['time'] * unit, made['reading']), header)
        log = read_log(write(tmp_path, boot + text.encode()))
        np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)
        note, = log.notes
        assert re.search(r'\b6 lines.*ets Jul', note)


def test_a_cut_last_line_is_left_out_and_noted_also_alone_in_its_block(tmp_path: Path) -> None:
    text = log_text('time,accX,accY,accZ')
    whole = read_log(write(tmp_path, text))
    assert not whole.notes
    for cut in (12, 20, 30):
        log = read_log(write(tmp_path, text[:-cut]))
        assert [note for note in log.notes if 'cut' in note]
        np.testing.assert_array_equal(log.table.reading, whole.table.reading[:-1])
    block = ''.join(f'{k / 100},0,0,9.8\n' for k in range(65536))
    log = read_log(write(tmp_path, f'time,ax,ay,az\n{block}655.36,0'))
    assert len(log.table) == 65536
    assert 'cut' in log.notes[0]


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
    assert re.findall(r'\d+', log.notes[0])[:3] == ['1', '1502', '1500']
    assert 1500 not in log.table.row
    assert log.table.row[-1] == len(lines)


@pytest.mark.parametrize('text', [
    '', '\n\n', '# nothing\n', 'hello\n', 'hello world\nthis is no table\n', '"', '"\n"\n',
    ',,,\n', 'time,ax,ay,az\n', 'time,ax,ay,az\n"', '\x00' * 100, 'ax,ay,az\n\x00,1,2\n',
    'a\n1\n2\n', 'ax,ay,az\n' + '"' * 200_000, 'ax,ay,az\n1,2,"' + '3' * 200_000 + '\n',
    '1,2\n3,4\n', 'ax,ay,az\n1,2,3\n' + '"\n' * 3000, '{"a": [1, 2, 3]}\n',
    '<html><body>1,2,3</body></html>', ';;;\n;;;\n', 'ax,ay,az\n1e999,1,1\n',
    '1,2,3,4,5,6\n' * 9])
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


@pytest.mark.parametrize(('line', 'before'), [
    ('ax:{0}\tay:{1}\taz:{2}\n', ''), ('12:00:{when:06.3f} -> {0},{1},{2}\n', ''),
    ('12:00:{when:06.3f} -> {0} {1} {2}\n', '#\n')])
def test_the_serial_monitor_and_plotter_of_arduino_are_read(line: str, before: str, tmp_path: Path
                                                            ) -> None:
    made = samples(poses=8, rest=30, turn=8)
    text = before + ''.join(line.format(*row, when=when) for when, row in zip(
        made['time'], rows_of(made['reading'])))
    log = read_log(write(tmp_path, text), LogOptions(rate=None if 'when' in line else 100.0))
    check(log, made['reading'], made['time'], within_s=1e-6)


@pytest.mark.parametrize('blank', [',,,', ';;;', '""', '  ', '"","","",""', ' , ,,'])
def test_rows_without_any_value_are_ignored(blank: str, tmp_path: Path) -> None:
    log = read_log(write(tmp_path, log_text() + f'{blank}\n' * 20))
    check(log, samples()['reading'])
    assert log.notes == () or ',' not in blank


# ------------------------------------------------------------------------------------ names

NAMED = {
    '': ['accX', 'acc_x', 'accelX', 'a_x', 'linear_acceleration.x', 'AccX', 'AcX', 'xacc', 'gFx',
         'imu/accel/x', 'Accel_LN_X_CAL', 'accSmooth[0]', 'ACCX'],
    'm/s2': ['Acceleration x (m/s^2)', 'accelerometer_m_s2[0]', 'ACCEL X (m/s²)',
             'a_RS_S_x [m s^-2]', 'Accélération x (m/s²)'],
    'g': ['ax [g]', 'x-axis (g)', 'accel_g_x'],
    'mg': ['acc_x_mg']}


@pytest.mark.parametrize(('x', 'unit'), [(x, unit) for unit in NAMED for x in NAMED[unit]])
def test_names_of_accelerations_are_known_with_their_units(x: str, unit: str) -> None:
    known = meaning(x)
    assert (known.quantity, known.axis) == ('reading', 0)
    found = unit_of('reading', known.unit)
    assert found == {'': None, 'mg': ('g', 1e-3)}.get(unit, (unit, 1.0))


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
        header: str, found: str, advice: str, chosen: dict[str, str], reads: Reads) -> None:
    made = samples()
    columns = made['time'], made['reading'], -made['reading']
    with pytest.raises(InputError, match=found) as refusal:
        reads(header, *columns)
    assert advice in refusal.value.advice
    check(reads(header, *columns, columns=chosen), -made['reading'])


def test_a_column_of_text_that_looks_like_a_temperature_does_not_stand_in_the_way(
        reads: Reads) -> None:
    made = samples()
    warm = ['' if k % 10 else '25.0' for k in range(len(made['time']))]
    log = reads('time,ax,ay,az,temp', made['time'], made['reading'], warm)
    assert 'temperature' not in log.table
    assert any('temperature=temp' in note for note in log.notes)


def test_columns_are_given_by_name_or_number(reads: Reads) -> None:
    made = samples()
    header = 'first,second,third,fourth_us'
    columns = made['reading'][:, ::-1], made['time'] * 1e6
    with pytest.raises(InputError, match='expected three of an accelerometer'):
        reads(header, *columns)
    given = {'ax': 'third', 'ay': '2', 'az': 'First', 'time': 'fourth_us', 'label': 'second'}
    log = reads(header, *columns, digits='.12g', columns=given)
    check(log, made['reading'], made['time'])
    assert log.table['label'][9] == format(made['reading'][9, 1], '.12g')
    for wrong, message in (({'ax': 'fifth'}, "no column 'fifth'"), ({'ax': '9'}, "column '9'"),
                           ({'bx': '1'}, "names 'bx'"), ({'ax': '1'}, 'expected ax, ay and az'),
                           ({'az': ''}, 'names az, expected ax, ay and az')):
        with pytest.raises(InputError, match=message):
            reads(header, *columns, columns=wrong)


@pytest.mark.parametrize('width', [3, 4, 5, 7, 8])
def test_a_table_without_header_is_read_by_its_number_of_columns(width: int, reads: Reads) -> None:
    made = samples()
    warm = np.linspace(20.0, 30.0, len(made['time']))
    parts = [made['time'], made['reading'], made['rate'], warm]
    which = {3: [1], 4: [0, 1], 5: [0, 1, 3], 7: [0, 1, 2], 8: [0, 1, 2, 3]}[width]
    log = reads('', *(parts[k] for k in which), rate=100.0 if width == 3 else None)
    assert 'no header' in log.read_as
    check(log, made['reading'], made['time'])
    assert ('rate' in log.table) == (width > 5)
    assert ('temperature' in log.table) == (width in (5, 8))
    if width > 5:
        np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7)
    with pytest.raises(InputError, match='column 1 does not increase'):
        reads('', made['reading'], made['time'])


def test_names_in_a_comment_and_units_in_a_row_below_the_header_are_read(reads: Reads) -> None:
    made = samples()
    log = reads('# time [s], acc_x [m/s^2], acc_y [m/s^2], acc_z [m/s^2]', made['time'],
                made['reading'])
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)
    assert 'acc_x/y/z [m/s^2]' in log.read_as
    assert log.units.name == 'm/s2'
    made = samples(per_g=1000.0)
    log = reads('ms,mg,mg,mg', made['time'] * 1e3, made['reading'], before='time,accX,accY,accZ\n')
    assert log.units.name == 'g'
    check(log, made['reading'] / 1e3)
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-9)


def test_own_columns_keep_their_names_and_nothing_is_assumed(reads: Reads) -> None:
    ups, same = G * spread_directions(9), np.ones((9, 1))
    log = reads('ax,ay,az,std_x,std_y,std_z,count,orientation,label', ups, 0.01 * np.ones((9, 3)),
                50.0 * same, np.arange(9), [f'side {k}' for k in range(9)])
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
def test_times_in_any_unit_become_seconds(name: str, unit: float, start: float, reads: Reads
                                          ) -> None:
    made = samples()
    stamps = [format(stamp, '.19g' if unit == 1.0 else '.0f')
              for stamp in ((made['time'] + start) / unit).tolist()]
    log = reads(f'{name},accX,accY,accZ', stamps, made['reading'])
    np.testing.assert_allclose(log.table['time'] - start, made['time'], atol=2e-6)
    assert '/' in log.read_as
    words = {1e-3: 'ms', 1e-6: 'us µs', 1e-9: 'ns', 1.0: 's'}[unit]
    assert any(word in log.read_as for word in words.split())


@pytest.mark.parametrize('form', ['%Y-%m-%dT%H:%M:%S.%fZ', '%Y-%m-%d %H:%M:%S.%f',
                                  '%Y/%m/%d %H:%M:%S.%f', '%d-%b-%Y %H:%M:%S.%f',
                                  '%Y-%m-%dT%H:%M:%S.%f+00:00', '%H:%M:%S.%f',
                                  '%H:%M:%S:%f'])
def test_dates_become_seconds(form: str, reads: Reads) -> None:
    made = samples()
    start = datetime(2026, 1, 31, 23, 59, 45, tzinfo=timezone.utc).timestamp()
    texts = [datetime.fromtimestamp(start + each, timezone.utc).strftime(form)
             for each in made['time'].tolist()]
    log = reads('Timestamp,AccX,AccY,AccZ', texts, made['reading'])
    check(log, time=made['time'], within_s=2e-6)
    if '%d' in form:
        assert log.table['time'][0] == pytest.approx(start, abs=1e-5)


@pytest.mark.parametrize(('names', 'said'), [
    ('time,ax,ay,az', 'time in s (73 Hz), ax/y/z in m/s2'),
    ('t_ms,acc_x,acc_y,acc_z', 't_ms in ms (73 Hz) -> s, acc_x/y/z in m/s2'),
    ('Time (s),Acceleration x (m/s^2),Acceleration y (m/s^2),Acceleration z (m/s^2)',
     'phyphox format, Time (s) in s (73 Hz), Acceleration x/y/z (m/s^2) in m/s2')])
def test_columns_unit_and_rate_are_said_also_where_gravity_is_lacking(
        names: str, said: str, reads: Reads) -> None:
    reading, in_ms = samples()['reading'], names.startswith('t_ms')
    time = np.round(np.arange(len(reading)) / 73.0, 3) * (1000.0 if in_ms else 1.0)
    assert reads(names, time, reading).read_as == said
    with pytest.raises(InputError, match='gravity removed') as caught:
        reads(names, time, 0.01 * np.random.default_rng(1).normal(size=reading.shape))
    assert said.removesuffix(' in m/s2') in caught.value.read_as
    if sys.version_info >= (3, 11):
        assert caught.value.__notes__ == [f'read as: {caught.value.read_as}']


def test_a_bad_date_is_an_error_with_its_line_or_is_skipped(reads: Reads) -> None:
    reading = samples()['reading']
    dates = [f'2026-01-01T12:{k // 6000:02d}:{k / 100 % 60:05.2f}' for k in range(len(reading))]
    for bad in ('2026-13-45T12:00', '2026-01-01T12:61', 'yesterday'):
        dates[99] = bad
        with pytest.raises(InputError, match=f'row 100.*{bad}'):
            reads('time,accX,accY,accZ', dates, reading)
    log = reads('time,accX,accY,accZ', dates, reading, skip_bad=True)
    assert len(log.table) == len(reading) - 1


@pytest.mark.parametrize(('unit', 'name'), [(1e-6, 't_us'), (1e-3, 'timestamp_ms'),
                                            (1e-6, 'micros'), (1e-6, 'timestamp')])
def test_a_counter_that_starts_again_is_continued_and_noted(unit: float, name: str, reads: Reads
                                                            ) -> None:
    made = samples()
    ticks = np.round((made['time'] - 10.0) / unit).astype(np.int64) % 2**32
    log = reads(f'{name},accX,accY,accZ', ticks, made['reading'], digits='.12g')
    np.testing.assert_allclose(np.diff(log.table['time']), 1.0 / RATE_HZ, atol=2e-6)
    assert any('starts again once' in note for note in log.notes)


def test_stamps_that_jump_back_or_are_far_apart_stay_times_of_samples(reads: Reads) -> None:
    made = samples()
    made['time'][1000:] -= 5.0
    still = np.array([0.1, 0.2, G]) + 0.01 * np.random.default_rng(5).normal(size=(6000, 3))
    few = samples(rest=10, turn=4)['reading']
    for name, stamps, reading, seconds in (
            ('time', made['time'], made['reading'], made['time']),
            ('time', np.arange(6000) * 10.0, still, np.arange(6000) * 10.0),
            ('Time since start in ms', np.arange(len(few)) * 500.0, few,
             np.arange(len(few)) * 0.5)):
        log = reads(f'{name},ax,ay,az', stamps, reading)
        assert isinstance(log.table, Recording)
        np.testing.assert_allclose(log.table['time'], seconds)


@pytest.mark.parametrize(('tick', 'rate_hz'), [(1e-4, 400.0), (1e-4, 60.0), (1e-6, 60.0),
                                               (1e-4, 100.0), (1e-6, 120.0)])
def test_the_clock_of_xsens_is_in_ticks_of_its_own(tick: float, rate_hz: float, reads: Reads
                                                   ) -> None:
    made = samples()
    times = np.arange(len(made['time'])) / rate_hz
    log = reads('PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z', counted(made),
                12_000_000 + np.round(times / tick), made['reading'], digits='.12g')
    check(log, time=times, within_s=tick)
    assert ('100 µs' if tick == 1e-4 else 'SampleTimeFine in µs') in log.read_as


@pytest.mark.parametrize('beside', ['comment', 'seconds', 'counter'])
def test_a_unit_of_time_is_that_which_agrees_with_what_else_the_file_states(
        beside: str, reads: Reads) -> None:
    made = samples()
    times = np.arange(len(made['time'])) / 8.0  # in µs, 100 rows per second would be as plausible
    columns = [np.round(times * 1e3), made['reading']]
    log = {'comment': lambda: reads('stamp,accX,accY,accZ', *columns, before='# Rate: 8 Hz\n'),
           'seconds': lambda: reads('stamp,accX,accY,accZ,elapsed_s_time', *columns, times),
           'counter': lambda: reads('Counter,stamp,accX,accY,accZ', 10 * np.arange(len(times)),
                                    *columns, before='# Rate: 80 Hz\n')}[beside]()
    check(log, time=times, within_s=1e-3)


def test_stamps_that_contradict_the_stated_rate_are_noted(reads: Reads) -> None:
    made = samples()
    for rate, notes in ((100, 0), (400, 1)):
        log = reads('t_ms,accX,accY,accZ', made['time'] * 1e3, made['reading'],
                    before=f'# Sample rate: {rate} Hz\n')
        assert len(log.notes) == notes
    assert re.findall(r'\d+', log.notes[0]) == ['100', '400']


@pytest.mark.parametrize(('header', 'first'), [
    ('Date,Timestamp', '2026-01-31 12:00:00'), ('time,millis', '12:00:{}'), ('time,t_ms', '17'),
    ('Second,stamp', '')])
def test_the_clock_that_runs_finest_is_read(header: str, first: str, reads: Reads) -> None:
    made = samples()
    coarse = [first.format(f'{int(when) % 60:02d}') for when in made['time']]
    log = reads(f'{header},accX,accY,accZ', coarse, np.round(made['time'] * 1e3), made['reading'])
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-3)


def test_seconds_and_nanoseconds_of_ros_are_read_together(reads: Reads) -> None:
    made = samples()
    log = reads('stamp.secs,stamp.nsecs,accX,accY,accZ', np.floor(made['time']),
                np.round(made['time'] % 1.0 * 1e9), made['reading'], digits='.12g')
    np.testing.assert_allclose(log.table['time'], made['time'], atol=1e-8)


def test_the_start_and_the_rate_above_the_samples_of_a_wristband_are_read(reads: Reads) -> None:
    counts = np.round(samples(per_g=64.0)['reading'])
    log = reads('', counts, before='1544027300.000000, 1544027300.000000, 1544027300.000000\n'
                                   '50.0, 50.0, 50.0\n')
    np.testing.assert_allclose(np.diff(log.table['time']), 0.02, atol=1e-9)
    np.testing.assert_array_equal(log.table.reading, counts)


# ------------------------------------------------------------------- samples without times

def counted(made: dict[str, Any], start: int = 65_000, bits: int = 16) -> np.ndarray:
    """Return the numbers of the samples by a counter of this width."""
    return (start + np.arange(len(made['time']))) % 2**bits


@pytest.mark.parametrize('comment', ['// Sample rate: 100.0Hz', '// Update Rate: 100.0Hz',
                                     '# Config: data_rate = 100.0 Hz, filter = 48 Hz',
                                     'Acquisition frequency: 100 Hz',
                                     '--- Data File Created at 100 Hz ---', 'OutputRate:,0.1kHz',
                                     '# fs = 100 Hz', 'Sampling Frequency (Hz): 100',
                                     'Sample rate,100,Hz'])
@pytest.mark.parametrize('name', ['Counter', 'PacketCounter', 'Packet number', ''])
def test_samples_without_times_have_the_rate_that_the_file_states(comment: str, name: str,
                                                                  reads: Reads) -> None:
    made = samples()
    columns = [made['reading'], made['rate']]
    header, kept = 'Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z', np.ones(len(made['time']), bool)
    if name:  # without a counter, no sample is missing
        kept = np.arange(len(kept)) % 37 != 5
        columns, header = [counted(made), *columns], f'{name},{header}'
    log = reads(header, *(column[kept] for column in columns), before=f'{comment}\n')
    assert isinstance(log.table, Recording)
    check(log, time=made['time'][kept])
    assert '100 Hz (stated)' in log.read_as


def test_samples_without_times_need_their_rate(reads: Reads) -> None:
    made = ac.simulate({}, recording=True, poses=8, rate=50.0)
    with pytest.raises(InputError, match='--rate HZ'):
        reads('ax,ay,az', made.reading)
    log = reads('ax,ay,az', made.reading, rate=50.0)
    assert isinstance(log.table, Recording)
    np.testing.assert_allclose(log.table['time'], np.arange(len(made)) / 50.0)
    assert '50 Hz (stated)' in log.read_as
    with pytest.raises(InputError, match='has times, but --rate is 50'):
        reads('time,ax,ay,az', made['time'], made.reading, rate=50.0)


def untimed(kind: str, count: int) -> tuple[str, np.ndarray]:
    """Return the header and the rows of a table without times."""
    rng, ups = np.random.default_rng(2), spread_directions(count)
    lean, turn = np.linspace(-1.4, 1.4, count), np.linspace(0.0, 19.0, count)
    return {
        'poses': lambda: ('ax,ay,az', ac.simulate({}, poses=count).reading),
        'spread': lambda: ('ax,ay,az', G * ups),
        'slowly turned': lambda: ('ax,ay,az', G * np.column_stack(
            [np.cos(lean) * np.cos(turn), np.cos(lean) * np.sin(turn), np.sin(lean)])),
        'marked': lambda: ('ax,ay,az,orientation', np.column_stack([G * ups, np.arange(count)])),
        'with rates': lambda: ('Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z', np.column_stack(
            [G * ups, rng.normal(size=(count, 3))])),
        'of one direction': lambda: (
            'ax,ay,az', np.array([0.1, 0.2, G]) + 0.01 * rng.normal(size=(count, 3))),
        'moving': lambda: ('acc_x[mg],acc_y[mg],acc_z[mg]', np.round(
            1000.0 * (ups + rng.normal(size=(count, 3)))))}[kind]()


@pytest.mark.parametrize(('kind', 'count'), [('poses', 400), ('marked', 1500)])
def test_many_poses_without_times_are_poses(kind: str, count: int, reads: Reads) -> None:
    assert isinstance(reads(*untimed(kind, count)).table, Poses)


@pytest.mark.parametrize(('kind', 'count'), [
    ('with rates', 300), ('with rates', 953), ('of one direction', 300),
    ('of one direction', 953), ('moving', 900), ('spread', 1500), ('slowly turned', 400)])
def test_rows_that_no_person_poses_are_not_taken_for_poses(kind: str, count: int, reads: Reads
                                                           ) -> None:
    with pytest.raises(InputError, match='look like samples'):
        reads(*untimed(kind, count))
    assert isinstance(reads(*untimed(kind, count), rate=50.0).table, Recording)


def test_more_rows_with_times_than_a_person_poses_are_samples(reads: Reads) -> None:
    header, poses = untimed('spread', 1500)
    assert isinstance(reads(f'time,{header}', np.arange(1500) * 5.0, poses).table, Recording)


# ------------------------------------------------------------------------------------ units

@pytest.mark.parametrize(('header', 'per_g', 'units', 'factor'), [
    ('', G, 'm/s2', 1.0), ('', 1.0, 'g', 1.0), ('', 256.0, 'native', 1.0),
    *(('time,accX,accY,accZ', *each) for each in (
        (G, 'm/s2', 1.0), (1.0, 'g', 1.0), (1000.0, 'g', 1e-3), (16384.0, 'native', 1.0),
        (2048.0, 'native', 1.0), (256.0, 'native', 1.0), (0.3, 'native', 1.0)))])
def test_the_unit_is_recognised_at_rest(header: str, per_g: float, units: str, factor: float,
                                        reads: Reads) -> None:
    made = samples(per_g=per_g)
    log = reads(header, made['time'], made['reading'])
    assert log.units.name == units
    check(log, made['reading'] * factor)
    assert units in log.read_as


def test_counts_with_large_offsets_are_native_and_their_scale_is_said(reads: Reads) -> None:
    made = samples(per_g=400.0)
    log = reads('time,x,y,z', made['time'], (made['reading'] + 512).round())
    assert log.units.name == 'native'
    value = float(log.read_as.split(', ')[-1].split(' counts')[0])
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


def test_the_unit_that_the_user_states_goes_first(reads: Reads) -> None:
    made = samples()
    log = reads('t,ax [g],ay [g],az [g]', made['time'], made['reading'], units='m/s2',
                gravity=9.81)
    assert (log.units.name, log.units.per_g) == ('m/s2', 9.81)
    check(log, made['reading'])
    with pytest.raises(InputError, match='is in g, but --units is m/s2'):
        reads('time,ax,ay,az', made['time'], made['reading'], before='# units: "g"\n',
              units='m/s2')


@pytest.mark.parametrize(('header', 'per_g'), [
    ('time,ax,ay,az', G), ('time,ax,ay,az', 1.0), ('Time (s),Linear Acceleration x (m/s^2),'
                                                   'Linear Acceleration y (m/s^2),'
                                                   'Linear Acceleration z (m/s^2)', G),
    ('t,userAccelX(g),userAccelY(g),userAccelZ(g)', 1.0)])
def test_a_log_without_gravity_is_refused_in_those_words(header: str, per_g: float, reads: Reads
                                                         ) -> None:
    rng = np.random.default_rng(7)
    moving = np.abs(samples()['rate']).max(axis=1) > 0.1
    free = 0.004 * rng.normal(size=(len(moving), 3)) + 0.005
    free[moving] += 0.4 * rng.normal(size=(int(moving.sum()), 3))
    for units in ('', 'm/s2' if per_g == G else 'g'):
        with pytest.raises(InputError, match='linear acceleration, gravity removed') as refusal:
            reads(header, np.arange(len(free)) / 100.0, free * per_g, units=units)
        assert 'native' not in str(refusal.value)
        assert 'with g' in refusal.value.advice


@pytest.mark.parametrize(('per_g', 'offset'), [
    (0.02, 0.0), (0.02, 5.0), (0.33, 0.8), (1.0, 0.8), (G, 5.0), (300.0, 0.8), (1000.0, 5.0)])
def test_readings_with_gravity_are_never_taken_for_linear_acceleration(per_g: float, offset: float,
                                                                       reads: Reads) -> None:
    made = samples(int(10 * per_g + offset), per_g)
    reads('time,accX,accY,accZ', made['time'],
          made['reading'] + offset * per_g * np.array([1.0, -0.6, 0.3]))


def test_a_free_fall_is_no_rest(reads: Reads) -> None:
    made = samples()
    made['reading'][200:260] *= 0.01
    assert reads('time,accX,accY,accZ', made['time'], made['reading']).units.name == 'm/s2'


def test_an_acceleration_that_is_free_of_gravity_by_its_name_is_refused(reads: Reads) -> None:
    made = samples()
    given = 't,FreeAcc_X,FreeAcc_Y,FreeAcc_Z', made['time'], made['reading']
    with pytest.raises(InputError, match='FreeAcc_X, FreeAcc_Y, FreeAcc_Z only, linear'):
        reads(*given)
    chosen = {'ax': 'FreeAcc_X', 'ay': 'FreeAcc_Y', 'az': 'FreeAcc_Z'}
    assert reads(*given, columns=chosen).units.name == 'm/s2'


@pytest.mark.parametrize(('free', 'whole'), [
    ('Accelerometer_{}', 'TotalAcceleration_{}'), ('accelerometer_{}', 'totalacceleration_{}'),
    ('acceleration.{}', 'accelerationIncludingGravity.{}'), ('a{}', 'gF{}')])
def test_an_acceleration_with_gravity_by_its_name_goes_before_one_without(
        free: str, whole: str, reads: Reads) -> None:
    made = samples(per_g=1.0 if whole == 'gF{}' else G)
    names = [name.format(axis) for name in (free, whole, 'w{}') for axis in 'xyz']
    log = reads(','.join(('time', *names)), made['time'], 0.3 + 0.01 * made['reading'],
                made['reading'], made['rate'], before='\n')
    check(log, made['reading'])
    np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7, atol=1e-9)
    assert log.units.name == ('g' if whole == 'gF{}' else 'm/s2')
    assert whole.format('x') in log.read_as


@pytest.mark.parametrize('header', ['', 'time,x,y,z'])
def test_numbers_of_which_nothing_says_what_they_are_are_noted(header: str, reads: Reads) -> None:
    made = samples(per_g=48.0)  # the field of the Earth, in µT
    for names, per_g, is_noted in ((header, 48.0, True), ('time,accX,accY,accZ', 48.0, False),
                                   (header, 1.0, False)):
        log = reads(names, made['time'], made['reading'] / 48.0 * per_g)
        assert any('magnetometer' in note for note in log.notes) == is_noted


@pytest.mark.parametrize('header', ['Time (s),W,X,Y,Z', 't,w,x,y,z'])
def test_a_quaternion_is_not_taken_for_an_accelerometer(header: str, reads: Reads) -> None:
    turns = np.random.default_rng(3).normal(size=(400, 4))
    turns /= np.linalg.norm(turns, axis=1)[:, np.newaxis]
    with pytest.raises(InputError, match='expected three of an accelerometer'):
        reads(header, np.arange(400) / 50.0, turns)


# ---------------------------------------------------------------------------------- context

@pytest.mark.parametrize(('names', 'factor', 'said'), [
    ('gyroX_dps,gyroY_dps,gyroZ_dps', 180.0 / np.pi, '°/s -> rad/s'),
    ('gyro_x (rad/s),gyro_y (rad/s),gyro_z (rad/s)', 1.0, 'rad/s'),
    ('GyX,GyY,GyZ', 180.0 / np.pi, '°/s -> rad/s (assumed)'),
    ('gyr_x,gyr_y,gyr_z', 1.0, 'rad/s (assumed)')])
def test_angular_rates_become_rad_per_s(names: str, factor: float, said: str, reads: Reads
                                        ) -> None:
    made = samples()
    log = reads(f'time,accX,accY,accZ,{names}', made['time'], made['reading'],
                made['rate'] * factor)
    np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7)
    assert said in log.read_as


def test_angular_rates_and_temperatures_in_counts_are_not_used_and_noted(reads: Reads) -> None:
    made = samples(per_g=16384.0)
    columns = made['time'], made['reading'], made['rate'] * 7506.0, 2000.0 + made['time']
    log = reads('time,accX,accY,accZ,gyroX,gyroY,gyroZ,temp', *columns)
    own = reads('time,accX,accY,accZ,gx,gy,gz,temp', *columns)
    assert not {'rate', 'temperature'} & {*log.table.columns}
    assert 'rate' not in own.table
    for words in ('gyroX/Y/Z at rest are those of no gyro', 'temp has values of about 20'):
        assert any(words in note for note in log.notes)


@pytest.mark.parametrize('unit', ['rad/s', '°/s'])
@pytest.mark.parametrize('names', ['gx,gy,gz', 'GX,GY,GZ', 'gyroX,gyroY,gyroZ'])
@pytest.mark.parametrize('seed', range(3))
def test_the_unit_of_a_gyro_is_seen_at_rest(unit: str, names: str, seed: int, reads: Reads
                                            ) -> None:
    rng = np.random.default_rng(seed)
    time, per_s = np.arange(1500) / 100.0, 1.0 if unit == 'rad/s' else 180.0 / np.pi
    up = rng.normal(size=3)
    reading = G * up / np.linalg.norm(up) + 0.02 * rng.normal(size=(1500, 3))
    bias, noise = rng.uniform(-0.05, 0.05, 3), np.radians(rng.uniform(0.08, 0.5))
    rate = bias + noise * rng.normal(size=(1500, 3))
    log = reads(f'time,ax,ay,az,{names}', time, reading, rate * per_s)
    np.testing.assert_allclose(log.table['rate'], rate, rtol=1e-6)


@pytest.mark.parametrize('order', [('reading', 'rate'), ('rate', 'reading')])
@pytest.mark.parametrize('seed', range(3))
def test_columns_without_names_have_the_roles_that_their_values_show(
        order: tuple[str, str], seed: int, reads: Reads) -> None:
    made = samples(seed)
    log = reads('', made['time'], *(made[key] for key in order))
    check(log, made['reading'], made['time'])
    np.testing.assert_allclose(log.table['rate'], made['rate'], rtol=1e-7)


@pytest.mark.parametrize('bits', [12, 14, 16])
@pytest.mark.parametrize('seed', range(3))
def test_counts_that_lost_their_sign_are_read_with_it(bits: int, seed: int, reads: Reads) -> None:
    made = samples(seed, per_g=2.0**bits / 4.0)
    counts = np.round(made['reading'])
    log = reads('time,accX,accY,accZ', made['time'], counts % 2.0**bits)
    np.testing.assert_array_equal(log.table.reading, counts)
    middle = counts + 2.0**(bits - 1)  # without a sign, with zero in the middle
    log = reads('time,accX,accY,accZ', made['time'], middle)
    np.testing.assert_array_equal(log.table.reading, middle)


@pytest.mark.parametrize('period', [1.0, 0.2, 64.0])
def test_coarse_stamps_are_spread_over_their_samples(period: float, reads: Reads) -> None:
    made = samples()
    time = made['time'] * period  # so that each stamp has 50 samples
    log = reads('time,ax,ay,az', np.floor(time / period) * period, made['reading'])
    np.testing.assert_allclose(np.diff(log.table['time']), np.diff(time), atol=0.3 / RATE_HZ)


@pytest.mark.parametrize('dated', [True, False])
def test_rows_with_the_newest_first_are_turned_round(dated: bool, reads: Reads) -> None:
    made = samples()
    time = made['time'] + 43_170.0  # through noon
    texts = [(datetime(2026, 1, 31) + timedelta(seconds=each)).strftime('%m/%d/%Y %I:%M:%S.%f %p')
             for each in time.tolist()]
    log = reads('time,ax,ay,az', *(part[::-1] for part in (
        texts if dated else time, made['reading'])))
    check(log, made['reading'], time, within_s=2e-6)


@pytest.mark.parametrize(('name', 'factor', 'zero'), [
    ('temp', 1.0, 0.0), ('Temperature (°C)', 1.0, 0.0), ('temp_f', 1.8, 32.0),
    ('temperature_K', 1.0, 273.15)])
@pytest.mark.parametrize('encoding', ['utf-8', 'cp1252'])
def test_temperatures_become_degrees_celsius(name: str, factor: float, zero: float, encoding: str,
                                             tmp_path: Path) -> None:
    made = samples()
    warm = np.linspace(20.0, 30.0, len(made['time']))
    text = text_of(rows_of(made['time'], made['reading'], warm * factor + zero),
                   f'time,accX,accY,accZ,{name}')
    log = read_log(write(tmp_path, text.encode(encoding)))
    np.testing.assert_allclose(log.table['temperature'], warm, atol=1e-5)


# ------------------------------------------------------------------------------- large logs

def test_a_long_log_is_read_in_blocks_of_flat_memory_as_at_once(tmp_path: Path) -> None:
    block = rows_of(samples(per_g=1000.0, poses=10, rest=400, turn=100)['reading'], digits='.6g')
    peaks = []
    for times in (40, 100):
        lines = [f'{10 * k},{",".join(row)}\n' for k, row in enumerate(block * times)]
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
