# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables in files: text, packed or not, ZIP archives, sheets of Excel; standard input, DataFrames.

phyphox and Sensor Logger export a ZIP archive with one CSV file for each sensor, and phyphox an
Excel file with one sheet for each. Each table is a `Member`: the bytes of a CSV file, piece by
piece, so that it is read as any other text log is. `accel_calib.logs.records`
makes members of other files.

"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
import csv
from dataclasses import dataclass
from functools import partial
import gzip
import io
from itertools import chain, islice
import json
import lzma
from pathlib import Path
import re
import sys
from typing import Any
import zipfile

import numpy as np

from .child import LogFile
from ..errors import InputError
from ..table import ABOUT
from ..text import some

ROWS = 500
"""Number of rows that are read at once."""

CELL_BYTES = 18
"""Bytes of a number as text, about."""

_PIECE, _ENCRYPTED = 1 << 16, 1


def _open_zstd(path: Path) -> Any:
    """Open a file with the zstd of Python 3.14, or with that which `rosbags` needs before."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd.open(path)


PACKED: Mapping[str, tuple[bytes, Callable[..., Any]]] = {
    '.gz': (rb'\x1f\x8b\x08', gzip.open), '.bz2': (rb'BZh\d1AY&SY', bz2.open),
    '.xz': (rb'\xfd7zXZ\0', lzma.open), '.zst': (rb'\x28\xb5\x2f\xfd', _open_zstd)}
"""First bytes of packed files by suffix, and the functions that open them."""

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


class Stream(io.RawIOBase):
    """The bytes of a table as a file; damaged bytes are an InputError."""

    def __init__(self, file: LogFile, parts: Bytes) -> None:
        self._file, self._parts, self._left = file, parts, memoryview(b'')

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        while not self._left:
            with self._file.refused():
                part = next(self._parts, None)
            if part is None:
                return 0
            self._left = memoryview(part)
        taken, self._left = self._left[:len(buffer)], self._left[len(buffer):]
        buffer[:len(taken)] = taken
        return len(taken)


def _pieces(opened: Callable[[], Any]) -> Bytes:
    """Yield the bytes of a file, or of one in it."""
    with opened() as file:
        yield from iter(partial(file.read, _PIECE), b'')


def text(path: Path, _: ExitStack) -> list[Member]:
    """Return the only table of a file, unpacked if it is packed."""
    with path.open('rb') as file:
        head = file.read(10)
    unpack = next((opened for first, opened in PACKED.values() if re.match(first, head)),
                  io.FileIO)
    return [Member('', path.stat().st_size, partial(_pieces, partial(unpack, path)))]


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


# ---------------------------------------------------------------- standard input, DataFrame

class Piped(str):
    """The bytes of a text log that came through standard input; the text is its name."""

    data: bytes

    def __new__(cls, data: bytes) -> Piped:
        made = super().__new__(cls, 'standard input')
        made.data = data
        return made

    @property
    def table(self) -> Member:
        """Return the log as a table."""
        return Member('', len(self.data), lambda: (part for part in (self.data,)))


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
            yield from csv_of(chain([list(columns)], zip(*parts, strict=True)))

        return Member('', len(columns) * len(self.data) * CELL_BYTES, lines)
