# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The quadric through the readings of a still sensor, from the moments of the readings.

Poses of unknown orientation satisfy |W⁻¹ (reading - V)| = 1 (NXP AN5286):

    readingᵀ A reading - 2 readingᵀ A V + VᵀA V - B² = 0,   W⁻¹ = (A / B²)^(1/2)

The coefficients are the eigenvector of XᵀX with the smallest eigenvalue, where a row of X holds
the monomials of a reading. This cost depends on origin and scale. The readings are therefore first
shifted and scaled by the sphere that fits them. Counts and volts then lead to the same result as
m/s², without a loss of digits. Leading axes of all arrays are sensors.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..table import Floats

_RIDGE = 1e-12
"""Keeps the solution finite for poses in a plane; the centre is then in the plane."""

_BLOCK = 8192
"""Number of poses per block; their monomials fit in the cache."""

_IDENTITY, _ONES, _COLUMN = np.eye(3), np.ones(3), np.ones((3, 1))


@dataclass(frozen=True)
class Form:
    """
    The quadratic monomials r_i r_j of a quadric.

    Parameters
    ----------
    first, second : (k,) array of int
        i and j; pairs with i = j are first.

    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]

    @cached_property
    def pairs(self) -> NDArray[np.intp]:
        """(2 k,) array, all i, then all j."""
        return np.concatenate([self.first, self.second])

    @cached_property
    def twice(self) -> Floats:
        """(k,) array, how often each monomial occurs in rᵀ A r."""
        return np.where(self.first == self.second, 1.0, 2.0)

    @cached_property
    def linear(self) -> Floats:
        """(3, 3 k) array, the part linear in r when the origin moves by c."""
        taken = np.zeros((3, 3, len(self.twice)))
        for k, (i, j) in enumerate(zip(self.first, self.second)):
            taken[i, j, k] += self.twice[k]
            taken[j, i, k] += self.twice[k]
        return taken.reshape(3, -1)

    @cached_property
    def scatter(self) -> Floats:
        """(k, 9) array, maps the coefficients to the entries of A."""
        entries = np.zeros((len(self.twice), 3, 3))
        each = np.arange(len(self.twice))
        entries[each, self.first, self.second] = entries[each, self.second, self.first] = 1.0
        return entries.reshape(-1, 9)


DIAGONAL = Form(np.array([0, 1, 2]), np.array([0, 1, 2]))
SYMMETRIC = Form(np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2]))


def centred(reading: Floats) -> tuple[Floats, Floats]:
    """Return the (..., 3) mean, and the (..., 3, n) readings minus the mean."""
    transposed = reading.swapaxes(-1, -2)
    mean = transposed.sum(axis=-1) / reading.shape[-2]
    return mean, transposed - mean[..., np.newaxis]


def sphere_of(second: Floats, third: Floats, count: int) -> tuple[Floats, Floats]:
    """
    Return the sphere from moments about the mean.

    It solves |r|² = 2 V·r + (W² - |V|²), multiplied by r and by 1 and summed over the poses. The
    sum of all r is zero.

    Parameters
    ----------
    second : (..., 3, 3) array
        Sum of r rᵀ.
    third : (..., 3) array
        Sum of |r|² r.
    count : int
        Number of poses.

    Returns
    -------
    (..., 3) array, (...) array
        Centre and radius.

    """
    trace = second[..., 0, 0] + second[..., 1, 1] + second[..., 2, 2]
    ridge = (_RIDGE * trace + 1e-300)[..., np.newaxis, np.newaxis] * _IDENTITY
    centre = np.linalg.solve(second + ridge, third[..., np.newaxis])[..., 0] / 2.0
    squared = trace / count + (centre * centre) @ _ONES
    return centre, np.sqrt(squared + (squared == 0.0))


def quadric(reading: Floats, form: Form) -> tuple[Floats, Floats]:
    """
    Fit the quadric whose matrix A has the entries of this form; other entries are zero.

    Parameters
    ----------
    reading : (..., n, 3) array
        Readings in any unit.
    form : Form
        `DIAGONAL` or `SYMMETRIC`.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W and V; NaN where the quadric is no ellipsoid.

    """
    mean, r = centred(reading)
    size = len(form.twice)
    moments = _moments(form, r[..., :_BLOCK])
    for start in range(_BLOCK, r.shape[-1], _BLOCK):
        moments = moments + _moments(form, r[..., start:start + _BLOCK])
    centre, radius = sphere_of(moments[..., size:-1, size:-1],
                               _ONES @ moments[..., :3, size:-1], r.shape[-1])
    radius = radius[..., np.newaxis]
    change = _to_sphere(form, centre, radius)
    beta = np.linalg.eigh(change.swapaxes(-1, -2) @ moments @ change)[1][..., 0]
    mat_w, offset = _ellipsoid(form, beta)
    return mat_w * radius[..., np.newaxis], mean + centre + offset * radius


def _moments(form: Form, r: Floats) -> Floats:
    """Sum the products of the monomials, r and 1 over the poses; r is (..., 3, n)."""
    size = len(form.twice)
    monomials = np.ones((*r.shape[:-2], size + 4, r.shape[-1]))
    monomials[..., size:-1, :] = r
    pairs = r[..., form.pairs, :]
    np.multiply(pairs[..., :size, :], pairs[..., size:, :], out=monomials[..., :size, :])
    return monomials @ monomials.swapaxes(-1, -2)


def _to_sphere(form: Form, centre: Floats, radius: Floats) -> Floats:
    """Return the matrix from monomials of r to those of (r - centre) / radius, times `twice`."""
    size, lead = len(form.twice), centre.shape[:-1]
    change = np.zeros((*lead, size + 4, size + 4))
    diagonal = change.reshape(*lead, -1)[..., ::size + 5]
    moved, twice = centre / -radius, form.twice / (radius * radius)
    diagonal[..., :size] = twice
    diagonal[..., size:] = 1.0 / radius
    change[..., size:-1, :size] = ((moved / radius) @ form.linear).reshape(*lead, 3, size)
    pairs = moved[..., form.pairs]
    change[..., -1, :size] = form.twice * pairs[..., :size] * pairs[..., size:]
    change[..., -1, size:-1] = moved
    change[..., -1, -1] = 1.0
    return change


def _ellipsoid(form: Form, beta: Floats) -> tuple[Floats, Floats]:
    """Return W and V of the quadric with these coefficients; NaN where it is no ellipsoid."""
    size = len(form.twice)
    mat_a = (beta[..., :size] @ form.scatter).reshape(*beta.shape[:-1], 3, 3)
    values, vectors = np.linalg.eigh(mat_a)
    sign = np.copysign(1.0, values[..., 1:2])  # AN5286: negate the whole vector
    with np.errstate(invalid='ignore', divide='ignore'):
        along = (beta[..., np.newaxis, size:-1] @ vectors)[..., 0, :] / (-2.0 * values)
        values = values * sign
        field_squared = (along * along * values) @ _COLUMN - beta[..., -1:] * sign  # B²
        gain = np.sqrt(field_squared / values)  # the middle value is positive: NaN where B² is not
        mat_w = (vectors * gain[..., np.newaxis, :]) @ vectors.swapaxes(-1, -2)
        return mat_w, (vectors @ along[..., np.newaxis])[..., 0]
