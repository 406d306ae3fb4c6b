# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The messages of a session: their statistics, and what is known beside them.

Rates and ages use the arrival times by a steady clock, so that they are also right for a bag that
is played at another speed. They cover the last `_SPAN` seconds.

"""

from collections import Counter, deque
from collections.abc import Callable, Mapping
import math
from typing import NamedTuple

import numpy as np

from ..table import Floats

_SPAN = 5.0
"""Time over which rate and faults are counted [s]."""

_HELD = 3.0
"""Time without shaking after which a sensor that is not still is turning slowly [s]."""

_TURNS = 0.1
"""Slowest turn that is reported [°/s]."""

_BEYOND_NOISE = 8.0
"""Range of the means of batches that do not turn, at most, in their standard deviations."""

SILENT = 2.0
"""Time without messages after which the stream counts as silent [s]."""

_FEWEST = 5
"""Smallest number of messages for a statement about stamps."""

_FEW = 0.5
"""Share of repeated stamps above which the stamps count as constant."""

_OTHER_UNIT = 50.0
"""Ratio of stamps to arrivals that no bag is played with."""

_ONE_WAY_G = 0.15
"""Largest change of the mean readings of a sensor that stays in one direction [g]."""


class _Batch(NamedTuple):
    """
    Messages that were added together.

    `arrived` and `stamp` are those of the last one [s]; `mean` is the (3,) mean reading, `length`
    the mean length of a reading, which a quick turn does not change, and `spread` the largest
    standard deviation over the axes. The others are numbers of messages.

    """

    arrived: float
    stamp: float
    mean: Floats
    length: float
    spread: float
    messages: int
    zero: int
    repeated: int
    backward: int


class StreamStatistics:
    """
    Statistics of a stream of messages.

    Attributes
    ----------
    messages : int
        Number of messages.
    dropped : Counter of str
        Number of dropped ones by kind.
    stamp, arrived : float
        Stamp of the last message, and its arrival by the steady clock [s].
    newest : (3,) array or None
        The last reading.
    spread : float
        Largest standard deviation over the axes of the last batch [unit of the reading].

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.messages, self.dropped = 0, Counter[str]()
        self.stamp = self.spread = math.nan
        self.arrived = self._advanced = self._dropped_at = -math.inf
        self.newest: Floats | None = None
        self._batches: deque[_Batch] = deque()

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; parameters as in `Session.push`."""
        stamps = rows[:, 0]
        steps = np.diff(stamps, prepend=self.stamp)  # the first step of a stream is NaN
        readings = rows[:, 1:4]
        self.spread = float(np.max(readings.std(axis=0)))
        if arrived - self.arrived > SILENT:  # the rate is that since the stream is back
            self._batches.clear()
        self._batches.append(_Batch(
            arrived, float(stamps[-1]), readings.mean(axis=0),
            float(np.linalg.norm(readings, axis=1).mean()), self.spread, len(rows),
            *(int(np.sum(each)) for each in (stamps == 0.0, steps == 0.0, steps < 0.0))))
        while self._batches[0].arrived < arrived - _SPAN:
            self._batches.popleft()
        self.messages += len(rows)
        if np.any(steps):  # NaN, too
            self._advanced = arrived
        self.stamp, self.arrived, self.newest = float(stamps[-1]), arrived, readings[-1]

    def turn_rate(self, threshold: float, expected: float) -> float:
        """Return the rate of a slow turn without shaking [°/s]; 0 if there is none."""
        track = [each for each in self._batches if 0.0 <= self.stamp - each.stamp <= _HELD]
        spread = max((each.spread for each in track), default=0.0)
        if not 0.0 < spread < threshold:  # 0: single messages do not show the noise
            return 0.0
        seconds = self.stamp - track[0].stamp
        way = float(np.linalg.norm(np.ptp([each.mean for each in track], axis=0)))
        noise = spread / math.sqrt(min(each.messages for each in track))
        rate = math.degrees(way / expected) / seconds if seconds > 0.8 * _HELD else 0.0
        return rate if rate > _TURNS and way > _BEYOND_NOISE * noise else 0.0

    def shaken(self, per_g: float) -> float:
        """Return the smallest spread of the last batches in one direction; 0 if it has turned."""
        means = np.array([each.mean for each in self._batches]).reshape(-1, 3)
        seconds = self.arrived - self._batches[0].arrived if self._batches else 0.0
        if seconds < 0.8 * _SPAN or np.max(np.ptp(means, axis=0)) > _ONE_WAY_G * per_g:
            return 0.0
        return min(each.spread for each in self._batches)

    def drop(self, kind: str, count: int = 1) -> None:
        """Count dropped messages of a kind."""
        self.dropped[kind] += count
        if kind != 'implausible':  # its raw message is already counted
            self.messages += count
        self._dropped_at = self._clock()

    @property
    def dropped_ago(self) -> float:
        """Time since the last dropped message [s]; infinite if there was none."""
        return self._clock() - self._dropped_at

    @property
    def age(self) -> float:
        """Time since the last message [s]; infinite if there was none."""
        return self._clock() - self.arrived

    @property
    def stopped(self) -> float:
        """Time for which messages have arrived with one and the same stamp [s]."""
        return self.arrived - self._advanced

    @property
    def rate(self) -> float:
        """Messages per second over the last seconds; 0 if the stream is silent."""
        if self.age > SILENT or len(self._batches) < 2:
            return 0.0
        span = self._batches[-1].arrived - self._batches[0].arrived
        count = sum(batch.messages for batch in self._batches) - self._batches[0].messages
        return count / span if span > 0.0 else 0.0

    @property
    def length(self) -> float:
        """Mean length of a reading of the last batch; NaN without messages."""
        return self._batches[-1].length if self._batches else math.nan

    @property
    def stamp_fault(self) -> str:
        """Return what is wrong with the stamps of the last seconds, and what to do, or ''."""
        if self.age > SILENT:
            return ''
        messages, zero, repeated, backward = np.sum([each[5:] for each in self._batches], axis=0)
        if messages < _FEWEST:
            return ''
        driver = 'expected the time of each reading: set header.stamp in the driver'
        steps = np.diff([(each.stamp, each.arrived) for each in self._batches], axis=0)
        stamped, arrived = steps[np.argsort(np.abs(steps[:, 0]))][:-1].sum(axis=0)  # a jump is one
        factor = abs(stamped) / arrived if arrived > 0.5 * _SPAN else 1.0
        return next((f'the stamps {words}' for holds, words in (
            (zero > _FEW * messages, f'are zero, {driver}'),
            (repeated > _FEW * messages, f'are constant ({self.stamp:.3f} s), {driver}'),
            (backward > 1, f'are out of order in {backward} of the last {messages} messages, '
             'expected increasing stamps: check that only one driver publishes'),
            (not 1.0 / _OTHER_UNIT < factor < _OTHER_UNIT,
             f'advance by {stamped:.3g} s in {arrived:.1f} s of messages, about '
             f'1e{round(math.log10(max(factor, 1e-12)))} times as much, expected seconds: the '
             'driver states them in another unit: correct header.stamp')) if holds), '')


AGAIN = 10.0
"""Shortest time between two equal log lines about single messages or a silent stream [s]."""

HELD = 30.0
"""Time after which a column of which values have arrived counts as missing [s]."""


class Around:
    """
    The last value of each column of the context, which holds until the next one.

    Attributes
    ----------
    values : mapping of str to float
        What has arrived; another mapping after each change.
    assumed : mapping of str to float
        What a calibration uses for a column of which nothing has arrived.
    filled : mapping of str to float
        The values, and what is assumed for the others.

    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._begun = clock, clock()
        self._came: dict[str, float] = {}
        self.values: Mapping[str, float] = {}
        self.assumed: Mapping[str, float] = {}
        self.filled: Mapping[str, float] = {}

    def assume(self, assumed: Mapping[str, float]) -> None:
        """Let a calibration use these values for columns of which nothing has arrived."""
        self.assumed, self.filled = assumed, {**assumed, **self.values}

    @property
    def temperature(self) -> float:
        """Return the temperature [°C]; NaN: none."""
        return self.values.get('temperature', math.nan)

    def take(self, column: str, value: float) -> None:
        """Take a value that has arrived; one that is not finite is ignored."""
        if math.isfinite(value):
            self._came[column] = self._clock()
            if value != self.values.get(column):
                self.values = {**self.values, column: value}
                self.filled = {**self.assumed, **self.values}

    def is_missing(self, column: str) -> bool:
        """Return whether nothing has arrived for too long."""
        limit = HELD if column in self._came else AGAIN
        return self._clock() - self._came.get(column, self._begun) > limit
