# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Numbers and texts of a text table of any dialect, block by block; lines of a port; our own tables.

The rows are read once, in blocks, so the memory needed does not depend on the length of the file.
`numpy.loadtxt` parses all numbers. A row is looked at on its own only if its block has a fault.

Our own tables have ``#`` comments, one header line, and columns by name: those of
`accel_calib.table.COLUMNS`; other columns of numbers are quantities. Three kinds of comments are
read, with values in JSON: ``# units: "m/s2"``, ``# sensor: "imu_link"`` and ``# autopilot: {…}``.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
import csv
from dataclasses import replace
from functools import partial
import io
from itertools import chain, islice, pairwise
import json
from pathlib import Path
import re
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .columns import choose_columns, is_log_header, LogOptions
from .dialect import Cells, Dialect, is_clock, is_number, layout_of, short
from .quantities import decide_quantities
from ..disk import write_atomically
from ..errors import InputError
from ..table import column_of, COLUMNS, Floats, Recording, Table
from ..text import counted, one_line

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


def text_table(path: Path, options: LogOptions, raw: io.BufferedReader[Any], size: int
               ) -> TextTable:
    """Return the text table of an open file of this size [bytes]; see `layout_of`."""
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


class TextTable:
    """
    A text table, read once, block by block; its columns are those that the options name.

    `head` are the first lines, from which `layout` and `columns` are found, `rest` the others, and
    `size` is the number of bytes. Bad rows raise unless the options skip them; bad quantities are
    NaN.

    """

    def __init__(self, path: Path, head: Sequence[str], rest: Iterator[str], options: LogOptions,
                 encoding: str = 'utf-8', size: int = 0) -> None:
        self.layout = layout_of(path, head, partial(is_log_header, options), encoding)
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
                words = f'is cut: {short(line)!r}' if short(line) else 'holds no text'
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
                 for k in (*self.columns.labels, *self.columns.dates)}
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
        if widths != {breaks} or any(not is_clock(dialect.cells(line)[k])
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
        present = [k for k in self.columns.context if cells[k].strip()]
        for k in (*self.columns.needed, *present):
            if not is_number(cells[k].replace(',', '.') if comma else cells[k]):
                return (f', column {layout.name(k)} is {short(cells[k])!r}, expected a finite '
                        'number')
        for k in self.columns.dates:
            if not is_clock(cells[k]):
                return (f', column {layout.name(k)} is {short(cells[k])!r}, expected a time such '
                        'as 2026-01-31T12:00:00.250')
        return None


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
        cells = self._table.read([f'{line}\n' for line in lines])
        if not len(cells.row):
            return None
        columns, row = self._quantities.columns(cells, self._name)
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
