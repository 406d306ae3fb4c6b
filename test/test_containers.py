# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Logs in ZIP archives, Excel files and MATLAB files are read as their tables are."""

from collections.abc import Callable, Mapping
import datetime
from pathlib import Path
import struct
from typing import Any
import zipfile

from accel_calib.errors import InputError
from accel_calib.logs import LogOptions
from accel_calib.table import Recording
from inside import read_log
import numpy as np
import openpyxl
import pytest
import scipy.io
from test_logs import check, rows_of, samples, text_of, write

PHYPHOX = '"Time (s)","Acceleration x (m/s^2)","Acceleration y (m/s^2)","Acceleration z (m/s^2)"'
LINEAR = PHYPHOX.replace('Acceleration', 'Linear Acceleration')
GYRO = '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
LOGGER = 'time,seconds_elapsed,z,y,x'

Tables = Mapping[str, str]


def short() -> dict[str, np.ndarray]:
    return samples(rest=60, turn=20)


def tables_of(makers: str) -> tuple[dict[str, str], np.ndarray]:
    """Return the tables of an app's export, and the readings with gravity."""
    time, reading, rate = short().values()
    free = 0.02 * rate  # as if of the hand that turns the phone
    if makers == 'phyphox':
        return {'Linear Accelerometer': text_of(rows_of(time, free), LINEAR),
                'Gyroscope': text_of(rows_of(time, rate), GYRO),
                'Accelerometer': text_of(rows_of(time, reading), PHYPHOX),
                'meta/device': 'property,value\nversion,1.1\n'}, reading

    def logger(values: np.ndarray) -> str:
        return text_of(rows_of(1.7e18 + 1e9 * time, time, values[:, ::-1]), LOGGER)

    return {'Accelerometer': logger(free),
            'Gravity': logger(reading), 'Gyroscope': logger(rate),
            'Magnetometer': logger(5.0 * reading), 'Metadata': 'version,device\n3,phone\n',
            'TotalAcceleration': logger(reading)}, reading


def raw(folder: Path, content: tuple[str, bytes]) -> Path:
    return write(folder, content[1], content[0])


def zipped(folder: Path, tables: Tables, name: str = 'log.zip',
           method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(folder / name, 'w', method) as archive:
        for each, text in tables.items():
            archive.writestr(f'{each}.csv', text)
    return folder / name


def stored(folder: Path, tables: Tables) -> Path:
    return zipped(folder, tables, 'log.csv', zipfile.ZIP_STORED)


def matlab(folder: Path, held: Mapping[str, Any]) -> Path:
    scipy.io.savemat(folder / 'log.mat', held, do_compression=True)
    return folder / 'log.mat'


def rows_in(text: str) -> list[list[Any]]:
    cells = [[cell.strip('"') for cell in line.split(',')] for line in text.splitlines()]
    return [cells[0], *([float(cell) for cell in row] for row in cells[1:])]


def excel(path: Path, tables: Mapping[str, list[list[Any]]]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.active)
    for name, rows in tables.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(row)
    book.save(path)
    return path


PACKED = {'zip': zipfile.ZIP_DEFLATED, 'bz2 zip': zipfile.ZIP_BZIP2, 'lzma zip': zipfile.ZIP_LZMA}


def written(kind: str, folder: Path, tables: Tables) -> Path:
    if kind in PACKED:
        return zipped(folder, tables, method=PACKED[kind])
    if kind == 'stored zip':
        return stored(folder, tables)
    sheets = {name.replace('/', ' '): rows_in(text) for name, text in tables.items()
              if name not in ('meta/device', 'Metadata')}
    return excel(folder / 'log.xlsx', sheets)


@pytest.mark.parametrize('kind', ['zip', 'stored zip', 'xlsx'])
@pytest.mark.parametrize('maker', ['phyphox', 'sensor-logger'])
def test_the_table_of_the_accelerometer_in_an_export_is_read_and_named(
        maker: str, kind: str, tmp_path: Path) -> None:
    tables, reading = tables_of(maker)
    log = read_log(written(kind, tmp_path, tables))
    assert isinstance(log.table, Recording)
    check(log, reading)
    name = 'Accelerometer' if maker == 'phyphox' else 'TotalAcceleration'
    assert log.read_as.startswith(f'{name}.csv, ' if 'zip' in kind else f'{name}, ')
    assert log.units.name == 'm/s2'


@pytest.mark.parametrize('kind', ['zip', 'xlsx'])
def test_of_two_accelerometers_one_is_chosen_by_its_name(kind: str, tmp_path: Path) -> None:
    made, header = short(), 'time,accX,accY,accZ'
    path = written(kind, tmp_path, {
        'left': text_of(rows_of(made['time'], made['reading']), header),
        'right': text_of(rows_of(made['time'], -made['reading']), header)})
    end = '.csv' if kind == 'zip' else ''
    with pytest.raises(InputError,
                       match=f'left{end}, right{end}, expected one.*--topic "left{end}"'):
        read_log(path)
    check(read_log(path, LogOptions(topic=f'right{end}')), -made['reading'])
    with pytest.raises(InputError, match='no table up, expected one of left'):
        read_log(path, LogOptions(topic='up'))


def test_dates_of_a_sheet_are_times_and_blank_rows_at_its_end_are_left_out(tmp_path: Path) -> None:
    made, start = short(), datetime.datetime(2026, 1, 31, 12)
    rows = [[start + datetime.timedelta(seconds=round(at, 3)), *row] for at, row in
            zip(made['time'].tolist(), made['reading'].tolist(), strict=True)]
    log = read_log(excel(tmp_path / 'log.xlsx', {
        'S': [['time', 'ax', 'ay', 'az'], *rows, *[[None] * 4] * 3]}))
    check(log, made['reading'], made['time'], within_s=2e-3)


@pytest.mark.parametrize('form', ['columns', 'rows', 'three', 'one', 'alone'])
def test_plain_arrays_of_matlab_are_read(form: str, tmp_path: Path) -> None:
    made = short()
    time, reading = made['time'], made['reading']
    held = {'columns': {'t': time[:, np.newaxis], 'acc': reading, 'gyr': made['rate'],
                        'mag': 5.0 * reading, 'rate_hz': 100.0, 'name': 'a phone'},
            'rows': {'t': time, 'acc': reading.T},
            'three': {'t': time, **dict(zip(('ax', 'ay', 'az'), reading.T, strict=True))},
            'one': {'data': np.column_stack([time, reading])},
            'alone': {'t': time[:7], 'acc': reading}}[form]
    options = LogOptions(rate=100.0) if form == 'alone' else LogOptions()
    log = read_log(matlab(tmp_path, held), options)
    check(log, reading, time)
    assert ('rate' in log.table) == (form == 'columns')


def encrypted(folder: Path, tables: Tables) -> Path:
    path = zipped(folder, tables)
    data = bytearray(path.read_bytes())
    for mark, at in ((b'PK\x03\x04', 6), (b'PK\x01\x02', 8)):
        data[data.index(mark) + at] |= 1
    return raw(folder, (path.name, data))


# A file of level 5: the array flag 17 (opaque), as MATLAB Mobile saves its timetables.
OPAQUE = (struct.pack('<IIII', 6, 8, 17, 0) + struct.pack('<II', 1, 12)
          + b'Acceleration'.ljust(16, b'\0') + struct.pack('<II', 1, 4) + b'MCOS'.ljust(8, b'\0')
          + struct.pack('<II', 1, 9) + b'timetable'.ljust(16, b'\0'))
TIMETABLE = (b'MATLAB 5.0 MAT-file'.ljust(124) + struct.pack('<H2s', 0x100, b'IM')
             + struct.pack('<II', 14, len(OPAQUE)) + OPAQUE)
VERSION_7_3 = b'MATLAB 7.3 MAT-file, Platform: GLNXA64'.ljust(512) + b'\x89HDF\r\n\x1a\n'
BLACKBOX = (b'H Product:Blackbox flight data recorder by Nicholas Sherlock\n'
            b'H Data version:2\nH Field I name:loopIteration,time,accSmooth[0]\n\0\1\2')
ONE = {'acc': 'time,ax,ay,az\n0,0,0,9.8\n'}
FLIGHTS = ({'flight': 'ULog\x01\x12\x35'},
           {'flight': 'FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n'})


@pytest.mark.parametrize(('write', 'content', 'words'), [
    (zipped, {'gyro': f'{GYRO}\n0,0,0,0\n', 'baro': 't,p\n0,1\n'},
     'gyro.csv, baro.csv, expected one of an acc'),
    (zipped, {'meta/time': 'a,b\n'}, 'holds 0 tables'),
    (encrypted, ONE, 'needs a password'),
    *((write, flight, 'holds flight.csv, an? .* log.*unpack it')
      for write in (zipped, stored) for flight in FLIGHTS),
    (matlab, {'log': {'acc': np.ones((9, 3))}},
     'holds struct log, expected plain arrays.*writetimetable'),
    (matlab, {'name': 'phone'}, 'holds char name, expected plain arrays'),
    (matlab, {'gyr': np.ones((9, 2))}, 'ax, ay, az'),
    (raw, ('sensorlog.mat', TIMETABLE), 'expected plain arrays.*writetimetable'),
    (raw, ('log.mat', VERSION_7_3), 'is damaged .*expected an HDF5 file'),
    *((raw, (name, BLACKBOX), f'decode it with blackbox_decode {name}')
      for name in ('LOG00001.BFL', 'btfl.bbl', 'LOG.TXT'))])
def test_a_container_without_a_table_to_read_is_refused_with_what_to_do(
        write: Callable[[Path, Any], Path], content: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        read_log(write(tmp_path, content))


def test_the_damage_of_a_sheet_is_stated_although_there_are_others(tmp_path: Path) -> None:
    tables, _ = tables_of('phyphox')
    path = written('xlsx', tmp_path, {**tables, 'Metadata Time': 'a,b\n1,2'})
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, 'w') as archive:
        for name, data in parts.items():
            archive.writestr(name, data.replace(b'<row r="9"', b'<row<'))
    with pytest.raises(InputError, match='is damaged.* expected an Excel file'):
        read_log(path)
