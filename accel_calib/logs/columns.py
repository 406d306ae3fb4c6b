# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Columns of a text log: the records of a table of text, and which column holds which of ours.

What the user names goes first, then our own names, then the maker's layout, then the words of
other names. A table without header is read by the number of its columns. Two accelerometers that
the names cannot tell apart are an error, because a wrong choice would give a wrong calibration.

"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
import csv
from dataclasses import dataclass, field
import math
from pathlib import Path
import re
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .names import (
    BARE, bare_name, check_sensor, COMPUTED_WORDS, COUNTERS, folded, format_named, FREE_WORDS,
    LINEAR_WORDS, LogFormat, Meaning, meaning, OURS, RATE, READING, recognise, unit_of, UNITS,
    WHOLE_WORDS, WORDS)
from ..errors import InputError
from ..table import COLUMNS, CONTEXT, Floats, quantity_key
from ..text import some
from ..units import STANDARD_GRAVITY, UnitName

FRACTION = 'time_fraction'
"""Key of a column with the part of a second beside a time in whole seconds."""

BY_ORDER: Mapping[int, tuple[str, ...]] = {
    3: READING, 4: ('time', *READING), 5: ('time', *READING, 'temperature'),
    7: ('time', *READING, *RATE), 8: ('time', *READING, *RATE, 'temperature')}
"""Columns of a table without header, by their number."""

OF_POSES = {'count', 'orientation', 'std'}
"""Columns that only poses have."""

_EMPTY = ('', 'nan', 'na', 'n/a', 'null', 'none')
"""Texts of a cell of the context without a number."""

_FIRST_ROWS = 5
"""Number of rows that show whether a column has numbers, dates or other text."""

MOST = 5000
"""Number of columns among which names other than our own are looked for."""

MONITOR = re.compile(r'^(\d{1,2}:\d{2}:\d{2}(?:\.\d+)?) -> ')
"""Time that the serial monitor of the Arduino IDE puts before a line."""

LABEL = re.compile(r'(?:^|(?<=[\s,;|]))[A-Za-z_][A-Za-z_0-9 .]*?(?:\s*[:=]\s*|\s+)(?=[-+.\d])')
"""Name before a number, as the serial plotter of the Arduino IDE has it: ``ax:0.01``, ``x 1``."""

LABELLED_UNIT = re.compile(r'(?<=[\d.]) *(?:m?g|m/s(?:\^?2|²|/s)|(?:°|deg|rad)/s|dps|°?C)'
                           r'(?=[\s,;|]|$)')
"""Unit after a number with a name."""

_CLOCK = re.compile(
    r'(?:(\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}-[A-Za-z]{3}-\d{4}|\d{1,2}[./]\d{1,2}[./]\d{4})'
    r',?[T ])?(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,:](\d*))?)? ?([AaPp]\.?[Mm]\.?)? ?'
    r'(Z|UTC|[-+]\d{2}(?::?\d{2})?)?', re.ASCII)
"""Date, which may be absent, and time of the day."""

_DIGITS = re.compile(r'(20\d\d)(0[1-9]|1[0-2])([0-3]\d)[T_ ]?([0-2]\d)([0-5]\d)([0-5]\d)[.,]?')
"""Date and time of the day in digits alone."""

RATES_HZ = (1.0, 10_000.0)
"""Plausible numbers of samples per second."""

EPOCH_S = (1e9, 4e9)
"""Unix times from 2001 to 2096 [s]."""

_DELIMITER_WORDS = {'\t': 'tab', '': 'blanks', '|': "'|'", ';': "';'"}
_NUMBER = re.compile(r'[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?', re.ASCII)
UNREADABLE = re.compile('[\x00-\x08\x0e-\x1a\x1c-\x1f\x7f\ufffd]')
_SHOWN_CHARACTERS = 40


@dataclass(frozen=True)
class LogOptions:
    """
    How to read a log. By default everything is recognised.

    Parameters
    ----------
    columns : mapping of str to str
        Columns of a text log under our names: a name in the header or a number from 1, such as
        ``{'time': 'timestamp_ms', 'ax': 'accX'}``. An empty text leaves a column out.
    format : str
        Name of a maker's layout, from `accel_calib.logs.NAMES`.
    skip_bad : bool
        Whether lines that cannot be read are skipped, rather than an error.
    rate : float or None
        Samples per second of a text log without times [Hz].
    units : {'m/s2', 'g', 'native', ''}
        Unit of the readings.
    default_units : {'m/s2', 'g', 'native', ''}
        Unit of readings whose unit the log does not state, instead of a recognised one.
    gravity : float
        Local gravity [m/s²].
    topic : str
        Imu topic of a bag, message of a flight log, or table of an archive or Excel file.
    sensor : str
        frame_id of the messages of a bag, or number of the sensor of a flight log.
    context : mapping of str to str
        Topics of a bag with a number beside the readings, by column: as `named_topics` returns.
    in_child : bool
        Whether a binary file is read in a child process with limits, rather than in this one.
    partial : bool
        Whether columns of the context may have empty cells, which are NaN.

    """

    columns: Mapping[str, str] = field(default_factory=dict)
    format: str = ''  # noqa: A003
    skip_bad: bool = False
    rate: float | None = None
    units: UnitName | Literal[''] = ''
    default_units: UnitName | Literal[''] = ''
    gravity: float = STANDARD_GRAVITY
    topic: str = ''
    sensor: str = ''
    context: Mapping[str, str] = field(default_factory=dict)
    in_child: bool = True
    partial: bool = False

    def __post_init__(self) -> None:
        for name in ('columns', 'context'):
            if not isinstance(given := getattr(self, name), Mapping):
                raise ValueError(f'{name} is {given!r}, expected a mapping by column')

    @property
    def instance(self) -> str:
        """Return `sensor`, of a flight log: ``1.0``, as programs write a number, is 1."""
        return re.sub(r'^0*(\d+)(\.0*)?$', r'\1', self.sensor.strip())


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
            line = MONITOR.sub(lambda found: found[1] + (delimiter or ' '), line)
        line = line.removeprefix(self.prefix)
        if self.labelled:
            line = LABEL.sub('', LABELLED_UNIT.sub('', line))
        cells = line.split(delimiter or None)
        if '"' in line:
            with suppress(csv.Error):  # A cell is longer than 131,072 characters.
                cells = next(csv.reader(
                    [line], delimiter=delimiter or ' ', skipinitialspace=True), [])
        return [cell.strip() for cell in cells]


@dataclass(frozen=True)
class TextLayout:
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

    def step(self, column: int) -> float:
        """Return the median step between the first numbers of a column; 0 without numbers."""
        cells = self.first(column)
        if len(cells) < 2 or not all(map(is_number, cells)):
            return 0.0
        return float(np.median(np.diff([float(cell) for cell in cells])))

    def name(self, column: int) -> str:
        """Return the name of a column, or its number from 1."""
        has_name = column < len(self.header) and self.header[column]
        return short(self.header[column]) if has_name else str(column + 1)

    def unit(self, column: int) -> str:
        """Return the text of the unit of a column, which can stand in a row below the header."""
        unit = meaning(self.header[column]).unit if column < len(self.header) else ''
        if unit or column >= len(self.units_row):
            return unit
        below = self.units_row[column].strip('()[]')
        return below if any(unit_of(key, below) for key in UNITS) else ''


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


@dataclass(frozen=True)
class Chosen:
    """
    The columns of a text log that are used, and the maker's layout, if any.

    All are indices of columns. `sources` are those of a key of `COLUMNS`; those of ``KEY/`` divide
    the ones of a key, and ``instance`` is the number of the sensor. The others are the columns of
    numbers that each row needs, those of the `context`, which a row may lack, `dates` (times as
    text), and further columns of numbers, the `quantities`.

    """

    layout: TextLayout
    sources: Mapping[str, tuple[int, ...]]
    maker: LogFormat | None
    needed: tuple[int, ...]
    context: tuple[int, ...]
    dates: tuple[int, ...]
    quantities: Mapping[str, int]

    def numbers(self, cells: Cells, key: str) -> Floats:
        """Return the (n, k) numbers of a key as in the file; divided, if its maker says so."""
        values = np.column_stack([cells.numbers[k] for k in self.sources[key]])
        for divisor in self.sources.get(f'{key}/', ()):
            with np.errstate(all='ignore'):  # a row divided by 0 is refused later, with its number
                values /= cells.numbers[divisor][:, np.newaxis]
        return values

    def names(self, key: str) -> list[str]:
        """Return the names of the columns of a key in the file."""
        return [*map(self.layout.name, self.sources[key])]


def is_number(text: str) -> bool:
    """Return whether a cell is a finite number, with a decimal point."""
    return _NUMBER.fullmatch(text) is not None and math.isfinite(float(text))


def is_filled(cell: str) -> bool:
    """Return whether a cell is not one of those that programs write without a number."""
    return cell.casefold() not in _EMPTY


def clock_in(text: str) -> re.Match[str] | None:
    """Return date, which may be absent, time, and zone of a text; None if it is no time."""
    return _CLOCK.fullmatch(_DIGITS.sub(r'\1-\2-\3T\4:\5:\6.', text, count=1))


def short(text: str) -> str:
    """Return the beginning of a text for a message, without characters that cannot be read."""
    text = UNREADABLE.sub('', text[:10 * _SHOWN_CHARACTERS]).strip()
    return text if len(text) <= _SHOWN_CHARACTERS else f'{text[:_SHOWN_CHARACTERS]}…'


def shown(names: Sequence[str]) -> str:
    """Return the names of columns for a message."""
    return some(map(short, names))


def is_log_header(options: LogOptions, cells: Sequence[str]) -> bool:
    """Return whether cells are the names of the columns of a log."""
    theirs = [name.casefold() for name in options.columns.values()
              if name and not name.isdecimal()]
    if theirs:
        return {cell.casefold() for cell in cells}.issuperset(theirs)
    return (set(READING) <= set(cells) or bool(_triples('reading', cells) or _bare(cells))
            or recognise(cells[:MOST]) is not None)


def choose_columns(layout: TextLayout, options: LogOptions) -> Chosen:
    """
    Return the columns of a log that are used.

    Raise InputError if there is not exactly one accelerometer, or a given column is not there.

    """
    maker, found = _name_columns(layout, options)
    sources = {key: tuple(found[name] for name in own.names) for key, own in COLUMNS.items()
               if found.keys() >= {*own.names}}
    sources |= {key: (k,) for key, k in found.items() if key not in OURS}
    clocks = layout.first(found['time'])[:_FIRST_ROWS] if 'time' in found else []
    dates = sources['time'] if clocks and all(map(clock_in, clocks)) else ()
    texts = {'label', 'time'} if dates else {'label'}
    needed = {k for key, which in sources.items() if key not in texts for k in which}
    of_poses = options.partial or bool(OF_POSES & sources.keys())
    context = {k for key in CONTEXT for k in sources.get(key, ())}
    used = {k for which in sources.values() for k in which}
    quantities: dict[str, int] = {}  # the other columns of numbers that can be a cause
    for k, name in enumerate(() if maker else layout.header[:MOST]):
        known, cells = meaning(name), layout.first(k)
        if (k not in used and known.quantity in {'', *sources} - {'reading', 'rate', 'time'}
                and bare_name(name) not in COUNTERS and COMPUTED_WORDS.isdisjoint(known.group)
                and quantity_key(name)
                and _are_numbers(list(filter(is_filled, cells)) or cells if of_poses else cells)):
            quantities.setdefault(quantity_key(name), k)
    return Chosen(
        layout=layout, sources=sources, maker=maker, needed=tuple(sorted(needed - context)),
        context=tuple(sorted(context)), dates=dates, quantities=quantities)


def _name_columns(layout: TextLayout, options: LogOptions
                  ) -> tuple[LogFormat | None, dict[str, int]]:
    """Return the maker's layout, if any, and the columns under our names."""
    header, given = layout.header, options.columns
    if options.format:
        maker: LogFormat | None = format_named(options.format, header, str(layout.path))
    else:
        maker = recognise(header[:MOST])
        # Our own names go first, unless the maker's layout says that they are other columns.
        if maker is not None and set(READING) <= {*header} and not {*READING} <= {*maker.marks}:
            maker = None
    if maker is None or set(READING) & given.keys():
        found = _sources(layout, given)
        counter = counter_of(layout) if options.rate or layout.rate_hz else None
        if counter is not None and 'time' not in found and 'time' not in given:
            found['time'] = counter
        return None, found
    check_sensor(header[:MOST], layout.path)
    spelled = {folded(name): name for name in reversed(header)}
    theirs = {key: spelled[folded(name)] for key, name in maker.columns.items()
              if folded(name) in spelled}
    ours = {key: theirs.pop(key) for key in OURS if key in theirs}
    found = _sources(layout, {**ours, **given})
    return maker, found | {key: column(layout, name) for key, name in theirs.items()}


def _are_numbers(cells: Sequence[str]) -> bool:
    return all(is_number(cell.replace(',', '.')) for cell in cells)


def _sources(layout: TextLayout, given: Mapping[str, str]) -> dict[str, int]:
    """Return columns under our names; `given` are those that the user or a maker names."""
    header = layout.header
    for ours in given:
        if ours not in OURS:
            raise InputError(f'--columns names {ours!r}, expected one of {", ".join(OURS)}',
                             'correct the name before the =')
    found = {ours: column(layout, theirs) for ours, theirs in given.items() if theirs}
    partly = set(READING) & set(given)
    if partly and not set(READING) <= set(found):
        raise InputError(f'--columns names {", ".join(sorted(partly))}, expected ax, ay and az',
                         'name all three')
    is_named = set(READING) <= set(header) and not set(READING) & set(found)
    bare = header if is_named else [name.partition('[')[0].strip() for name in header]
    if is_named:
        for name, count in Counter(header).items():
            if count > 1 and name in OURS:
                raise InputError(f'{layout.path} has {count} columns {name}, expected one',
                                 'remove or rename the others')
    elif not set(READING) <= set(found):
        found = {**_readings(layout), **found}
    # Names that only a pose table has, which its readings may lack.
    if is_named or any({*COLUMNS[key].names} <= {*bare} for key in ('std', 'reference')):
        found = {**{name: bare.index(name) for own in COLUMNS.values()
                    if not own.made and {*own.names} <= {*bare} for name in own.names}, **found}
    if header:
        found = {**_contexts(layout, found), **found}
    # What is not asked for, and holds other text than numbers, does not stand in the way.
    return {ours: k for ours, k in found.items() if given.get(ours, ours) and (
        ours not in (*RATE, *CONTEXT) or ours in given or layout.name(k) == ours
        or _are_numbers(layout.first(k)[:_FIRST_ROWS] if ours in RATE else [
            *filter(is_filled, layout.first(k))] or ['']))}


def column(layout: TextLayout, theirs: str) -> int:
    """Return a column by its name, in any case, or by its number."""
    header = layout.header
    same = ([k for k, name in enumerate(header) if name == theirs]
            or [k for k, name in enumerate(header) if name.casefold() == theirs.casefold()])
    if not same and theirs.isdecimal() and 1 <= int(theirs) <= layout.width:
        same = [int(theirs) - 1]
    if len(same) != 1:
        words = (f'the columns {shown(header)}' if header else
                 f'{layout.width} columns without names')
        raise InputError(f'{layout.path} has {words}, and {len(same) or "no"} '
                         f'{"columns" if same else "column"} {theirs!r}, expected one',
                         f'use a name of the header, or a number from 1 to {layout.width}')
    return same[0]


def _readings(layout: TextLayout) -> dict[str, int]:
    """Return the columns of the accelerometer; those of a table without header by their order."""
    header = layout.header
    if not header:
        if layout.width not in BY_ORDER:
            raise InputError(f'{layout.path} has no header line and {layout.width} columns, '
                             'expected 3 (ax, ay, az), 4 (time first), 5 (temperature last), 7 '
                             '(angular rate last) or 8 (temperature last)', 'add a header line, '
                             'or name them with --columns time=1,ax=2,ay=3,az=4')
        return {name: k for k, name in enumerate(BY_ORDER[layout.width])}
    groups = list(_triples('reading', header).values())
    words = {triple[0]: set(meaning(header[triple[0]]).group) for triple in groups}
    with_gravity = [triple for triple in groups if not FREE_WORDS & words[triple[0]]]
    plain = [triple for triple in with_gravity if not LINEAR_WORDS & words[triple[0]]]
    whole = [triple for triple in plain if WHOLE_WORDS & words[triple[0]]]
    if groups and not with_gravity:
        raise InputError(f'{layout.path} has {", ".join(map(layout.name, groups[0]))} only, '
                         'linear acceleration, gravity removed, by its name; expected an '
                         'accelerometer', 'record the acceleration with gravity, often called raw '
                         'or total acceleration')
    groups = whole or plain or with_gravity or _bare(header)
    if len(groups) == 1:
        return dict(zip(READING, groups[0]))
    if groups:
        names = ' and '.join(', '.join(map(layout.name, triple)) for triple in groups[:3])
        # A name that several columns have is replaced by the number.
        choice = ','.join(f'{name}={header[k] if header.count(header[k]) == 1 else k + 1}'
                          for name, k in zip(READING, groups[0]))
        raise InputError(f'{layout.path} has {len(groups)} accelerometers, {names}, expected one',
                         f'choose one with --columns "{choice}"')
    missing = [name for name in READING if name not in header]
    lacks = f', and lacks {", ".join(missing)}' if len(missing) < len(READING) else ''
    raise InputError(f'{layout.path} has the columns {shown(header)}{lacks}, expected three '
                     'of an accelerometer, such as ax, ay, az or accX, accY, accZ',
                     'name them with --columns ax=NAME,ay=NAME,az=NAME')


def columns_named(quantity: str, header: Sequence[str]) -> dict[int, Meaning]:
    """Return the meanings of the names that mean a quantity, by the index of their columns."""
    return {k: meaning(name) for k, name in enumerate(header[:MOST])
            if meaning(name).quantity == quantity}


def _triples(quantity: str, header: Sequence[str]) -> dict[tuple[str, ...], list[int]]:
    """Return the columns of the three axes of each sensor of a quantity."""
    axes: dict[tuple[str, ...], dict[int, list[int]]] = {}
    for k, known in columns_named(quantity, header).items():
        if known.axis is not None:
            axes.setdefault(known.group, {}).setdefault(known.axis, []).append(k)
    found: dict[tuple[str, ...], list[int]] = {}
    for group, by_axis in axes.items():
        for count in range(max(map(len, by_axis.values()))):
            for wanted in ((0, 1, 2), (1, 2, 3)):
                if all(len(by_axis.get(axis, ())) > count for axis in wanted) and (
                        wanted[0] == 0 or 0 not in by_axis):
                    key = (*group, f'#{count}') if count else group
                    found[key] = [by_axis[axis][count] for axis in wanted]
    return found


def _bare(header: Sequence[str]) -> list[list[int]]:
    """Return the columns x, y, z of each sensor of a file without other names; no quaternions."""
    if 'w' in map(str.casefold, header):
        return []
    axes: dict[int, list[int]] = {}
    for k, known in columns_named('', header).items():
        if not known.unit and known.axis is not None and BARE.issuperset(known.group):
            axes.setdefault(known.axis, []).append(k)
    count = min(len(axes.get(axis, ())) for axis in range(3))
    return [[axes[axis][k] for axis in range(3)] for k in range(count)]


def _contexts(layout: TextLayout, found: Mapping[str, int]) -> dict[str, int]:
    more: dict[str, int] = {}
    header = layout.header
    # Columns of times that run, and how finely. A date that stays the same, or a time of the day
    # in whole seconds, is no clock of the samples.
    cells = {k: layout.first(k) for k in columns_named('time', header) if 'time' not in found}
    different = {k: len(set(texts)) for k, texts in cells.items()
                 if all(is_number(text.replace(',', '.')) or clock_in(text)
                        for text in texts[:_FIRST_ROWS])}
    different |= {k: max(different.get(other, 0), different[k]) for k in different
                  for other in _fraction(layout, k).values()}
    clocks = {k: 2 * count >= max(different.values()) for k, count in different.items()
              if count > 1 or len(cells[k]) < _FIRST_ROWS}
    if clocks:
        # The name that is most plainly that of the time of a sample.
        best = max(clocks, key=lambda k: (
            clocks[k], header[k].casefold() == 'time', {*WORDS['time']}.issuperset(
                meaning(header[k]).group), bool(meaning(header[k]).unit), -k))
        more |= {'time': best, **_fraction(layout, best)}
    if RATE[0] not in found:  # the gyro that belongs to the accelerometer, if it is plain
        gyros = _triples('rate', header)
        if len(gyros) > 1:
            own = set(meaning(layout.name(found[READING[0]])).group)
            shared = [len(own.intersection(group)) for group in gyros]
            gyros = {group: triple for (group, triple), count in zip(gyros.items(), shared)
                     if count == max(shared) and shared.count(count) == 1}
        more |= {name: k for triple in gyros.values() for name, k in zip(RATE, triple)}
    for key in CONTEXT:
        which = [*columns_named(key, header)]
        if key not in found and len(which) == 1:
            more[key] = which[0]
    return more


def counter_of(layout: TextLayout) -> int | None:
    """Return the column that counts the samples, or None."""
    return next((k for k, name in enumerate(layout.header[:MOST])
                 if bare_name(name) in COUNTERS and len(layout.first(k)) >= _FIRST_ROWS
                 and layout.step(k) > 0.0), None)


def _fraction(layout: TextLayout, best: int) -> dict[str, int]:
    """Return the column of the part of a second beside whole seconds, such as that of ROS."""
    header, cells = layout.header, layout.first(best)
    known = meaning(header[best])
    clocks = [*map(clock_in, cells)]
    if not (all(match and not match[5] for match in clocks) or (
            unit_of('time', known.unit) == ('s', 1.0) and _in_range(cells, 1.0, math.inf))):
        return {}
    for k, other in columns_named('time', header).items():
        unit = unit_of('time', other.unit)
        if (unit is not None and unit[1] < 1.0 and {*WORDS['time']}.issuperset(
                {*known.group} ^ {*other.group}) and _in_range(layout.first(k), unit[1], 1.0)):
            return {FRACTION: k}
    return {}


def _in_range(cells: Sequence[str], unit: float, limit: float) -> bool:
    """Return whether cells are whole numbers of a unit, from 0 to a limit."""
    return all(is_number(cell) and float(cell) % 1.0 == 0.0 and 0.0 <= float(cell) * unit < limit
               for cell in cells)
