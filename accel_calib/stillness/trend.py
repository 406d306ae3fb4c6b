# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Slopes, oscillations and the noise of means, over sliding windows of a series of chunks.

**Sliding sums.** A window of length L is composed of windows of length 1, 2, 4, …, so the cost
grows with the logarithm of L, and the result depends only on the values in the window.

**Slope.** With t = -(L-1)/2 … (L-1)/2, the least squares slope is Σ t x / Σ t². The power of the
residuals r and the product of neighbours are computed without the residuals, from Σ x² and Σ x x'
(x' is the next value). With m the mean, T = Σ t x and b the slope:

    Σ r²   = Σ x² - L m² - b T
    Σ r r' = Σ x x' - m (2 Σ x - x_0 - x_L-1) + (L-1) m²
             - b (2 T - (t_L-1 + 1)(x_L-1 - x_0)) + b² Σ t t'

**Significance.** The values are means of K consecutive cells of equal length (chunks, or joined
chunks). For independent samples, a cell mean has the variance w = (variance of the samples) /
(samples per cell), and the slope has the variance w / Σ t². For correlated samples this is
multiplied by a factor estimated from the residuals r: their power over w, times (1 + ρ)/(1 - ρ)
for a correlation ρ between neighbours (the sum of the correlations of an AR(1) process [1]_).
Power and ρ are pooled over the axes, because K cells of one axis are too few. They are at least
those of white noise.

**Oscillation.** A frequency f explains the share Σ p² / Σ r² of the residuals r of the line. Here
p is the least squares fit of a cos(2πft) + b sin(2πft), with a and b for each axis. The largest
share over all f is near 1 if one frequency dominates (periodogram of Lomb and Scargle [3]_). Over
36 cells of three axes it is about 0.14 for white noise, and about 0.3 for noise with a correlation
time of two cells, because the spectrum of noise has no peak.

**Mean.** The variance of the mean of a correlated series is the sum of its autocovariances divided
by its length. Those at long lags are noise, so that the sum ends where a pair Γ_j = γ_2j + γ_2j+1
is not positive (initial positive sequence, Geyer [2]_). Subtracting the mean removes the variance
of the mean from each autocovariance; it is added again.

References
----------
.. [1] G. E. P. Box, G. M. Jenkins, G. C. Reinsel, Time Series Analysis, 3rd ed., section 2.1.
.. [2] C. J. Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7 (1992) 473-483.
.. [3] J. D. Scargle, Studies in Astronomical Time Series Analysis II, Astrophysical Journal 263
   (1982) 835-853.

"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .chunks import CHUNKS_PER_WINDOW, Records
from ..units import Floats, Indices

_FEWEST_PERIODS = 2.0
"""Number of periods in a window below which a drift resembles an oscillation."""

_BATCH = 4096
"""Number of windows of which the oscillation is computed at a time, to bound the memory."""

_CORRELATION_MAX = 0.9
_TINY = 1e-300

_ROUND_OFF = 1e-13
"""Ratio of a variance to the mean square about the origin below which it is a rounding error."""


def sliding(fold: np.ufunc, values: Floats, length: int) -> Floats:
    """Return the sums (`numpy.add`) or maxima over windows of this length along the last axis."""
    count = values.shape[-1] - length + 1
    found: Floats | None = None
    size, start = 1, 0
    while True:
        if length & size:
            part = values[..., start:start + count]
            found = part if found is None else fold(found, part)
            start += size
        if start == length:
            return np.asarray(found)
        values = fold(values[..., :-size], values[..., size:])
        size *= 2


def window_figures(sums: Records, origin: Floats) -> tuple[Floats, Floats]:
    """Return the (axes, m) means and variances of all windows, of sums relative to an origin."""
    first, second = (np.ascontiguousarray(sums[name].T[:len(origin)])
                     for name in ('first', 'second'))
    inside, total, power = (sliding(np.add, each, CHUNKS_PER_WINDOW)
                            for each in (sums['count'], first, second))
    mean = total / inside
    square = power - total * mean
    return mean + origin[:, np.newaxis], np.where(
        square <= _ROUND_OFF * power, 0.0, square) / (inside - 1.0)


def oscillation(values: Floats, length: int, index: Indices) -> Floats:
    """
    Return the (m,) largest shares of the residuals of all axes that one frequency explains.

    `values` are (axes, n), and `index` (m,) the first values of the windows of this length.

    """
    line, waves = _waves(length)
    found = np.empty(len(index))
    for start in range(0, len(index), _BATCH):
        part = index[start:start + _BATCH, np.newaxis] + np.arange(length)
        window = values[:, part]
        window = window - window.mean(axis=2, keepdims=True)
        window -= (window @ line)[..., np.newaxis] * line
        power = np.sum((window @ waves)**2, axis=0).reshape(len(part), -1, 2).sum(axis=2)
        found[start:start + _BATCH] = (power.max(axis=1)
                                       / (np.sum(window**2, axis=(0, 2)) + _TINY))
    return found


@cache
def _waves(length: int) -> tuple[Floats, Floats]:
    """Return the unit line, and (length, 2 f) orthonormal pairs of waves of f frequencies."""
    time = np.arange(length) - 0.5 * (length - 1)
    smooth = np.column_stack([np.full(length, length**-0.5), time / np.sqrt(np.sum(time**2))])
    found = []
    for periods in np.arange(_FEWEST_PERIODS, 0.5 * length, 0.5):
        angle = 2.0 * np.pi * periods / length * time
        pair = np.column_stack([np.cos(angle), np.sin(angle)])
        found.append(np.linalg.qr(pair - smooth @ (smooth.T @ pair))[0])
    return smooth[:, 1], np.concatenate(found, axis=1)


class Trend(NamedTuple):
    """
    Least squares lines through windows of cells of three axes.

    `slope` (3, ...) is in the unit of the cells per second, and `square` (3, ...) the sum of the
    squared residuals. `strength` (...) is the sum over the axes of (slope / its standard error)².
    `excess` is the ratio of the variance of a mean to that of white noise, at least 1. `error` is
    the standard error of the slope of the noisiest axis, for independent samples.

    """

    slope: Floats
    square: Floats
    strength: Floats
    excess: Floats
    error: Floats


def trend_of(values: Floats, length: int, spacing: float, white: Floats) -> Trend:
    """
    Return the lines through all windows of this length: (3, ..., n) to (3, ..., n - length + 1).

    The cells are at this spacing [s]. `white` (3, ...) is the variance of a cell mean for
    independent samples.

    """
    windows = sliding_window_view(values, length, axis=-1)
    time = np.arange(length) - 0.5 * (length - 1)
    time_square = float(np.sum(time**2))
    total, moment = windows.sum(axis=-1), np.einsum('...t,t->...', windows, time)
    step, mean = moment / time_square, total / length
    first, last = windows[..., 0], windows[..., -1]
    # Relative to the mean: digits of a small noise on a large mean are lost only once.
    square = np.einsum('...t,...t->...', windows, windows) - total * mean
    square = np.maximum(square - step * moment, 0.0)
    product = np.einsum('...t,...t->...', windows[..., 1:], windows[..., :-1])
    product -= mean * (2.0 * total - first - last) - (length - 1) * mean * mean
    product -= step * (2.0 * moment - (time[-1] + 1.0) * (last - first))
    product += step * step * float(np.sum(time[1:] * time[:-1]))
    white = white + _TINY
    weight = 1.0 / white
    squares, neighbours = (np.sum(each * weight, axis=0) for each in (square, product))
    correlation = np.clip(neighbours / (squares + _TINY) + 3.0 / length, 0.0, _CORRELATION_MAX)
    power = np.maximum(squares / (3.0 * max(length - 2, 1)), 1.0)
    excess = power * (1.0 + correlation) / (1.0 - correlation)
    slope, time_square = step / spacing, time_square * spacing**2
    strength = np.sum(slope * slope * weight, axis=0) * time_square / excess
    return Trend(slope, square, strength, excess, np.sqrt(np.max(white, axis=0) / time_square))


def excess_of_means(centred: Floats, white: Floats) -> float:
    """
    Return the excess of a series: the variance of its mean over that of white noise.

    `centred` (axes, K) are means of cells minus their common mean; the excess is 1 for fewer than
    4 cells. `white` (axes,) is the variance of a cell mean for independent samples; axes with 0
    are ignored.

    """
    axes, size = white > 0.0, centred.shape[1]
    if size < 4 or not axes.any():
        return 1.0
    scaled = centred[axes] / np.sqrt(white[axes])[:, np.newaxis]
    # The autocovariances are computed by a Fourier transform with zero padding.
    padded = 1 << (2 * size - 1).bit_length()
    power = np.sum(np.abs(np.fft.rfft(scaled, padded, axis=1))**2, axis=0)
    terms = (size - np.arange(size)) * axes.sum()
    return _long_run(np.fft.irfft(power, padded)[:size] / terms, size)


def _long_run(covariance: Floats, size: int) -> float:
    """Return the sum of the autocovariances of a series at lags below its half; see the module."""
    near = covariance[:size // 2]
    pairs = near[0:-1:2] + near[1::2]
    kept = pairs[np.logical_and.accumulate(pairs > 0.0)]
    lost = (4.0 * len(kept) - 1.0) / size
    return max(2.0 * float(kept.sum()) - float(near[0]), 0.0) / max(1.0 - lost, 0.25)


_DIGITS = 1e-14
"""Rounding error of differences of sums, relative to the squared reading."""


@dataclass(frozen=True)
class Stretch:
    """
    Figures of the last chunks up to each of m chunks.

    `slope` (3, m) and `strength` (m,) are those of the reading, see `Trend`, and `excess` (groups,
    m) that of the noise of the mean, for reading and rate. `variance` (axes, m) is the mean
    variance of the windows, and `highest` (3, m) the largest one of the reading. `samples` (m,) is
    their number, and `at_limit` (3, m) the share that repeats the extreme of its axis so far;
    `same` (m,) is the share that repeats the sample before. `means` (3, m + length - 1) are those
    of the chunks of the reading. `scatter` (m,) is the mean square of their residuals, sum over
    the axes, and `white` (m,) the same for independent samples.

    """

    slope: Floats
    strength: Floats
    excess: Floats
    variance: Floats
    highest: Floats
    samples: Floats
    at_limit: Floats
    same: Floats
    means: Floats
    scatter: Floats
    white: Floats


def stretch(sums: Records, level: Floats, length: int, size: int, spacing: float) -> Stretch:
    """
    Return the figures over `length` chunks that end at each of the last `size` chunks.

    `sums` are those of at least as many chunks, `level` the (axes, m) variances of the windows
    that end with the last of them, and `spacing` is the length of a chunk [s].

    """
    sums = sums[len(sums) - size - length + 1:]
    inner = length - CHUNKS_PER_WINDOW + 1
    level = level[:, level.shape[1] - size - inner + 1:]
    variance = sliding(np.add, level, inner) / inner
    count = sliding(np.add, sums['count'], length)
    # Reading and rate are (3, groups, …).
    cells = sums['first'].T[:len(level)] / sums['count']
    cells = cells.reshape(-1, 3, cells.shape[1]).swapaxes(0, 1)
    white = (variance * (length / count)).reshape(-1, 3, size).swapaxes(0, 1)
    white = white + _DIGITS * np.sum(np.square(cells[..., length - 1:]), axis=0)
    found = trend_of(cells, length, spacing, white)
    return Stretch(
        slope=found.slope[:, 0], strength=found.strength[0], excess=found.excess,
        variance=variance, highest=sliding(np.maximum, level[:3], inner), samples=count,
        at_limit=sliding(np.add, sums['at_limit'].T, length) / count,
        same=sliding(np.add, sums['repeats'], length) / np.maximum(count - length, 1.0),
        means=cells[:, 0], scatter=np.sum(found.square, axis=(0, 1)) / length,
        white=np.sum(white, axis=(0, 1)))
