# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures of finished dwells, one record per dwell.

The noise of a mean is computed along the mean reading if that is known to be the vertical. A
sensor that settles tilts slightly, which changes its reading across the vertical. Its mean is
correct for its mean attitude, and the fit uses only the noise along the force.

"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .noise import excess_of_means, strength_of, Trend
from .ongoing import OngoingDwell
from .sliding import Line, lines_through
from .sums import chained, Records
from ..table import Floats

FIGURES = np.dtype([
    ('lowest', float, 6),     # lower confidence limit of the mean variance of the windows
    ('average', float, 6),    # mean variance of the windows
    ('mean', float, 6),       # reading and rate
    ('std', float, 3),        # of the samples
    ('slope', float, 3), ('square', float, 3), ('neighbours', float, 3),  # see `sliding.Line`
    ('time_square', float), ('cells', float),
    ('white', float, 3),      # variance of a cell mean for independent samples
    ('spacing', float),       # time between cells [s]
    ('begin', float), ('end', float), ('time', float),  # first, last and mean stamp [s]
    ('samples', float),
    ('excess', float),        # variance of the mean over that of independent samples
    ('along', float),         # the same along the mean reading, if that is the vertical
    ('beside_slope', bool),   # the reading has a slope directly before or after
    ('orientation', np.intp),
    ('around', float, 2),     # temperature and supply voltage
    ('part_slope', float, 3), ('part_strength', float, 3)])  # first, middle and last half
"""Means and variances in the unit of the readings, slopes per cell, `part_slope` per second."""


def figures(dwells: Sequence[OngoingDwell], *, known_units: bool) -> Records:
    """
    Return the figures of dwells.

    Parameters
    ----------
    dwells : sequence of OngoingDwell
        The finished dwells.
    known_units : bool
        Whether the unit is known, so that the mean reading is nearly vertical.

    Returns
    -------
    (k,) array of FIGURES
        One record per dwell.

    """
    found = np.empty(len(dwells), FIGURES)
    if not dwells:
        return found
    total = chained(*(dwell.total() for dwell in dwells))
    count = total['count'][:, np.newaxis]
    shift = total['first'] / count
    square = np.maximum(total['second'] - total['first'] * shift, 0.0)
    variance = square[:, :3] / np.maximum(count - 1.0, 1.0)
    level = total['level'] / np.maximum(total['windows'], 1.0)[:, np.newaxis]
    found['mean'] = shift + [dwell.origin for dwell in dwells]
    found['std'] = np.sqrt(variance)
    _add_noise(found, dwells, variance.T, level[:, :3].T, known_units)
    spread = np.sqrt((1.0 + np.maximum(found['excess'], 1.0)) / total['count'])
    found['lowest'] = level * np.exp(-2.0 * spread)[:, np.newaxis]
    found['average'] = level
    for name in ('begin', 'end', 'orientation', 'beside_slope'):
        found[name] = [getattr(dwell, name) for dwell in dwells]
    found['time'] = [dwell.epoch for dwell in dwells] + total['time'] / total['count']
    found['samples'] = total['count']
    known = total['context_count']
    found['around'] = np.where(known > 0.0, total['context_sum'], np.nan) / np.maximum(known, 1.0)
    return found


def trend_of(found: Records) -> Trend:
    """Return the slopes over whole dwells, with their significance."""
    line = Line(found['slope'].T, found['square'].T, found['neighbours'].T, found['time_square'],
                found['cells'])
    return strength_of(line, found['spacing'], found['white'].T)


def _add_noise(found: Records, dwells: Sequence[OngoingDwell], variance: Floats, level: Floats,
               known_units: bool) -> None:
    """Set the figures that depend on the means of cells."""
    sizes = np.array([len(dwell.cells) for dwell in dwells], dtype=float)
    count = np.zeros((len(dwells), int(sizes.max())))
    sums = np.zeros((3, *count.shape))
    for k, dwell in enumerate(dwells):
        count[k, :len(dwell.cells)] = dwell.cells['count']
        sums[:, k, :len(dwell.cells)] = dwell.cells['first'][:, :3].T
    per_cell = count.sum(axis=1) / sizes
    means = sums / np.maximum(count, 1.0)
    centred = (means - means.sum(axis=2, keepdims=True) / sizes[:, np.newaxis]) * (count > 0.0)
    line = lines_through(centred, sizes)
    spacing = np.array([dwell.size * dwell.length for dwell in dwells])
    for name in ('slope', 'square', 'neighbours'):
        found[name] = getattr(line, name).T
    found['white'], found['spacing'] = (level / per_cell).T, spacing
    found['time_square'], found['cells'] = line.time_square, sizes
    _add_parts(found, centred, sizes, level / per_cell, spacing)
    white = variance / per_cell
    found['excess'] = found['along'] = excess_of_means(centred, sizes, white)
    if known_units:
        mean = found['mean'][:, :3].T
        up = mean / np.maximum(np.linalg.norm(mean, axis=0), 1e-300)
        along = np.einsum('ak,akt->kt', up, centred)[np.newaxis]
        found['along'] = excess_of_means(along, sizes, np.sum(up ** 2 * white, axis=0)[np.newaxis])


def _add_parts(found: Records, centred: Floats, sizes: Floats, white: Floats, spacing: Floats
               ) -> None:
    """
    Set the slopes of the first, the middle and the last half, and their strengths.

    They reveal a turn that begins or ends within a dwell better than the slope of the whole dwell.

    """
    half = sizes // 2
    inside = np.arange(int(half.max())) < half[:, np.newaxis]
    for k, start in enumerate((0.0 * half, (sizes - half) // 2, sizes - half)):
        index = start[:, np.newaxis] + np.arange(inside.shape[1])
        part = np.take_along_axis(centred, index.astype(np.intp)[np.newaxis], axis=2) * inside
        part -= inside * (part.sum(axis=2) / half)[:, :, np.newaxis]
        trend = strength_of(lines_through(part, half), spacing, white)
        found['part_slope'][:, k] = np.sqrt(np.sum(trend.slope ** 2, axis=0))
        found['part_strength'][:, k] = trend.strength
