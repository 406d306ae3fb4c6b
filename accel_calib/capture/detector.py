# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The stillness detector of one sensor: it converts samples to dwells."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from .average import FIGURES, figures
from .chunks import Chunker, Interruption, together
from .dwell import Dwell, judged
from .ongoing import OngoingDwell
from .rule import Rule
from .settings import CaptureSettings
from .sums import chained, Records, WIDTH
from .tracker import Tracker
from ..table import Floats
from ..units import Units

_EARLIER = 100
"""Number of earlier dwells that are used in the test of a new dwell."""


class StillDetector:
    """
    Find the dwells of one sensor, block by block.

    The dwells do not depend on the division into blocks; a stream and a recording have the same
    dwells.

    Parameters
    ----------
    settings : CaptureSettings
        Settings of the detector.
    units : Units
        Unit of the readings.
    keep : int or None
        Number of finished dwells to keep; None: all.

    """

    def __init__(self, settings: CaptureSettings, units: Units, keep: int | None = 1000) -> None:
        self._settings = settings
        self._chunker = Chunker(settings)
        self._rule = Rule(settings, units)
        self._tracker: Tracker | None = None
        self._most = keep
        self._kept = np.empty(0, FIGURES)
        self._still = False
        self._mean = np.full(6, np.nan)
        self._number = 0

    def push(self, samples: Floats) -> list[Dwell]:
        """
        Add samples.

        Parameters
        ----------
        samples : (n, 9) array
            Columns time, reading (3), rate (3), temperature and supply voltage. Times and
            readings must be finite; NaN marks other missing values.

        Returns
        -------
        list of Dwell
            The dwells that ended, and are still according to the noise known now.

        """
        return self._last(self.add([_columns(samples)]))

    def add(self, blocks: Iterable[Floats]) -> int:
        """
        Add samples as (k, n) arrays, with the columns of `push` as rows.

        Rows without values can be omitted at the end: k is 4, 7 or 9.

        Returns
        -------
        int
            Number of dwells that ended; `dwells` returns the still ones.

        """
        return self._keep(self._feed(blocks, last=False))

    def close(self) -> list[Dwell]:
        """End the ongoing dwell, because the stream is interrupted; return it if it is still."""
        count = self._keep(self._feed([np.empty((4, 0))], last=True) + self._leave())
        self._chunker.restart()
        return self._last(count)

    @property
    def still(self) -> bool:
        """Whether the sensor is still now."""
        return self._still

    def current(self) -> Dwell | None:
        """Return the ongoing dwell so far, or None if it is too short or not still."""
        dwell = None if self._tracker is None else self._tracker.current()
        if dwell is None:
            return None
        found = self._beside(figures([dwell], known_units=self._rule.known), self._kept)
        return found[0] if found else None

    def dwells(self) -> list[Dwell]:
        """Return the kept dwells that are still according to the noise known now."""
        return [each for each in self._judged() if each is not None]

    def doubtful(self) -> set[float]:
        """Return the starts of the kept dwells that are not still with the noise known now."""
        return {float(start) for start, each in zip(self._kept['begin'], self._judged())
                if each is None}

    @property
    def threshold(self) -> float:
        """
        Return the standard deviation below which a window is still now.

        The value is the largest over the axes, in the unit of the readings. It is infinite before
        the first samples of a sensor in native units.

        """
        mean = np.nan_to_num(self._mean)[:, np.newaxis]
        limit = self._rule.limit_of(self._rule.noise_of(mean))
        return float(np.sqrt(np.max(limit[:3])))

    @property
    def interruptions(self) -> tuple[Interruption, ...]:
        """Return the most recent interruptions of the stamps, at most 10,000."""
        return tuple(self._chunker.interruptions)

    def _feed(self, blocks: Iterable[Floats], last: bool) -> list[OngoingDwell]:
        found: list[OngoingDwell] = []
        whole = [chunks for block in blocks for chunks in self._chunker.feed(block, last)]
        for chunks in together(whole):
            if chunks.fresh:
                found += self._leave()
            verdict = self._rule.feed(chunks)
            if self._tracker is None:
                self._tracker = Tracker(self._settings, self._rule, verdict, self._number)
            found += self._tracker.feed(verdict)
            self._still = bool(verdict.still[-1])
            self._mean = chunks.origin
        return found

    def _leave(self) -> list[OngoingDwell]:
        if self._tracker is None:
            return []
        found = self._tracker.close()
        self._number = self._tracker.number
        self._tracker = None
        self._still = False
        return found

    def _keep(self, found: list[OngoingDwell]) -> int:
        """Store the figures of these dwells, and return their number."""
        if found:
            new = figures(found, known_units=self._rule.known)
            every = chained(self._kept, new)
            self._kept = every if self._most is None else every[-self._most:]
        return len(found)

    def _judged(self) -> list[Dwell | None]:
        return judged(self._kept, self._rule) if len(self._kept) else []

    def _last(self, count: int) -> list[Dwell]:
        """Return the last dwells that are still, tested together with earlier dwells."""
        if not count:
            return []
        count = min(count, len(self._kept))
        return self._beside(self._kept[-count:], self._kept[:-count])

    def _beside(self, found: Records, earlier: Records) -> list[Dwell]:
        earlier = earlier[-_EARLIER:]
        table = chained(earlier, found)
        return [each for each in judged(table, self._rule, len(earlier)) if each is not None]


def _columns(samples: Floats) -> Floats:
    """Return (n, 9) samples as rows, without missing columns at the end."""
    known: NDArray[np.bool_] = np.any(~np.isnan(samples), axis=0)
    rows = WIDTH if known[7:].any() else 7 if known[4:7].any() else 4
    return np.ascontiguousarray(samples[:, :rows].T)
