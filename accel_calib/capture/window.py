# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Windows over chunks: means, variances, trends, and lower limits of the variance.

**Rounding.** Samples x = μ + n with noise n of the standard deviation σ are rounded to multiples
of q. The error of the mean of many samples depends on μ. Over all μ its variance is

    e² = q² Σ_k exp(-4π² k² σ²/q²) / (2π² k²)                                 (1)

and the mean variance v of the rounded samples is σ² + q²/12 - e² [1]_. So v determines σ and e².
For σ < 0.2 q the samples take two values at most, and v = q σ/√π. For a larger σ the first term of
(1) is enough, and e² is found by iteration.

References
----------
.. [1] B. Widrow, I. Kollár, Quantization Noise, Cambridge 2008, chapter 4.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from .chunks import CHUNKS_PER_WINDOW, Records
from .trend import lines, over_axes, sliding_max, sliding_sum, strength_of, Trend
from ..table import Floats

RELATIVE = 1e-6
"""Smallest ratio of standard deviation to reading, for data without noise."""

STD_FLOOR_G = 3.3e-4
"""Smallest noise of a sensor [g]; smaller shaking is harmless."""

AT_LIMIT = 0.1
"""Share of samples at a limit above which a variance is not that of the noise; it is then smaller
by a sixth or more."""

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
    at_limit : (3, n) array
        Number of samples that repeat the extreme of their axis so far.

    """

    count: Floats
    first: Floats
    second: Floats
    at_limit: Floats


def columns_of(sums: Records, axes: int) -> Columns:
    """Return the sums of n chunks for the reading (3 axes), or reading and rate (6)."""
    first, second = (np.ascontiguousarray(sums[name].T[:axes]) for name in ('first', 'second'))
    return Columns(sums['count'].copy(), first, second, np.ascontiguousarray(sums['at_limit'].T))


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
        Excess of the noise of the mean, for reading and rate; see above.
    variance : (axes, m) array
        Mean variance of the windows.
    highest : (3, m) array
        Largest variance of the windows, for the reading.
    samples : (m,) array
        Number of samples.
    at_limit : (3, m) array
        Share of samples that repeat the extreme of their axis so far.
    means : (3, m + length - 1) array
        Means of the chunks of the reading.
    scatter : (m,) array
        Mean square of the residuals of the means of the reading, sum over the axes.
    white : (m,) array
        The same for independent samples.

    """

    trend: Trend
    excess: Floats
    variance: Floats
    highest: Floats
    samples: Floats
    at_limit: Floats
    means: Floats
    scatter: Floats
    white: Floats


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
    scatter = over_axes(line.square) / length
    line = line._replace(slope=_grouped(line.slope), square=_grouped(line.square),
                         neighbours=_grouped(line.neighbours))
    found = strength_of(line, spacing, _grouped(white))
    reading = Trend(found.slope[:, 0], *(part[0] for part in found[1:]))
    at_limit = sliding_sum(sums.at_limit[:, start:], length) / count
    return Stretch(reading, found.excess, variance, sliding_max(level[:3], inner), count, at_limit,
                   cells[:3], scatter, over_axes(white))


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


def clipped(average: Floats, at_limit: Floats, step: Floats, mean: Floats) -> NDArray[np.bool_]:
    """
    Return which axes end at a limit while another axis varies by more than rounding.

    Parameters
    ----------
    average : (axes, n) array
        Variances.
    at_limit : (3, n) array
        Share of samples that repeat the extreme of their axis so far.
    step, mean : (2, n) array, (axes, n) array
        Smallest steps so far; mean readings and rates.

    """
    reading = mean[:3]
    tiny = _tiny(reading)
    least = at_least(np.zeros_like(reading), step, reading)
    ends = (average[:3] <= tiny) | (at_limit > AT_LIMIT)
    return np.asarray(ends & np.any(average[:3] > 2.0 * least, axis=0))


def at_least_any(noise: Floats, scale: Floats) -> Floats:
    """Return (axes, n) variances, with those of the reading raised to `STD_FLOOR_G`."""
    found = noise.copy()
    found[:3] = np.fmax(noise[:3], (STD_FLOOR_G * scale)**2)
    return found


_TWO_VALUES = 0.1128
"""Variance of rounded samples [steps²] below which they alternate between two values."""

_SOLVED = 30
"""Steps of the iteration for larger variances; each divides the error by 2.4 or more."""


def rounding_left(variance: Floats) -> Floats:
    """
    Return the variance that rounding leaves in a mean, from the variance of the rounded samples.

    Parameters
    ----------
    variance : (...) array
        Variance of the rounded samples, as an average over many true values [steps²].

    Returns
    -------
    (...) array
        Variance of the error of the mean of many samples [steps²]: 1/12 without noise, 0 if the
        noise of the samples is a step or more.

    """
    small = np.pi * variance**2 + 1.0 / 12.0 - variance
    left = np.zeros_like(variance)
    for _ in range(_SOLVED):
        left = np.exp(-4.0 * np.pi**2 * (variance - 1.0 / 12.0 + left)) / (2.0 * np.pi**2)
    return np.where(variance < _TWO_VALUES, small, left)


def rounding(step: float, mean: Floats, level: Floats) -> tuple[Floats, Floats]:
    """Return the effect of rounding on samples and on their mean; see `Rule.rounding`."""
    step = step if np.isfinite(step) else 0.0
    tiny = RELATIVE * np.sqrt(np.sum(mean**2, axis=0))
    resolution = np.maximum(step / math.sqrt(12.0), tiny)
    left = step**2 * rounding_left(level / step**2) if step > 0.0 else np.zeros(3)
    return resolution, np.maximum(left[:, np.newaxis], 1e-2 * tiny**2)
