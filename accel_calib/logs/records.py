# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Records in files as tables: JSON, JSON lines, the line protocol of InfluxDB, Parquet and Feather.

A record becomes a row, and a key inside another one becomes ``acc.x`` or ``acc[0]``. Records of
several series, such as those of several sensors in one file, are one table per series.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
import io
from itertools import chain, islice
import json
from pathlib import Path
import re
from typing import Any

from .containers import Bytes, csv_of, Member, most_numbers, ROWS
from ..errors import InputError

_MOST_BYTES, _LONGEST_LINE = 1 << 25, 1 << 20
"""Largest JSON file that is read as a whole [bytes], and longest line of a record [characters]."""

_FIRST_RECORDS = 4000
"""Number of first records whose series are known."""

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
        return list(_in_json('', json.load(file), size))


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
    return _named(json.loads(line))


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
    """Yield a table for each of the series of records."""
    for series in dict.fromkeys(each for each, _ in islice(records(), _FIRST_RECORDS)):
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
    count, most = held.count_rows() * len(names), most_numbers(path)
    if count > most:
        raise InputError(f'{path} holds {count} numbers, expected at most {most} for its size',
                         'export the log as CSV')

    def parts() -> Bytes:
        batches = held.to_batches(columns=names, batch_size=ROWS, use_threads=False)
        for k, batch in enumerate(batches):
            table = Table.from_batches([batch]).rename_columns(
                ['time' if name in dates else name for name in names]).flatten()
            csv.write_csv(table, text := io.BytesIO(), csv.WriteOptions(include_header=not k))
            yield text.getvalue()

    return [Member('', path.stat().st_size, parts)]
