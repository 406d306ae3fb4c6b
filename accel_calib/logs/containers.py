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
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack, redirect_stderr, redirect_stdout
import csv
from dataclasses import dataclass
import errno
from functools import partial
import gzip
import io
from itertools import chain, islice
import json
import lzma
import os
from pathlib import Path
import re
import sys
from typing import Any
import zipfile

import numpy as np

from ..errors import InputError
from ..table import ABOUT
from ..text import reason

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_ENCRYPTED = 1
_MOST_BYTES, _MOST_ABOUT = 1 << 29, 1 << 23
"""Largest size of the parts of an Excel file, and of those that are not cells [bytes]."""

_CELLS = re.compile(r'xl/(worksheets|media)/|xl/sharedStrings')
_MOST_ROWS, _MOST_CELLS = 1 << 20, 50_000_000
_SMALL, _LARGEST_RATIO, _NUMBER_BYTES = 2_000_000, 100, 8
"""Numbers that any file may hold, largest ratio of unpacked to packed data, size of a number."""

ROWS = 500
"""Number of rows that are read at once."""

CELL_BYTES = 18
"""Bytes of a number as text, about."""

_PIECE = 1 << 16
_MAGIC = 10

PACKED: Mapping[str, tuple[bytes, Callable[..., Any]]] = {
    '.gz': (rb'\x1f\x8b\x08', gzip.open), '.bz2': (rb'BZh\d1AY&SY', bz2.open),
    '.xz': (rb'\xfd7zXZ\0', lzma.open), '.zst': (rb'\x28\xb5\x2f\xfd', zstd.open)}
"""First bytes of packed files by suffix, and the functions that open them."""

AGAIN = 'copy it again, or export the log as CSV'
UNPACK = 'unpack it, and use the log in it'

_STANDARD_ERROR = 2

_BY_VALUE = (None, errno.EINVAL, errno.EOVERFLOW, errno.EISDIR, errno.EFBIG, errno.ENAMETOOLONG,
             errno.ENOTDIR)
"""System errors that a damaged size or place in a file causes; others are not about its bytes."""

Bytes = Generator[bytes, None, None]


# ------------------------------------------------------------------------------ damage

class DamagedLogError(InputError):
    """A library cannot read a log."""


@contextmanager
def damage_refused(what: str, expected: str, advice: str) -> Iterator[None]:
    """
    Turn what a library raises for damaged bytes into a DamagedLogError.

    Errors of the system, such as a missing file or permission, pass.

    """
    try:
        yield
    except InputError:
        raise
    except Exception as err:  # libraries of logs raise errors of any class
        if isinstance(err, OSError) and err.errno not in _BY_VALUE:
            raise
        raise DamagedLogError(f'{what} ({reason(err)}), expected {expected}', advice) from err


@contextmanager
def sound_log(path: Path, expected: str, advice: str = 'copy it from the vehicle again'
              ) -> Iterator[None]:
    """Refuse damage as `damage_refused` does, and drop what a library prints."""
    with damage_refused(f'{path} is damaged', expected, advice), redirect_stdout(
            io.StringIO()), redirect_stderr(io.StringIO()), _silent_c():
        yield


@contextmanager
def _silent_c() -> Iterator[None]:
    """Drop what C code prints to standard error, which Python cannot redirect."""
    try:
        kept = os.dup(_STANDARD_ERROR)
    except OSError:  # standard error is closed, so nothing is printed
        yield
        return
    try:
        with open(os.devnull, 'wb') as nowhere:
            os.dup2(nowhere.fileno(), _STANDARD_ERROR)
            yield
    finally:
        os.dup2(kept, _STANDARD_ERROR)
        os.close(kept)


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

    def __init__(self, path: Path, expected: str, parts: Bytes) -> None:
        self._parts, self._left = parts, memoryview(b'')
        self._sound = partial(damage_refused, f'{path} is damaged', expected, AGAIN)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        while not self._left:
            with self._sound():
                part = next(self._parts, None)
            if part is None:
                return 0
            self._left = memoryview(part)
        taken, self._left = self._left[:len(buffer)], self._left[len(buffer):]
        buffer[:len(taken)] = taken
        return len(taken)


def most_numbers(path: Path) -> int:
    """Return the largest number of numbers that a file of this size holds."""
    return max(_SMALL, _LARGEST_RATIO * path.stat().st_size // _NUMBER_BYTES)


def _pieces(path: Path, opened: Callable[[], Any]) -> Bytes:
    """Yield the bytes of a file, or of one in it; InputError if they are too many."""
    most = left = CELL_BYTES * most_numbers(path)
    with opened() as file:
        while part := file.read(_PIECE):
            left -= len(part)
            if left < 0:
                raise InputError(f'{path} unpacks to more than {most} bytes, expected at most as '
                                 'many for its size', UNPACK)
            yield part


def text(path: Path, _: ExitStack) -> list[Member]:
    """Return the only table of a file, unpacked if it is packed."""
    with path.open('rb') as file:
        head = file.read(_MAGIC)
    unpack = next((opened for first, opened in PACKED.values() if re.match(first, head)),
                  io.FileIO)
    return [Member('', path.stat().st_size, partial(_pieces, path, partial(unpack, path)))]


def archived(path: Path, stack: ExitStack) -> list[Member]:
    """Return the files of a ZIP archive."""
    archive = stack.enter_context(zipfile.ZipFile(path))
    if any(info.header_offset < 0 for info in archive.infolist()):
        raise zipfile.BadZipFile('a file starts before the archive')
    infos = [info for info in archive.infolist() if not info.is_dir() and not any(
        part.startswith(('.', '__MACOSX')) or part == 'meta'  # phyphox: about the phone
        for part in Path(info.filename).parts)]
    if any(info.flag_bits & _ENCRYPTED for info in infos):
        raise InputError(f'{path} needs a password, expected a ZIP archive without one', UNPACK)
    return [Member(info.filename, info.file_size,
                   partial(_pieces, path, partial(archive.open, info))) for info in infos]


def csv_of(rows: Iterator[Sequence[Any]]) -> Bytes:
    """Yield rows as the bytes of a CSV file."""
    while block := list(islice(rows, ROWS)):
        text = io.StringIO()
        csv.writer(text, lineterminator='\n').writerows(block)
        yield text.getvalue().encode()


# ------------------------------------------------------------------------------------ Excel

def sheets(path: Path, stack: ExitStack) -> list[Member]:
    """Return the sheets of an Excel file (.xlsx)."""
    import openpyxl

    with zipfile.ZipFile(path) as archive:
        sizes = {info: info.file_size for info in archive.infolist()}
    size = sum(sizes.values())
    about = sum(each for info, each in sizes.items() if not _CELLS.match(info.filename))
    if size > _MOST_BYTES or about > _MOST_ABOUT:
        raise InputError(f'{path} unpacks to {size} bytes, {about} of them not of cells, expected '
                         f'at most {_MOST_BYTES} and {_MOST_ABOUT}', AGAIN)
    file = stack.enter_context(path.open('rb'))  # of a path, the suffix would have to be right
    book = openpyxl.load_workbook(file, read_only=True, data_only=True)
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # those that the file states can be wrong
    return [Member(sheet.title, size, partial(_sheet, path, partial(
        sheet.iter_rows, values_only=True))) for sheet in book.worksheets]


def old_sheets(path: Path, _: ExitStack) -> list[Member]:
    """Return the sheets of an Excel file of the old format (.xls)."""
    import xlrd

    book = xlrd.open_workbook(path, ragged_rows=True)

    def rows(sheet: Any) -> Iterator[Sequence[Any]]:
        for k in range(sheet.nrows):
            yield [xlrd.xldate_as_datetime(cell.value, book.datemode)
                   if cell.ctype == xlrd.XL_CELL_DATE else cell.value for cell in sheet.row(k)]

    return [Member(sheet.name, path.stat().st_size, partial(_sheet, path, partial(rows, sheet)))
            for sheet in book.sheets()]


def _sheet(path: Path, rows: Callable[[], Iterator[Sequence[Any]]]) -> Bytes:
    """Yield the rows of a sheet as CSV; all rows have the same number of cells."""
    width = cells = rows_read = 0
    most, left = min(_MOST_CELLS, most_numbers(path)), rows()
    while block := [list(row) for row in islice(left, ROWS)]:
        width = max(width, *map(len, block))
        cells, rows_read = cells + (width + 1) * len(block), rows_read + len(block)
        if cells > most or rows_read > _MOST_ROWS:
            raise InputError(f'{path} has more than {_MOST_ROWS} rows or {most} cells, expected a '
                             'smaller Excel file', AGAIN)
        yield from csv_of(row + [None] * (width - len(row)) for row in block)


# ---------------------------------------------------------------- standard input, DataFrame

class Piped(str):
    """The bytes of a text log that came through standard input; the text is its name."""

    data: bytes

    def __new__(cls, data: bytes) -> Piped:
        made = super().__new__(cls, 'standard input')
        made.data = data
        return made

    def __getnewargs__(self) -> tuple[bytes]:  # type: ignore[override]
        return (self.data,)

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
        """Return the DataFrame as a table."""
        columns = dict(self._columns())
        about = getattr(self.data, 'attrs', {})
        head = ''.join(f'# {name}: {json.dumps(about[name])}\n' for name in ABOUT
                       if about.get(name))

        def lines() -> Bytes:
            cells = [_plain(values) for values in columns.values()]
            yield head.encode()
            yield from csv_of(chain([list(columns)], zip(*cells, strict=True)))

        return Member('', len(columns) * len(self.data) * CELL_BYTES, lines)

    def _columns(self) -> Iterator[tuple[str, Any]]:
        index = getattr(self.data, 'index', None)
        if index is not None and (index.name is not None or index.dtype.kind in 'fMm'):
            yield str(index.name or 'time'), index
        yield from ((str(name), self.data[name]) for name in self.data.columns)


def _plain(values: Any) -> list[Any]:
    """Return a column as numbers or text; dates in UTC, durations in s."""
    is_date = getattr(values.dtype, 'kind', '') == 'M'
    cells = np.asarray(values, 'M8[ns]' if is_date else None)
    if cells.dtype.kind == 'M':
        return np.datetime_as_string(cells).tolist()
    return (cells / np.timedelta64(1, 's') if cells.dtype.kind == 'm' else cells).tolist()
