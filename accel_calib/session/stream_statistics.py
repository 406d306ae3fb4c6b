# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Statistics of the stream of messages, and faults of its stamps.

Rates and ages use the arrival times by a steady clock, so that they are also right for a bag that
is played at another speed. The statistics cover the last `_SPAN` seconds.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import math
from time import monotonic
from typing import NamedTuple

import numpy as np

from ..table import Floats

_SPAN = 5.0
"""Time over which rate and faults are counted [s]."""

SILENT = 2.0
"""Time without messages after which the stream counts as silent [s]."""

_FEWEST = 5
"""Smallest number of messages for a statement about stamps."""

_FEW = 0.5
"""Share of repeated stamps above which the stamps count as constant."""


class _Batch(NamedTuple):
    """Messages that were added together: counts, and arrival of the last one [s]."""

    arrived: float
    messages: int
    zero: int
    repeated: int
    backward: int


class StreamStatistics:
    """
    Statistics of a stream of messages.

    Parameters
    ----------
    clock : callable
        Steady clock [s].

    Attributes
    ----------
    messages : int
        Number of messages.
    not_finite, foreign, implausible : int
        Numbers of dropped messages: readings that are not finite, messages of another sensor, and
        corrected messages that are not plausible.
    stamp : float
        Stamp of the last message [s].
    arrived : float
        Time of its arrival, by the steady clock [s].
    temperature : float
        Last temperature [°C]; NaN: none.
    reading : (3,) array or None
        Mean reading of the last batch.
    newest : (3,) array or None
        The last reading.
    spread : float
        Largest standard deviation over the axes of the last batch [unit of the reading].

    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self.messages = self.not_finite = self.foreign = self.implausible = 0
        self.stamp = self.temperature = self.spread = math.nan
        self.arrived = self._advanced = self._dropped_at = -math.inf
        self.reading: Floats | None = None
        self.newest: Floats | None = None
        self._batches: deque[_Batch] = deque()

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; parameters as in `Session.push`."""
        stamps = rows[:, 0]
        steps = np.diff(stamps, prepend=self.stamp)  # the first step of a stream is NaN
        self._batches.append(_Batch(
            arrived, len(rows), int(np.sum(stamps == 0.0)), int(np.sum(steps == 0.0)),
            int(np.sum(steps < 0.0))))
        while self._batches[0].arrived < arrived - _SPAN:
            self._batches.popleft()
        self.messages += len(rows)
        if np.any(steps):  # NaN, too
            self._advanced = arrived
        self.stamp, self.arrived = float(stamps[-1]), arrived
        self.reading, self.newest = rows[:, 1:4].mean(axis=0), rows[-1, 1:4]
        self.spread = float(np.max(rows[:, 1:4].std(axis=0)))

    def drop(self, name: str, count: int = 1) -> None:
        """Count dropped messages; `name` is ``not_finite``, ``foreign`` or ``implausible``."""
        setattr(self, name, getattr(self, name) + count)
        if name != 'implausible':  # its raw message is already counted
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
    def stamp_fault(self) -> str:
        """Return what is wrong with the stamps of the last seconds, and what to do, or ''."""
        if self.age > SILENT:
            return ''
        _, messages, zero, repeated, backward = (
            sum(column) for column in zip(*self._batches, strict=True))
        if messages < _FEWEST:
            return ''
        if zero > _FEW * messages:
            return ('the stamps are zero, expected the time of each reading: set header.stamp in '
                    'the driver')
        if repeated > _FEW * messages:
            return (f'the stamps are constant ({self.stamp:.3f} s), expected the time of each '
                    'reading: set header.stamp in the driver')
        if backward > 1:
            return (f'the stamps are out of order in {backward:.0f} of the last {messages:.0f} '
                    'messages, expected increasing stamps: check that only one driver publishes')
        return ''
