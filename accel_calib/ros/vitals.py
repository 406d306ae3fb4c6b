# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What the calibrator counts of its stream, for `health`."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from .fitting import title
from .health import Health

if TYPE_CHECKING:
    from .calibrator_node import CalibratorNode
    from .conversion import Triple


class Vitals:
    """
    Counts of a stream of messages; rates go by a steady clock.

    Parameters
    ----------
    per_g : float
        Readings in 1 g; NaN where that is not known.

    """

    def __init__(self, per_g: float) -> None:
        self._per_g = per_g
        self._bad = self._messages_at_tick = 0
        self._bad_at = -math.inf
        self._tick_at, self._rate = time.monotonic(), 0.0
        self._reading: Triple = (math.nan, math.nan, math.nan)
        self.messages = 0
        self.stamp = math.nan
        self.temperature = math.nan

    def good(self, stamp: float, reading: Triple, count: int) -> None:
        """Count messages, of which this is the last."""
        self.messages += count
        self.stamp, self._reading = stamp, reading

    def bad(self) -> None:
        """Count a message with a reading that is not finite."""
        self.messages += 1
        self._bad += 1
        self._bad_at = time.monotonic()

    def tick(self) -> None:
        """Take the rate since the last tick."""
        now = time.monotonic()
        self._rate = (self.messages - self._messages_at_tick) / max(now - self._tick_at, 1e-3)
        self._tick_at, self._messages_at_tick = now, self.messages

    @property
    def length_g(self) -> float:
        """Give |a| of the last message [g]; NaN where it is not known."""
        return math.hypot(*self._reading) / self._per_g

    def health(self, node: CalibratorNode) -> Health:
        """Give the state of the node as it is now."""
        applied, detector, store = node.applied, node.watch.detector, node.store
        breaks = detector.interruptions
        rest_ago = math.nan
        if applied.rest is not None:
            rest_ago = 0.0 if detector.still else max(0.0, self.stamp - applied.rest.end)
        return Health(
            sensor=node.sensor, state=self._state(node), problem=node.problem,
            calibration=title(applied.calibration),
            file='' if store is None else str(store.calibration),
            writable=store is None or store.is_writable(),
            messages=self.messages, bad=self._bad, bad_ago=time.monotonic() - self._bad_at,
            rate=self._rate, length=self.length_g, temperature=self.temperature,
            rest_ago=rest_ago, residual=applied.residual, standing=applied.standing,
            poses=len(node.watch.book.poses()), interruptions=len(breaks),
            last_interruption=f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else '',
            threshold=detector.threshold, next_pose=node.commands.view.next)

    def _state(self, node: CalibratorNode) -> str:
        if not node.applied.enabled:
            return 'correction switched off, raw messages go out'
        if node.applied.calibration is not None:
            return 'correcting'
        if not self.messages:
            return 'waiting for the first message'
        return ('no calibration, raw messages go out' if node.settings.passthrough
                else 'no calibration, nothing goes out')
