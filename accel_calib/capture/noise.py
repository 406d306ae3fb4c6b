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
Noise of a mean when samples are correlated, and slopes that stand out of it.

Both work on the means of K consecutive, equally long cells (chunks, or chunks joined).

**Slope.** Least squares over the cells: slope = Σ t x / Σ t², t centred. Were the samples
independent, a cell mean would have the variance w = (variance of the samples) / (samples of a
cell), and the slope w / Σ t². The residuals r tell by how much it is really more: their power
over w, times (1 + ρ)/(1 - ρ) for a correlation ρ between neighbours (an AR(1) process has this
sum of its correlations [1]_). Power and ρ are pooled over the axes, for which K cells of one
axis are too few, and are never taken below those of white noise.

**Mean.** The variance of the mean of a correlated series is the sum of its autocovariances
over its length. Sample autocovariances are noise at long lags; the sum is therefore stopped
where a pair Γ_j = γ_2j + γ_2j+1 is no longer positive, the initial positive sequence of Geyer
[2]_. Taking off the mean takes the variance of the mean from each; it is put back.

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
    A slope over cells, and how it stands to its noise.

    Parameters
    ----------
    slope : (3, ...) array
        Unit of the cells per second.
    strength : (...) array
        Sum over the axes of (slope / its standard error)².
    excess : (...) array
        Variance of a mean over that of white noise, at least 1.
    error : (...) array
        Standard error of the slope, were the samples independent, where it is largest.

    """

    slope: Floats
    strength: Floats
    excess: Floats
    error: Floats


def strength_of(line: Line, spacing: float | Floats, white: Floats, axes: slice) -> Trend:
    """
    Give slopes with how they stand to their noise.

    Parameters
    ----------
    line : Line
        Lines through cells, (3 or more, n).
    spacing : float or (n,) array
        Time from cell to cell [s].
    white : (3 or more, n) array
        Variance of a cell mean, were the samples independent.
    axes : slice
        The three axes to take together.

    """
    size = line.length
    white = white[axes] + _TINY
    slope, weight = line.slope[axes] / spacing, 1.0 / white
    square = _over_axes(line.square[axes] * weight)
    neighbours = _over_axes(line.neighbours[axes] * weight)
    correlation = np.clip(neighbours / (square + _TINY) + 3.0 / size, 0.0, _CORRELATION_MAX)
    power = np.maximum(square / (3.0 * (size - 2)), 1.0)
    excess = power * (1.0 + correlation) / (1.0 - correlation)
    time_square = line.time_square * spacing**2
    strength = _over_axes(slope * slope * weight) * time_square / excess
    error = np.sqrt(np.maximum(np.maximum(white[0], white[1]), white[2]) / time_square)
    return Trend(slope, strength, excess, error)


def _over_axes(values: Floats) -> Floats:
    return np.asarray(values[0] + values[1] + values[2])


def excess_of_mean(cells: Floats, white: Floats) -> float:
    """
    Give the variance of the mean of these cells over that of white noise.

    Parameters
    ----------
    cells : (3, K) array
        Means of K consecutive cells.
    white : (3,) array
        Variance of a cell mean, were the samples independent; axes with 0 are left out.

    """
    axes = white > 0.0
    size = cells.shape[1]
    if not axes.any() or size < 4:
        return 1.0
    centred = cells[axes] - cells[axes].mean(axis=1, keepdims=True)
    centred /= np.sqrt(white[axes])[:, np.newaxis]
    return _long_run(_autocovariance(centred, size // 2), size)


def _autocovariance(centred: Floats, lags: int) -> Floats:
    size = centred.shape[1]
    total = sum(np.correlate(row, row, 'full')[size - 1:size - 1 + lags] for row in centred)
    return np.asarray(total / (len(centred) * (size - np.arange(lags))))


def _long_run(covariance: Floats, size: int) -> float:
    pairs = covariance[:len(covariance) // 2 * 2].reshape(-1, 2).sum(axis=1)
    stop = np.flatnonzero(pairs <= 0.0)
    kept = pairs[:stop[0]] if len(stop) else pairs
    found = 2.0 * float(np.sum(kept)) - float(covariance[0])
    lost = (4.0 * len(kept) - 1.0) / size
    return max(found, 0.0) / max(1.0 - lost, 0.25)
