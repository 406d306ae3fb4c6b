# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The sums of a dwell as it goes on.

The chunks of a dwell are kept as at most `2 · CELLS` cells, a power of two chunks each, so that
a dwell of days takes no more memory than one of a minute.

"""

from __future__ import annotations

import math

import numpy as np

from .chunks import Chunks
from .dwell import Candidate, Dwell
from .noise import excess_of_mean
from .sliding import line
from .sums import CONTEXT, CONTEXT_COUNT, CONTEXT_SUM, COUNT, FIRST, ROW, SECOND, TIME
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

    """

    def __init__(self, chunks: Chunks, orientation: int) -> None:
        self._epoch = chunks.epoch
        self._origin = chunks.origin
        self._length = chunks.length
        self._cells: Floats = np.empty((DWELL_ROW, 0))
        self._partial: Floats = np.empty((DWELL_ROW, 0))
        self._size = 1
        self._begin = self._end = 0.0
        self.chunks = 0
        self.orientation = orientation

    def add(self, rows: Floats, begin: Floats, end: Floats) -> None:
        """Add consecutive chunks: (DWELL_ROW, m) sums, first and last stamps."""
        count = rows.shape[1]
        if not count:
            return
        self._begin = self._begin if self.chunks else float(begin[0])
        self._end = float(end[-1])
        self.chunks += count
        while rows.shape[1]:
            room = ((2 * CELLS - self._cells.shape[1]) * self._size - self._partial.shape[1])
            self._append(rows[:, :room])
            rows = rows[:, room:]

    def _append(self, rows: Floats) -> None:
        if self._size > 1:
            rows = np.concatenate([self._partial, rows], axis=1)
            whole = rows.shape[1] // self._size * self._size
            self._partial = rows[:, whole:]
            rows = rows[:, :whole].reshape(DWELL_ROW, -1, self._size).sum(axis=2)
        cells = rows if not self._cells.size else np.concatenate([self._cells, rows], axis=1)
        self._cells = cells
        if cells.shape[1] == 2 * CELLS:
            self._cells = cells[:, 0::2] + cells[:, 1::2]
            self._size *= 2

    def _total(self) -> Floats:
        return np.asarray(self._cells.sum(axis=1) + self._partial.sum(axis=1))

    def continued_by(self, rows: Floats, scale: float) -> bool:
        """Tell whether these chunks have the same mean reading as the dwell so far."""
        old = self._total()
        new = rows.sum(axis=1)
        level = np.maximum(old[LEVEL] / max(old[WINDOWS], 1.0), new[LEVEL] / new[WINDOWS])
        apart = np.abs(old[FIRST] / old[COUNT] - new[FIRST] / new[COUNT])[:3]
        return bool(np.all(apart <= np.sqrt(level[:3]) + _AGREE_G * scale))

    def candidate(self, beside_slope: bool = False) -> Candidate:
        """Give the average of what was added; beside a slope, it is suspected of going on."""
        total = self._total()
        count = total[COUNT]
        shift = total[FIRST] / count
        square = np.maximum(total[SECOND] - total[FIRST] * shift, 0.0)
        variance = square[:3] / max(count - 1.0, 1.0)
        level = total[LEVEL] / max(total[WINDOWS], 1.0)
        excess, slope = self._noise(variance, level[:3])
        mean = shift + self._origin
        dwell = Dwell(self._begin, self._end, self._epoch + float(total[TIME] / count),
                      mean[:3], np.sqrt(variance), count / max(excess, 1.0), int(count),
                      _context(total, mean[3:]), self.orientation)
        spread = math.sqrt((1.0 + max(excess, 1.0)) / count)
        levels = np.concatenate([level * math.exp(-2.0 * spread), level, mean, slope])
        return Candidate(dwell, levels, excess, beside_slope)

    def _noise(self, variance: Floats, level: Floats) -> tuple[float, Floats]:
        """Give the excess of the noise of the mean, and the slope as `dwell.SLOPE` has it."""
        cells = self._cells[FIRST.start:FIRST.start + 3] / self._cells[COUNT]
        per_cell = float(self._cells[COUNT].sum()) / cells.shape[1]
        found = line(cells)
        spacing = self._size * self._length
        return (excess_of_mean(cells, variance / per_cell),
                np.concatenate([found.slope, found.square, found.neighbours, level / per_cell,
                                [found.time_square, cells.shape[1], spacing]]))


def _context(total: Floats, rate: Floats) -> dict[str, float | Floats]:
    context: dict[str, float | Floats] = {}
    for name, count, value in zip(CONTEXT, total[CONTEXT_COUNT], total[CONTEXT_SUM]):
        if count > 0.0:
            context[name] = float(value / count)
    if math.isfinite(rate.sum()):
        context['rate'] = rate
    return context
