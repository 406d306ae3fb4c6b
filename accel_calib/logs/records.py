# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Records and arrays in files as tables.

Files of records are JSON, JSON lines, the line protocol of InfluxDB, Parquet and Feather; those of
arrays are NumPy, MATLAB and HDF5.

A record becomes a row, and a key inside another one becomes ``acc.x`` or ``acc[0]``. Records of
several series, such as those of several sensors in one file, are one table per series.

Arrays of one length are the columns of one table if their names are those of an accelerometer.
Otherwise each array is a table, whose columns are read by their order. Structs and timetables of
MATLAB are refused: only MATLAB can convert all of them. No pickled object is read.

"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
import io
from itertools import chain, islice
from pathlib import Path
import re
from typing import Any
import zipfile

import numpy as np
import scipy

from .columns import is_log_header, LogOptions
from .containers import Bytes, CELL_BYTES, csv_of, Member, ROWS
from .dialect import shown
from ..errors import InputError
from ..text import read_json

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


def json_line(line: str) -> tuple[str, Record]:
    """Return the series of a line of JSON, and the record."""
    return _named(read_json(line))


def influx_line(line: str) -> tuple[str, Record]:
    """Return the series of a line in the line protocol of InfluxDB, and the record."""
    found = _INFLUX.fullmatch(line)
    if found is None:
        raise ValueError(f'{line[:40]!r} is no line of InfluxDB')
    record = {key: value.rstrip('iu') for key, value in _FIELD.findall(found[2])}
    return found[1], {'timestamp': found[3], **record}


def lines(parse: Callable[[str], tuple[str, Record]], path: Path, _: ExitStack) -> list[Member]:
    """Return the series of a file of one record per line; a function parses a line."""
    def records() -> Iterator[tuple[str, Record]]:
        with path.open(encoding='utf-8-sig', errors='replace') as file:
            for number, line in enumerate(iter(partial(file.readline, _LONGEST_LINE), ''), 1):
                if line.isspace() or line[0] == '#':
                    continue
                try:
                    yield parse(line)
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

_BY_ORDER = (3, 4, 5, 7, 8)
"""Widths of arrays that are read by the order of their columns."""

_NUMBERS = re.compile(r'double|single|u?int\d+|float\d+|datetime64.*|void\d+')
_EXPORT = 'store arrays of numbers'
_EXPORT_MATLAB = ('write a CSV file in MATLAB: writetimetable(Acceleration, "log.csv"), or '
                  'writematrix for an array')

_Held = tuple[tuple[int, ...], str, Callable[[], Any]]
"""An array in a file: its shape, the kind of its elements, and the function that reads it."""


def matlab(path: Path, _: ExitStack) -> list[Member]:
    """Return the arrays of a MATLAB file up to version 7."""
    try:
        held = scipy.io.whosmat(path)
    except TypeError:  # of scipy, for tables, timetables and other objects
        held = []

    def load(name: str) -> Any:
        return scipy.io.loadmat(path, variable_names=[name])[name]

    return _tables(path, {name: (shape, kind, partial(load, name)) for name, shape, kind in held},
                   _EXPORT_MATLAB)


def hdf5(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of an HDF5 file, such as one of MATLAB 7.3; links are not followed."""
    import h5py

    held: dict[str, _Held] = {}

    def add(name: str, each: Any) -> None:
        if isinstance(each, h5py.Dataset) and name[0] != '#' and not each.external:
            held[name] = (each.shape or (), each.dtype.name, lambda: each[()])

    stack.enter_context(h5py.File(path)).visititems(add)
    return _tables(path, held, _EXPORT)


def of_numpy(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of a NumPy file (.npy, .npz)."""
    files: dict[str, Callable[[], Any]] = {'': partial(path.open, 'rb')}
    if zipfile.is_zipfile(path):
        archive = stack.enter_context(zipfile.ZipFile(path))
        files = {name.removesuffix('.npy'): partial(archive.open, name)
                 for name in archive.namelist()}

    def load(name: str) -> Any:
        with files[name]() as file:
            return np.lib.format.read_array(file, allow_pickle=False)

    held: dict[str, _Held] = {}
    for name, opened in files.items():
        with opened() as file:
            is_first = np.lib.format.read_magic(file) == (1, 0)
            shape, _, dtype = (np.lib.format.read_array_header_1_0 if is_first else
                               np.lib.format.read_array_header_2_0)(file)
        held[name] = (shape, dtype.name, partial(load, name))
    return _tables(path, held, _EXPORT)


def _tables(path: Path, held: Mapping[str, _Held], advice: str) -> list[Member]:
    """Return arrays as tables; InputError without plain arrays."""
    plain = {name: load for name, (shape, kind, load) in held.items()
             if _NUMBERS.fullmatch(kind) and 0 < len(shape) <= 2 and max(shape) > 1}
    if not plain:
        kinds = shown([f'{kind} {name}' for name, (_, kind, _) in held.items()])
        raise InputError(f'{path} holds {kinds or "timetables or other objects"}, expected plain '
                         'arrays of numbers', advice)
    arrays = {}
    for name, load in plain.items():
        values = load()
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
    by_length: dict[int, dict[str, Any]] = {}
    for name, values in arrays.items():
        by_length.setdefault(len(values), {})[name] = values
    for group in by_length.values():
        header = [cell for name, values in group.items() for cell in _names(name, values)]
        alone = len(group) == 1 and len(header) in _BY_ORDER
        if is_log_header(LogOptions(), header) and not alone:
            tables.append(_table(', '.join(group), header, *group.values()))
        else:
            tables += [_table(name, [], values) for name, values in group.items()
                       if values.shape[1] in _BY_ORDER]
    return tables or [_table(name, _names(name, values), values)
                      for name, values in arrays.items()]


def _names(name: str, values: Any) -> list[str]:
    """Return the names of the columns of an array; none for a name that is empty."""
    width = values.shape[1] if name else 0
    ends = {1: [''], 3: ['_x', '_y', '_z']}.get(width, [f'_{k + 1}' for k in range(width)])
    return [f'{name}{end}' for end in ends]


def _table(name: str, header: list[str], *arrays: Any) -> Member:
    table = np.hstack([values.astype(float) for values in arrays])
    rows = [header] if header else []
    return Member(name, table.size * CELL_BYTES, lambda: csv_of(chain(rows, table.tolist())))
