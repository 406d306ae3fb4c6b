# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Statistics of a stream of messages."""

from __future__ import annotations

import math
from time import monotonic

from ..table import Floats


class StreamStatistics:
    """
    Statistics of a stream of messages; rates use a steady clock.

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
    reading : (3,) array
        Last reading.
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
        """Count messages; parameters as in `Session.push`."""
        self.messages += len(rows)
        self.stamp, self.reading, self.arrived = float(rows[-1, 0]), rows[-1, 1:4], arrived

    def drop(self, name: str, count: int = 1) -> None:
        """Count dropped messages; `name` is ``not_finite``, ``foreign`` or ``implausible``."""
        setattr(self, name, getattr(self, name) + count)
        if name != 'implausible':  # its raw message is already counted
            self.messages += count
        self._dropped_at = monotonic()

    @property
    def dropped_ago(self) -> float:
        """Time since the last dropped message [s]; infinite if there was none."""
        return monotonic() - self._dropped_at

    def tick(self) -> None:
        """Update the rate from the messages since the last tick."""
        now = monotonic()
        self.rate = (self.messages - self._messages_at_tick) / max(now - self._tick_at, 1e-3)
        self._tick_at, self._messages_at_tick = now, self.messages
