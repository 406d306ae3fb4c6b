# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Windows over chunks: means, variances, slopes, and lower limits of the variance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .noise import strength_of, Trend
from .sliding import lines, sliding_max, sliding_sum
from .sums import CHUNKS_PER_WINDOW, Records
from ..table import Floats

RELATIVE = 1e-6
"""Smallest ratio of standard deviation to reading, for data without noise."""

STD_FLOOR_G = 3.3e-4
"""Smallest noise of a sensor [g]; smaller shaking is harmless."""

_DIGITS = 1e-14
"""Rounding error of differences of sums, relative to the squared reading."""


@dataclass(frozen=True)
class Columns:
    """
    Sums of chunks as contiguous arrays.

    Parameters
    ----------
    count : (n,) array
        Number of samples.
    first, second : (axes, n) array
        Sums of reading and rate, and of their squares.

    """

    count: Floats
    first: Floats
    second: Floats


def columns_of(sums: Records, axes: int) -> Columns:
    """Return the sums of n chunks for the reading (3 axes), or reading and rate (6)."""
    first, second = (np.ascontiguousarray(sums[name].T[:axes]) for name in ('first', 'second'))
    return Columns(sums['count'].copy(), first, second)


def windows(sums: Columns) -> tuple[Floats, Floats]:
    """Return mean and variance of the windows that end with each chunk, (axes, n)."""
    count = sliding_sum(sums.count, CHUNKS_PER_WINDOW)
    first = sliding_sum(sums.first, CHUNKS_PER_WINDOW)
    level = sliding_sum(sums.second, CHUNKS_PER_WINDOW)
    mean = first / count
    level -= first * mean
    np.maximum(level, 0.0, out=level)
    level /= count - 1.0
    return mean, level


@dataclass(frozen=True)
class Stretch:
    """
    Figures of the last chunks up to each chunk.

    Parameters
    ----------
    trend : Trend
        Slopes of the reading, (3, m).
    excess : (groups, m) array
        Excess of the noise of the mean, for reading and rate; see `noise`.
    variance : (axes, m) array
        Mean variance of the windows.
    highest : (3, m) array
        Largest variance of the windows, for the reading.
    samples : (m,) array
        Number of samples.

    """

    trend: Trend
    excess: Floats
    variance: Floats
    highest: Floats
    samples: Floats


def stretch(sums: Columns, level: Floats, length: int, size: int, spacing: float) -> Stretch:
    """Return the figures over `length` chunks that end at each of the last `size` chunks."""
    start = len(sums.count) - size - length + 1
    counts, first = sums.count[start:], sums.first[:, start:]
    inner = length - CHUNKS_PER_WINDOW + 1
    level = level[:, level.shape[1] - size - inner + 1:]
    variance = sliding_sum(level, inner) / inner
    count = sliding_sum(counts, length)
    cells = first / counts
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
    """Reshape (axes, n) to (3, groups, n)."""
    return values.reshape(-1, 3, values.shape[-1]).swapaxes(0, 1)


def at_least(floor: Floats, step: Floats, mean: Floats) -> Floats:
    """
    Return variances raised to the smallest values that resolution and mean allow.

    Parameters
    ----------
    floor : (axes, n) array
        The variances of the reading (axes = 3), or of reading and rate (6).
    step : (2, n) array
        Smallest steps so far.
    mean : (axes, n) array
        Mean readings and rates.

    """
    groups = len(floor) // 3
    known = np.where(np.isfinite(step[:groups]), step[:groups], 0.0)
    least = np.fmax(0.25 * known**2, _tiny(mean))
    return np.asarray(np.fmax(floor, np.repeat(least, 3, axis=0)))


def _tiny(mean: Floats) -> Floats:
    """Return the (groups, n) smallest variances, for data without noise."""
    square = (mean * mean).reshape((-1, 3, *mean.shape[1:]))
    return RELATIVE**2 * (square[:, 0] + square[:, 1] + square[:, 2])


def clipped(average: Floats, step: Floats, mean: Floats) -> NDArray[np.bool_]:
    """Return which axes are constant while another axis varies by more than rounding."""
    reading = mean[:3]
    tiny = _tiny(reading)
    least = at_least(np.zeros_like(reading), step, reading)
    constant = average[:3] <= tiny
    return np.asarray(constant & np.any(average[:3] > 2.0 * least, axis=0))


def at_least_any(noise: Floats, scale: Floats) -> Floats:
    """Return (axes, n) variances, with those of the reading raised to `STD_FLOOR_G`."""
    found = noise.copy()
    found[:3] = np.fmax(noise[:3], (STD_FLOOR_G * scale)**2)
    return found


def rounding(step: float, floor: Floats, mean: Floats, std: Floats) -> tuple[Floats, Floats]:
    """Return the effect of rounding on samples and on their mean; see `Rule.rounding`."""
    step = step if np.isfinite(step) else 0.0
    tiny = RELATIVE * np.sqrt(np.sum(mean**2, axis=0))
    square = step**2 / 12.0
    own = np.minimum(np.sqrt(floor), std)
    left = square * np.exp(-np.square(2.0 * np.pi * own / np.maximum(step, tiny)))
    return np.maximum(np.sqrt(square), tiny), np.maximum(left, 1e-2 * tiny**2)
