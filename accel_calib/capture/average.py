# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs that ended to one column of figures each, many at a time.

The noise of a mean is taken along the mean where that is known to be the vertical: a sensor that
settles tilts, which moves its reading across; its mean is right for its mean attitude, and the
fit asks for the noise along the force only.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .noise import excess_of_means, strength_of
from .run import LEVEL, Run, WINDOWS
from .sliding import lines_through
from .sums import CONTEXT_COUNT, CONTEXT_SUM, COUNT, FIRST, SECOND, TIME
from ..table import Floats

# Rows of the figures of dwells; reading and rate, or the reading alone.
LOWEST = slice(0, 6)      # lower end of the mean variance of the windows
AVERAGE = slice(6, 12)    # mean variance of the windows
MEAN = slice(12, 18)
STD = slice(18, 21)       # of the samples
SLOPE = slice(21, 36)     # slope, residuals, neighbours, white; time_square, length, spacing
SPAN = slice(36, 39)      # first, last and mean stamp
SAMPLES = 39
EXCESS = 40               # variance of the mean over that of independent samples
BESIDE = 41               # whether the reading sloped just before or after
ORIENTATION = 42
AROUND = slice(43, 45)    # temperature and supply voltage
ALONG = 45                # as EXCESS, along the mean reading where that is the vertical
PARTS = slice(46, 52)     # slopes over halves of the dwell [1/s], and their strengths
FIGURES = 52


def figures(runs: Sequence[Run], *, known_units: bool) -> Floats:
    """Give what runs come to, (FIGURES, k); `known_units` if 0 is no force, but for the offset."""
    found = np.empty((FIGURES, len(runs)))
    if not runs:
        return found
    total = np.array([run.total() for run in runs]).T
    count = total[COUNT]
    shift = total[FIRST] / count
    square = np.maximum(total[SECOND] - total[FIRST] * shift, 0.0)
    variance = square[:3] / np.maximum(count - 1.0, 1.0)
    level = total[LEVEL] / np.maximum(total[WINDOWS], 1.0)
    found[MEAN] = shift + np.array([run.origin for run in runs]).T
    found[STD] = np.sqrt(variance)
    found[SLOPE], found[PARTS], found[EXCESS], found[ALONG] = _noise(
        runs, variance, level[:3], found[MEAN][:3] if known_units else None)
    spread = np.sqrt((1.0 + np.maximum(found[EXCESS], 1.0)) / count)
    found[LOWEST] = level * np.exp(-2.0 * spread)
    found[AVERAGE] = level
    found[SPAN] = np.array([(run.begin, run.end, run.epoch) for run in runs]).T
    found[SPAN.stop - 1] += total[TIME] / count
    found[SAMPLES] = count
    found[BESIDE] = [run.beside_slope for run in runs]
    found[ORIENTATION] = [run.orientation for run in runs]
    known = total[CONTEXT_COUNT]
    found[AROUND] = np.where(known > 0.0, total[CONTEXT_SUM], np.nan) / np.maximum(known, 1.0)
    return found


def _noise(runs: Sequence[Run], variance: Floats, level: Floats, mean: Floats | None
           ) -> tuple[Floats, Floats, Floats, Floats]:
    """Give `SLOPE`, `PARTS`, `EXCESS` and `ALONG`, from the means of cells."""
    sizes = np.array([run.cells.shape[1] for run in runs], dtype=float)
    cells = np.zeros((4, len(runs), int(sizes.max())))
    for k, run in enumerate(runs):
        cells[0, k, :run.cells.shape[1]] = run.cells[COUNT]
        cells[1:, k, :run.cells.shape[1]] = run.cells[FIRST][:3]
    per_cell = cells[0].sum(axis=1) / sizes
    means = cells[1:] / np.maximum(cells[0], 1.0)
    inside = cells[0] > 0.0
    centred = (means - means.sum(axis=2, keepdims=True) / sizes[:, np.newaxis]) * inside
    line = lines_through(centred, sizes)
    spacing = [run.size * run.length for run in runs]
    slope = np.vstack([line.slope, line.square, line.neighbours, level / per_cell,
                       line.time_square, sizes, spacing])
    white = variance / per_cell
    excess = excess_of_means(centred, sizes, white)
    parts = _parts(centred, sizes, level / per_cell, np.array(spacing))
    if mean is None:
        return slope, parts, excess, excess
    up = mean / np.maximum(np.linalg.norm(mean, axis=0), 1e-300)
    along = np.einsum('ak,akt->kt', up, centred)[np.newaxis]
    white = np.sum(up**2 * white, axis=0)[np.newaxis]
    return slope, parts, excess, excess_of_means(along, sizes, white)


def _parts(centred: Floats, sizes: Floats, white: Floats, spacing: Floats) -> Floats:
    """
    Give slopes over the first, the middle and the last half, and their strengths, (6, k).

    A turn that begins or ends within a dwell shows there better than over the whole.

    """
    half = sizes // 2
    inside = np.arange(int(half.max())) < half[:, np.newaxis]
    found = []
    for start in (0.0 * half, (sizes - half) // 2, sizes - half):
        index = start[:, np.newaxis] + np.arange(inside.shape[1])
        part = np.take_along_axis(centred, index.astype(np.intp)[np.newaxis], axis=2) * inside
        part -= inside * (part.sum(axis=2) / half)[:, :, np.newaxis]
        found.append(strength_of(lines_through(part, half), spacing, white))
    return np.array([*(np.sqrt(np.sum(each.slope**2, axis=0)) for each in found),
                     *(each.strength for each in found)])
