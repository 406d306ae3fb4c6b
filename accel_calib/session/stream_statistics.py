# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Counts of a stream of messages."""

from __future__ import annotations

import math
from time import monotonic

from ..table import Floats


class StreamStatistics:
    """
    Counts of a stream of messages; rates are by a steady clock.

    Attributes
    ----------
    messages : int
        Messages so far.
    not_finite, foreign, implausible : int
        Of these, readings that were not finite, and messages of another sensor; corrected
        messages that were not plausible.
    stamp : float
        Stamp of the last message [s].
    arrived : float
        When it arrived, by the steady clock [s].
    temperature : float
        The last one [°C]; NaN: none.
    reading : (3,) array
        The last one.
    rate : float
        Messages per second between the last two ticks.

    """

    def __init__(self) -> None:
        self.messages = self.not_finite = self.foreign = self.implausible = 0
        self.stamp = self.temperature = math.nan
        self.arrived = self._dropped_at = -math.inf
        self.reading: Floats | None = None
        self.rate = 0.0
        self._tick_at, self._messages_at_tick = monotonic(), 0

    def add(self, rows: Floats, arrived: float) -> None:
        """Count messages; arguments as `Session.push`."""
        self.messages += len(rows)
        self.stamp, self.reading, self.arrived = float(rows[-1, 0]), rows[-1, 1:4], arrived

    def drop(self, name: str, count: int = 1) -> None:
        """Count messages that are dropped: ``not_finite``, ``foreign`` or ``implausible``."""
        setattr(self, name, getattr(self, name) + count)
        if name != 'implausible':  # its raw message is counted with the others
            self.messages += count
        self._dropped_at = monotonic()

    @property
    def dropped_ago(self) -> float:
        """Time since the last message was dropped [s]; infinite: there was none."""
        return monotonic() - self._dropped_at

    def tick(self) -> None:
        """Compute the rate since the last tick."""
        now = monotonic()
        self.rate = (self.messages - self._messages_at_tick) / max(now - self._tick_at, 1e-3)
        self._tick_at, self._messages_at_tick = now, self.messages
