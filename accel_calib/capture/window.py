# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Windows over chunks: their means, variances and slopes, and the least variance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .noise import strength_of, Trend
from .sliding import lines, sliding_max, sliding_sum
from .sums import CHUNKS_PER_WINDOW, COUNT, FIRST, SECOND
from ..table import Floats

RELATIVE = 1e-6
"""Standard deviation over the size of a reading that is granted to data without noise."""

STD_FLOOR_G = 3.3e-4
"""Noise that is granted to any sensor [g]: smaller shaking does no harm."""

_DIGITS = 1e-14
"""Of the square of a reading: what differences of sums may be wrong by."""


def windows(rows: Floats, axes: int) -> tuple[Floats, Floats]:
    """Give mean and variance of the windows that end with each chunk, (axes, n)."""
    count = sliding_sum(rows[COUNT], CHUNKS_PER_WINDOW)
    first = sliding_sum(rows[FIRST.start:FIRST.start + axes], CHUNKS_PER_WINDOW)
    level = sliding_sum(rows[SECOND.start:SECOND.start + axes], CHUNKS_PER_WINDOW)
    mean = first / count
    level -= first * mean
    np.maximum(level, 0.0, out=level)
    level /= count - 1.0
    return mean, level


class Stretch(NamedTuple):
    """
    What was over the last chunks before each.

    Parameters
    ----------
    trend : Trend
        Slopes of the reading, (3, m).
    excess : (groups, m) array
        As that of the trend, of reading and rate.
    variance : (axes, m) array
        Mean of the windows' variances.
    highest : (3, m) array
        Highest of them, of the reading.
    samples : (m,) array
        Samples.

    """

    trend: Trend
    excess: Floats
    variance: Floats
    highest: Floats
    samples: Floats


def stretch(rows: Floats, level: Floats, length: int, size: int, spacing: float) -> Stretch:
    """Give what was over so many chunks, for the last `size` ones."""
    axes = len(level)
    rows = rows[:, rows.shape[1] - size - length + 1:]
    inner = length - CHUNKS_PER_WINDOW + 1
    level = level[:, level.shape[1] - size - inner + 1:]
    variance = sliding_sum(level, inner) / inner
    count = sliding_sum(rows[COUNT], length)
    cells = rows[FIRST.start:FIRST.start + axes] / rows[COUNT]
    white = variance * (length / count)
    square = np.square(cells[:, length - 1:]).reshape(-1, 3, size).sum(axis=1)
    white += _DIGITS * square.repeat(3, axis=0)
    line = lines(cells, length)
    line = line._replace(slope=_grouped(line.slope), square=_grouped(line.square),
                         neighbours=_grouped(line.neighbours))
    found = strength_of(line, spacing, _grouped(white))
    reading = Trend(found.slope[:, 0], *(part[0] for part in found[1:]))
    return Stretch(reading, found.excess, variance, sliding_max(level[:3], inner), count)


def _grouped(values: Floats) -> Floats:
    """Give (3, groups, n) of (axes, n)."""
    return values.reshape(-1, 3, values.shape[-1]).swapaxes(0, 1)


def at_least(floor: Floats, step: Floats, mean: Floats) -> Floats:
    """
    Give variances not less than the resolution and the size of the mean allow.

    Parameters
    ----------
    floor : (axes, n) array
        The variances, of the reading (axes = 3) and the rate (6).
    step : (2, n) array
        Smallest steps seen.
    mean : (axes, n) array
        Mean readings and rates.

    """
    groups = len(floor) // 3
    known = np.where(np.isfinite(step[:groups]), step[:groups], 0.0)
    least = np.fmax(0.25 * known**2, _tiny(mean))
    return np.asarray(np.fmax(floor, np.repeat(least, 3, axis=0)))


def _tiny(mean: Floats) -> Floats:
    """Give (groups, n) variances that are granted to data without noise."""
    square = (mean * mean).reshape((-1, 3, *mean.shape[1:]))
    return RELATIVE**2 * (square[:, 0] + square[:, 1] + square[:, 2])


def clipped(average: Floats, step: Floats, mean: Floats) -> NDArray[np.bool_]:
    """Tell which axes are constant while another varies by more than rounding: no noise."""
    reading = mean[:3]
    tiny = _tiny(reading)
    least = at_least(np.zeros_like(reading), step, reading)
    constant = average[:3] <= tiny
    return np.asarray(constant & np.any(average[:3] > 2.0 * least, axis=0))


def granted(noise: Floats, scale: Floats) -> Floats:
    """Give (axes, n) variances, those of the reading not less than is granted to any sensor."""
    found = noise.copy()
    found[:3] = np.fmax(noise[:3], (STD_FLOOR_G * scale)**2)
    return found


def rounding(step: float, floor: Floats, mean: Floats, std: Floats) -> tuple[Floats, Floats]:
    """Give what steps of the reading do to samples and to their mean; see `Rule.rounding`."""
    step = step if np.isfinite(step) else 0.0
    tiny = RELATIVE * np.sqrt(np.sum(mean**2, axis=0))
    square = step**2 / 12.0
    own = np.minimum(np.sqrt(floor), std)
    left = square * np.exp(-np.square(2.0 * np.pi * own / np.maximum(step, tiny)))
    return np.maximum(np.sqrt(square), tiny), np.maximum(left, 1e-2 * tiny**2)
