# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Readings at rest, as far as a reader needs them: which unit they are in, and whether gravity is in.

A sensor at rest reads 1 g plus its offset, in any direction. So the readings at rest lie on a
sphere whose radius is 1 g in the unit of the sensor. Without gravity they lie around 0, and no
sphere fits them.

"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from ...table import Floats
from ...units import STANDARD_GRAVITY

_WINDOWS = 400
"""Largest number of windows of a recording."""

_SHORTEST, _LONGEST = 8, 256
"""Shortest and longest window [samples]."""

_QUIET_SHARE = 0.3
"""Share of the windows that are taken for rests: those with the least scatter."""

_SPHERE_POINTS = 6
_SPREAD = 0.3
"""Smallest ratio of the standard deviations along the axes of the readings to fit a sphere."""

_OFF_SPHERE = 0.1
"""Largest RMS distance from the sphere, relative to its radius."""

_SMALL_G = 0.3
"""Readings at rest below this [g] have no gravity in them."""

_SMALL = 0.5
"""The same, in a unit that is not known: below half of the smallest common unit, g."""

_FACTOR = 1.4
"""Largest factor between the readings at rest and 1 g in their unit."""

_MG = (1000.0 / 1.3, 1012.0)
"""Range of whole numbers at rest that are mg; 1024 counts per g begin above it."""


@dataclass(frozen=True)
class Rests:
    """
    Readings at rest.

    Parameters
    ----------
    length : float
        Median length of the readings at rest.
    radius : float
        Radius of the sphere through them; NaN if they do not determine one.
    whole : bool
        Whether all readings are whole numbers.

    """

    length: float
    radius: float
    whole: bool

    @property
    def per_g(self) -> float:
        """Value of 1 g, as far as the readings tell."""
        return self.length if math.isnan(self.radius) else self.radius

    def near(self, per_g: float, factor: float = _FACTOR) -> bool:
        """Return whether 1 g of the readings is within a factor of a value."""
        lengths = (self.length, self.per_g)
        return all(1.0 / factor <= length / per_g <= factor for length in lengths)

    @property
    def unit(self) -> tuple[str, float] | None:
        """Return the unit of the readings and the factor to it; None if it is not common."""
        if self.near(STANDARD_GRAVITY):
            return 'm/s2', 1.0
        if self.near(1.0):
            return 'g', 1.0
        if self.near(1000.0, 1.3) and (not self.whole or _MG[0] < self.per_g < _MG[1]):
            return 'g', 1e-3
        return None

    def lack_gravity(self, per_g: float | None) -> bool:
        """
        Return whether gravity is not in the readings: they are small and on no sphere.

        Parameters
        ----------
        per_g : float or None
            1 g in the stated unit of the readings, or None if the unit is not known.

        """
        small = _SMALL if per_g is None else _SMALL_G * per_g
        return self.length < small and self.unit is None and math.isnan(self.radius)


def rests_of(reading: Floats, *, samples: bool) -> Rests:
    """
    Return the readings at rest of the first block of a log.

    Parameters
    ----------
    reading : (n, 3) array
        Readings, in the unit of the file.
    samples : bool
        Whether rows are samples; otherwise each row is a pose at rest.

    """
    still = _quiet(reading) if samples else reading
    with np.errstate(over='ignore', invalid='ignore'):
        length = float(np.median(np.linalg.norm(still, axis=1)))
        radius = _radius(still)
    whole = bool(np.all(reading[:1000] == np.round(reading[:1000])))
    return Rests(length, radius, whole)


def _quiet(reading: Floats) -> Floats:
    """Return the means of the windows with the least scatter."""
    size = int(np.clip(len(reading) // _WINDOWS, _SHORTEST, _LONGEST))
    count = len(reading) // size
    if count < 2:
        return reading
    windows = reading[:count * size].reshape(count, size, 3)
    with np.errstate(over='ignore', invalid='ignore'):
        scatter = np.linalg.norm(windows.std(axis=1), axis=1)
    quiet = np.argsort(scatter, kind='stable')[:max(2, int(_QUIET_SHARE * count))]
    means: Floats = windows[quiet].mean(axis=1)
    return means


def _radius(still: Floats) -> float:
    """Return the radius of the sphere through readings at rest; NaN if they determine none."""
    size = float(np.abs(still).max()) if len(still) else 0.0
    if len(still) < _SPHERE_POINTS or not 0.0 < size < 1e150:
        return math.nan
    scaled = still / size
    centred = scaled - scaled.mean(axis=0)
    scales = np.linalg.svd(centred, compute_uv=False)
    if scales[2] < _SPREAD * scales[0]:
        return math.nan
    # |m|² = 2 c·m + (r² - |c|²) is linear in the centre c.
    rows = np.column_stack([2.0 * centred, np.ones(len(centred))])
    found = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)[0]
    square = float(found[3] + found[:3] @ found[:3])
    if square <= 0.0:
        return math.nan
    radius = math.sqrt(square)
    off = np.linalg.norm(centred - found[:3], axis=1) - radius
    on_sphere = float(np.sqrt(np.mean(off**2))) < _OFF_SPHERE * radius
    return radius * size if on_sphere else math.nan
