# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Numbers and texts of a text table of any dialect, block by block; lines of a port; our own tables.

`find_layout` decides from the first lines of a file, its head, where the table begins and how its
cells are parted. `csv.Sniffer` is not used: it needs many equal rows, and takes a letter, a
decimal mark or a blank for the delimiter. The delimiter here is that of a header line with known
names, or else the one whose cells are numbers in most lines.

The rows are read once, in blocks, so the memory needed does not depend on the length of the file.
`numpy.loadtxt` parses all numbers. A row is looked at on its own only if its block has a fault.

Our own tables have ``#`` comments, one header line, and columns by name: those of
`accel_calib.table.COLUMNS`; other columns of numbers are quantities. Three kinds of comments are
read, with values in JSON: ``# units: "m/s2"``, ``# sensor: "imu_link"`` and ``# autopilot: {…}``.

"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
import csv
from dataclasses import replace
from functools import partial
import io
from itertools import chain, islice, pairwise, product
import json
from pathlib import Path
import re
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .columns import (
    Cells, choose_columns, clock_in, Dialect, EPOCH_S, is_filled, is_log_header, is_number, LABEL,
    LABELLED_UNIT, LogOptions, MONITOR, RATES_HZ, short, TextLayout, UNREADABLE)
from .quantities import decide_quantities
from ..disk import write_atomically
from ..errors import InputError
from ..table import ABOUT, Autopilot, column_of, COLUMNS, Floats, Recording, Table
from ..text import counted, one_line, read_json
from ..units import UNIT_NAMES

DELIMITERS = (';', '\t', '|', ',', '')
"""Delimiters in the order of preference; the empty one is any run of blanks."""

_TRIED_LINES = 200
"""Number of lines from which the delimiter and the decimal mark are found, and of the rows in
`TextLayout.sample`."""

_RATE = re.compile(
    r'(?:rate|frequency|\bodr|\bfs|\bat)\b(?:[^\w\n]{0,12}(\d+(?:\.\d+)?)[ ,;\t]?(k?)Hz\b|'
    r'\W{1,2}(k?)Hz\W{1,6}(\d+(?:\.\d+)?)\b)', re.ASCII | re.IGNORECASE)
"""Rate of the samples in the lines before a table: ``Sample rate: 50.0Hz``, ``fs (Hz): 100``."""

_MOTIONCAL = re.compile(r'Raw:(?:-?\d+,){8}-?\d+\s*')
_MOTIONCAL_NAMES = ('accX', 'accY', 'accZ', *6 * ('',))
"""Names of the counts that the sketches for MotionCal print; those of gyro and magnetometer have
no unit."""

_LIKE_NUMBER = re.compile(r'[-+]?(?:(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?|nan|inf)',
                          re.ASCII | re.IGNORECASE)
_DECIMAL = re.compile(r'[-+]?\d*([.,])\d+(?:[eE][-+]?\d+)?', re.ASCII)
_THOUSANDS = re.compile(r'[-+]?[1-9]\d{0,2},\d{3}', re.ASCII)
_EXAMPLE = 'such as time,ax,ay,az and one row for each pose or sample'

ROWS = 65536
"""Number of lines in a block."""

_HEAD_LINES = 4000
_HEAD_CHARACTERS = 2_000_000
_LONGEST_LINE = 16_000_000
"""Longest line [characters]."""

PEEKED = 1 << 16
"""Number of bytes from which the encoding is found."""

_BLANK = ' \t\r\n,;|'
"""Characters of a row without any value, as spreadsheets write at the end of a table."""

_ONE_LABEL = re.compile(r'\s*([A-Za-z]\w*)(?:\s*[:=]\s*|\s+)[-+]?\d*\.?\d+(?:\s*\D{0,6})?')


def text_table(path: Path, options: LogOptions, raw: 'io.BufferedReader[Any]', size: int
               ) -> 'TextTable':
    """Return the text table of an open file of this size [bytes]; see `find_layout`."""
    encoding = _encoding(raw.peek())
    text = io.TextIOWrapper(raw, encoding, errors='replace', newline=None)
    head, rows, characters = list[str](), iter(text), 0
    for line in islice(iter(partial(text.readline, _LONGEST_LINE), ''), _HEAD_LINES):
        if len(line) == _LONGEST_LINE:
            raise InputError(f'{path} has a line of more than {_LONGEST_LINE} characters, '
                             'expected a table with one line for each row',
                             'use a CSV table or a bag')
        head.append(line)
        characters += len(line)
        if characters >= _HEAD_CHARACTERS and len(head) > 1:
            break
    names = [match[1] for match in map(_ONE_LABEL.fullmatch, head) if match]
    cycle = list(dict.fromkeys(names))  # of numbers that stand one per line
    repeats = len(cycle) >= 3 and names[:3 * len(cycle)] == 3 * cycle
    if repeats and 4 * len(names) > len(head):
        rows = _readings(chain(head, text), cycle[0])
        head = list(islice(rows, _HEAD_LINES))
    return TextTable(path, head, rows, options, encoding=encoding, size=size)


def _readings(lines: Iterable[str], label: str) -> Iterator[str]:
    """Yield the lines from each one with a label to the next as one line."""
    parts: list[str] = []
    for line in lines:
        if parts and re.match(rf'\s*{label}\b', line):
            yield f'{" ".join(parts)}\n'
            parts = []
        parts.append(line.strip())
    yield f'{" ".join(parts)}\n'


def _encoding(head: bytes) -> str:
    """Return the encoding, from the byte order mark or the bytes that are 0."""
    if head.startswith((b'\xff\xfe', b'\xfe\xff')):
        return 'utf-16'
    if head.startswith(b'\xef\xbb\xbf'):
        return 'utf-8-sig'
    pairs = len(head) // 2
    low, high = head[:2 * pairs:2].count(0), head[1:2 * pairs:2].count(0)
    if max(low, high) > 0.4 * pairs and min(low, high) < 0.1 * pairs:
        return 'utf-16-le' if high > low else 'utf-16-be'
    try:
        head.decode('utf-8')
    except UnicodeDecodeError as err:
        if b'\x00' not in head and err.start < len(head) - 3:
            bad = head.decode('utf-8', errors='replace').count('\ufffd')
            return 'cp1252' if bad < 0.05 * len(head) else 'utf-8'  # of Windows, or garbage
    return 'utf-8'


def find_layout(path: Path, head: Sequence[str], options: LogOptions, encoding: str) -> TextLayout:
    """
    Return where a table begins, and how its cells are parted; raise InputError without a table.

    `head` are the first lines, and the options may name columns.

    """
    bad = sum(len(UNREADABLE.findall(line)) for line in head)
    if bad > 0.3 * sum(map(len, head)):
        raise InputError(f'{path} is not a text file, expected a CSV table',
                         'use a CSV table or a bag')
    if all(line.isspace() or line[0] == '#' for line in head):
        raise InputError(f'{path} is empty, expected a header line {_EXAMPLE}',
                         'check that this is the intended file')
    base = _base_of(head)
    plain = [k for k, line in enumerate(head) if base.is_row(line)]
    found = _find_names(head, base, options) or _find_numbers(head, base, plain)
    if found is None:
        raise InputError(f'{path} has no table of numbers in its first '
                         f'{counted(len(head), "line")}, expected a header line {_EXAMPLE}',
                         'check that this is the intended file')
    dialect, header, at, first = found
    cells = {k: dialect.cells(head[k]) for k in plain if k > at}
    below = [k for k in cells if k >= first]
    start = next((k for k in below if any(map(_LIKE_NUMBER.fullmatch, cells[k]))),
                 below[0] if below else len(head))
    rate_hz = None if header else _rate_above([cells[k] for k in below if k >= start][:2])
    if rate_hz is not None:
        start = below[2] if len(below) > 2 else start
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
    return TextLayout(
        path=path, dialect=dialect, decimal=_decimal_of(path, dialect, rows), header=header,
        units_row=units_row, width=_width(header, rows), start=start, encoding=encoding,
        about=_about(path, head), notes=tuple(notes),
        sample=tuple(map(tuple, rows[:_TRIED_LINES])), rate_hz=rate_hz)


def _decimal_of(path: Path, dialect: Dialect, rows: Sequence[Sequence[str]]) -> str:
    """Return the decimal mark of numbers; raise InputError if commas part thousands."""
    found = [match for row in rows[:_TRIED_LINES] for match in map(_DECIMAL.fullmatch, row)
             if match]
    marks = {match[1] for match in found}
    commas = [match[0] for match in found if match[1] == ',']
    if (dialect.delimiter == ',' or '.' in marks) and commas and all(
            map(_THOUSANDS.fullmatch, commas)):
        raise InputError(f'{path} has commas between thousands, such as {commas[0]}, expected '
                         'plain numbers', 'write them without these commas')
    return min(marks, default='')


def _rate_above(rows: Sequence[Sequence[str]]) -> float | None:
    """Return the rate in two rows: Empatica writes time and rate into each column above all."""
    values = [{float(cell) for cell in row} for row in rows if all(map(is_number, row))]
    if [*map(len, values)] != [1, 1] or len(rows[0]) < len('xyz'):
        return None
    (begun,), (rate,) = values
    return rate if begun > EPOCH_S[0] and RATES_HZ[0] <= rate <= RATES_HZ[1] else None


_Found = tuple[Dialect, tuple[str, ...], int, int]
"""Dialect, names, and the indices of the header line (or -1) and of the first line below it."""


def _base_of(head: Sequence[str]) -> Dialect:
    """Return what precedes each row, and which lines are none; the delimiter is any."""
    filled = sum(not line.isspace() for line in head)
    timed = sum(MONITOR.match(line) is not None for line in head)
    raw = sum(_MOTIONCAL.fullmatch(line) is not None for line in head)
    is_gcdc = any(line.startswith(';Headers,') for line in head)
    return Dialect(',', timed > filled / 2, prefix='Raw:' if raw > filled / 3 else '',
                   marks=(*Dialect.marks, ';') if is_gcdc else Dialect.marks)


def _find_names(head: Sequence[str], base: Dialect, options: LogOptions) -> _Found | None:
    """Return the names in the first line with known names."""
    lettered = (k for k, line in enumerate(head) if any(map(str.isalpha, line[:1000])))
    for k, delimiter in product(lettered, DELIMITERS):
        dialect = replace(base, delimiter=delimiter)
        cells = _names_in(head[k], dialect)
        if cells and is_log_header(options, cells):
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
    if dialect.monitor and cells and clock_in(cells[0]):
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
        line = LABELLED_UNIT.sub('', MONITOR.sub('', head[first]))
        names = tuple(name.strip(' :=\t') for name in LABEL.findall(line))
        return dialect, (*('time',) * dialect.monitor, *names), -1, first
    before = ((k, _names_in(head[k], dialect)) for k in reversed(range(first)))
    return next(((dialect, tuple(cells), k, first) for k, cells in before
                 if len(cells) == width), (dialect, (), -1, first))


def _row_width(cells: Sequence[str]) -> tuple[int, int]:
    """Return the numbers of cells, and of those of text, of a row of numbers; 0 of others."""
    numbers = sum(_LIKE_NUMBER.fullmatch(cell) is not None for cell in cells)
    others = sum(bool(cell) and not clock_in(cell) for cell in cells) - numbers
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
            text = text.strip()
            with suppress(TypeError, ValueError):  # an ordinary comment
                bare = text in UNIT_NAMES or ('sensor' in name and text[:1] != '"')
                value: Any = text if bare else read_json(text)
                about[name.strip()] = Autopilot(**value) if 'autopilot' in name else (
                    '' if value is None else str(value))
    if about.get('units', '') not in ('', *UNIT_NAMES):
        raise InputError(f'{path} has the units {about["units"]!r}, expected one of '
                         f'{", ".join(UNIT_NAMES)}', 'correct that line or remove it')
    return about


class TextTable:
    """
    A text table, read once, block by block; its columns are those that the options name.

    `head` are the first lines, from which `layout` and `columns` are found, `rest` the others, and
    `size` is the number of bytes. Bad rows raise unless the options skip them; bad quantities are
    NaN.

    """

    def __init__(self, path: Path, head: Sequence[str], rest: Iterator[str], options: LogOptions,
                 encoding: str = 'utf-8', size: int = 0) -> None:
        self.layout = find_layout(path, head, options, encoding)
        self.columns, self.size = choose_columns(self.layout, options), size
        self._numeric = (*self.columns.needed, *self.columns.context,
                         *self.columns.quantities.values())
        self._lines, self._skip_bad = chain(head[self.layout.start:], rest), options.skip_bad
        self._line, self._row = self.layout.start, 0
        self._bad = self._cut = ''
        self._bad_count = self.characters = 0
        self.more = False

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what has been skipped so far."""
        first = ', the first' if self._bad_count > 1 else ''
        bad = f'skipped {counted(self._bad_count, "bad line")}{first}: {self._bad}'
        return (*self.layout.notes, *filter(None, (bad if self._bad_count else '', self._cut)))

    def blocks(self) -> Iterator[Cells]:
        """Yield blocks of rows; InputError without rows, or for a bad cell or number of cells."""
        found = 0
        parts = iter(lambda: list(islice(self._lines, ROWS)), [])
        for lines, following in pairwise(chain(parts, [[]])):
            self.more = bool(following)
            cells = self.read(lines, last=not following)
            self.characters = sum(map(len, lines))
            found += len(cells.row)
            if len(cells.row):
                yield cells
        if not found:
            raise InputError(f'{self.layout.path} has a header line but no rows, expected one row '
                             'for each pose or sample', 'add the rows')

    def read(self, lines: Sequence[str], *, last: bool = False) -> Cells:
        """Return the rows of the next lines; a row that is cut at the last line is left out."""
        dialect, numeric = self.layout.dialect, self._numeric
        kept = list(filter(dialect.is_row, lines))
        rows, k = ([], 0) if '"' in ''.join(kept) else (kept, len(kept))
        while k < len(kept):  # a quoted cell can have several lines, at most 20
            most = min(k + 20, len(kept)) if kept[k].count('"') % 2 else k
            end = next((j for j in range(k + 1, most) if kept[j].count('"') % 2), k)
            rows.append(''.join(kept[k:end + 1]))
            k = end + 1
        is_joined = len(rows) < len(kept)
        number = np.arange(self._row + 1, self._row + len(rows) + 1)
        self._row += len(rows)
        if last and rows and self._row > 1:
            line = rows[-1]
            is_whole = line.endswith('\n') and len(dialect.cells(line)) >= self.layout.width
            if self._fault(line) is not None and not is_whole:
                what = 'is no row' if line.endswith('\n') else 'is cut'
                words = f'{what}: {short(line)!r}' if short(line) else 'holds no text'
                self._cut = f'left out the last line, which {words}'
                rows, number = rows[:-1], number[:-1]
        values = self._parsed(rows)
        if values is None:
            place = [k for k, line in enumerate(lines, self._line + 1) if dialect.is_row(line)]
            good = self._good(rows, number, [] if is_joined else place)
            rows, number = [rows[k] for k in good], number[good]
            texts_of = ([cells[k].replace(',', '.') for k in numeric]
                        for cells in map(dialect.cells, rows))
            values = np.array([[float(text) if is_number(text) else np.nan for text in texts]
                               for texts in texts_of])
        self._line += len(lines)
        numbers = dict(zip(numeric, values.reshape(-1, len(numeric)).T, strict=True))
        texts = {k: np.array([dialect.cells(line)[k] for line in rows], object)
                 for k in (*self.columns.sources.get('label', ()), *self.columns.dates)}
        return Cells(numbers, texts, number)

    def _parsed(self, lines: list[str]) -> Floats | None:
        """Return the numbers of rows, or None if one may have a fault."""
        layout, columns = self.layout, self._numeric
        dialect, delimiter = layout.dialect, layout.dialect.delimiter
        texts, breaks = lines, layout.width - 1
        if dialect.monitor or dialect.labelled or dialect.prefix or '"' in ''.join(lines):
            rows = list(map(dialect.cells, lines))  # without quotes, parted by tabs
            if any(len(row) != layout.width for row in rows):
                return None
            texts = ['\t'.join([row[k] for k in columns]) for row in rows]
            delimiter, columns, breaks = '\t', tuple(range(len(columns))), len(columns) - 1
        widths = {line.count(delimiter) if delimiter else len(line.split()) - 1 for line in texts}
        if widths != {breaks} or any(not clock_in(dialect.cells(line)[k])
                                     for k in self.columns.dates for line in lines):
            return None
        if delimiter != ',' and layout.decimal != '.':
            texts = [line.replace(',', '.') for line in texts]
        with suppress(ValueError):
            values = np.loadtxt(texts, delimiter=delimiter or None, usecols=columns, ndmin=2,
                                comments=None, quotechar=None)
            if len(values) == len(lines) and np.isfinite(values).all():
                return values
        return None

    def _good(self, lines: Sequence[str], rows: NDArray[np.int64],
              place: Sequence[int]) -> list[int]:
        """Return the indices of the sound rows; a bad row is an error, or is skipped."""
        good = []
        for k, line in enumerate(lines):
            fault = self._fault(line)
            if fault is None:
                good.append(k)
            elif (line.lstrip().startswith(Dialect.marks)
                  or not line.replace('""', '').strip(_BLANK)):
                continue
            elif not self._skip_bad or not self._bad:
                self._bad = f'{f"line {place[k]}: " if place else ""}row {rows[k]}{fault}'
                if not self._skip_bad:
                    raise InputError(f'{self.layout.path}{"," if place else ":"} {self._bad}',
                                     'correct the row or remove it, or add --skip-bad')
            self._bad_count += fault is not None
        return good

    def _fault(self, line: str) -> str | None:
        layout = self.layout
        cells = layout.dialect.cells(line)
        if len(cells) != layout.width:
            return f' has {counted(len(cells), "value")}, expected {layout.width}'
        comma = layout.decimal != '.' and (layout.dialect.delimiter != ',' or '"' in line)
        present = [k for k in self.columns.context if is_filled(cells[k])]
        bad = [k for k in (*self.columns.needed, *present)
               if not is_number(cells[k].replace(',', '.') if comma else cells[k])]
        bad += [k for k in self.columns.dates if not clock_in(cells[k])]
        if not bad:
            return None
        expected = ('a time such as 2026-01-31T12:00:00.250' if bad[0] in self.columns.dates else
                    'a number, or a time such as 2026-01-31T12:00:00.250'
                    if bad[0] in self.columns.sources.get('time', ()) else 'a finite number')
        found = short(UNREADABLE.sub('?', cells[bad[0]]))
        return f', column {layout.name(bad[0])} is {found!r}, expected {expected}'


# ----------------------------------------------------------------------------- serial ports

class LineReader:
    """
    Samples of lines that are read as the lines of a text log are.

    Dialect, columns and units are recognised from the `head`, the first complete lines; `first`
    are their samples, and `interval` is the time from one line to the next [s]. `name` is that of
    the port. A line that cannot be read is skipped, because a serial port can lose characters.
    Raise InputError if the lines have no accelerometer, contradict the options, or hold no
    gravity.

    """

    def __init__(self, name: str, head: Sequence[str], interval: float, options: LogOptions
                 ) -> None:
        lines = [f'{line}\n' for line in head]
        self._name = name
        self._table = TextTable(Path(name), lines, iter(()), replace(options, skip_bad=True))
        rows = lines[self._table.layout.start:]
        first = self._table.read(rows)
        if not len(first.row):
            raise InputError(f'{name} sends no row of numbers, expected one line for each sample',
                             'check the format of the lines')
        timed = 'time' in self._table.columns.sources
        rate_hz = options.rate or len(first.row) / len(rows) / interval
        self._quantities = decide_quantities(
            self._table.columns, first, options if timed else replace(options, rate=rate_hz))
        self.units = self._quantities.units
        rate = f'no times, {rate_hz:.4g} Hz ({"stated" if options.rate else "measured"})'
        self.read_as = ', '.join([*self._quantities.said, *(() if timed else (rate,))])
        self.first = Recording(*self._quantities.columns(first, name), self.units.name)
        self.findings = tuple(self._quantities.findings)

    def samples(self, lines: Sequence[str]) -> Recording | None:
        """Return the samples of the next complete lines; None if there are none."""
        columns, row = self._quantities.columns(
            self._table.read([f'{line}\n' for line in lines]), self._name)
        return Recording(columns, row, self.units.name) if len(row) else None


# -------------------------------------------------------------------------- writing of tables

def write_table(path: Path, table: Table) -> None:
    """Write poses or samples; errors as in `write_blocks`."""
    write_blocks(path, (table,))


def write_blocks(path: Path, blocks: Iterable[Table]) -> int:
    """
    Write poses or samples block by block, and return the number of rows.

    The memory needed is that of one block. The tables have the same columns, units and sensor. If
    the file cannot be written (OSError), or the iterable fails, an earlier file is unchanged.

    """
    rows = 0

    def write(file: TextIO) -> None:
        nonlocal rows
        writer = csv.writer(file, lineterminator='\n')
        keys: list[str] = []
        for block in blocks:
            if not keys:
                keys = [key for key, column in COLUMNS.items() if key in block and not column.made]
                keys += block.quantities
                file.writelines(f'# {name}: {one_line(json.dumps(value, ensure_ascii=False))}\n'
                                for name, value in block.about.items())
                writer.writerow([name for key in keys for name in column_of(key).names])
            columns: list[list[str]] = []
            for values in (block[key] for key in keys):
                digits = '.16g' if values.ndim == 1 else '.12g'  # stamps need all digits
                columns += [values.tolist()] if values.dtype.kind in 'US' else [
                    ['' if value != value else format(value, digits) for value in column.tolist()]
                    for column in np.atleast_2d(values.T)]
            writer.writerows(zip(*columns, strict=True))
            rows += len(block)

    write_atomically(path, write)
    return rows
