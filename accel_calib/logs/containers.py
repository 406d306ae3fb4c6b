# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables in files, DataFrames and standard input, each as the bytes of a CSV file.

Each table is a `Member`: its bytes come piece by piece, so that it is read as any other text log
is. Files of text can be packed. phyphox and Sensor Logger export a ZIP archive with one CSV file
for each sensor, and phyphox an Excel file with one sheet for each. Files of records are JSON, JSON
lines, the line protocol of InfluxDB, Parquet and Feather; those of arrays are NumPy, MATLAB and
HDF5.

A record becomes a row, and a key inside another one becomes ``acc.x`` or ``acc[0]``. Records of
several series, such as those of several sensors in one file, are one table per series.

Arrays of one length are the columns of one table if their names are those of an accelerometer.
Otherwise each array is a table, whose columns are read by their order. Structs and timetables of
MATLAB are refused: only MATLAB can convert all of them. No pickled object is read.

"""

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
import csv
from dataclasses import dataclass
from functools import partial
from importlib import import_module
import io
from itertools import chain, islice
import json
from pathlib import Path
import re
from typing import Any
import zipfile

import numpy as np
import scipy

from .bag import ZSTD
from .child import LogFile
from .columns import BY_ORDER, is_log_header, LogOptions, shown
from ..errors import InputError
from ..table import ABOUT
from ..text import read_json, some

ROWS = 500
"""Number of rows that are read at once."""

CELL_BYTES = 18
"""Bytes of a number as text, about."""

_PIECE, _ENCRYPTED = 1 << 16, 1


PACKED: Mapping[str, tuple[bytes, str]] = {
    '.gz': (rb'\x1f\x8b\x08', 'gzip'), '.bz2': (rb'BZh\d1AY&SY', 'bz2'),
    '.xz': (rb'\xfd7zXZ\0', 'lzma'), '.zst': (rb'\x28\xb5\x2f\xfd', ZSTD)}
"""First bytes of packed files by suffix, and the modules that open them."""

UNPACK = 'unpack it, and use the log in it'

Bytes = Generator[bytes, None, None]


# ------------------------------------------------------------------------------ tables

@dataclass(frozen=True)
class Member:
    """
    A table of a file: its name, its size [bytes, estimated], its bytes from the start.

    The name is empty if the file has no other table.

    """

    name: str
    size: int
    parts: Callable[[], Bytes]


@dataclass(eq=False)
class Stream(io.RawIOBase):
    """The bytes of a table as a file; damaged bytes are an InputError."""

    file: LogFile
    parts: Bytes
    left: memoryview = memoryview(b'')

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        while not self.left:
            with self.file.refused():
                part = next(self.parts, None)
            if part is None:
                return 0
            self.left = memoryview(part)
        taken, self.left = self.left[:len(buffer)], self.left[len(buffer):]
        buffer[:len(taken)] = taken
        return len(taken)


def _pieces(opened: Callable[[], Any]) -> Bytes:
    """Yield the bytes of a file, or of one in it."""
    with opened() as file:
        yield from iter(partial(file.read, _PIECE), b'')


def text(path: Path, _: ExitStack) -> list[Member]:
    """Return the only table of a file."""
    return [_unpacked(partial(path.open, 'rb'), path.stat().st_size)]


def _unpacked(opened: Callable[[], Any], size: int) -> Member:
    """Return the only table of a file that a function opens; unpacked if it is packed."""
    def unpacked() -> Any:
        file = opened()
        packed = next((module for first, module in PACKED.values()
                       if re.match(first, file.peek(10))), None)
        return file if packed is None else import_module(packed).open(file)

    return Member('', size, partial(_pieces, unpacked))


def archived(path: Path, stack: ExitStack) -> list[Member]:
    """Return the files of a ZIP archive."""
    archive = stack.enter_context(zipfile.ZipFile(path))
    if any(info.flag_bits & _ENCRYPTED for info in archive.infolist()):
        raise InputError(f'{path} needs a password, expected a ZIP archive without one', UNPACK)
    return [Member(info.filename, info.file_size, partial(_pieces, partial(archive.open, info)))
            for info in archive.infolist() if not info.is_dir() and not any(
                part.startswith(('.', '__MACOSX')) or part == 'meta'  # phyphox: about the phone
                for part in Path(info.filename).parts)]


def csv_of(rows: Iterator[Sequence[Any]]) -> Bytes:
    """Yield rows as the bytes of a CSV file."""
    while block := list(islice(rows, ROWS)):
        text = io.StringIO()
        csv.writer(text, lineterminator='\n').writerows(block)
        yield text.getvalue().encode(errors='replace')  # half of a pair is no text in UTF-8


# ------------------------------------------------------------------------------------ Excel

def sheets(path: Path, stack: ExitStack) -> list[Member]:
    """Return the sheets of an Excel file (.xlsx)."""
    import openpyxl

    file = stack.enter_context(path.open('rb'))  # of a path, the suffix would have to be right
    book = openpyxl.load_workbook(file, read_only=True, data_only=True)
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # those that the file states can be wrong
    return [Member(sheet.title, path.stat().st_size, partial(_sheet, partial(
        sheet.iter_rows, values_only=True))) for sheet in book.worksheets]


def old_sheets(path: Path, _: ExitStack) -> list[Member]:
    """Return the sheets of an Excel file of the old format (.xls)."""
    import xlrd

    book = xlrd.open_workbook(path, ragged_rows=True)

    def rows(sheet: Any) -> Iterator[Sequence[Any]]:
        for k in range(sheet.nrows):
            yield [xlrd.xldate_as_datetime(cell.value, book.datemode)
                   if cell.ctype == xlrd.XL_CELL_DATE else cell.value for cell in sheet.row(k)]

    return [Member(sheet.name, path.stat().st_size, partial(_sheet, partial(rows, sheet)))
            for sheet in book.sheets()]


def _sheet(rows: Callable[[], Iterator[Sequence[Any]]]) -> Bytes:
    """Yield the rows of a sheet as CSV; all rows have the same number of cells."""
    width, left = 0, rows()
    while block := [list(row) for row in islice(left, ROWS)]:
        width = max(width, *map(len, block))
        yield from csv_of(row + [None] * (width - len(row)) for row in block)


# ---------------------------------------------------------------------- JSON, InfluxDB

_MOST_BYTES, _LONGEST_LINE = 1 << 25, 1 << 20
"""Largest JSON file that is read as a whole [bytes], and longest line of a record [characters]."""

_SERIES = ('sensor', 'topic', 'type', 'measurement')
"""Keys whose text names the series of a record."""

_INFLUX = re.compile(r'((?:\\.|[^\\\s])+) +((?:"(?:\\.|[^"\\])*"|\\.|[^\\\s"])+)(?: +(-?\d+))?\s*')
_FIELD = re.compile(r'((?:\\.|[^\\,=])+)=("(?:\\.|[^"\\])*"|[^,]*)')

Record = Mapping[str, Any]


def json_document(path: Path, _: ExitStack) -> list[Member]:
    """Return the tables of a JSON file: lists of records, and objects of columns."""
    size = path.stat().st_size
    if size > _MOST_BYTES:
        raise InputError(f'{path} has {size} bytes, expected a JSON file of at most {_MOST_BYTES}',
                         'store one record per line (JSON lines)')
    with path.open(encoding='utf-8-sig') as file:
        return list(_in_json('', read_json(file.read()), size))


def _in_json(name: str, held: Any, size: int) -> Iterator[Member]:
    if isinstance(held, list) and held and isinstance(held[0], dict):
        yield from _series(name, size, lambda: map(_named, held))
    elif isinstance(held, list) and held and isinstance(held[0], list):
        yield Member(name, size, lambda: csv_of(iter(held)))
    elif isinstance(held, dict):
        lengths: dict[int, dict[str, Sequence[Any]]] = {}
        for key, value in held.items():
            is_column = isinstance(value, dict) and not any(
                isinstance(each, dict | list) for each in value.values())  # as pandas writes it
            cells = list(value.values()) if is_column else value
            if isinstance(cells, list) and cells and not isinstance(cells[0], dict):
                lengths.setdefault(len(cells), {})[key] = cells
            else:
                yield from _in_json(f'{name}.{key}' if name else key, value, size)
        for columns in lengths.values():
            rows = [('', dict(zip(columns, row))) for row in zip(*columns.values())]
            yield from _series(name or ', '.join(columns), size, partial(iter, rows))


def _named(record: Record) -> tuple[str, Record]:
    """Return the series of a record, and the record; ValueError if it is none."""
    if not isinstance(record, dict):
        raise ValueError(f'{str(record)[:40]} is no record')
    names = (record.get(key) for key in _SERIES)
    return next((name for name in names if isinstance(name, str)), ''), record


def lines(kind: str, path: Path, _: ExitStack) -> list[Member]:
    """Return the series of a file of one record per line: 'json', or 'influx' of InfluxDB."""
    def records() -> Iterator[tuple[str, Record]]:
        with path.open(encoding='utf-8-sig', errors='replace') as file:
            for number, line in enumerate(iter(partial(file.readline, _LONGEST_LINE), ''), 1):
                if line.isspace() or line[0] == '#':
                    continue
                try:
                    if kind == 'json':
                        yield _named(read_json(line))
                    elif found := _INFLUX.fullmatch(line):
                        cells = {key: text.rstrip('iu') for key, text in _FIELD.findall(found[2])}
                        yield found[1], {'timestamp': found[3], **cells}
                    else:
                        raise ValueError(f'{line[:40]!r} is no line of InfluxDB')
                except ValueError as err:
                    if line.endswith('\n'):  # only the last line can be cut
                        raise InputError(f'{path}: line {number} is no record ({err}), expected '
                                         'one per line', 'correct the line or remove it') from err

    return list(_series('', path.stat().st_size, records))


def _series(name: str, size: int, records: Callable[[], Iterator[tuple[str, Record]]]
            ) -> Iterator[Member]:
    """Yield a table for each of the series of the first 4000 records."""
    for series in dict.fromkeys(each for each, _ in islice(records(), 4000)):
        yield Member('.'.join(filter(None, (name, series))), size, partial(_rows, series, records))


def _rows(series: str, records: Callable[[], Iterator[tuple[str, Record]]]) -> Bytes:
    """Yield the records of a series as CSV; the columns are those of the first ones."""
    flat = (dict(_flat('', record)) for each, record in records() if each == series)
    head = list(islice(flat, ROWS))
    names = list(dict.fromkeys(name for record in head for name in record))
    yield from csv_of(chain([names], (
        [record.get(name) for name in names] for record in chain(head, flat))))


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values inside a value with their names: ``acc.x``, ``acc[0]``."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _flat(f'{name}.{key}' if name else key, each)
    elif isinstance(value, list):
        for k, each in enumerate(value):
            yield from _flat(f'{name}[{k}]', each)
    else:
        yield name, value


# -------------------------------------------------------------------------- Parquet, Feather

def columnar(kind: str, path: Path, _: ExitStack) -> list[Member]:
    """Return the table of a Parquet or Feather file; columns of text and lists are left out."""
    from pyarrow import csv, dataset, Table, types

    held = dataset.dataset(str(path), format=kind)
    names = [field.name for field in held.schema
             if types.is_primitive(field.type) or types.is_struct(field.type)]
    dates = [field.name for field in held.schema
             if types.is_timestamp(field.type) and field.name.startswith('__index')]  # of pandas

    def parts() -> Bytes:
        batches = held.to_batches(columns=names, batch_size=ROWS, use_threads=False)
        for k, batch in enumerate(batches):
            table = Table.from_batches([batch]).rename_columns(
                ['time' if name in dates else name for name in names]).flatten()
            csv.write_csv(table, text := io.BytesIO(), csv.WriteOptions(include_header=not k))
            yield text.getvalue()

    return [Member('', path.stat().st_size, parts)]


# -------------------------------------------------------------------------- NumPy, MATLAB, HDF5

_NUMBERS = re.compile(r'double|single|u?int\d+|float\d+|datetime64.*|void\d+')
_EXPORT = 'store arrays of numbers'
_EXPORT_MATLAB = ('write a CSV file in MATLAB: writetimetable(Acceleration, "log.csv"), or '
                  'writematrix for an array')

_Held = Mapping[str, tuple[tuple[int, ...], str]]
"""The arrays in a file by name: their shapes, and the kinds of their elements."""


def matlab(path: Path, _: ExitStack) -> list[Member]:
    """Return the arrays of a MATLAB file up to version 7."""
    try:
        held = scipy.io.whosmat(path)
    except TypeError:  # of scipy, for tables, timetables and other objects
        held = []
    return _tables(path, {name: (shape, kind) for name, shape, kind in held}, lambda name: (
        scipy.io.loadmat(path, variable_names=[name])[name]), _EXPORT_MATLAB)


def hdf5(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of an HDF5 file, such as one of MATLAB 7.3; links are not followed."""
    import h5py

    found: dict[str, Any] = {}
    stack.enter_context(h5py.File(path)).visititems(
        lambda name, each: found.update({name: each}))
    return _tables(path, {
        name: (each.shape or (), each.dtype.name) for name, each in found.items()
        if isinstance(each, h5py.Dataset) and name[0] != '#' and not each.external
    }, lambda name: found[name][()], _EXPORT)


def of_numpy(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of a NumPy file (.npy, .npz)."""
    files: dict[str, Callable[[], Any]] = {'': partial(path.open, 'rb')}
    if zipfile.is_zipfile(path):
        archive = stack.enter_context(zipfile.ZipFile(path))
        files = {name.removesuffix('.npy'): partial(archive.open, name)
                 for name in archive.namelist()}
    held = {}
    for name, opened in files.items():
        with opened() as file:
            is_first = np.lib.format.read_magic(file) == (1, 0)
            shape, _, dtype = (np.lib.format.read_array_header_1_0 if is_first else
                               np.lib.format.read_array_header_2_0)(file)
        held[name] = shape, dtype.name
    return _tables(path, held, lambda name: np.lib.format.read_array(
        stack.enter_context(files[name]()), allow_pickle=False), _EXPORT)


def _tables(path: Path, held: _Held, load: Callable[[str], Any], advice: str) -> list[Member]:
    """Return arrays, which a function loads, as tables; InputError without plain arrays."""
    plain = [name for name, (shape, kind) in held.items()
             if _NUMBERS.fullmatch(kind) and 0 < len(shape) <= 2 and max(shape) > 1]
    if not plain:
        kinds = shown([f'{kind} {name}' for name, (_, kind) in held.items()])
        raise InputError(f'{path} holds {kinds or "timetables or other objects"}, expected plain '
                         'arrays of numbers', advice)
    arrays = {}
    for name in plain:
        values = load(name)
        for field in values.dtype.names or ('',):  # of records
            column = values[field] if field else values
            if column.dtype.kind == 'M':  # dates in s since 1970
                column = column.astype('M8[ns]').astype(np.int64) / 1e9
            if column.dtype.kind in 'iuf':
                column = column if column.ndim == 2 else column[:, np.newaxis]
                is_wide = column.shape[0] < column.shape[1]  # with one column per sample
                arrays['/'.join(filter(None, (name, field)))] = column.T if is_wide else column
    # Arrays of one length together, or each alone if their names tell no accelerometer.
    tables: list[Member] = []
    names: dict[str, list[str]] = {}  # of the columns of each array; none for a name that is empty
    by_length: dict[int, dict[str, Any]] = {}
    for name, values in arrays.items():
        width = values.shape[1] if name else 0
        ends = {1: [''], 3: ['_x', '_y', '_z']}.get(width, [f'_{k + 1}' for k in range(width)])
        names[name] = [f'{name}{end}' for end in ends]
        by_length.setdefault(len(values), {})[name] = values
    for group in by_length.values():
        header = [cell for name in group for cell in names[name]]
        alone = len(group) == 1 and len(header) in BY_ORDER
        if is_log_header(LogOptions(), header) and not alone:
            tables.append(_table(', '.join(group), header, *group.values()))
        else:
            tables += [_table(name, [], values) for name, values in group.items()
                       if values.shape[1] in BY_ORDER]
    return tables or [_table(name, names[name], values) for name, values in arrays.items()]


def _table(name: str, header: list[str], *arrays: Any) -> Member:
    table = np.hstack([values.astype(float) for values in arrays])
    rows = [header] if header else []
    return Member(name, table.size * CELL_BYTES, lambda: csv_of(chain(rows, table.tolist())))


# ---------------------------------------------------------------- standard input, DataFrame

class Piped(str):
    """The bytes of a log that came through standard input; the text is its name."""

    data: bytes

    def __new__(cls, data: bytes) -> 'Piped':
        made = super().__new__(cls, 'standard input')
        made.data = data
        return made

    @property
    def table(self) -> Member:
        """Return the log as a table."""
        return _unpacked(lambda: io.BufferedReader(io.BytesIO(self.data)), len(self.data))


@dataclass(frozen=True)
class Frame:
    """
    A DataFrame that is read as a log; the text of it is its name in messages.

    Its index is a column if it has a name, or holds dates or fractions, which are then times. The
    unit, the sensor and the autopilot are read from ``attrs``, where
    `accel_calib.table.Table.to_dataframe` puts them.

    """

    data: Any

    def __str__(self) -> str:
        return 'the DataFrame'

    @property
    def table(self) -> Member:
        """Return the DataFrame as a table; InputError if two columns have one name."""
        if twice := [each for each, count in Counter(self.data.columns).items() if count > 1]:
            raise InputError(f'{self} has several columns {some(twice)}, expected one of each',
                             'remove or rename the others')
        columns = {str(name): self.data[name] for name in self.data.columns}
        are_names = not all(isinstance(name, int) for name in self.data.columns)
        index, about = getattr(self.data, 'index', None), getattr(self.data, 'attrs', {})
        if index is not None and (index.name is not None or index.dtype.kind in 'fMm'):
            columns = {str(index.name or 'time'): index, **columns}
        head = ''.join(f'# {name}: {json.dumps(about[name], default=str)}\n' for name in ABOUT
                       if isinstance(about.get(name), str | Mapping) and about[name])

        def lines() -> Bytes:
            yield head.encode()
            parts = []
            for values in columns.values():
                is_date = getattr(values.dtype, 'kind', '') == 'M'
                cells = np.asarray(values, 'M8[ns]' if is_date else None)
                if cells.dtype.kind == 'M':
                    cells = np.datetime_as_string(cells)  # in UTC
                elif cells.dtype.kind == 'm':
                    cells = cells / np.timedelta64(1, 's')
                parts.append(cells.tolist())
            names = [list(columns)] if are_names else []  # numbers would be read as a row
            yield from csv_of(chain(names, zip(*parts, strict=True)))

        return Member('', len(columns) * len(self.data) * CELL_BYTES, lines)
