# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Quantities of a text log: the conversion of its columns to our units.

`decided` looks at the first block of numbers and decides the unit of each column: what the user,
the file, the maker's layout or the name states, or else what the readings at rest and the rate of
the samples show. Each assumption is in `Quantities.read_as`.

**Time.** A unit that no name states is found from the rate: 1 to 10,000 samples per second are
plausible. Where two units are, that with a rate nearer to 100 Hz is taken; stamps since 1970
decide before. A counter of the clock can start again.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .accelerometer import compact, rests_of, unit_of_reading
from .columns import Chosen, FRACTION, LogOptions, rates_beside, unused
from .dialect import EPOCH_S, has_date, RATES_HZ, seconds_of
from .names import (
    bare_name, COUNTERS, DEGREE, meaning, RATE, READING, TICKS, unit_of, UNITS, ZEROS)
from .text import Cells
from ..errors import InputError
from ..table import COLUMNS, Floats
from ..units import Units, units_of

TIME_UNITS = dict(UNITS['time'].values())
"""Factors to seconds, by the name of the unit."""

TICK = 'ticks of 100 µs'

_AGREES = 1.25
"""Factor within which the rate of stamps is the one that the file states."""

_MOST_BACK = 0.1
"""Share of steps back in time above which a column is no time."""

_LIKELY_RATE = 20.0
"""Angular rates [rad/s] of a sensor that is turned by hand stay below this; in °/s they do not."""

_LIKELY_RATE_DEG = 3000.0
_LARGEST_RATE = 40.0
"""Angular rates [rad/s] above those of common gyros, 2000 °/s."""

_LIKELY_TEMPERATURE_C = (-60.0, 150.0)

_USUAL_HZ = 100.0
_DAY_S = 86_400.0
_COUNTER = 2.0**32
_NEAR_END = 0.01
"""Share of the range of a counter, before and after it starts again, in which the stamps are."""

_MANY_ROWS = 500
_WINDOW = 8
_AT_REST = 0.3
_MOVES = 5.0
_MOVING = 0.05
"""Share of windows whose scatter is above `_MOVES` times that at rest, the quantile `_AT_REST`."""


def unit_by_rate(stamps: Floats, beside: Sequence[float] = (),
                 units: Mapping[str, float] = TIME_UNITS) -> tuple[str, float] | None:
    """
    Return the unit in which stamps have a plausible rate, and that rate [Hz], or None.

    `beside` are the rates that the file states; a unit with one of them goes first.

    """
    step = step_of(stamps)
    if not step > 0.0:
        return None
    rates = {name: 1.0 / (step * unit) for name, unit in units.items()}
    plausible = [name for name, rate in rates.items() if RATES_HZ[0] * 0.9 <= rate
                 <= RATES_HZ[1] * 1.1]
    stated = [name for name in rates if any(_agree(rates[name], rate) for rate in beside)]
    since_1970 = [name for name in plausible
                  if EPOCH_S[0] <= float(np.median(stamps)) * units[name] <= EPOCH_S[1]]
    if not np.all(stamps == np.round(stamps)) and 's' in plausible:
        plausible = ['s']
    best = min(stated or since_1970 or plausible, default=None,
               key=lambda name: abs(math.log(rates[name] / _USUAL_HZ)))
    return None if best is None else (best, rates[best])


def _agree(one: float, two: float) -> bool:
    return 1.0 / _AGREES < one / two < _AGREES


def step_of(stamps: Floats) -> float:
    """Return the usual step between stamps; some sensors repeat a stamp of whole ms."""
    steps = np.diff(stamps)
    if not len(steps):
        return 0.0
    middle = float(np.median(steps))
    forward = steps[steps > 0.0]
    if middle > 0.0 or not len(forward):
        return middle
    return float(forward.sum()) / len(steps)


def is_dense(stamps: Floats, reading: Floats) -> bool:
    """
    Return whether rows that are far apart in seconds are the samples of a moving sensor.

    A sensor that is logged each ten seconds is nearly always still. In a recording of turns and
    rests the scatter within many short windows is much larger than that at rest. Of real
    recordings by hand that is 10 % of the windows or more, of 58 h at rest 1 %.

    """
    if len(stamps) < _MANY_ROWS or step_of(stamps) < 1.0:
        return False
    windows = reading[:len(reading) // _WINDOW * _WINDOW].reshape(-1, _WINDOW, 3)
    scatter = np.linalg.norm(windows.std(axis=1), axis=1)
    at_rest = float(np.quantile(scatter, _AT_REST))
    return bool(np.mean(scatter > _MOVES * at_rest) > _MOVING)


@dataclass
class Counter:
    """Continues the times of a counter that starts again at one of these periods [s]."""

    periods: tuple[float, ...]
    added: float = 0.0
    last: float = math.nan
    starts: int = 0

    def continued(self, seconds: Floats) -> Floats:
        """Return times that go on where the counter starts again."""
        before = np.concatenate([[self.last], seconds[:-1]])
        steps = np.zeros(len(seconds))
        for period in self.periods:
            again = ((before >= (1.0 - _NEAR_END) * period) & (before < 1.000001 * period)
                     & (seconds <= _NEAR_END * period))
            steps[again] = period
            self.starts += int(np.count_nonzero(again))
        total = self.added + np.cumsum(steps)
        if len(seconds):
            self.last, self.added = float(seconds[-1]), float(total[-1])
        return seconds + total


def counter_of(unit: str, *, of_day: bool = False) -> Counter:
    """Return the counter for stamps in a unit: 2^32 µs or ms, or a day."""
    if of_day:
        return Counter((_DAY_S,))
    ranges = {'µs': (_COUNTER * 1e-6,), 'ms': (_COUNTER * 1e-3,), TICK: (_COUNTER * 1e-4,),
              's': (_COUNTER * 1e-6, _COUNTER * 1e-3)}
    return Counter(ranges.get(unit, ()))


_SAMPLES_APART_S = 0.9
"""Rows that are nearer in time are samples."""

_MOST_POSES = 1000
"""More rows than these are samples: no person takes as many poses."""

_FEW_POSES = 200
"""Fewer rows without times are poses."""

_SAME = 0.1
"""Successive samples at rest are nearer than this, relative to the spread of the readings."""

_ONE_SIDE = 0.3
"""Readings of a sensor that is not turned scatter by less, relative to their length."""

_OF_POSES = {'count', 'orientation', 'std'}
"""Columns that only poses have."""


def are_samples(columns: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether rows are samples: with time, not marked as poses, and dense or many."""
    if 'time' not in columns or _OF_POSES & columns.keys() or len(columns['time']) < 2:
        return False
    apart = float(np.median(np.diff(columns['time'])))
    return apart < _SAMPLES_APART_S or len(columns['time']) > _MOST_POSES


def are_untimed_samples(columns: Mapping[str, NDArray[Any]]) -> bool:
    """
    Return whether rows without times are samples.

    They are if a person does not take as many poses, or if they are many and have angular rates,
    are mostly like the row before, all have about the same direction, or are on no sphere.

    """
    readings = columns['reading']
    if len(readings) < _FEW_POSES or ({'time'} | _OF_POSES) & columns.keys():
        return False
    step = np.linalg.norm(np.diff(readings, axis=0), axis=1)
    middle = np.median(readings, axis=0)
    spread = np.median(np.linalg.norm(readings - middle, axis=1))
    return bool(len(readings) > _MOST_POSES or 'rate' in columns
                or np.median(step) < _SAME * spread
                or spread < _ONE_SIDE * np.linalg.norm(middle)
                or math.isnan(rests_of(readings, samples=False).radius))


@dataclass
class Quantities:
    """
    The conversion of the columns of a log; `decided` makes it.

    `scales` are the factor to our unit and our value at 0, by column. `instance` is the number of
    the sensor whose rows are read, where rows of several alternate. `rate_hz` is the rate of
    samples without times. `said` is what is assumed, and `notes` what is not used.

    """

    chosen: Chosen
    units: Units
    scales: dict[str, tuple[float, float]] = field(default_factory=dict)
    counter: Counter = field(default_factory=lambda: Counter(()))
    instance: float | None = None
    rate_hz: float | None = None
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
        columns |= {key: cells.numbers[:, self.chosen.numeric.index(k)]
                    for key, k in self.chosen.quantities.items()}
        if self.rate_hz is not None:
            columns['time'] = (cells.row - 1) / self.rate_hz
        return columns, cells.row

    def scale(self, keys: Sequence[str], factor: float, zero: float = 0.0) -> None:
        """Set the factor of columns to our unit, and our value at 0."""
        self.scales.update(dict.fromkeys(keys, (factor, zero)))

    def _scaled(self, cells: Cells, ours: str) -> Floats:
        values = self.chosen.numbers(cells, ours)
        factor, zero = self.scales.get(ours, (1.0, 0.0))
        return values if (factor, zero) == (1.0, 0.0) else values * factor + zero

    def _seconds(self, cells: Cells) -> Floats:
        if self.chosen.dates:
            return seconds_of(self.chosen.texts(cells, 'time'), self.chosen.layout.path,
                              cells.row.tolist())
        seconds = self._scaled(cells, 'time')
        if FRACTION in self.chosen.sources:
            return seconds + 1e-9 * self.chosen.numbers(cells, FRACTION)
        return seconds


def _of_instance(columns: Chosen, cells: Cells, instance: float) -> Cells:
    which = columns.numbers(cells, 'instance') == instance
    texts = [[text for text, own in zip(part, which) if own] for part in cells.texts]
    return Cells(cells.numbers[which], texts, cells.row[which])


def decided(columns: Chosen, first: Cells, options: LogOptions) -> Quantities:
    """Return the conversion of the columns, from the first block of a log; see above."""
    made = Quantities(columns, units_of('m/s2', options.gravity))
    if columns.maker is not None:
        made.said.append(f'{columns.maker.name} format')
        made.notes += [columns.maker.note] if columns.maker.note else []
    made.said += columns.layout.words
    if 'instance' in columns.sources:
        made.instance = _instance(columns, first, options, made.notes)
        first = _of_instance(columns, first, made.instance)
    if 'time' in columns.sources:
        _decide_time(made, first, options)
    _decide_reading(made, first, options)
    _decide_rate(made, first)
    _decide_temperature(made, first)
    _decide_supply(made)
    made.notes += unused(columns.layout, columns.sources)
    return made


def _instance(columns: Chosen, first: Cells, options: LogOptions, notes: list[str]) -> float:
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

def _decide_time(made: Quantities, first: Cells, options: LogOptions) -> None:
    source, path = made.chosen.sources['time'], made.chosen.layout.path
    rate_hz = options.rate or made.chosen.layout.rate_hz
    if rate_hz is not None and bare_name(source.name) in COUNTERS:
        made.scale(['time'], 1.0 / rate_hz)
        made.counter = Counter(tuple(2.0**bits / rate_hz for bits in (8, 16, 32)))
        made.said.append(f'{source.name} at {rate_hz:g} Hz (stated) -> s')
        return
    if options.rate is not None:
        raise InputError(f'{path} has times, but --rate is {options.rate:g}', 'remove --rate, or '
                         'leave the times out with --columns time=')
    if made.chosen.dates:
        of_day = not has_date(made.chosen.texts(first, 'time')[0])
        made.counter = counter_of('', of_day=of_day)
        made.said.append(f'{source.name}: {"times of the day" if of_day else "dates"} -> s')
        return
    stamps = made.chosen.numbers(first, 'time')
    back = np.count_nonzero(np.diff(stamps) < 0.0)
    if not made.chosen.layout.header and back > _MOST_BACK * (len(stamps) - 1):
        raise InputError(f'{path} has no header line, and column '
                         f'{source.name} does not increase, expected times',
                         'add a header line, or name the columns with --columns ax=1,ay=2,az=3')
    unit, words = _unit_of_time(made, first, stamps)
    made.counter = counter_of(unit)
    scale = {**TIME_UNITS, TICK: 1e-4}[unit]
    made.scale(['time'], scale)
    made.said += [words] if words else []
    stated = made.chosen.layout.rate_hz
    step = scale * step_of(stamps)
    if stated and step > 0.0 and not any(_agree(1.0 / step, rate) for rate
                                         in rates_beside(made.chosen.layout, source)):
        made.notes.append(f'{source.name} has {1.0 / step:.4g} samples per second, but the file '
                          f'states {stated:g} Hz')


def _unit_of_time(made: Quantities, first: Cells, stamps: Floats) -> tuple[str, str]:
    source, layout = made.chosen.sources['time'], made.chosen.layout
    scale = made.chosen.maker and made.chosen.maker.scales.get('time')
    if scale:
        unit = min(TIME_UNITS, key=lambda name: abs(np.log(TIME_UNITS[name] / scale)))
        return unit, f'{source.name} in {unit}' if unit != 's' else ''
    stated = unit_of('time', source.unit)
    if stated:
        return stated[0], f'{source.name} -> s' if stated[0] != 's' else source.name
    if layout.header and source.name == 'time' and (layout.about or 'count' in made.chosen.sources
                                                    or not _by_rate(made, first, stamps)):
        return 's', ''
    own = TICKS.get(bare_name(source.name), TIME_UNITS)
    found = unit_by_rate(stamps, rates_beside(layout, source), own)
    named = f'column {source.name}' if source.name.isdecimal() else source.name
    if found is None:
        return 's', f'{named} in s'
    return found[0], f'{named} in {found[0]} ({found[1]:.3g} Hz)' + (
        ' -> s' if found[0] != 's' else '')


def _by_rate(made: Quantities, first: Cells, stamps: Floats) -> bool:
    """Return whether the unit of a column ``time`` is found from the rate; by default it is s."""
    return (made.chosen.names(READING) != list(READING)
            or is_dense(stamps, made.chosen.three(first, READING)))


# ---------------------------------------------------------------------------------- reading

def _decide_reading(made: Quantities, first: Cells, options: LogOptions) -> None:
    raw = made.chosen.three(first, READING)
    columns = {'reading': raw, **{key: raw for key, column in COLUMNS.items()
                                  if column.names[0] in made.chosen.sources}}
    if 'time' in made.chosen.sources:
        samples = are_samples({**columns, 'time': made._seconds(first)})
    else:
        samples = are_untimed_samples(columns)
        made.rate_hz = options.rate or (made.chosen.layout.rate_hz if samples else None)
    samples = samples or made.rate_hz is not None
    found = unit_of_reading(made.chosen, raw, options, samples=samples)
    made.units = found.units
    made.scale(READING, found.factor)
    if found.assumed or made.said:
        made.said += found.words
    if found.units.is_native and _says_nothing(made.chosen, options):
        made.notes.append('nothing in the file says what the numbers are: they are taken for '
                          'those of an accelerometer in counts or volts; a magnetometer looks '
                          'alike')


def _says_nothing(columns: Chosen, options: LogOptions) -> bool:
    """Return whether neither names nor the user say that the readings are accelerations."""
    named = meaning(columns.sources[READING[0]].name)
    return not (options.units or columns.maker or named.quantity
                or {*READING} & {*options.columns})


# ---------------------------------------------------------------------------------- context

def _drop(made: Quantities, keys: Sequence[str], note: str) -> None:
    sources = {key: value for key, value in made.chosen.sources.items() if key not in keys}
    made.chosen = replace(made.chosen, sources=sources)
    made.notes.append(note)


def _decide_rate(made: Quantities, first: Cells) -> None:
    columns = made.chosen
    if not columns.sources.keys() >= set(RATE):
        return
    words = compact(columns.names(RATE))
    if columns.maker is not None and 'gx' in columns.maker.columns:
        made.scale(RATE, columns.maker.scales.get('gx', 1.0))
        return
    stated = unit_of('rate', columns.sources['gx'].unit)
    largest = float(np.quantile(np.abs(columns.three(first, RATE)), 0.999))
    own = columns.sources['gx'].name == 'gx' and largest < _LARGEST_RATE
    if stated is None and own and columns.layout.header:
        return
    if stated is None and largest >= _LIKELY_RATE_DEG:
        _drop(made, RATE, f'the angular rates {words} look like counts and are not used: state '
              'their unit in the names, such as gyroX_dps')
        return
    unit, factor = stated or (('rad/s', 1.0) if largest < _LIKELY_RATE else ('°/s', DEGREE))
    made.scale(RATE, factor)
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
            made.scale(['temperature'], factor, ZEROS[unit])
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
    if 'supply_voltage' not in made.chosen.sources:
        return
    source = made.chosen.sources['supply_voltage']
    unit, factor = unit_of('supply_voltage', source.unit) or ('V', 1.0)
    if factor != 1.0:
        made.scale(['supply_voltage'], factor)
        made.said.append(f'{source.name} in {unit} -> V')
