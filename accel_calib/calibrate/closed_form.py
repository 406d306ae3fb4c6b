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
Closed forms: the documents' own costs, without iteration and without weights.

Poses of unknown orientation obey |W⁻¹ (reading - V)| = 1, a quadric in the reading (NXP AN5286):

    readingᵀ A reading - 2 readingᵀ A V + VᵀA V - B² = 0,   W⁻¹ = (A / B²)^(1/2)

The 4-parameter model (A = I) is linear least squares; 7 (A diagonal) and 10 (A symmetric) take
the eigenvector of XᵀX with the smallest eigenvalue, where a row of X holds the monomials of a
reading. That cost depends on origin and scale, so the readings are first shifted and scaled by
the 4-parameter result: then counts and volts give what m/s² give, without a loss of digits.

Poses of known orientation obey reading = X force + y, linear in X and y (ESGI'95 report, 3).

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ..errors import RefusedFitError
from ..table import Floats

_FACE_COSINE = np.cos(np.radians(20.0))
"""A reading within 20° of an axis of the sensor is one of the six faces."""

_RIDGE = 1e-12
"""Keeps poses in a plane from dividing by zero: they put the centre into the plane."""

_BLOCK = 8192
"""Poses at a time: their monomials stay in the cache."""

_IDENTITY, _ONES = np.eye(3), np.ones(3)
_TURN_MORE = 'take poses with each side of the sensor up and down, and some edges'


@dataclass(frozen=True)
class _Form:
    """
    The quadratic monomials r_i r_j of a quadric.

    Parameters
    ----------
    first, second : (k,) array of int
        i and j; those with i = j first.

    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]

    @cached_property
    def pairs(self) -> NDArray[np.intp]:
        """(2 k,) array, all i and then all j."""
        return np.concatenate([self.first, self.second])

    @cached_property
    def twice(self) -> Floats:
        """(k,) array, how often each stands in rᵀ A r."""
        return np.where(self.first == self.second, 1.0, 2.0)

    @cached_property
    def linear(self) -> Floats:
        """(3, 3 k) array, what moving the origin by c takes from each in proportion to r."""
        taken = np.zeros((3, 3, len(self.twice)))
        for k, (i, j) in enumerate(zip(self.first, self.second)):
            taken[i, j, k] += self.twice[k]
            taken[j, i, k] += self.twice[k]
        return taken.reshape(3, -1)

    @cached_property
    def scatter(self) -> Floats:
        """(k, 9) array, from the coefficients to the entries of A."""
        entries = np.zeros((len(self.twice), 3, 3))
        each = np.arange(len(self.twice))
        entries[each, self.first, self.second] = entries[each, self.second, self.first] = 1.0
        return entries.reshape(-1, 9)


_DIAGONAL = _Form(np.array([0, 1, 2]), np.array([0, 1, 2]))
_SYMMETRIC = _Form(np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2]))


def fit_4(reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit offset and one gain (AN5286 eq. 10-14).

    Parameters
    ----------
    reading : (..., n, 3) array
        Readings in any unit, n >= 4; leading axes are sensors.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W, in the unit of the readings per g, and V.

    """
    mean, r = _centred(reading)
    third = (r @ np.sum(r * r, axis=-2)[..., np.newaxis])[..., 0]
    centre, radius = _sphere(r @ r.swapaxes(-1, -2), third, r.shape[-1])
    return radius[..., np.newaxis, np.newaxis] * _IDENTITY, mean + centre


def fit_7(reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit offset and a gain for each axis (AN5286 eq. 24-30).

    Parameters
    ----------
    reading : (..., n, 3) array
        Readings in any unit, n >= 6; leading axes are sensors.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W, diagonal, in the unit of the readings per g, and V; NaN for a sensor, among several,
        whose poses lie on no ellipsoid.

    Raises
    ------
    RefusedFitError
        If the poses of the only sensor lie on no ellipsoid.

    """
    return _checked(*_quadric(reading, _DIAGONAL))


def fit_10(reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit offset and symmetric gain (AN5286 eq. 40-46).

    Parameters
    ----------
    reading : (..., n, 3) array
        Readings in any unit, n >= 9; leading axes are sensors.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W, symmetric, in the unit of the readings per g, and V; NaN as `fit_7`.

    Raises
    ------
    RefusedFitError
        If the poses of the only sensor lie on no ellipsoid.

    """
    return _checked(*_quadric(reading, _SYMMETRIC))


def _checked(mat_w: Floats, vec_v: Floats) -> tuple[Floats, Floats]:
    """Give the result as it is, but for an only sensor make sure that there is one."""
    if mat_w.ndim == 2 and not isfinite(mat_w[0, 0]):
        raise RefusedFitError('the poses lie on no ellipsoid', _TURN_MORE)
    return mat_w, vec_v


def _centred(reading: Floats) -> tuple[Floats, Floats]:
    """Give the mean (..., 3), and the readings from there on, (..., 3, n)."""
    transposed = reading.swapaxes(-1, -2)
    mean = transposed.sum(axis=-1) / reading.shape[-2]
    return mean, transposed - mean[..., np.newaxis]


def _sphere(second: Floats, third: Floats, count: int) -> tuple[Floats, Floats]:
    """
    Give centre (..., 3) and radius (...) of the sphere from moments about the mean.

    |r|² = 2 V·r + (W² - |V|²), summed over the poses times r, and alone; their r sum up to zero.

    """
    trace = second[..., 0, 0] + second[..., 1, 1] + second[..., 2, 2]
    kept_apart = (_RIDGE * trace + 1e-300)[..., np.newaxis, np.newaxis] * _IDENTITY
    centre = np.linalg.solve(second + kept_apart, third[..., np.newaxis])[..., 0] / 2.0
    squared = trace / count + (centre * centre) @ _ONES
    return centre, np.sqrt(squared + (squared == 0.0))


def _quadric(reading: Floats, form: _Form) -> tuple[Floats, Floats]:
    """Fit the quadric whose matrix A has the entries of this form; others are zero."""
    mean, r = _centred(reading)
    size = len(form.twice)
    moments = _moments(form, r[..., :_BLOCK])
    for start in range(_BLOCK, r.shape[-1], _BLOCK):
        moments = moments + _moments(form, r[..., start:start + _BLOCK])
    centre, radius = _sphere(moments[..., size:-1, size:-1],
                             _ONES @ moments[..., :3, size:-1], r.shape[-1])
    change = _to_sphere(form, centre, radius[..., np.newaxis])
    beta = np.linalg.eigh(change.swapaxes(-1, -2) @ moments @ change)[1][..., 0]
    mat_w, offset = _ellipsoid(form, beta)
    radius = radius[..., np.newaxis]
    return mat_w * radius[..., np.newaxis], mean + centre + offset * radius


def _moments(form: _Form, r: Floats) -> Floats:
    """Sum up the products of the monomials, r and 1 over the poses; r is (..., 3, n)."""
    size = len(form.twice)
    monomials = np.ones((*r.shape[:-2], size + 4, r.shape[-1]))
    monomials[..., size:-1, :] = r
    pairs = r[..., form.pairs, :]
    np.multiply(pairs[..., :size, :], pairs[..., size:, :], out=monomials[..., :size, :])
    return monomials @ monomials.swapaxes(-1, -2)


def _to_sphere(form: _Form, centre: Floats, radius: Floats) -> Floats:
    """Give the matrix from monomials of r to those of (r - centre) / radius, each `twice`."""
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


def _ellipsoid(form: _Form, beta: Floats) -> tuple[Floats, Floats]:
    """Give W and V of the quadric with these coefficients; NaN where it is no ellipsoid."""
    size = len(form.twice)
    mat_a = (beta[..., :size] @ form.scatter).reshape(*beta.shape[:-1], 3, 3)
    values, vectors = np.linalg.eigh(mat_a)
    sign = np.copysign(1.0, values[..., 1:2])  # AN5286: negate the whole vector
    values = values * sign
    with np.errstate(invalid='ignore', divide='ignore'):
        along = (beta[..., np.newaxis, size:-1] @ vectors)[..., 0, :] * sign / values
        field_squared = (along * along * values) @ _ONES[:, np.newaxis] / 4.0
        field_squared -= beta[..., -1:] * sign  # B²
        gain = np.sqrt(field_squared) / np.sqrt(values)
        mat_w = (vectors * gain[..., np.newaxis, :]) @ vectors.swapaxes(-1, -2)
        return mat_w, (vectors @ along[..., np.newaxis])[..., 0] / -2.0


def fit_12(reading: Floats, reference: Floats) -> tuple[Floats, Floats]:
    """
    Fit m = X a + y to poses of known orientation (ESGI'95 report, section 3).

    Parameters
    ----------
    reading : (n, 3) array
        Readings m in any unit.
    reference : (n, 3) array
        True specific force a.

    Returns
    -------
    (3, 3) array, (3,) array
        X and y.

    Raises
    ------
    RefusedFitError
        If the known forces all lie in a plane.

    """
    design = np.column_stack([reference, np.ones(len(reference))])
    solution, _, rank, _ = np.linalg.lstsq(design, reading, rcond=1e-6)
    if rank < 4:
        raise RefusedFitError(f'the {len(reading)} known orientations lie in a plane', _TURN_MORE)
    return solution[:3].T, solution[3]


def faces(reading: Floats) -> Floats | None:
    """
    Tell which face is up in each pose, where all six faces are there and nothing else is.

    Parameters
    ----------
    reading : (n, 3) array
        Readings in any unit.

    Returns
    -------
    (n, 3) array or None
        Unit vectors along the axes; None if the poses are not the six faces.

    """
    centre = (reading.max(axis=0) + reading.min(axis=0)) / 2.0
    r = reading - centre
    axis = np.argmax(np.abs(r), axis=1)
    along = np.take_along_axis(r, axis[:, np.newaxis], axis=1)[:, 0]
    reference = np.eye(3)[axis] * np.sign(along)[:, np.newaxis]
    aligned = np.all(np.abs(along) >= _FACE_COSINE * np.linalg.norm(r, axis=1))
    return reference if aligned and len(np.unique(reference, axis=0)) == 6 else None


def fit_six_faces(faces_up: Floats, faces_down: Floats, gravity: float = 1.0
                  ) -> tuple[Floats, Floats]:
    """
    Give X and y of m = X a + y from the six faces (ESGI'95 report, section 3).

    Parameters
    ----------
    faces_up, faces_down : (3, 3) array
        Row i: the reading with axis i up, and down.
    gravity : float
        Local gravity in the unit in which forces are meant.

    Returns
    -------
    (3, 3) array, (3,) array
        X and y.

    """
    mat_x = (faces_up - faces_down).T / (2.0 * gravity)
    return mat_x, (faces_up + faces_down).mean(axis=0) / 2.0


def two_position(reading_up: Floats | float, reading_down: Floats | float
                 ) -> tuple[Floats | float, Floats | float]:
    """
    Calibrate an axis from +1 g and -1 g, in native units (Intan RHD2000 note).

    Parameters
    ----------
    reading_up, reading_down : float or array
        Readings with the axis up and down, in V or counts.

    Returns
    -------
    float or array, float or array
        Sensitivity per g and zero-g offset, in the unit of the readings.

    Examples
    --------
    >>> sensitivity, offset = two_position(2.1218, 1.4282)
    >>> round(sensitivity, 4), round(offset, 4)
    (0.3468, 1.775)

    """
    return (reading_up - reading_down) / 2.0, (reading_up + reading_down) / 2.0
