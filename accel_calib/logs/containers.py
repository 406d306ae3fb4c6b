# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Files that hold several tables: ZIP archives, sheets of Excel, and arrays of MATLAB; DataFrames.

phyphox and Sensor Logger export a ZIP archive with one CSV file for each sensor, and phyphox an
Excel file with one sheet for each. The table of the accelerometer, or a DataFrame, is handed over
as the bytes of a CSV file, piece by piece, so that it is read as any other text log is. Structs
and timetables of MATLAB are refused: only MATLAB can convert all of them.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass
from datetime import date, datetime, time
from functools import partial
import io
from itertools import chain, islice
import json
import lzma
from pathlib import Path
import re
from typing import Any
import zipfile
import zlib

import numpy as np
import scipy

from .columns import Chosen, chosen, is_log_header, LogOptions
from .dialect import shown
from .formats import (
    BLACKBOX, DamagedLogError, FLIGHT_LOG, HEAD, MATLAB, MATLAB_HDF5, OLE, sound_log)
from .names import meaning, READING, record_instead
from .text import open_text, TextTable
from ..errors import InputError, needing
from ..table import ABOUT
from ..text import reason

_WORKBOOK = 'xl/workbook.xml'

_ENCRYPTED = 1
_MOST_TABLES = 500
_MOST_BYTES, _MOST_ABOUT = 1 << 29, 1 << 23
"""Largest size of the parts of an Excel file, and of those that are not cells [bytes]."""

_CELLS = re.compile(r'xl/(worksheets|media)/|xl/sharedStrings')
_MOST_ROWS, _MOST_CELLS = 1 << 20, 50_000_000
_SMALL, _LARGEST_RATIO, _NUMBER_BYTES = 2_000_000, 100, 8
"""Numbers that any file may hold, largest ratio of unpacked to packed data, size of a number."""

_ROWS = 500
"""Number of rows of a sheet that are read at once."""

_CELL_BYTES = 18
"""Bytes of a number as text, about."""

_BY_ORDER = (3, 4, 5, 7, 8)
"""Widths of arrays that are read by the order of their columns."""

_AGAIN = 'export the log as CSV'
_UNPACK = 'unpack it, and use the log in it'
_EXPORT_MATLAB = ('write a CSV file in MATLAB: writetimetable(Acceleration, "log.csv"), or '
                  'writematrix for an array')
_NUMBERS = {'double', 'single', *(f'{sign}int{bits}' for sign in ('', 'u')
                                  for bits in (8, 16, 32, 64))}


@dataclass(frozen=True)
class Member:
    """A table in a container: its name, its size [bytes, estimated], its bytes from the start."""

    name: str
    size: int
    opened: Callable[[], Any]

    @contextmanager
    def text(self, path: Path, options: LogOptions) -> Iterator[TextTable]:
        """Open the table; errors as in `open_text`."""
        with self.opened() as file, open_text(
                path / self.name, lambda cells: is_log_header(cells, options),
                stream=(file, self.size)) as text:
            yield text


class _Stream(io.RawIOBase):
    """The bytes of an iterator as a file."""

    def __init__(self, parts: Iterator[bytes]) -> None:
        self._parts, self._left = parts, b''

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any, /) -> int:
        while not self._left:
            part = next(self._parts, None)
            if part is None:
                return 0
            self._left = part
        taken, self._left = self._left[:len(buffer)], self._left[len(buffer):]
        buffer[:len(taken)] = taken
        return len(taken)


@contextmanager
def open_table(path: Path, head: bytes, options: LogOptions) -> Iterator[tuple[str, TextTable]]:
    """
    Open a container, and yield the name of its table with the accelerometer, and the table.

    `options.topic` can name it; raise InputError if there is none, or several. Tables of linear
    acceleration come last, and tables whose names say that they are of an accelerometer first.

    """
    with _members_of(path, head) as members:
        member = _member_of(path, members, options)
        with member.text(path, options) as text:
            yield member.name, text


@contextmanager
def _members_of(path: Path, head: bytes) -> Iterator[Sequence[Member]]:
    if head.startswith(BLACKBOX):
        raise InputError(f'{path} is a log of the blackbox as the flight controller wrote it, '
                         'expected its CSV file', f'decode it with blackbox_decode {path.name}')
    if head.startswith(MATLAB_HDF5):
        raise InputError(f'{path} is a MATLAB file of version 7.3, expected version 7 or older',
                         f'save it with save(file, "-v7"), or {_EXPORT_MATLAB}')
    if head.startswith(OLE):
        yield _old_sheets(path)
    elif head.startswith(MATLAB) or path.suffix == '.mat':
        yield _arrays(path)
    else:
        with _sound_archive(path), zipfile.ZipFile(path) as archive:
            if any(info.header_offset < 0 for info in archive.infolist()):
                raise zipfile.BadZipFile('a file starts before the archive')
            excel = _WORKBOOK in archive.namelist()
            yield from (_sheets(path, archive) if excel else [_files(path, archive)])


def _member_of(path: Path, members: Sequence[Member], options: LogOptions) -> Member:
    names = [member.name for member in members]
    wanted = [member for member in members if options.topic in ('', member.name)]
    if not 0 < len(names) <= _MOST_TABLES:
        raise InputError(f'{path} holds {len(names)} tables, expected 1 to {_MOST_TABLES}',
                         'check that this is the intended file')
    if not wanted:
        raise InputError(f'{path} has no table {options.topic}, expected one of {shown(names)}',
                         f'name one of these with --topic "{names[0]}"')
    tables, refused = _tables(path, wanted, options)
    if not tables:
        damaged = [err for err in refused if isinstance(err, DamagedLogError)]
        if damaged or len(wanted) == 1:
            raise (damaged or refused)[0]
        raise InputError(f'{path} has the tables {shown(names)}, expected one of an accelerometer',
                         'export the table of the accelerometer, with gravity, or name one with '
                         f'--topic "{names[0]}" to see why it is not read')
    left = _preferred(tables)
    if len(left) > 1:
        raise InputError(f'{path} has {len(left)} tables of accelerometers, '
                         f'{shown([member.name for member in left])}, expected one',
                         f'choose one with --topic "{left[0].name}"')
    return left[0]


def _tables(path: Path, members: Sequence[Member], options: LogOptions
            ) -> tuple[dict[Member, Chosen], list[InputError]]:
    """Return the tables that have the columns of an accelerometer, and why others have not."""
    tables, refused = {}, []
    for member in members:
        try:
            with member.text(path, options) as text:
                tables[member] = chosen(text.layout, options)
        except InputError as err:
            refused.append(err)
    return tables, refused


def _preferred(tables: Mapping[Member, Chosen]) -> list[Member]:
    """Return the tables of accelerometers by their names, as far as the names tell."""
    ranks = {member: (not record_instead(columns.layout.header, columns.layout.path),
                      _is_named(member, columns)) for member, columns in tables.items()}
    return [member for member in tables if ranks[member] == max(ranks.values())]


def _is_named(member: Member, columns: Chosen) -> bool:
    names = [Path(member.name).stem, *columns.names(READING[:1])]
    return any(meaning(name).quantity == 'reading' or 'accel' in name.casefold()
               for name in names)


def _most_numbers(path: Path) -> int:
    """Return the largest number of numbers that a file of this size holds."""
    return max(_SMALL, _LARGEST_RATIO * path.stat().st_size // _NUMBER_BYTES)


# ----------------------------------------------------------------------------- ZIP archives

@contextmanager
def _sound_archive(path: Path) -> Iterator[None]:
    try:
        yield
    except (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError,
            OSError) as err:
        if isinstance(err, OSError) and err.errno is not None:
            raise  # only damaged bytes of bz2 have no number
        raise InputError(f'{path} cannot be unpacked ({reason(err)}), expected a ZIP archive',
                         f'copy it again, or {_UNPACK}') from err


def _files(path: Path, archive: zipfile.ZipFile) -> list[Member]:
    infos = [info for info in archive.infolist() if not info.is_dir() and not any(
        part.startswith(('.', '__MACOSX')) or part == 'meta'  # phyphox: about the phone
        for part in Path(info.filename).parts)]
    if any(info.flag_bits & _ENCRYPTED for info in infos):
        raise InputError(f'{path} needs a password, expected a ZIP archive without one',
                         _UNPACK)
    return [Member(info.filename, info.file_size, partial(_unpacked, path, archive, info))
            for info in infos]


def _unpacked(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Any:
    """Open a file of an archive; InputError if it is a flight log."""
    file: Any = archive.open(info)
    if FLIGHT_LOG.search(file.peek(HEAD)[:HEAD]):
        raise InputError(f'{path} holds the flight log {info.filename}, expected a table',
                         _UNPACK)
    return file


# ------------------------------------------------------------------------------------ Excel

def _sheets(path: Path, archive: zipfile.ZipFile) -> Iterator[Sequence[Member]]:
    size = sum(info.file_size for info in archive.infolist())
    about = sum(info.file_size for info in archive.infolist() if not _CELLS.match(info.filename))
    if size > _MOST_BYTES or about > _MOST_ABOUT:
        raise InputError(f'{path} unpacks to {size} bytes, {about} of them not of cells, expected '
                         f'at most {_MOST_BYTES} and {_MOST_ABOUT}', _AGAIN)
    with needing('openpyxl', 'an Excel file (.xlsx)'):
        import openpyxl
    with path.open('rb') as file:  # of a path, the suffix would have to be right
        with sound_log(path, 'an Excel file (.xlsx)', _AGAIN):
            book = openpyxl.load_workbook(file, read_only=True, data_only=True)
            for sheet in book.worksheets:
                sheet.reset_dimensions()  # those that the file states can be wrong
        yield [Member(sheet.title, size, partial(
            _rows, path, partial(sheet.iter_rows, values_only=True))) for sheet in book.worksheets]


def _old_sheets(path: Path) -> list[Member]:
    with needing('xlrd', 'an Excel file (.xls)'):
        import xlrd
    with sound_log(path, 'an Excel file (.xls)', _AGAIN):
        book = xlrd.open_workbook(path, ragged_rows=True)

    def rows(sheet: Any) -> Iterator[Sequence[Any]]:
        for k in range(sheet.nrows):
            yield [xlrd.xldate_as_datetime(cell.value, book.datemode)
                   if cell.ctype == xlrd.XL_CELL_DATE else cell.value for cell in sheet.row(k)]

    return [Member(sheet.name, path.stat().st_size, partial(_rows, path, partial(rows, sheet)))
            for sheet in book.sheets()]


def _rows(path: Path, rows: Callable[[], Iterator[Sequence[Any]]]) -> _Stream:
    return _Stream(_csv(_padded(path, rows())))


def _csv(rows: Iterator[Sequence[Any]]) -> Iterator[bytes]:
    while block := list(islice(rows, _ROWS)):
        text = io.StringIO()
        csv.writer(text, lineterminator='\n').writerows(block)
        yield text.getvalue().encode()


def _padded(path: Path, rows: Iterator[Sequence[Any]]) -> Iterator[list[str]]:
    """Yield the rows of a sheet as text; all rows have the same number of cells."""
    width = cells = rows_read = 0
    most = min(_MOST_CELLS, _most_numbers(path))
    while True:
        with sound_log(path, 'an Excel file', _AGAIN):
            block = [[_cell(value) for value in row] for row in islice(rows, _ROWS)]
        if not block:
            return
        width = max(width, *map(len, block))
        cells, rows_read = cells + (width + 1) * len(block), rows_read + len(block)
        if cells > most or rows_read > _MOST_ROWS:
            raise InputError(f'{path} has more than {_MOST_ROWS} rows or {most} cells, expected a '
                             'smaller Excel file', _AGAIN)
        yield from ([*row, *[''] * (width - len(row))] for row in block)


def _cell(value: object) -> str:
    if isinstance(value, (datetime, date, time)):
        return value.isoformat()
    return '' if value is None else str(value)


# ----------------------------------------------------------------------------------- MATLAB

def _arrays(path: Path) -> list[Member]:
    """Return the arrays of a ``.mat`` file as tables; those of one length are columns of one."""
    with sound_log(path, 'a MATLAB file (.mat)', _AGAIN):
        try:
            held = scipy.io.whosmat(path)
        except TypeError:  # of scipy, for tables, timetables and other objects
            held = []
        plain = [name for name, shape, kind in held
                 if kind in _NUMBERS and len(shape) == 2 and max(shape) > 1]
        size = sum(int(np.prod(shape)) for name, shape, _ in held if name in plain)
        most = _most_numbers(path)
        found = scipy.io.loadmat(path, variable_names=plain) if 0 < size <= most else {}
    if not found:
        kinds = shown([f'{kind} {name}' for name, _, kind in held])
        raise InputError(f'{path} holds {kinds or "timetables or other objects"}, expected plain '
                         f'arrays of at most {most} numbers', _EXPORT_MATLAB)
    arrays = {name: values.T if values.shape[0] < values.shape[1] else values
              for name in plain if (values := found[name]).dtype.kind in 'iuf'}
    return [_array_table(name, group) for name, group in _groups(arrays).items()]


def _groups(arrays: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return arrays of one length together, or each alone if their names tell no accelerometer."""
    groups: dict[str, dict[str, Any]] = {}
    by_length: dict[int, dict[str, Any]] = {}
    for name, values in arrays.items():
        by_length.setdefault(len(values), {})[name] = values
    for group in by_length.values():
        header = [cell for name, values in group.items() for cell in _names(name, values)]
        if is_log_header(header, LogOptions()):
            groups[', '.join(group)] = group
        else:
            groups |= {name: {'': values} for name, values in group.items()
                       if values.shape[1] in _BY_ORDER}
    return groups or {name: {name: values} for name, values in arrays.items()}


def _names(name: str, values: Any) -> list[str]:
    """Return the names of the columns of an array; none for a name that is empty."""
    width = values.shape[1] if name else 0
    ends = {1: [''], 3: ['_x', '_y', '_z']}.get(width, [f'_{k + 1}' for k in range(width)])
    return [f'{name}{end}' for end in ends]


def _array_table(name: str, group: Mapping[str, Any]) -> Member:
    header = [cell for each, values in group.items() for cell in _names(each, values)]
    table = np.hstack([values.astype(float) for values in group.values()])
    rows = [header] if header else []
    return Member(name, table.size * _CELL_BYTES,
                  lambda: _Stream(_csv(chain(rows, table.tolist()))))


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
        """Return the log as a table of a container."""
        return Member('', len(self.data), lambda: io.BytesIO(self.data))


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
        """Return the DataFrame as a table of a container."""
        columns = dict(self._columns())
        about = getattr(self.data, 'attrs', {})
        head = ''.join(f'# {name}: {json.dumps(about[name])}\n' for name in ABOUT
                       if about.get(name))

        def lines() -> Iterator[bytes]:
            cells = [_plain(values) for values in columns.values()]
            yield head.encode()
            yield from _csv(chain([list(columns)], zip(*cells, strict=True)))

        size = len(columns) * len(self.data) * _CELL_BYTES
        return Member('', size, lambda: _Stream(lines()))

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
