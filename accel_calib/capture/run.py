# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The sums of a dwell as it goes on.

The chunks of a dwell are kept as at most `2 · CELLS` cells, a power of two chunks each, so that
a dwell of days takes no more memory than one of a minute.

"""

from __future__ import annotations

import numpy as np

from .chunks import Chunks
from .sums import COUNT, FIRST, ROW
from ..table import Floats

CELLS = 256

LEVEL = slice(ROW, ROW + 6)
"""Columns of a row of sums that the dwell adds: the variance of the window at each chunk."""

WINDOWS = ROW + 6
"""Column: number of windows in the sum."""

DWELL_ROW = WINDOWS + 1

_AGREE_G = 2e-3   # [g] by which the mean may differ after a knock, beside the noise


class Run:
    """
    The chunks of a dwell, as they come.

    Parameters
    ----------
    chunks : Chunks
        Where epoch, origin and length are taken from.
    orientation : int
        Number of the dwell.

    Attributes
    ----------
    begin, end : float
        First and last stamp [s].
    cells : (DWELL_ROW, n) array
        Sums over `size` chunks each.
    beside_slope : bool
        Whether the reading sloped just before or after: it is suspected of going on.

    """

    def __init__(self, chunks: Chunks, orientation: int) -> None:
        self.epoch = chunks.epoch
        self.origin = chunks.origin
        self.length = chunks.length
        self.cells: Floats = np.empty((DWELL_ROW, 0))
        self._partial: Floats = np.empty((DWELL_ROW, 0))
        self.size = 1
        self.begin = self.end = 0.0
        self.chunks = 0
        self.beside_slope = False
        self.orientation = orientation

    def add(self, rows: Floats, begin: Floats, end: Floats) -> None:
        """Add consecutive chunks: (DWELL_ROW, m) sums, first and last stamps."""
        count = rows.shape[1]
        if not count:
            return
        self.begin = self.begin if self.chunks else float(begin[0])
        self.end = float(end[-1])
        self.chunks += count
        while rows.shape[1]:
            room = ((2 * CELLS - self.cells.shape[1]) * self.size - self._partial.shape[1])
            self._append(rows[:, :room])
            rows = rows[:, room:]

    def _append(self, rows: Floats) -> None:
        if self.size > 1:
            rows = np.concatenate([self._partial, rows], axis=1)
            whole = rows.shape[1] // self.size * self.size
            self._partial = rows[:, whole:]
            rows = rows[:, :whole].reshape(DWELL_ROW, -1, self.size).sum(axis=2)
        cells = rows if not self.cells.size else np.concatenate([self.cells, rows], axis=1)
        self.cells = cells
        if cells.shape[1] == 2 * CELLS:
            self.cells = cells[:, 0::2] + cells[:, 1::2]
            self.size *= 2

    def total(self) -> Floats:
        """Give the sum of what was added."""
        return np.asarray(self.cells.sum(axis=1) + self._partial.sum(axis=1))

    def continued_by(self, rows: Floats, scale: float) -> bool:
        """Tell whether these chunks have the same mean reading as the dwell so far."""
        old = self.total()
        new = rows.sum(axis=1)
        level = np.maximum(old[LEVEL] / max(old[WINDOWS], 1.0), new[LEVEL] / new[WINDOWS])
        apart = np.abs(old[FIRST] / old[COUNT] - new[FIRST] / new[COUNT])[:3]
        return bool(np.all(apart <= np.sqrt(level[:3]) + _AGREE_G * scale))
