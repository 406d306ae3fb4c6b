# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The stillness detector: samples in, dwells out, one sensor."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
import math

import numpy as np
from numpy.typing import NDArray

from .average import figures, SPAN
from .chunks import Chunker, Interruption, together
from .dwell import Dwell, judged
from .rule import Rule
from .run import Run
from .settings import CaptureSettings
from .sums import CONTEXT, WIDTH
from .tracker import Tracker
from ..table import Floats
from ..units import Units

_NO_RATE = (math.nan, math.nan, math.nan)
_NO_CONTEXT: Mapping[str, float] = {}
_BESIDE = 100    # dwells beside which a new one is judged
_BUFFER = 4096   # samples that wait for a chunk to end, at most


class StillDetector:
    """
    Find the dwells of one sensor, sample by sample or block by block.

    Parameters
    ----------
    settings : CaptureSettings
        What is still, and for how long.
    units : Units
        Unit of the readings.
    keep : int or None
        So many dwells are kept, the last ones; None: all.

    """

    def __init__(self, settings: CaptureSettings, units: Units, keep: int | None = 1000) -> None:
        self._settings = settings
        self._chunker = Chunker(settings)
        self._rule = Rule(settings, units)
        self._tracker: Tracker | None = None
        self._figures: deque[Floats] = deque(maxlen=keep)
        self._still = False
        self._mean = np.full(6, np.nan)
        self._number = 0
        self._buffer: list[tuple[float, ...]] = []
        self._latest = -math.inf
        self._boundary = -math.inf

    def push(self, time: float, reading: Sequence[float], rate: Sequence[float] | None = None,
             context: Mapping[str, float] = _NO_CONTEXT) -> list[Dwell]:
        """
        Take one sample; the numbers must be finite.

        Parameters
        ----------
        time : float
            Header stamp [s].
        reading : sequence of 3 floats
            In the unit of the readings.
        rate : sequence of 3 floats, optional
            Angular rate [rad/s], or whatever the gyro gives.
        context : mapping of str to float
            ``temperature`` [°C] and ``supply_voltage`` [V] where known.

        Returns
        -------
        list of Dwell
            The dwells that ended, as far as they are still by what is known now.

        """
        if context:
            extra = [context.get(name, math.nan) for name in CONTEXT]
        else:
            extra = [math.nan, math.nan]
        buffer = self._buffer
        buffer.append((time, *reading, *(_NO_RATE if rate is None else rate), *extra))
        if self._latest <= time < self._boundary and len(buffer) < _BUFFER:
            self._latest = time
            return []
        self._latest = time
        self._buffer = []
        return self.push_block(np.array(buffer))

    def push_block(self, samples: Floats) -> list[Dwell]:
        """
        Take many samples at once.

        Parameters
        ----------
        samples : (n, 9) array
            Columns time, reading (3), rate (3, NaN: none), temperature and supply voltage
            (NaN: none).

        Returns
        -------
        list of Dwell
            As `push`.

        """
        return self.push_columns(_columns(samples))

    def push_columns(self, samples: Floats) -> list[Dwell]:
        """
        Take many samples at once, (k, n): the columns of `push_block` as rows.

        Rows that hold nothing may be left out at the end: k is 4, 7 or 9.

        """
        return self._told(self.add([samples]))

    def add(self, blocks: Iterable[Floats]) -> int:
        """Take many samples as `push_columns`; give the number of dwells, to be asked for."""
        count = self._keep(self._feed(blocks, last=False))
        self._boundary = self._chunker.boundary
        return count

    def close(self) -> list[Dwell]:
        """End the running dwell, for no sample follows; give it if it is one."""
        buffer, self._buffer = self._buffer, []
        samples = _columns(np.array(buffer).reshape(-1, WIDTH))
        count = self._keep(self._feed([samples], last=True) + self._leave())
        self._chunker.restart()
        self._boundary = -math.inf
        return self._told(count)

    @property
    def still(self) -> bool:
        """Tell whether the sensor is still now."""
        return self._still

    def current(self) -> Dwell | None:
        """Give the running dwell so far, if it makes a pose already."""
        run = None if self._tracker is None else self._tracker.current()
        if run is None:
            return None
        found = figures([run], known_units=self._rule.known)
        told = self._beside(found, list(self._figures))
        return told[0] if told else None

    def dwells(self) -> list[Dwell]:
        """Give the dwells that ended, of those kept, and are still by what is known now."""
        return [each for each in self._judged() if each is not None]

    def withdrawn(self) -> set[float]:
        """Give the starts of those kept that turned out not to be still."""
        return {float(column[SPAN.start]) for column, each in zip(self._figures, self._judged())
                if each is None}

    @property
    def threshold(self) -> float:
        """
        Give the standard deviation below which a window is still now.

        In the unit of the readings, of the axis where it is largest; infinite before anything
        is known of a sensor in native units.

        """
        mean = np.nan_to_num(self._mean)[:, np.newaxis]
        limit = self._rule.limit_of(self._rule.noise_of(mean))
        return float(np.sqrt(np.max(limit[:3])))

    @property
    def interruptions(self) -> tuple[Interruption, ...]:
        """Give the breaks in the stamps so far, the last thousands of them."""
        return tuple(self._chunker.interruptions)

    def _feed(self, blocks: Iterable[Floats], last: bool) -> list[Run]:
        found: list[Run] = []
        whole = [chunks for block in blocks for chunks in self._chunker.feed(block, last)]
        for chunks in together(whole):
            if chunks.fresh:
                found += self._leave()
            judged = self._rule.feed(chunks)
            if self._tracker is None:
                self._tracker = Tracker(self._settings, self._rule, judged, self._number)
            found += self._tracker.feed(judged)
            self._still = bool(judged.still[-1])
            self._mean = chunks.origin
        return found

    def _leave(self) -> list[Run]:
        if self._tracker is None:
            return []
        found = self._tracker.close()
        self._number = self._tracker.number
        self._tracker = None
        self._still = False
        return found

    def _keep(self, found: list[Run]) -> int:
        """Keep what these come to, and give their number."""
        if found:
            self._figures.extend(figures(found, known_units=self._rule.known).T.copy())
        return len(found)

    def _judged(self) -> list[Dwell | None]:
        return judged(np.array(self._figures).T, self._rule) if self._figures else []

    def _told(self, count: int) -> list[Dwell]:
        """Give the last so many dwells, judged beside the earlier ones."""
        if not count:
            return []
        last = [self._figures[k] for k in range(-min(count, len(self._figures)), 0)]
        return self._beside(np.array(last).T, list(self._figures)[:-count])

    def _beside(self, found: Floats, earlier: list[Floats]) -> list[Dwell]:
        earlier = earlier[-_BESIDE:]
        table = np.concatenate([np.array(earlier).T, found], axis=1) if earlier else found
        return [each for each in judged(table, self._rule, len(earlier)) if each is not None]


def _columns(samples: Floats) -> Floats:
    """Give (n, 9) samples as rows, without those that hold nothing."""
    known: NDArray[np.bool_] = np.any(~np.isnan(samples), axis=0)
    rows = WIDTH if known[7:].any() else 7 if known[4:7].any() else 4
    return np.ascontiguousarray(samples[:, :rows].T)
