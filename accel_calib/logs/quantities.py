# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Quantities of a text log: the conversion of its columns to our units.

`decided` looks at the first block of numbers and decides the unit of each column: what the user,
the file, the maker's layout or the name states, or else what the readings at rest and the rate of
the samples show. Each assumption is in `Quantities.read_as`.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import clock
from .accelerometer import compact, unit_of_reading
from .clock import has_date, seconds_of
from .columns import FRACTION, unused
from .names import RATE, READING, unit_of, ZEROS
from .records import are_samples, are_untimed_samples, LogOptions
from .selection import Chosen
from .text import Cells
from ..errors import InputError
from ..table import COLUMNS, Floats
from ..units import Units, units_of

_MOST_BACK = 0.1
"""Share of steps back in time above which a column is no time."""

_LIKELY_RATE = 20.0
"""Angular rates [rad/s] of a sensor that is turned by hand stay below this; in °/s they do not."""

_LIKELY_RATE_DEG = 3000.0
_LARGEST_RATE = 40.0
"""Angular rates [rad/s] above those of common gyros, 2000 °/s."""

_LIKELY_TEMPERATURE_C = (-60.0, 150.0)
_DEGREE = np.pi / 180.0


@dataclass
class Quantities:
    """
    The conversion of the columns of a log; `decided` makes it.

    Parameters
    ----------
    chosen : Chosen
        The columns.
    units : Units
        Unit of the readings.
    scales : mapping of str to (float, float)
        Factor to our unit, and our value at 0.
    counter : Counter
        Continues times of a counter that starts again.
    instance : float or None
        Number of the sensor whose rows are read, where rows of several alternate.
    said, notes : list of str
        What is assumed, and what is not used.

    """

    chosen: Chosen
    units: Units
    scales: dict[str, tuple[float, float]] = field(default_factory=dict)
    counter: clock.Counter = field(default_factory=lambda: clock.Counter(()))
    instance: float | None = None
    said: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def read_as(self) -> str:
        """Return what is assumed, in one line."""
        return ', '.join(self.said)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Return what is not used, and whether the counter of the clock started again."""
        if not self.counter.starts:
            return tuple(self.notes)
        times = 'once' if self.counter.starts == 1 else f'{self.counter.starts} times'
        return (*self.notes, f'the clock starts again {times} at the end of its range; its times '
                'are continued')

    def columns(self, cells: Cells) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
        """Return the columns of a block in our units, and its row numbers."""
        if self.instance is not None:
            cells = _of_instance(self.chosen, cells, self.instance)
        columns: dict[str, NDArray[Any]] = {}
        sources = self.chosen.sources
        for key, column in COLUMNS.items():
            if column.made or not sources.keys() >= set(column.names):
                continue
            if key == 'label':
                columns[key] = np.array(self.chosen.texts(cells, 'label'), dtype=str)
            elif key == 'time':
                columns[key] = self.counter.continued(self._seconds(cells))
            elif len(column.names) == 1:
                columns[key] = self._scaled(cells, key)
            else:
                columns[key] = np.column_stack([self._scaled(cells, name)
                                                for name in column.names])
        return columns, cells.row

    def _scaled(self, cells: Cells, ours: str) -> Floats:
        values = self.chosen.numbers(cells, ours)
        if ours not in self.scales:
            return values
        factor, zero = self.scales[ours]
        return values * factor + zero

    def _seconds(self, cells: Cells) -> Floats:
        if self.chosen.dates:
            return seconds_of(self.chosen.texts(cells, 'time'), self.chosen.layout.path,
                              cells.row.tolist())
        seconds = self._scaled(cells, 'time')
        if FRACTION in self.chosen.sources:
            return seconds + 1e-9 * self.chosen.numbers(cells, FRACTION)
        return seconds


def _of_instance(columns: Chosen, cells: Cells, instance: float) -> Cells:
    """Return the rows of one sensor."""
    which = columns.numbers(cells, 'instance') == instance
    texts = [[text for text, own in zip(part, which) if own] for part in cells.texts]
    return Cells(cells.numbers[which], texts, cells.row[which])


def decided(columns: Chosen, first: Cells, options: LogOptions) -> Quantities:
    """
    Return the conversion of the columns.

    Parameters
    ----------
    columns : Chosen
        The columns.
    first : Cells
        The first block of the log.
    options : LogOptions
        What the user states.

    Raises
    ------
    InputError
        If the units that are stated contradict each other or the readings, or gravity is not in
        the readings.

    """
    made = Quantities(columns, units_of('m/s2', options.gravity))
    if columns.maker is not None:
        made.said.append(f'{columns.maker.name} format')
        made.notes += [columns.maker.note] if columns.maker.note else []
    made.said += columns.layout.words
    if 'instance' in columns.sources:
        made.instance = _instance(columns, first, options, made.notes)
        first = _of_instance(columns, first, made.instance)
    if 'time' in columns.sources:
        _decide_time(made, first)
    _decide_reading(made, first, options)
    _decide_rate(made, first)
    _decide_temperature(made, first)
    _decide_supply(made)
    made.notes += unused(columns.layout, columns.sources)
    return made


def _instance(columns: Chosen, first: Cells, options: LogOptions, notes: list[str]) -> float:
    """Return the number of the sensor to read."""
    there = np.unique(columns.numbers(first, 'instance')).tolist()
    words = ', '.join(f'{each:g}' for each in there)
    if options.sensor:
        try:
            asked = float(options.sensor)
        except ValueError:
            asked = np.nan
        if asked not in there:
            raise InputError(f'{columns.layout.path} has the sensors {words}, expected '
                             f'{options.sensor}', 'choose one of them with --sensor')
        return asked
    if len(there) > 1:
        notes.append(f'the log has the sensors {words}; sensor {there[0]:g} is read: choose '
                     'another with --sensor')
    return float(there[0])


# ------------------------------------------------------------------------------------- time

def _decide_time(made: Quantities, first: Cells) -> None:
    source = made.chosen.sources['time']
    if made.chosen.dates:
        of_day = not has_date(made.chosen.texts(first, 'time')[0])
        made.counter = clock.counter_of('', of_day=of_day)
        made.said.append(f'{source.name}: {"times of the day" if of_day else "dates"} -> s')
        return
    stamps = made.chosen.numbers(first, 'time')
    back = np.count_nonzero(np.diff(stamps) < 0.0)
    if not made.chosen.layout.header and back > _MOST_BACK * (len(stamps) - 1):
        raise InputError(f'{made.chosen.layout.path} has no header line, and column '
                         f'{source.name} does not increase, expected times',
                         'add a header line, or name the columns with --columns ax=1,ay=2,az=3')
    unit, words = _unit_of_time(made, first, stamps)
    made.counter = clock.counter_of(unit)
    if unit != 's':
        made.scales['time'] = (clock.UNITS[unit], 0.0)
    if words:
        made.said.append(words)


def _unit_of_time(made: Quantities, first: Cells, stamps: Floats) -> tuple[str, str]:
    """Return the unit of the stamps, and what is assumed."""
    source, layout = made.chosen.sources['time'], made.chosen.layout
    scale = made.chosen.maker and made.chosen.maker.scales.get('time')
    if scale:
        unit = min(clock.UNITS, key=lambda name: abs(np.log(clock.UNITS[name] / scale)))
        return unit, f'{source.name} in {unit}' if unit != 's' else ''
    stated = unit_of('time', source.unit)
    if stated:
        return stated[0], f'{source.name} -> s' if stated[0] != 's' else source.name
    if layout.header and source.name == 'time' and (layout.about or 'count' in made.chosen.sources
                                                    or not _by_rate(made, first, stamps)):
        return 's', ''
    found = clock.unit_by_rate(stamps)
    named = f'column {source.name}' if source.name.isdecimal() else source.name
    if found is None:
        return 's', f'{named} in s'
    return found[0], f'{named} in {found[0]} ({found[1]:.3g} Hz)' + (
        ' -> s' if found[0] != 's' else '')


def _by_rate(made: Quantities, first: Cells, stamps: Floats) -> bool:
    """Return whether the unit of a column ``time`` is found from the rate; by default it is s."""
    if [made.chosen.sources[name].name for name in READING] != list(READING):
        return True
    raw = np.column_stack([made.chosen.numbers(first, name) for name in READING])
    return clock.is_dense(stamps, raw)


# ---------------------------------------------------------------------------------- reading

def _decide_reading(made: Quantities, first: Cells, options: LogOptions) -> None:
    raw = np.column_stack([made.chosen.numbers(first, name) for name in READING])
    columns = {'reading': raw, **{key: raw[:, 0] for key in ('count', 'orientation')
                                  if key in made.chosen.sources}}
    if 'time' in made.chosen.sources:
        samples = are_samples({**columns, 'time': made._seconds(first)})
    else:
        samples = options.rate is not None or are_untimed_samples(columns)
    found = unit_of_reading(made.chosen, raw, options, samples=samples)
    made.units = units_of(found.name, options.gravity)
    if found.factor != 1.0:
        made.scales.update(dict.fromkeys(READING, (found.factor, 0.0)))
    if found.assumed or made.said:
        made.said += found.words


# ---------------------------------------------------------------------------------- context

def _drop(made: Quantities, keys: Sequence[str], note: str) -> None:
    """Leave columns out, and note why."""
    sources = {key: value for key, value in made.chosen.sources.items() if key not in keys}
    made.chosen = Chosen(made.chosen.layout, sources, made.chosen.maker, made.chosen.numeric,
                         made.chosen.text)
    made.notes.append(note)


def _decide_rate(made: Quantities, first: Cells) -> None:
    columns = made.chosen
    if not columns.sources.keys() >= set(RATE):
        return
    words = compact([columns.sources[name].name for name in RATE])
    scale = columns.maker and columns.maker.scales.get('gx')
    if columns.maker is not None and 'gx' in columns.maker.columns:
        made.scales.update(dict.fromkeys(RATE, (scale or 1.0, 0.0)))
        return
    stated = unit_of('rate', columns.sources['gx'].unit)
    largest = float(np.quantile(np.abs(np.column_stack(
        [columns.numbers(first, name) for name in RATE])), 0.999))
    own = columns.sources['gx'].name == 'gx' and largest < _LARGEST_RATE
    if stated is None and own and columns.layout.header:
        return
    if stated is None and largest >= _LIKELY_RATE_DEG:
        _drop(made, RATE, f'the angular rates {words} look like counts and are not used: state '
              'their unit in the names, such as gyroX_dps')
        return
    unit, factor = stated or (('rad/s', 1.0) if largest < _LIKELY_RATE else ('°/s', _DEGREE))
    if factor != 1.0:
        made.scales.update(dict.fromkeys(RATE, (factor, 0.0)))
    made.said.append(f'{words} in {unit}' + ('' if unit == 'rad/s' else ' -> rad/s')
                     + ('' if stated else ' (assumed)'))


def _decide_temperature(made: Quantities, first: Cells) -> None:
    columns = made.chosen
    if 'temperature' not in columns.sources:
        return
    source = columns.sources['temperature']
    stated = unit_of('temperature', source.unit)
    if stated is not None:
        unit, factor = stated
        if unit != '°C':
            made.scales['temperature'] = (factor, ZEROS[unit])
            made.said.append(f'{source.name} in {unit} -> °C')
        return
    if columns.maker is not None or (source.name == 'temperature' and columns.layout.header):
        return
    middle = float(np.median(columns.numbers(first, 'temperature')))
    if _LIKELY_TEMPERATURE_C[0] <= middle <= _LIKELY_TEMPERATURE_C[1]:
        made.said.append(f'{source.name} in °C (assumed)')
        return
    _drop(made, ['temperature'], f'the temperature {source.name} has values of about '
          f'{middle:.4g} in a unit that is not known, and is not used: state its unit in the '
          'name, such as temperature_K')


def _decide_supply(made: Quantities) -> None:
    source = made.chosen.sources.get('supply_voltage')
    stated = source and unit_of('supply_voltage', source.unit)
    if source and stated and stated[1] != 1.0:
        made.scales['supply_voltage'] = (stated[1], 0.0)
        made.said.append(f'{source.name} in {stated[0]} -> V')
