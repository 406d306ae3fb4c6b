# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A small log in each format is read as it was written, or refused with what converts it."""

import bz2
from collections.abc import Callable
from datetime import datetime, timezone
from functools import partial
import gzip
import json
import lzma
from pathlib import Path
import sys
from typing import Any
import zipfile

from accel_calib.errors import InputError
from accel_calib.fleet import recordings
from accel_calib.logs import FORMATS, LogOptions, SUFFIXES
from bag_files import zstd
from inside import read_log
import numpy as np
import pytest
import shared
from test_logs import check, rows_of, samples, text_of, write

h5py = pytest.importorskip('h5py')
pa = pytest.importorskip('pyarrow')
feather, parquet = pytest.importorskip('pyarrow.feather'), pytest.importorskip('pyarrow.parquet')

START_S = 1_780_000_000
MADE = samples(poses=8, rest=40, turn=10)
MADE['time'] = np.round(MADE['time'], 3)
MADE['reading'] = np.round(MADE['reading'], 3)
TIME, READING = MADE['time'], MADE['reading']
COUNTS = np.round(READING / 9.80665 * 8192.0)
ROWS = list(zip(TIME.tolist(), READING.tolist(), strict=True))
TABLE = text_of(rows_of(TIME, READING), 'time,accX,accY,accZ').encode()
RECORDS = [{'t': t, 'imu': {'acc': dict(zip('xyz', row, strict=True)), 'ok': True}, 'note': None}
           for t, row in ROWS]
RATE = LogOptions(rate=100.0)


def json_lines(records: Any) -> bytes:
    return ''.join(f'{json.dumps(record)}\n' for record in records).encode()


def influx(t: float, row: list[float], series: str = 'imu,sensor=a') -> str:
    fields = ','.join(f'a{axis}={value}' for axis, value in zip('xyz', row, strict=True))
    return f'{series} {fields} {round((START_S + t) * 1e9)}\n'


def lines(form: str, values: np.ndarray = READING) -> bytes:
    return ''.join(form.format(*row, t=t) for (t, _), row in zip(
        ROWS, values.tolist(), strict=True)).encode()


def arrow(write: Callable[..., None], path: Path) -> None:
    dates = pa.array([datetime.fromtimestamp(START_S + t, timezone.utc) for t in TIME])
    acc = pa.StructArray.from_arrays([pa.array(row) for row in READING.T], names=list('xyz'))
    write(pa.table({'when': pa.array(['x'] * len(TIME)), '__index_level_0__': dates, 'acc': acc}),
          str(path))


def hdf5(path: Path) -> None:
    with h5py.File(path, 'w') as file:
        file['imu/acc'], file['imu/t'] = READING, TIME
        file['imu/gyr'], file['about'] = MADE['rate'], 'a phone'


def fields(path: Path) -> None:
    made = np.zeros(len(TIME), [('t', '<f8'), ('accel', '<f4', 3)])
    made['t'], made['accel'] = TIME, READING
    np.save(path, made)


def archive(path: Path, **members: bytes) -> None:
    with zipfile.ZipFile(path, 'w') as file:
        for name, data in members.items():
            file.writestr(name.replace('_', '.'), data)


# Name, content or function that writes it, and the readings, if they are not those in m/s².
READ: list[tuple[str, Any, Any]] = [
    ('log.csv.gz', gzip.compress(TABLE), None), ('log.bz2', bz2.compress(TABLE), None),
    ('log.csv.xz', lzma.compress(TABLE), None), ('log.zst', zstd.compress(TABLE), None),
    ('three.npy', partial(np.save, arr=READING), RATE),
    ('four.npy', partial(np.save, arr=np.column_stack([TIME, READING])), None),
    ('fields.npy', fields, None),
    ('named.npz', partial(np.savez_compressed, t=TIME, acc=READING, rate=100.0,
                          about=np.array(['a'])), None),
    ('log.parquet', partial(arrow, parquet.write_table), None),
    ('log.feather', partial(arrow, feather.write_feather), None),
    ('log.h5', hdf5, None), ('log.json', json.dumps(RECORDS, indent=1).encode(), None),
    ('columns.json', json.dumps({'about': {'rate': 100}, 'data': {
        't': TIME.tolist(), 'acc': READING.tolist()}}).encode(), None),
    ('rows.json', json.dumps([['t', 'ax', 'ay', 'az'], *([t, *row] for t, row in ROWS)]).encode(),
     None),
    ('pandas.json', json.dumps({name: dict(enumerate(column.tolist())) for name, column in zip(
        ('t', 'ax', 'ay', 'az'), (TIME, *READING.T), strict=True)}).encode(), None),
    ('cut.jsonl', json_lines(RECORDS) + b'{"t": 9', None),
    ('lists.log', json_lines({'t': t, 'acc': row} for t, row in ROWS), None),
    ('influx.lp', ''.join(influx(t, row) for t, row in ROWS).encode(), None),
    ('plotter.txt', lines('ax: {} ay: {} az: {}\n'), RATE),
    ('units.txt', lines('aX: {} m/s^2 aY: {} m/s^2 aZ: {} m/s^2\n'), RATE),
    ('names.txt', lines('x {} y {} z {}\n'), RATE),
    ('three.txt', lines('X: {}\nY: {}\nZ: {}\n'), RATE),
    ('four.txt', b'ready\n' + lines('t= {t}\nax= {}\nay= {}\naz= {}\n\n'), None),
    ('raw.txt', lines('Raw:{:.0f},{:.0f},{:.0f},3,-5,12,300,0,-217\n', COUNTS),
     LogOptions(rate=100.0, units='native')),
    ('uni.txt', lines('Raw:{:.0f},{:.0f},{:.0f},3,-5,12,300,0,-217\nUni:1,1,1,1,1,1,1,1,1\n',
                      COUNTS), LogOptions(rate=100.0, units='native')),
    ('gcdc.csv', b';Title, X16\n;SampleRate, 100,Hz\n;Deadband, 0, counts\n;Headers, time,Ax,Ay,'
     b'Az\n' + lines('{t},{:.0f},{:.0f},{:.0f}\n', COUNTS), LogOptions(units='native'))]


FRAME = b'\x55\x51' + bytes(8) + b'\x03' + b'\x55\x52' + bytes(8) + b'\x04'
SHIMMER = bytearray(256)
SHIMMER[30:37] = b'\0\x03\0\0\0\x02\0'
NILSPOD = bytes([52, 20, 3, 0, 5, 0x40, 0, 1, 16, 16]) + bytes(300)

# Name, content, and words of the refusal.
REFUSED: list[tuple[str, Any, str]] = [
    ('log.gt3x', partial(archive, info_txt=b'', log_bin=b''), 'ActiLife'),
    ('log.bin', b'Device Identity\r\nDevice Type:GENEActiv\r\n' + bytes(99), 'GENEActiv software'),
    ('log.cwa', b'MD\xfc\x03' + bytes(99), 'OmGui'), ('log.xdf', b'XDF:' + bytes(99), 'pyxdf'),
    ('log.IDE', b'\x1aE\xdf\xa3' + bytes(99), 'enDAQ Lab'), ('000', bytes(SHIMMER), 'pyshimmer'),
    ('wit.bin', b'\0\x01' + 9 * FRAME, 'WitMotion software'), ('n.bin', NILSPOD, 'nilspodlib'),
    ('log.tlog', bytes(8) + b'\xfe' + bytes(99), 'mavlogdump.py .* log.tlog'),
    ('log.bbl', b'H Product:Blackbox flight data recorder', 'blackbox_decode log.bbl'),
    ('log.yaml', b'format: accel_calib calibration', 'is a calibration'),
    ('log.mat.gz', gzip.compress(b'MATLAB 5.0 MAT-file'), 'holds log.mat, a MATLAB file.*unpack'),
    ('log.zip', partial(archive, a_mat=b'MATLAB 5.0 MAT-file'), 'holds a.mat, a MATLAB file'),
    ('log.csv.gz', gzip.compress(TABLE)[:-30], 'is damaged'),
    ('log.csv.zst', zstd.compress(TABLE)[:900], 'is damaged'),
    ('log.npy', partial(np.save, arr=np.array([{}]), allow_pickle=True), 'holds object, .*plain'),
    ('log.json', b'[{"a": 1}]' + bytes(1 << 25), 'JSON file of at most'),
    ('deep.json', b'[[1, ' + b'[' * 100_000, 'is damaged'),
    ('cut.json', b'[{"a": 1}, {', 'is damaged'),
    ('log.jsonl', b'{"t": 1}\n{"t": 2}\nx\n{"t": 3}\n', 'line 3 is no record')]


@pytest.mark.parametrize(('name', 'content', 'words'), REFUSED, ids=[name for name, *_ in REFUSED])
def test_what_is_not_read_is_refused_with_what_converts_it_and_little_memory(
        name: str, content: Any, words: str, tmp_path: Path) -> None:
    path = write(tmp_path, content, name)
    with shared.little_memory(), pytest.raises(InputError, match=words) as found:
        read_log(path)
    assert str(path) in found.value.message


# Formats that other tests write: bags, flight logs, archives, Excel, MATLAB.
ELSEWHERE = {'.mcap', '.ulg', '.bin', '.log', '.xlsx', '.xls', '.zip', '.mat', '.csv'}


def test_every_format_is_tested_and_fleet_finds_what_is_read(tmp_path: Path) -> None:
    tested = {Path(name).suffix.lower() for name, *_ in (*READ, *REFUSED)} | ELSEWHERE
    assert not [each.name for each in FORMATS if each.suffixes and not {*each.suffixes} & tested]
    names = [f'log{suffix}' for suffix in SUFFIXES]
    for name in (*names, 'notes.md', 'log.tlog'):
        (tmp_path / name).touch()
    assert sorted(each.inside for each in recordings([str(tmp_path)])) == sorted(names)


@pytest.mark.parametrize(('name', 'module'), [('log.h5', 'h5py'), ('log.feather', 'pyarrow')])
def test_a_missing_library_is_named(name: str, module: str, tmp_path: Path,
                                    monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, next(content for each, content, _ in READ if each == name), name)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f'needs it .*pip install {module}'):
        read_log(path)


def test_the_series_of_a_file_are_tables_and_the_one_that_is_read_is_noted(tmp_path: Path) -> None:
    gyro = [influx(t, [0.0, 0.0, 0.0], 'imu,sensor=b').replace('a', 'g') for t, _ in ROWS]
    text = ''.join(influx(t, row) + other for (t, row), other in zip(ROWS, gyro, strict=True))
    log = read_log(write(tmp_path, text, 'log.txt'))
    check(log, READING)
    assert log.read_as.startswith('imu,sensor=a, ')
    assert log.notes == ('imu,sensor=a is read of 2 tables: no other one has an accelerometer',)
    both = [{'sensor': name, 't': t, 'a': row} for t, row in ROWS for name in ('left', 'right')]
    with pytest.raises(InputError, match='2 tables of accelerometers, left, right, expected one'):
        read_log(write(tmp_path, json.dumps(both), 'log.json'))


@pytest.mark.parametrize(('name', 'poses'), [('arrays.npz', 14), ('gcdc_x16.csv', 14)])
def test_logs_of_others_become_poses(name: str, poses: int, tmp_path: Path,
                                     capsys: pytest.CaptureFixture[str]) -> None:
    path = shared.data(f'logs/{name}')
    _, made = shared.run_json(capsys, 'capture', path, '-o', tmp_path / 'poses.csv')
    assert made['poses'] == poses


@pytest.mark.parametrize(('name', 'content', 'options'), READ, ids=[name for name, *_ in READ])
def test_a_log_is_read_as_it_was_written(name: str, content: Any, options: LogOptions | None,
                                         tmp_path: Path) -> None:
    log = read_log(write(tmp_path, content, name), options or LogOptions())
    native = options is not None and options.units == 'native'
    np.testing.assert_allclose(log.table.reading, COUNTS if native else READING, rtol=1e-6)
    check(log, time=TIME, within_s=1e-6)
