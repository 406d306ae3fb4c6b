# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Sums, maxima and slopes over sliding windows. The cost grows with the logarithm of the length.

A window of length L is composed of windows of length 1, 2, 4, …. The result of a window therefore
depends only on the values in the window, not on earlier values or on the division into blocks.

**Slope.** With k = 0 … L-1 and t = k - (L-1)/2, the least squares slope is Σ t x / Σ t², computed
from Σ x and Σ k x. The power of the residuals r and the product of neighbours are computed without
the residuals, from Σ x² and Σ x x' (x' is the next value). With m the mean, T = Σ t x and b the
slope:

    Σ r²   = Σ x² - L m² - b T
    Σ r r' = Σ x x' - m (2 Σ x - x_0 - x_L-1) + (L-1) m²
             - b (2 T - (t_L-1 + 1)(x_L-1 - x_0)) + b² Σ t t'

"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..table import Floats


class Line(NamedTuple):
    """
    Least squares lines through windows, in units of one step.

    Parameters
    ----------
    slope : (..., n) array
        Slope per step.
    square, neighbours : (..., n) array
        Sums of the squared residuals, and of the products of neighbouring residuals.
    time_square : float or array
        Σ t².
    length : int or array
        Length of the windows.

    """

    slope: Floats
    square: Floats
    neighbours: Floats
    time_square: float | Floats
    length: int | Floats


def sliding_sum(values: Floats, length: int) -> Floats:
    """Return the sums over windows of this length along the last axis: (..., n - length + 1)."""
    return _folded(values, length, np.add)


def sliding_max(values: Floats, length: int) -> Floats:
    """Return the maxima over windows of this length."""
    return _folded(values, length, np.maximum)


def lines(values: Floats, length: int) -> Line:
    """Return the lines through all windows of this length, (axes, n - length + 1)."""
    if values.shape[-1] == length:
        centred = values - values.sum(axis=1, keepdims=True) / length
        return lines_through(centred[:, np.newaxis], np.array([length]))
    total, weighted = _weighted(values, length)
    first, last = values[..., :1 - length], values[..., length - 1:]
    square = sliding_sum(values * values, length)
    product = sliding_sum(values[..., :-1] * values[..., 1:], length - 1)
    time = np.arange(length) - 0.5 * (length - 1)
    time_square = float(np.sum(time**2))
    moment = weighted - 0.5 * (length - 1) * total
    slope = moment / time_square
    mean = total / length
    # Relative to the mean: digits of a small noise on a large mean are lost only once.
    square -= total * mean
    square -= slope * moment
    product -= mean * (2.0 * total - first - last) - (length - 1) * mean * mean
    product -= slope * (2.0 * moment - (time[-1] + 1.0) * (last - first))
    product += slope * slope * float(np.sum(time[1:] * time[:-1]))
    return Line(slope, np.maximum(square, 0.0), product, time_square,
                length)


def lines_through(centred: Floats, sizes: Floats) -> Line:
    """
    Return one line through each series.

    Parameters
    ----------
    centred : (axes, k, K) array
        Values of each series minus their mean, and 0 after the end of a series.
    sizes : (k,) array
        Lengths of the series.

    """
    index = np.arange(centred.shape[2])
    inside = index < sizes[:, np.newaxis]
    time = (index - 0.5 * (sizes[:, np.newaxis] - 1.0)) * inside
    time_square = np.einsum('kt,kt->k', time, time)
    slope = np.einsum('akt,kt->ak', centred, time) / time_square
    left = centred - slope[:, :, np.newaxis] * time
    return Line(slope, np.einsum('akt,akt->ak', left, left),
                np.einsum('akt,akt->ak', left[:, :, 1:], left[:, :, :-1]), time_square, sizes)


def _folded(values: Floats, length: int, fold: Callable[[Floats, Floats], Floats]) -> Floats:
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


def _weighted(values: Floats, length: int) -> tuple[Floats, Floats]:
    """Return the sums Σ x and Σ k x over the windows."""
    count = values.shape[-1] - length + 1
    weighted = np.zeros_like(values)
    total_found = np.zeros((*values.shape[:-1], count))
    found = np.zeros_like(total_found)
    size, start = 1, 0
    while True:
        if length & size:
            part = values[..., start:start + count]
            found = found + weighted[..., start:start + count] + start * part
            total_found = total_found + part
            start += size
        if start == length:
            return total_found, found
        weighted = weighted[..., :-size] + weighted[..., size:] + size * values[..., size:]
        values = values[..., :-size] + values[..., size:]
        size *= 2
