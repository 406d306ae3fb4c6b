# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The sums of an ongoing dwell.

The chunks of a dwell are combined into at most `2 · CELLS` cells. The number of chunks per cell is
a power of two, so a dwell of days needs no more memory than a dwell of a minute.

"""

from __future__ import annotations

import numpy as np

from .chunks import Chunks
from .sums import chained, Records, summed, SUMS
from ..table import Floats

CELLS = 256

DWELL = np.dtype([*SUMS.descr,
                  ('level', float, 6),     # variance of the window at each chunk
                  ('windows', float)])     # number of windows in that sum
"""Sums of a chunk in a dwell."""

_AGREE_G = 2e-3
"""Largest change of the mean by a knock [g], in addition to the noise, at equal orientation."""


class OngoingDwell:
    """
    The accumulated chunks of a dwell.

    Parameters
    ----------
    chunks : Chunks
        Source of epoch, origin and length.
    orientation : int
        Number of the dwell.

    Attributes
    ----------
    begin, end : float
        First and last stamp [s].
    cells : (n,) array of DWELL
        Sums over `size` chunks each.
    beside_slope : bool
        Whether the reading has a slope directly before or after the dwell.

    """

    def __init__(self, chunks: Chunks, orientation: int) -> None:
        self.epoch = chunks.epoch
        self.origin = chunks.origin
        self.length = chunks.length
        self.cells = self._partial = np.empty(0, DWELL)
        self.size = 1
        self.begin = self.end = 0.0
        self.chunks = 0
        self.beside_slope = False
        self.orientation = orientation

    def add(self, sums: Records, begin: Floats, end: Floats) -> None:
        """Add consecutive chunks: (m,) sums, first and last stamps."""
        if not len(sums):
            return
        self.begin = self.begin if self.chunks else float(begin[0])
        self.end = float(end[-1])
        self.chunks += len(sums)
        while len(sums):
            room = (2 * CELLS - len(self.cells)) * self.size - len(self._partial)
            self._append(sums[:room])
            sums = sums[room:]

    def _append(self, sums: Records) -> None:
        if self.size > 1:
            sums = chained(self._partial, sums)
            whole = len(sums) // self.size * self.size
            self._partial = sums[whole:]
            sums = summed(sums[:whole], self.size) if whole else sums[:0]
        self.cells = chained(self.cells, sums)
        if len(self.cells) == 2 * CELLS:
            self.cells = summed(self.cells, 2)
            self.size *= 2

    def total(self) -> Records:
        """Return the sum of all chunks, one record."""
        every = chained(self.cells, self._partial)
        return summed(every, len(every))

    def continued_by(self, sums: Records, scale: float) -> bool:
        """Return whether these chunks have the same mean reading as the dwell."""
        old, new = self.total(), summed(sums, len(sums))
        level = np.maximum(old['level'] / np.maximum(old['windows'], 1.0)[:, np.newaxis],
                           new['level'] / new['windows'][:, np.newaxis])[0, :3]
        apart = np.abs(old['first'] / old['count'][:, np.newaxis]
                       - new['first'] / new['count'][:, np.newaxis])[0, :3]
        return bool(np.all(apart <= np.sqrt(level) + _AGREE_G * scale))
