# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Times of a log in seconds: from stamps, from a counter that starts again, and from dates.

A unit that no name states is found from the rate: 1 to 10,000 samples per second are plausible.
Where two units are, that with a rate nearer to 100 Hz is taken; stamps since 1970 decide before.

Dates are those of ISO 8601, ``2026-01-31T12:00:00.250Z``, with a blank for the T or slashes, and
``31-Jan-2026`` and ``31.01.2026``. A date without a zone is taken as UTC.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import lru_cache
import math
from pathlib import Path
import re

import numpy as np

from ..errors import InputError
from ..table import Floats

UNITS = {'s': 1.0, 'ms': 1e-3, 'µs': 1e-6, 'ns': 1e-9}

_RATES_HZ = (1.0, 10_000.0)
_USUAL_HZ = 100.0
_EPOCH_S = (1e9, 4e9)
"""Unix times from 2001 to 2096 [s]."""

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


def unit_by_rate(stamps: Floats) -> tuple[str, float] | None:
    """
    Return the unit in which stamps have a plausible rate, and that rate [Hz].

    Parameters
    ----------
    stamps : (n,) array
        First stamps of a log.

    Returns
    -------
    (str, float) or None
        Key of `UNITS` and samples per second; None if no unit is plausible.

    """
    step = step_of(stamps)
    if not step > 0.0:
        return None
    rates = {name: 1.0 / (step * unit) for name, unit in UNITS.items()}
    plausible = [name for name, rate in rates.items() if _RATES_HZ[0] * 0.9 <= rate
                 <= _RATES_HZ[1] * 1.1]
    since_1970 = [name for name in plausible
                  if _EPOCH_S[0] <= float(np.median(stamps)) * UNITS[name] <= _EPOCH_S[1]]
    if not np.all(stamps == np.round(stamps)) and 's' in plausible:
        plausible = ['s']
    best = min(since_1970 or plausible, default=None,
               key=lambda name: abs(math.log(rates[name] / _USUAL_HZ)))
    return None if best is None else (best, rates[best])


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
    """
    Continues the times of a counter that starts again, block by block.

    Parameters
    ----------
    periods : tuple of float
        Ranges at which it can start again [s].

    """

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
    return Counter({'µs': (_COUNTER * 1e-6,), 'ms': (_COUNTER * 1e-3,),
                    's': (_COUNTER * 1e-6, _COUNTER * 1e-3)}.get(unit, ()))


_PATTERN = re.compile(
    r'(?:(\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}-[A-Za-z]{3}-\d{4}|\d{1,2}\.\d{1,2}\.\d{4})[T ])?'
    r'(\d{1,2}):(\d{2})(?::(\d{2})(?:[.,](\d+))?)? ?(Z|UTC|[-+]\d{2}(?::?\d{2})?)?', re.ASCII)
_FORMS = ('%Y-%m-%d', '%d-%b-%Y', '%d.%m.%Y')


def is_clock(text: str) -> bool:
    """Return whether a text is a date with a time, or a time of the day."""
    return _PATTERN.fullmatch(text) is not None


def has_date(text: str) -> bool:
    """Return whether a text is a date with a time."""
    found = _PATTERN.fullmatch(text)
    return found is not None and found[1] is not None


def seconds_of(texts: Sequence[str], path: Path, rows: Sequence[int]) -> Floats:
    """
    Return the seconds since 1970 of dates, or since midnight of times of the day.

    Parameters
    ----------
    texts : sequence of str
        The dates.
    path : Path
        The file, for error messages.
    rows : sequence of int
        Row numbers of the dates.

    Raises
    ------
    InputError
        If a text is no date or time.

    """
    seconds = np.empty(len(texts))
    for k, text in enumerate(texts):
        found = _seconds(text)
        if found is None:
            raise InputError(f'{path}: row {rows[k]} has the time {text[:40]!r}, expected one '
                             'such as 2026-01-31T12:00:00.250', 'correct the row or remove it')
        seconds[k] = found
    return seconds


def _seconds(text: str) -> float | None:
    """Return a date in seconds, or None if it is none."""
    found = _PATTERN.fullmatch(text)
    if found is None:
        return None
    date, hour, minute, second, digits, zone = found.groups()
    day = _day(date) if date else 0.0
    if day is None or not (int(hour) < 24 and int(minute) < 60 and int(second or 0) <= 60):
        return None
    fraction = float(f'0.{digits}') if digits else 0.0
    whole = day + int(hour) * 3600.0 + int(minute) * 60.0 + int(second or 0)
    return whole - _offset(zone) + fraction


@lru_cache(maxsize=64)
def _day(date: str) -> float | None:
    """Return the seconds from 1970 to a day, or None if there is no such day."""
    for form in _FORMS:
        try:
            day = datetime.strptime(date.replace('/', '-'), form)
        except ValueError:  # It has another form.
            continue
        return day.replace(tzinfo=timezone.utc).timestamp()
    return None


@lru_cache(maxsize=64)
def _offset(zone: str | None) -> float:
    """Return the offset of a time zone [s]."""
    if zone in (None, 'Z', 'UTC'):
        return 0.0
    size = int(zone[1:3]) * 3600.0 + int(zone[3:].lstrip(':') or 0) * 60.0
    return -size if zone[0] == '-' else size
