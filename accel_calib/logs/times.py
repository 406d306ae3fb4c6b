# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Clock of a text log: the conversion of its column of times to seconds.

A unit that no name states is found from the rate: 1 to 10,000 samples per second are plausible.
Where two units are, that with a rate nearer to 100 Hz is taken; stamps since 1970 decide before.
A counter of the clock can start again. Rows with the newest first are turned round. Stamps that
are coarser than the samples, such as whole seconds, are spread: the k-th sample of one stamp is k
periods later, and those of the first stamp, which may lack some, end with it.

Dates are those of ISO 8601, ``2026-01-31T12:00:00.250Z``, with a blank for the T or slashes,
``31-Jan-2026``, ``31.01.2026``, and digits alone, ``20260131120000250``. A date without a zone is
taken as UTC.

"""

from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import lru_cache
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .columns import (
    Cells, Chosen, clock_in, columns_named, counter_of, EPOCH_S, FRACTION, LogOptions, RATES_HZ,
    TextLayout)
from .names import bare_name, COUNTERS, READING, TICKS, unit_of, UNITS
from ..errors import InputError
from ..finding import Finding
from ..table import Floats

_UNITS = dict(UNITS['time'].values())
"""Factors to seconds, by the name of the unit."""

_DAYS = ('%Y-%m-%d', '%d-%b-%Y', '%d.%m.%Y', '%m-%d-%Y', '%d-%m-%Y')

_TICK = 'ticks of 100 µs'
_DAY_S = 86_400.0
_COUNTS = 2.0**32
_PERIODS_S = {'µs': (_COUNTS * 1e-6,), 'ms': (_COUNTS * 1e-3,), _TICK: (_COUNTS * 1e-4,),
              's': (_COUNTS * 1e-6, _COUNTS * 1e-3)}
"""Times after which counters of 32 bits start again [s], by the unit of the stamps."""

_NEAR_END = 0.01
"""Share of the range of a counter, before and after it starts again, in which the stamps are."""

_AGREES = 1.25
"""Factor within which the rate of stamps is the one that the file states."""

_MOST_BACK = 0.1
"""Share of steps back in time above which a column is no time."""

_USUAL_HZ, _POSES_HZ = 100.0, 1.0 / 30.0
_FAR_S, _POSES_FAR_S = 1e3, 1e5
"""Usual rates of samples and of poses, and intervals of theirs that are not in s."""

_LEAST_S = 2e-5
"""Smallest interval of samples: a shorter one has another unit."""

_FOUND = {name: factor for name, factor in _UNITS.items() if name not in ('min', 'h')}
"""Units that are found by the rate; the others are too near to them."""

_TURN_S = 60.0
"""Longest turn from one pose to another one [s]."""

_FASTEST = 1.0
_ENDS = 8
"""Largest rate of the temperature of a board [°C/s], from the first to the last of these parts."""

_GAP = 3.0
"""Steps above this ratio to the median are interruptions."""

_PACKETS = 0.01
"""Share of interruptions above which samples come in packets, if most time is between them."""

_REVERSED = 0.9
"""Share of steps back in time above which the newest row is the first one."""

_COARSE_S, _COARSE_ROWS = 0.05, 3.0
"""Smallest step of stamps [s], and smallest number of samples with one stamp, that are spread."""

_UNSORTED, _STANDS, _MANY_STEPS = 0.2, 0.3, 50
"""Share of steps back in time above which rows are in no order, and of rows with one time above
which the clock stands still, of at least so many steps."""

_SENSORS, _UNLIKE, _APART = (2, 3, 4), 5.0, 0.2
"""Numbers of sensors whose rows can alternate; the factor by which readings and steps in time
then differ more than those of one; and the least difference of their readings if the times are
even, relative to 1 g: less can be vibration at half the rate of the samples."""

_WINDOW = 8
"""Number of samples of a window; the readings in it change in a turn."""


@dataclass
class Clock:
    """
    The conversion of the times of a log to seconds, block by block; `clock_of` makes it.

    `scale` is the factor to s. A counter starts again at one of the `periods` [s]. `words` is what
    is assumed, and `doubts` what contradicts it. `newest_first` is whether the rows are turned
    round. Stamps with this `interval` are spread over samples with the `period` [s], 0 if they are
    not; `since` is the number of samples since the `last` stamp changed.

    """

    columns: Chosen
    scale: float = 1.0
    periods: tuple[float, ...] = ()
    words: str = ''
    doubts: tuple[str, ...] = ()
    added: float = 0.0
    last: float = math.nan
    starts: int = 0
    newest_first: bool = False
    interval: float = 0.0
    period: float = 0.0
    since: int = -1

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Return what is done about the order and the steps of the stamps."""
        order = Finding('clock', 'rows turned round (the newest was the first)')
        steps = Finding('clock', f'stamps of {self.interval:.3g} s spread over their samples '
                        f'({1.0 / (self.period or 1.0):.3g} Hz)')
        return (order,) * self.newest_first + (steps,) * bool(self.period)

    def seconds(self, cells: Cells) -> Floats:
        """Return the times of a block as they are stated [s]."""
        columns = self.columns
        seconds = (_seconds_of(cells.texts[columns.dates[0]], columns.layout.path, cells.row)
                   if columns.dates else columns.numbers(cells, 'time')[:, 0] * self.scale)
        return seconds + _fraction_of(columns, cells)

    def continued(self, cells: Cells) -> Floats:
        """Return the times of the next block, which go on where the counter starts again [s]."""
        seconds = self.seconds(cells)
        before = np.concatenate([[self.last], seconds[:-1]])
        within: Floats | float = 0.0  # since the stamp of each row
        if self.period and len(seconds):
            index = np.arange(len(seconds))
            changes = seconds != before
            first = np.maximum.accumulate(np.where(changes, index, -1 - self.since))
            if self.since < 0:  # the first stamp of the log may lack samples
                size = int(np.argmax(changes[1:])) + 1
                first[:size] -= max(round(self.interval / self.period) - size, 0)
            self.since = int(index[-1] - first[-1])
            within = np.minimum((index - first) * self.period, self.interval)
        steps = np.zeros(len(seconds))
        for period in self.periods:
            again = ((before >= (1.0 - _NEAR_END) * period) & (before < 1.000001 * period)
                     & (seconds <= _NEAR_END * period))
            steps[again] = period
            self.starts += int(np.count_nonzero(again))
        total = self.added + np.cumsum(steps)
        if len(seconds):
            self.last, self.added = float(seconds[-1]), float(total[-1])
        return seconds + total + within


def clock_of(columns: Chosen, first: Cells, options: LogOptions, *, of_poses: bool) -> Clock:
    """Return the clock of a log with times, from its first block of samples or poses."""
    if np.any(_fraction_of(columns, first) >= 1.0):  # it is a clock of its own
        own = {**columns.sources, 'time': columns.sources[FRACTION], FRACTION: ()}
        columns = replace(columns, sources=own, dates=())
    clock = _stated_clock(columns, first, options, of_poses)
    seconds = clock.seconds(first)
    steps = np.diff(seconds)
    moving = steps[steps != 0.0]
    clock.newest_first = len(moving) > 1 and bool(np.mean(moving < 0.0) > _REVERSED)
    if len(moving) > 1 and len(steps) >= _COARSE_ROWS * len(moving):
        interval = float(np.median(np.abs(moving)))
        if interval > _COARSE_S:
            clock.interval, clock.period = interval, _step_of(seconds)
    return clock


def _fraction_of(columns: Chosen, cells: Cells) -> Floats:
    """Return the (n,) parts of a second that a column has beside whole seconds [s], or 0."""
    fraction = np.zeros(len(cells.row))
    for k in columns.sources.get(FRACTION, ()):
        _, factor = unit_of('time', columns.layout.unit(k)) or ('', 0.0)
        fraction += factor * cells.numbers[k]
    return fraction


def check_order(time: Floats, reading: Floats, source: str) -> None:
    """Raise InputError if times of many samples are equal or in no order, or rows alternate."""
    steps = np.diff(time)
    back = int(np.count_nonzero(steps < 0.0))
    ends = np.flatnonzero(np.concatenate([[True], steps != 0.0, [True]]))
    if len(steps) >= _MANY_STEPS and (equal := int(np.max(np.diff(ends)))) > _STANDS * len(time):
        raise InputError(f'{source}: the times of {equal} rows are equal, expected times that '
                         'advance', 'leave them out, and state the samples per second: '
                         '--columns time= --rate HZ')
    if len(steps) >= _MANY_STEPS and back > _UNSORTED * len(steps):
        raise InputError(f'{source}: the times of {back} of {len(steps)} rows are before that of '
                         'the row above, expected rows in the order of their times',
                         'sort the rows by their times')
    for number in _SENSORS if len(steps) >= _MANY_STEPS else ():
        far, uneven = _change(reading, 1), _change(steps[:, np.newaxis], 1)
        is_far = far > _APART * float(np.median(np.linalg.norm(reading, axis=1)))
        if _change(reading, number) * _UNLIKE < far and (
                is_far or _change(steps[:, np.newaxis], number) * _UNLIKE < uneven):
            raise InputError(f'{source}: each reading is like that {number} rows above and unlike '
                             f'that of the row above: the rows of {number} sensors alternate, '
                             'expected one sensor',
                             'write the rows of each sensor to a file of its own')


def _change(values: Floats, rows: int) -> float:
    """Return the median distance of (n, k) values from those a number of rows above."""
    return float(np.median(np.linalg.norm(values[rows:] - values[:-rows], axis=1)))


def _stated_clock(columns: Chosen, first: Cells, options: LogOptions, of_poses: bool) -> Clock:
    """Return the clock with the unit that is stated, or found from the rate."""
    (column,), layout = columns.sources['time'], columns.layout
    name, rate_hz = layout.name(column), options.rate or layout.rate_hz
    named = ' + '.join([f'column {name}' if name.isdecimal() else name,
                        *map(layout.name, columns.sources.get(FRACTION, ()))])
    if rate_hz is not None and bare_name(name) in COUNTERS:
        return Clock(columns, 1.0 / rate_hz, tuple(2.0**bits / rate_hz for bits in (8, 16, 32)),
                     f'{name} at {rate_hz:g} Hz (stated) -> s')
    if options.rate is not None:
        raise InputError(f'{layout.path} has times, but --rate is {options.rate:g}',
                         'remove --rate, or leave the times out with --columns time=')
    if columns.dates:
        dated = (match := clock_in(first.texts[column][0])) and match[1]
        _, rate = _rate_in(Clock(columns).seconds(first))
        return Clock(columns, periods=() if dated else (_DAY_S,), words=(
            f'{named}: {"dates" if dated else "times of the day"}{rate} -> s'))
    stamps = columns.numbers(first, 'time')[:, 0]
    back = np.count_nonzero(np.diff(stamps) < 0.0)
    forth = np.count_nonzero(np.diff(stamps) > 0.0)
    if not layout.header and back > _MOST_BACK * (len(stamps) - 1) and forth > (
            1.0 - _REVERSED) * back:
        raise InputError(f'{layout.path} has no header line, and column {name} does not increase, '
                         'expected times',
                         'add a header line, or name the columns with --columns ax=1,ay=2,az=3')
    unit = _unit_of_time(columns, first, stamps, of_poses)
    scale = {**_UNITS, _TICK: 1e-4}[unit]
    step, rate = _rate_in(Clock(columns, scale).seconds(first))
    words = f'{named} in {unit}{rate}{"" if unit == "s" else " -> s"}'
    agrees = not layout.rate_hz or not step > 0.0 or any(
        1.0 / _AGREES < 1.0 / step / each < _AGREES for each in _rates_beside(layout, column))
    doubts = [] if agrees else [f'{name} has {1.0 / step:.4g} samples per second, but the '
                                f'file states {layout.rate_hz:g} Hz']
    if not of_poses and 0.0 < step < _LEAST_S:
        raise InputError(f'{layout.path} has {1.0 / step:.3g} samples per second, with {named} in '
                         f'{unit}, expected at most {1.0 / _LEAST_S:.0f}',
                         'state another unit in the name, such as time_s')
    if not of_poses and step > 1.0 / RATES_HZ[0] and not unit_of('time', layout.unit(column)):
        doubts.append(f'{named} is read in {unit}, one sample each {step:.4g} s; in another unit, '
                      'its name has to state it, such as time_ms')
    return Clock(columns, scale, _PERIODS_S.get(unit, ()), words, tuple(doubts))


def _unit_of_time(columns: Chosen, first: Cells, stamps: Floats, of_poses: bool) -> str:
    (column,), layout = columns.sources['time'], columns.layout
    of_maker = columns.maker and columns.maker.scales.get('time')
    if of_maker:
        return next(name for name, factor in _UNITS.items() if factor == of_maker)
    stated = unit_of('time', layout.unit(column))
    if stated:
        return stated[0]
    step, is_counted = _step_of(stamps), 'count' in columns.sources
    is_own = layout.header and layout.name(column) == 'time' and _LEAST_S < step < (
        _POSES_FAR_S if is_counted else _FAR_S)
    if is_own and (layout.about or is_counted or of_poses or (
            columns.names('reading') == [*READING] and _can_turn(columns, first, 1.0 / step))):
        return 's'
    return _likely_unit(columns, first, stamps, of_poses) if step > 0.0 else 's'


def _can_turn(columns: Chosen, first: Cells, rate_hz: float) -> bool:
    """Return whether a sensor that was turned was turned fast enough, if this is the rate."""
    reading = columns.numbers(first, 'reading')
    windows = reading[:len(reading) // _WINDOW * _WINDOW].reshape(-1, _WINDOW, 3)
    if not len(windows):
        return True
    turned = np.linalg.norm(np.ptp(windows.mean(axis=1), axis=0))
    fastest = np.max(np.linalg.norm(np.ptp(windows, axis=1), axis=1))
    return bool(turned < np.median(np.linalg.norm(reading, axis=1))
                or _WINDOW * (turned - fastest) <= _TURN_S * rate_hz * fastest)


def _likely_unit(columns: Chosen, first: Cells, stamps: Floats, of_poses: bool) -> str:
    """Return the unit with a plausible rate, best one that the file states; else s."""
    (column,), layout = columns.sources['time'], columns.layout
    step, units = _step_of(stamps), TICKS.get(bare_name(layout.name(column)), _FOUND)
    rates = {name: 1.0 / (step * unit) for name, unit in units.items()}
    plausible = [name for name, rate in rates.items() if RATES_HZ[0] * 0.9 <= rate
                 <= RATES_HZ[1] * 1.1]
    beside = _rates_beside(layout, column)
    agreeing = [name for name, rate in rates.items()
                if any(1.0 / _AGREES < rate / each < _AGREES for each in beside)]
    since_1970 = [name for name in plausible
                  if EPOCH_S[0] <= float(np.median(stamps)) * units[name] <= EPOCH_S[1]]
    if not np.all(stamps == np.round(stamps)) and 's' in plausible:
        plausible = ['s']
    usual = _USUAL_HZ
    if of_poses:
        plausible, usual = [*rates], _POSES_HZ
    else:
        plausible = [name for name in plausible
                     if _can_turn(columns, first, rates[name])] or plausible
        if 'temperature' in columns.sources:
            warm = columns.numbers(first, 'temperature')[:, 0]
            ends = np.array_split(warm[np.isfinite(warm)], _ENDS)
            change = abs(float(np.median(ends[-1]) - np.median(ends[0]))) if len(ends[-1]) else 0.0
            plausible = [name for name in plausible
                         if change * rates[name] <= _FASTEST * len(stamps)] or plausible
    return min(agreeing or since_1970 or plausible, default='s',
               key=lambda name: abs(math.log(rates[name] / usual)))


def _rates_beside(layout: TextLayout, time: int) -> list[float]:
    """Return the rates of the rows that the file states [Hz]: in words, or by another clock."""
    rates = []
    counted = counter_of(layout)
    if layout.rate_hz is not None:
        rates.append(layout.rate_hz / (1.0 if counted is None else layout.step(counted)))
    for k, known in columns_named('time', layout.header).items():
        unit, step = unit_of('time', known.unit), layout.step(k)
        if unit is not None and k != time and step > 0.0:
            rates.append(1.0 / (unit[1] * step))
    return rates


def _rate_in(stamps: Floats) -> tuple[float, str]:
    """Return the usual step between stamps [s], and the rate in words."""
    step = _step_of(stamps)
    return step, f' ({1.0 / step:.3g} Hz)' if step > 0.0 else ''


def _step_of(stamps: Floats) -> float:
    """Return the usual step between stamps; some sensors repeat a stamp of whole ms."""
    steps = np.diff(stamps)
    if not len(steps):
        return 0.0
    if np.count_nonzero(steps < 0.0) > _REVERSED * np.count_nonzero(steps):
        steps = -steps
    middle = float(np.median(steps))
    usual = steps[(steps >= 0.0) & (steps <= _GAP * middle)]
    ends = np.flatnonzero(np.abs(steps) > _GAP * middle)
    are_packets = len(ends) > _PACKETS * len(steps) and usual.sum() < steps[ends].sum()
    if middle > 0.0 and not are_packets:  # stamps can be rounded, so the mean, without gaps
        return float(np.mean(usual))
    if len(ends) < 2:
        return float(np.maximum(steps, 0.0).sum()) / len(steps)
    between = float(np.median(np.abs(np.diff(stamps[ends + 1]))))  # stamps that advance
    return between * (len(ends) - 1) / float(ends[-1] - ends[0])


def _seconds_of(texts: NDArray[np.object_], path: Path, rows: NDArray[np.int64]) -> Floats:
    """Return the seconds of dates since 1970, or of times since midnight; else InputError."""
    seconds = np.zeros(len(texts))
    for k, text in enumerate(texts):
        day, match = None, clock_in(text)
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
