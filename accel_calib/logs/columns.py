# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Columns of a log: which column of a header holds which of our columns.

What the user names goes first, then our own names, then the table of names
(`accel_calib.logs.names`). A table without header is read by the number of its columns.
Two accelerometers that the names cannot tell apart are an error, because a wrong choice would
give a wrong calibration. Other columns are used only where they are plain.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from .dialect import is_number, Layout, shown
from .names import BARE, is_unit, meaning, OURS, RATE, READING, unit_of, WORDS
from ..errors import InputError
from ..table import COLUMNS

FRACTION = 'time_ns'
"""Key of a column with the nanoseconds of a time in whole seconds."""

CONTEXT = (*RATE, 'temperature', 'supply_voltage')
"""Columns that are used only where they are plain."""

MOST = 5000
"""Number of columns among which names other than our own are looked for."""


@dataclass(frozen=True)
class Source:
    """A column of a file: its index, its name, and the text of the unit in the name."""

    index: int
    name: str
    unit: str = ''


def has_reading(header: Sequence[str]) -> bool:
    """Return whether names are those of a log with an accelerometer."""
    if set(READING) <= set(header):
        return True
    return bool(_triples('reading', header) or _bare(header))


def sources(layout: Layout, given: Mapping[str, str]) -> dict[str, Source]:
    """
    Return the columns of a log under our names.

    Parameters
    ----------
    layout : Layout
        The table, with its header.
    given : mapping of str to str
        Columns that the user names, under our names: a name in the header or a number from 1. An
        empty text leaves a column out.

    Raises
    ------
    InputError
        If there is no accelerometer, or there are several, or a given column is not there.

    """
    header = layout.header
    found = _given(layout, given)
    left_out = [ours for ours, theirs in given.items() if not theirs]
    if not header:
        found = {**_by_order(layout, found), **found}
    elif set(READING) <= set(header) and not set(READING) & set(found):
        found = {**_own(layout), **found}
    else:
        found = {**_readings(layout, found), **found}
    if header:
        found = {**_contexts(layout, found), **found}
    # What is not asked for, and holds other text than numbers, does not stand in the way.
    found = {ours: source for ours, source in found.items()
             if ours not in CONTEXT or ours in given or source.name == ours
             or _has_numbers(layout, source)}
    return {ours: source for ours, source in found.items() if ours not in left_out}


def _has_numbers(layout: Layout, source: Source) -> bool:
    """Return whether the first rows have numbers in a column."""
    cells = [row[source.index] for row in layout.sample if source.index < len(row)]
    return all(is_number(cell.replace(',', '.')) for cell in cells)


def _given(layout: Layout, given: Mapping[str, str]) -> dict[str, Source]:
    """Return the columns that the user names."""
    found: dict[str, Source] = {}
    for ours, theirs in given.items():
        if ours not in OURS:
            raise InputError(f'--columns names {ours!r}, expected one of {", ".join(OURS)}',
                             'correct the name before the =')
        if not theirs:
            continue
        found[ours] = column(layout, theirs)
    partly = set(READING) & set(found)
    if partly and partly != set(READING):
        raise InputError(f'--columns names {", ".join(sorted(partly))}, expected ax, ay and az',
                         'name all three')
    return found


def column(layout: Layout, theirs: str) -> Source:
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
    name = header[same[0]] if same[0] < len(header) else ''
    return _source(layout, same[0], meaning(name).unit)


def _source(layout: Layout, index: int, unit: str = '') -> Source:
    """Return a column with its unit, which can stand in a row below the header."""
    below = layout.units_row[index] if index < len(layout.units_row) else ''
    below = below.strip('()[]')
    return Source(index, layout.name(index), unit or (below if is_unit(below) else ''))


def _by_order(layout: Layout, found: Mapping[str, Source]) -> dict[str, Source]:
    """Return the columns of a table without header, by their order."""
    orders = {3: READING, 4: ('time', *READING), 5: ('time', *READING, 'temperature'),
              7: ('time', *READING, *RATE), 8: ('time', *READING, *RATE, 'temperature')}
    if set(READING) <= set(found):
        return {}
    if layout.width not in orders:
        raise InputError(f'{layout.path} has no header line and {layout.width} columns, expected '
                         '3 (ax, ay, az), 4 (time first), 5 (temperature last), 7 (angular rate '
                         'last) or 8 (temperature last)', 'add a header line, or name them with '
                         '--columns time=1,ax=2,ay=3,az=4')
    return {name: Source(k, str(k + 1)) for k, name in enumerate(orders[layout.width])}


def _own(layout: Layout) -> dict[str, Source]:
    """Return the columns with our own names."""
    counts = Counter(layout.header)
    for name in OURS:
        if counts[name] > 1:
            raise InputError(f'{layout.path} has {counts[name]} columns {name}, expected one',
                             'remove or rename the others')
    index = {name: k for k, name in enumerate(layout.header)}
    found: dict[str, Source] = {}
    for column in COLUMNS.values():
        if not column.made and index.keys() >= set(column.names):
            found |= {name: _source(layout, index[name]) for name in column.names}
    return found


def _readings(layout: Layout, found: Mapping[str, Source]) -> dict[str, Source]:
    """Return the columns of the accelerometer."""
    if set(READING) <= set(found):
        return {}
    header = layout.header
    groups = list(_triples('reading', header).values())
    with_gravity = [triple for triple in groups if not meaning(header[triple[0]]).free]
    plain = [triple for triple in with_gravity
             if 'linear' not in meaning(header[triple[0]]).group]
    groups = plain or with_gravity or groups or _bare(header)
    if len(groups) > 1:
        names = ' and '.join(', '.join(header[k] for k in triple) for triple in groups[:3])
        one = groups[0]
        raise InputError(f'{layout.path} has {len(groups)} accelerometers, {names}, expected one',
                         'choose one with --columns "' + ','.join(
                             f'{name}={_reference(header, k)}' for name, k in zip(READING, one))
                         + '"')
    if not groups:
        missing = [name for name in READING if name not in header]
        lacks = f', and lacks {", ".join(missing)}' if len(missing) < len(READING) else ''
        raise InputError(f'{layout.path} has the columns {shown(header)}{lacks}, expected three '
                         'of an accelerometer, such as ax, ay, az or accX, accY, accZ',
                         'name them with --columns ax=NAME,ay=NAME,az=NAME')
    return {name: _source(layout, k, meaning(header[k]).unit)
            for name, k in zip(READING, groups[0])}


def _reference(header: Sequence[str], k: int) -> str:
    """Return a name of a column, or its number if others have that name, too."""
    return header[k] if header.count(header[k]) == 1 else str(k + 1)


def _triples(quantity: str, header: Sequence[str]) -> dict[tuple[str, ...], list[int]]:
    """Return the columns of the three axes of each sensor of a quantity."""
    axes: dict[tuple[str, ...], dict[int, list[int]]] = {}
    for k, name in enumerate(header[:MOST]):
        known = meaning(name)
        if known.quantity == quantity and known.axis is not None:
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
    """Return the columns x, y, z of each sensor of a file without other names."""
    axes: dict[int, list[int]] = {}
    for k, name in enumerate(header[:MOST]):
        known = meaning(name)
        if not known.quantity and known.axis is not None and BARE.issuperset(known.group) and (
                not known.unit):
            axes.setdefault(known.axis, []).append(k)
    count = min(len(axes.get(axis, ())) for axis in range(3))
    return [[axes[axis][k] for axis in range(3)] for k in range(count)]


def _contexts(layout: Layout, found: Mapping[str, Source]) -> dict[str, Source]:
    """Return the columns of time, angular rate, temperature and supply, where they are plain."""
    more: dict[str, Source] = {}
    header = layout.header
    by_quantity: dict[str, list[int]] = {}
    for k, name in enumerate(header[:MOST]):
        by_quantity.setdefault(meaning(name).quantity, []).append(k)
    if 'time' not in found and by_quantity.get('time'):
        best = max(by_quantity['time'], key=lambda k: (_time_rank(header[k]), -k))
        more['time'] = _source(layout, best, meaning(header[best]).unit)
        more |= _fraction(layout, best)
    if RATE[0] not in found:
        for triple in _rates(header, found):
            more |= {name: _source(layout, k, meaning(header[k]).unit)
                     for name, k in zip(RATE, triple)}
    for key in ('temperature', 'supply_voltage'):
        which = by_quantity.get(key, [])
        if key not in found and len(which) == 1:
            more[key] = _source(layout, which[0], meaning(header[which[0]]).unit)
    return more


def _time_rank(name: str) -> tuple[bool, bool, bool]:
    """Return how plainly a name is that of the time of a sample."""
    known = meaning(name)
    words = [word for word in known.group if word not in WORDS['time']]
    return name.casefold() == 'time', not words, bool(known.unit)


def _fraction(layout: Layout, best: int) -> dict[str, Source]:
    """Return the column of the nanoseconds beside whole seconds, as ROS stamps have it."""
    known = meaning(layout.header[best])
    if unit_of('time', known.unit) != ('s', 1.0):
        return {}
    for k, name in enumerate(layout.header[:MOST]):
        other = meaning(name)
        if (other.quantity, other.group) == ('time', known.group) and (
                unit_of('time', other.unit) == ('ns', 1e-9)):
            return {FRACTION: Source(k, layout.name(k), other.unit)}
    return {}


def _rates(header: Sequence[str], found: Mapping[str, Source]) -> list[list[int]]:
    """Return the columns of the gyro that belongs to the accelerometer, if it is plain."""
    groups = [(group, triple) for group, triple in _triples('rate', header).items()]
    if len(groups) > 1:
        own = set(meaning(found[READING[0]].name).group) if READING[0] in found else set()
        shared = [len(own.intersection(group)) for group, _ in groups]
        groups = [each for each, count in zip(groups, shared)
                  if count == max(shared) and shared.count(count) == 1]
    return [triple for _, triple in groups[:1]]


def unused(layout: Layout, found: Mapping[str, Source]) -> tuple[str, ...]:
    """Return notes about columns that look like a temperature and are not used."""
    if 'temperature' in found:
        return ()
    names = [name for name in layout.header[:MOST]
             if meaning(name).quantity == 'temperature']
    if not names:
        return ()
    return (f'not used, though the names look like temperatures: {shown(names)}; choose one with '
            f'--columns temperature={names[0]}',)
