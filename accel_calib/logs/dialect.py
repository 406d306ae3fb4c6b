# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Dialect of a text table: where the table begins, how its cells are parted, what its dates are.

`layout_of` decides from the first lines of a file, its head. `csv.Sniffer` is not used: it needs
many equal rows, and takes a letter, a decimal mark or a blank for the delimiter. The delimiter
here is that of a header line with known names, or else the one whose cells are numbers in most
lines.

Dates are those of ISO 8601, ``2026-01-31T12:00:00.250Z``, with a blank for the T or slashes, and
``31-Jan-2026`` and ``31.01.2026``. A date without a zone is taken as UTC.

"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from functools import lru_cache
from itertools import product
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..table import ABOUT, Autopilot, Floats
from ..text import counted, read_json, some
from ..units import UNIT_NAMES

DELIMITERS = (';', '\t', '|', ',', '')
"""Delimiters in the order of preference; the empty one is any run of blanks."""

_DELIMITER_WORDS = {'\t': 'tab', '': 'blanks', '|': "'|'", ';': "';'"}
_TRIED_LINES = 200
"""Number of lines from which the delimiter and the decimal mark are found, and of the rows in
`Layout.sample`."""

_RATE = re.compile(
    r'(?:rate|frequency|\bodr|\bfs|\bat)\b(?:[^\w\n]{0,12}(\d+(?:\.\d+)?)[ ,;\t]?(k?)Hz\b|'
    r'\W{1,2}(k?)Hz\W{1,6}(\d+(?:\.\d+)?)\b)', re.ASCII | re.IGNORECASE)
"""Rate of the samples in the lines before a table: ``Sample rate: 50.0Hz``, ``fs (Hz): 100``."""

_MONITOR = re.compile(r'^(\d{1,2}:\d{2}:\d{2}(?:\.\d+)?) -> ')
"""Time that the serial monitor of the Arduino IDE puts before a line."""

_LABEL = re.compile(r'(?:^|(?<=[\s,;|]))[A-Za-z_][A-Za-z_0-9 .]*?(?:\s*[:=]\s*|\s+)(?=[-+.\d])')
"""Name before a number, as the serial plotter of the Arduino IDE has it: ``ax:0.01``, ``x 1``."""

_LABELLED_UNIT = re.compile(r'(?<=[\d.]) *(?:m?g|m/s(?:\^?2|²|/s)|(?:°|deg|rad)/s|dps|°?C)'
                            r'(?=[\s,;|]|$)')
"""Unit after a number with a name."""

_MOTIONCAL = re.compile(r'Raw:(?:-?\d+,){8}-?\d+\s*')
_MOTIONCAL_NAMES = ('accX', 'accY', 'accZ', *6 * ('',))
"""Names of the counts that the sketches for MotionCal print; those of gyro and magnetometer have
no unit."""

_NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?', re.ASCII)
_LIKE_NUMBER = re.compile(r'[-+]?(?:(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|nan|inf)',
                          re.ASCII | re.IGNORECASE)
_DECIMAL = re.compile(r'[-+]?\d*([.,])\d+(?:[eE][-+]?\d+)?', re.ASCII)
_UNREADABLE = re.compile('[\x00-\x08\x0e-\x1a\x1c-\x1f\x7f\ufffd]')
_SHOWN_CHARACTERS = 40
_EXAMPLE = 'such as time,ax,ay,az and one row for each pose or sample'

RATES_HZ = (1.0, 10_000.0)
"""Plausible numbers of samples per second."""

EPOCH_S = (1e9, 4e9)
"""Unix times from 2001 to 2096 [s]."""

CLOCK = re.compile(
    r'(?:(\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}-[A-Za-z]{3}-\d{4}|\d{1,2}[./]\d{1,2}[./]\d{4})'
    r',?[T ])?(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d+))?)? ?([AaPp]\.?[Mm]\.?)? ?'
    r'(Z|UTC|[-+]\d{2}(?::?\d{2})?)?', re.ASCII)
"""Date, which may be absent, and time of the day."""

_DAYS = ('%Y-%m-%d', '%d-%b-%Y', '%d.%m.%Y', '%m-%d-%Y', '%d-%m-%Y')

IsHeader = Callable[[Sequence[str]], bool]


@dataclass(frozen=True)
class Dialect:
    """
    How the cells of a table are parted; an empty delimiter is any run of blanks.

    `monitor`: each line begins with the time of a serial monitor. `labelled`: each number follows
    its name. `prefix`: begin of the lines that are rows, and `marks`: those of lines that are not.

    """

    delimiter: str
    monitor: bool = False
    labelled: bool = False
    prefix: str = ''
    marks: tuple[str, ...] = ('#', '//', '%')

    def is_row(self, line: str) -> bool:
        """Return whether a line can be a row."""
        return not (line.startswith(self.marks) or line.isspace()) and self.prefix in line

    def cells(self, line: str) -> list[str]:
        """
        Return the cells of a line, without quotes and blanks around them, and without names.

        The time of a monitor is the first cell.

        """
        delimiter = self.delimiter
        if self.monitor:
            line = _MONITOR.sub(lambda found: found[1] + (delimiter or ' '), line)
        line = line.removeprefix(self.prefix)
        if self.labelled:
            line = _LABEL.sub('', _LABELLED_UNIT.sub('', line))
        cells = line.split(delimiter or None)
        if '"' in line:
            with suppress(csv.Error):  # A cell is longer than 131,072 characters.
                cells = next(csv.reader(
                    [line], delimiter=delimiter or ' ', skipinitialspace=True), [])
        return [cell.strip() for cell in cells]


@dataclass(frozen=True)
class Layout:
    """
    Where the table of a text file begins, and how its cells are parted.

    `decimal` is the decimal mark, empty if the first rows have whole numbers only. `units_row` are
    the cells of a row of units below the `header`; both are empty if there are none. `width` is
    the number of cells in a row, and `start` that of lines before the first row. `about` has units
    and sensor from the comments, `notes` what was skipped before the table, and `sample` the cells
    of the first rows. `rate_hz` is the rate of the samples that the lines before the table state.

    """

    path: Path
    dialect: Dialect
    decimal: str
    header: tuple[str, ...]
    units_row: tuple[str, ...]
    width: int
    start: int
    encoding: str = 'utf-8'
    about: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    sample: tuple[tuple[str, ...], ...] = ()
    rate_hz: float | None = None

    @property
    def words(self) -> list[str]:
        """Return what differs from a plain CSV table."""
        words = ('' if self.encoding in ('utf-8', 'utf-8-sig') else self.encoding.upper(),
                 _DELIMITER_WORDS.get(self.dialect.delimiter, ''),
                 'decimal comma' if self.decimal == ',' else '',
                 'names before the numbers' if self.dialect.labelled else '',
                 '' if self.header else 'no header')
        return list(filter(None, words))

    def first(self, column: int) -> list[str]:
        """Return the first cells of a column."""
        return [row[column] for row in self.sample if column < len(row)]

    def name(self, column: int) -> str:
        """Return the name of a column, or its number from 1."""
        has_name = column < len(self.header) and self.header[column]
        return short(self.header[column]) if has_name else str(column + 1)


@dataclass(frozen=True)
class Cells:
    """A block of rows: numbers and texts by the index of the column, and row numbers from 1."""

    numbers: Mapping[int, Floats]
    texts: Mapping[int, NDArray[np.object_]]
    row: NDArray[np.int64]

    def take(self, which: NDArray[np.bool_] | slice) -> 'Cells':
        """Return the rows at these indices, or where this mask is true."""
        numbers = {k: values[which] for k, values in self.numbers.items()}
        texts = {k: values[which] for k, values in self.texts.items()}
        return Cells(numbers, texts, self.row[which])


def is_number(text: str) -> bool:
    """Return whether a cell is a finite number, with a decimal point."""
    return _NUMBER.fullmatch(text) is not None and math.isfinite(float(text))


def is_clock(text: str) -> bool:
    """Return whether a text is a date with a time, or a time of the day."""
    return CLOCK.fullmatch(text) is not None


def seconds_of(texts: NDArray[np.object_], path: Path, rows: NDArray[np.int64]) -> Floats:
    """Return the seconds of dates since 1970, or of times since midnight; else InputError."""
    seconds = np.zeros(len(texts))
    for k, text in enumerate(texts):
        day, match = None, CLOCK.fullmatch(text)
        if match is not None:
            date, hours, minute, second, digits, half, zone = match.groups()
            day, hour = _day(date) if date else 0.0, int(hours)
            if half and 1 <= hour <= 12:
                hour = hour % 12 + 12 * (half[0] in 'Pp')
        if day is None or not (hour < 24 and int(minute) < 60 and int(second or 0) <= 60):
            raise InputError(f'{path}: row {rows[k]} has the time {text[:40]!r}, expected one '
                             'such as 2026-01-31T12:00:00.250', 'correct the row or remove it')
        fraction, offset = float(f'0.{digits or 0}'), 0.0
        if zone not in (None, 'Z', 'UTC'):
            size = int(zone[1:3]) * 3600.0 + int(zone[3:].lstrip(':') or 0) * 60.0
            offset = -size if zone[0] == '-' else size
        whole = day + hour * 3600.0 + int(minute) * 60.0 + int(second or 0)
        seconds[k] = whole - offset + fraction
    return seconds


@lru_cache(maxsize=64)
def _day(date: str) -> float | None:
    """Return the seconds from 1970 to a day, or None if there is no such day."""
    for form in _DAYS:
        with suppress(ValueError):  # It has another form.
            day = datetime.strptime(date.replace('/', '-'), form)
            return day.replace(tzinfo=timezone.utc).timestamp()
    return None


def short(text: str) -> str:
    """Return the beginning of a text for a message, without characters that cannot be read."""
    text = _UNREADABLE.sub('', text[:10 * _SHOWN_CHARACTERS]).strip()
    return text if len(text) <= _SHOWN_CHARACTERS else f'{text[:_SHOWN_CHARACTERS]}…'


def shown(names: Sequence[str]) -> str:
    """Return the names of columns for a message."""
    return some(map(short, names))


def layout_of(path: Path, head: Sequence[str], is_header: IsHeader, encoding: str) -> Layout:
    """
    Return where a table begins, and how its cells are parted; raise InputError without a table.

    `head` are the first lines, and `is_header` returns whether cells are the names of columns of a
    log.

    """
    bad = sum(len(_UNREADABLE.findall(line)) for line in head)
    if bad > 0.3 * sum(map(len, head)):
        raise InputError(f'{path} is not a text file, expected a CSV table',
                         'use a CSV table or a bag')
    if all(line.isspace() or line[0] == '#' for line in head):
        raise InputError(f'{path} is empty, expected a header line {_EXAMPLE}',
                         'check that this is the intended file')
    base = _base_of(head)
    plain = [k for k, line in enumerate(head) if base.is_row(line)]
    found = _find_names(head, base, is_header) or _find_numbers(head, base, plain)
    if found is None:
        raise InputError(f'{path} has no table of numbers in its first '
                         f'{counted(len(head), "line")}, expected a header line {_EXAMPLE}',
                         'check that this is the intended file')
    dialect, header, at, first = found
    cells = {k: dialect.cells(head[k]) for k in plain if k > at}
    below = [k for k in cells if k >= first]
    start = next((k for k in below if any(map(_LIKE_NUMBER.fullmatch, cells[k]))),
                 below[0] if below else len(head))
    values = [{float(cell) for cell in cells[k]} if all(map(is_number, cells[k])) else set()
              for k in below[below.index(start):][:2]] if below else []
    rate_hz = None
    if not header and [*map(len, values)] == [1, 1] and len(cells[start]) >= len('xyz'):
        (begun,), (rate,) = values  # Empatica writes the time and the rate into each column
        if begun > EPOCH_S[0] and RATES_HZ[0] <= rate <= RATES_HZ[1]:
            rate_hz, start = rate, below[2] if len(below) > 2 else start
    passed = [short(head[k]) for k in plain if k < start and k != at]
    skipped = f'skipped {counted(len(passed), "line")} before the table'
    notes = [f'{skipped}{":" if len(passed) == 1 else ", the first is"} {each!r}'
             for each in passed[:1]]
    between = [tuple(cells[k]) for k in cells if k < start and at >= 0]
    units_row = next((each for each in between if len(each) == len(header)), ())
    rows = [cells[k] for k in cells if k >= start]
    stated = {float(before or after) * (1000.0 if any(kilo) else 1.0) for line in head[:start]
              for before, *kilo, after in _RATE.findall(line[:1000])}
    if rate_hz is None and len(stated) == 1 and min(stated) > 0.0:
        rate_hz = stated.pop()
    decimal = {match[1] for row in rows[:_TRIED_LINES] for match in map(_DECIMAL.fullmatch, row)
               if match}
    return Layout(
        path=path, dialect=dialect, decimal=min(decimal, default=''), header=header,
        units_row=units_row, width=_width(header, rows), start=start, encoding=encoding,
        about=_about(path, head), notes=tuple(notes),
        sample=tuple(map(tuple, rows[:_TRIED_LINES])), rate_hz=rate_hz)


_Found = tuple[Dialect, tuple[str, ...], int, int]
"""Dialect, names, and the indices of the header line (or -1) and of the first line below it."""


def _base_of(head: Sequence[str]) -> Dialect:
    """Return what precedes each row, and which lines are none; the delimiter is any."""
    filled = sum(not line.isspace() for line in head)
    timed = sum(_MONITOR.match(line) is not None for line in head)
    raw = sum(_MOTIONCAL.fullmatch(line) is not None for line in head)
    is_gcdc = any(line.startswith(';Headers,') for line in head)
    return Dialect(',', timed > filled / 2, prefix='Raw:' if raw > filled / 3 else '',
                   marks=(*Dialect.marks, ';') if is_gcdc else Dialect.marks)


def _find_names(head: Sequence[str], base: Dialect, is_header: IsHeader) -> _Found | None:
    """Return the names in the first line with known names."""
    lettered = (k for k, line in enumerate(head) if any(map(str.isalpha, line[:1000])))
    for k, delimiter in product(lettered, DELIMITERS):
        dialect = replace(base, delimiter=delimiter)
        cells = _names_in(head[k], dialect)
        if cells and is_header(cells):
            row = next((dialect.cells(line) for line in head[k + 1:] if base.is_row(line)), [])
            if len(row) == len(cells) or (delimiter and not head[k].startswith(Dialect.marks)):
                return dialect, tuple(cells), k, k + 1
    return None


def _names_in(line: str, dialect: Dialect) -> list[str]:
    """
    Return the cells of a header line; none if they are few or there are numbers.

    A time of a monitor in front of them is the name of the times.

    """
    line = line.removeprefix(';Headers,')
    cells = dialect.cells(line.lstrip('#/% ') if line.startswith(Dialect.marks) else line)
    if dialect.monitor and cells and is_clock(cells[0]):
        cells[0] = 'time'
    return [] if len(cells) < 3 or any(map(_LIKE_NUMBER.fullmatch, cells)) else cells


def _find_numbers(head: Sequence[str], base: Dialect, plain: Sequence[int]) -> _Found | None:
    """
    Return the dialect in which most `plain` lines are rows of numbers, and their names, if any.

    If the table has too few columns, the first line has the names.

    """
    step = max(1, len(plain) // _TRIED_LINES)
    tried = []
    for labelled, delimiter in product((False, True), DELIMITERS):
        dialect = replace(base, delimiter=delimiter, labelled=labelled)
        widths = Counter(filter(any, (_row_width(dialect.cells(head[k])) for k in plain[::-step])))
        for (width, others), count in widths.most_common(1):
            tried.append((count, -others, width, dialect))
    if not tried:
        dialect = Dialect(',')
        cells = [dialect.cells(head[k]) for k in plain]
        numbers = [any(map(_LIKE_NUMBER.fullmatch, row)) for row in cells]
        if not any(numbers):
            return None
        names = () if numbers[0] else tuple(cells[0])
        return dialect, names, plain[0], plain[0] + len(names[:1])
    _, _, width, dialect = max(tried, key=lambda each: each[:2])
    first = next((k for k in plain if _row_width(dialect.cells(head[k]))[0] == width), plain[-1])
    if dialect.prefix:
        return dialect, _MOTIONCAL_NAMES, -1, first
    if dialect.labelled:
        line = _LABELLED_UNIT.sub('', _MONITOR.sub('', head[first]))
        names = tuple(name.strip(' :=\t') for name in _LABEL.findall(line))
        return dialect, (*('time',) * dialect.monitor, *names), -1, first
    before = ((k, _names_in(head[k], dialect)) for k in reversed(range(first)))
    return next(((dialect, tuple(cells), k, first) for k, cells in before
                 if len(cells) == width), (dialect, (), -1, first))


def _row_width(cells: Sequence[str]) -> tuple[int, int]:
    """Return the numbers of cells, and of those of text, of a row of numbers; 0 of others."""
    numbers = sum(_LIKE_NUMBER.fullmatch(cell) is not None for cell in cells)
    others = sum(bool(cell) and not is_clock(cell) for cell in cells) - numbers
    return (len(cells), others) if numbers >= 3 and others <= numbers else (0, 0)


def _width(header: Sequence[str], rows: Sequence[Sequence[str]]) -> int:
    """Return the number of cells in a row; a delimiter at the end of each line may add one."""
    if not header:
        return Counter(map(len, rows)).most_common(1)[0][0] if rows else 0
    if rows and all(len(row) == len(header) + 1 and not row[-1] for row in rows):
        return len(header) + 1
    if rows and not header[-1] and all(len(row) == len(header) - 1 for row in rows):
        return len(header) - 1
    return len(header)


def _about(path: Path, head: Sequence[str]) -> dict[str, Any]:
    about = {}
    for line in head:
        name, colon, text = line[1:].partition(':')
        if line[0] == '#' and colon and name.strip() in ABOUT:
            with suppress(TypeError, ValueError):  # an ordinary comment
                value = read_json(text)
                about[name.strip()] = Autopilot(**value) if 'autopilot' in name else (
                    '' if value is None else str(value))
    if about.get('units', '') not in ('', *UNIT_NAMES):
        raise InputError(f'{path} has the units {about["units"]!r}, expected one of '
                         f'{", ".join(UNIT_NAMES)}', 'correct that line or remove it')
    return about
