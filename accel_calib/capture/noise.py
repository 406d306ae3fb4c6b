# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Noise of the mean of correlated samples, and significance of slopes.

Both use the means of K consecutive cells of equal length (chunks, or joined chunks).

**Slope.** Least squares over the cells: slope = Σ t x / Σ t², with t centred. For independent
samples, a cell mean has the variance w = (variance of the samples) / (samples per cell), and the
slope has the variance w / Σ t². For correlated samples this is multiplied by a factor estimated
from the residuals r: their power over w, times (1 + ρ)/(1 - ρ) for a correlation ρ between
neighbours (the sum of the correlations of an AR(1) process [1]_). Power and ρ are pooled over the
axes, because K cells of one axis are too few. They are at least those of white noise.

**Mean.** The variance of the mean of a correlated series is the sum of its autocovariances divided
by its length. Sample autocovariances at long lags are noise. The sum therefore ends where a pair
Γ_j = γ_2j + γ_2j+1 is not positive (initial positive sequence, Geyer [2]_). Subtracting the mean
removes the variance of the mean from each autocovariance; it is added again.

References
----------
.. [1] G. E. P. Box, G. M. Jenkins, G. C. Reinsel, Time Series Analysis, 3rd ed., section 2.1.
.. [2] C. J. Geyer, Practical Markov Chain Monte Carlo, Statistical Science 7 (1992) 473-483.

"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .sliding import Line
from ..table import Floats

_CORRELATION_MAX = 0.9
_TINY = 1e-300


class Trend(NamedTuple):
    """
    A slope over cells, and its significance.

    Parameters
    ----------
    slope : (3, ...) array
        Slope in the unit of the cells per second.
    strength : (...) array
        Sum over the axes of (slope / its standard error)².
    excess : (...) array
        Ratio of the variance of a mean to that of white noise, at least 1.
    error : (...) array
        Standard error of the slope of the noisiest axis, for independent samples.

    """

    slope: Floats
    strength: Floats
    excess: Floats
    error: Floats


def strength_of(line: Line, spacing: float | Floats, white: Floats) -> Trend:
    """
    Return slopes with their significance.

    Parameters
    ----------
    line : Line
        Lines through cells, (3, ...).
    spacing : float or array
        Time between cells [s].
    white : (3, ...) array
        Variance of a cell mean for independent samples.

    """
    size = line.length
    white = white + _TINY
    slope, weight = line.slope / spacing, 1.0 / white
    square = _over_axes(line.square * weight)
    neighbours = _over_axes(line.neighbours * weight)
    correlation = np.clip(neighbours / (square + _TINY) + 3.0 / size, 0.0, _CORRELATION_MAX)
    power = np.maximum(square / (3.0 * (size - 2)), 1.0)
    excess = power * (1.0 + correlation) / (1.0 - correlation)
    time_square = line.time_square * spacing**2
    strength = _over_axes(slope * slope * weight) * time_square / excess
    error = np.sqrt(np.maximum(np.maximum(white[0], white[1]), white[2]) / time_square)
    return Trend(slope, strength, excess, error)


def _over_axes(values: Floats) -> Floats:
    return np.asarray(values[0] + values[1] + values[2])


def excess_of_means(centred: Floats, sizes: Floats, white: Floats) -> Floats:
    """
    Return the excess of each series: the variance of its mean over that of white noise.

    Parameters
    ----------
    centred : (3, k, K) array
        Means of consecutive cells minus their common mean, and 0 after the end of a series.
    sizes : (k,) array
        Lengths of the series.
    white : (3, k) array
        Variance of a cell mean for independent samples; axes with 0 are ignored.

    Returns
    -------
    (k,) array
        The excess; 1 for a series of fewer than 4 cells.

    """
    axes = white > 0.0
    scaled = centred / np.sqrt(np.where(axes, white, np.inf))[:, :, np.newaxis]
    covariance = _autocovariance(scaled, sizes, np.maximum(axes.sum(axis=0), 1))
    found = _long_run(covariance, sizes)
    return np.where(axes.any(axis=0) & (sizes >= 4), found, 1.0)


def _autocovariance(centred: Floats, sizes: Floats, axes: Floats) -> Floats:
    """Return (k, lags) autocovariances, by a Fourier transform with zero padding."""
    length = centred.shape[2]
    padded = 1 << (2 * length - 1).bit_length()
    power = np.sum(np.abs(np.fft.rfft(centred, padded, axis=2))**2, axis=0)
    lags = np.arange(max(length // 2, 2))
    terms = np.maximum(sizes[:, np.newaxis] - lags, 1.0)
    return np.asarray(np.fft.irfft(power, padded, axis=1)[:, lags]
                      / (terms * axes[:, np.newaxis]))


def _long_run(covariance: Floats, sizes: Floats) -> Floats:
    pairs = covariance[:, 0:-1:2] + covariance[:, 1::2]
    usable = np.arange(pairs.shape[1]) < (sizes // 2 // 2)[:, np.newaxis]
    kept = np.logical_and.accumulate((pairs > 0.0) & usable, axis=1)
    found = 2.0 * np.sum(np.where(kept, pairs, 0.0), axis=1) - covariance[:, 0]
    lost = (4.0 * kept.sum(axis=1) - 1.0) / sizes
    return np.asarray(np.maximum(found, 0.0) / np.maximum(1.0 - lost, 0.25))
