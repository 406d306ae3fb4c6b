# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How often the samples of each axis had which variance: what is far quieter than all rests is none.

The smallest variance so far is that of a rest, unless something else than the sensor was quieter
once: a filter of the driver that started, or a gyro that was not on yet. It was then short, and in
one orientation, while the rests of a sensor that is turned have one variance in many orientations.

"""

from typing import NamedTuple

import numpy as np

from ..table import Floats

_BINS, _ZERO = 128, 64
"""Number of bins, by powers of 2 of the variance, and bin of a variance of 1."""

_NEAR, _BELOW = 2, 4
"""Bins on each side of the most frequent one that are of rests of the sensor, and number of bins
below it from which on a variance is that of no rest."""

_RARE = 5
"""Ratio of the numbers of stretches at rest and of quieter ones above which these are no rests. An
axis that does not vary at all is not measured, unless most rests are so, as of a coarse sensor."""

_TURNED = 0.3
"""Smallest range of the mean readings at rest of a sensor that was turned, relative to them."""

_ONE_WAY = 0.2
"""Largest range of the mean readings of what is quieter, relative to that at rest."""


class Known(NamedTuple):
    """
    What all samples of a sensor show about it.

    `least` are the (6,) variances of readings and rates below which nothing is a rest, 0 if they
    are not known, and `repeats` is whether a rest can repeat one reading.

    """

    least: Floats = np.zeros(6)
    repeats: bool = True


class Levels:
    """Counts of stretches by their variance, for each of 6 axes, with the range of readings."""

    def __init__(self) -> None:
        self._counts = np.zeros((6, _BINS), np.int64)
        self._lowest = np.full((6, _BINS, 3), np.inf)
        self._highest = np.full((6, _BINS, 3), -np.inf)
        self._found: Floats | None = np.zeros(6)

    def add(self, variance: Floats, reading: Floats) -> None:
        """Count (axes, n) variances of stretches, NaN if unknown, with (3, n) mean readings."""
        axis, which = np.nonzero(np.isfinite(variance))
        if not len(axis):
            return
        self._found = None
        with np.errstate(divide='ignore'):
            level = np.floor(np.log2(variance[axis, which])) + _ZERO
        found = axis, np.clip(level, 0, _BINS - 1).astype(np.intp)
        np.add.at(self._counts, found, 1)
        np.minimum.at(self._lowest, found, reading.T[which])
        np.maximum.at(self._highest, found, reading.T[which])

    @property
    def least(self) -> Floats:
        """Return the (6,) variances at rest where something was far quieter; 0 elsewhere."""
        if self._found is None:
            self._found = np.zeros(6)
            for axis, counts in enumerate(self._counts):
                lowest, highest = self._lowest[axis], self._highest[axis]
                near = np.convolve(counts, np.ones(2 * _NEAR + 1), 'same')
                most = int(np.argmax(near))
                rests = slice(max(most - _NEAR, 0), most + _NEAR + 1)
                peak = rests.start + int(np.argmax(counts[rests]))
                quieter = slice(1, max(peak - _BELOW, 1))
                count = int(np.sum(counts[quieter]))
                if not (count + counts[0] and max(count * _RARE, counts[0]) < near[most]):
                    continue
                low, high = lowest[rests].min(axis=0), highest[rests].max(axis=0)
                turned = np.max(high - low)
                way = np.max(highest[quieter].max(axis=0, initial=-np.inf)
                             - lowest[quieter].min(axis=0, initial=np.inf))
                size = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))
                if turned > _TURNED * size and way < _ONE_WAY * turned:
                    self._found[axis] = 2.0**(peak - _ZERO)
        return self._found
