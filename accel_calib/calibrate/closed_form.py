# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Closed forms: the documents' own costs, without iteration and without weights.

Poses of unknown orientation lie on a quadric (see `accel_calib.calibrate.quadric`). The
4-parameter model is its sphere, by linear least squares; for 7 its axes are those of the sensor,
and for 10 they may lie anywhere.

Poses of known orientation obey reading = X force + y, linear in X and y (ESGI'95 report, 3).

"""

from __future__ import annotations

from math import isfinite

import numpy as np

from .quadric import centred, DIAGONAL, quadric, sphere_of, SYMMETRIC
from ..errors import RefusedFitError
from ..table import Floats

_FACE_COSINE = np.cos(np.radians(20.0))
"""A reading within 20° of an axis of the sensor is one of the six faces."""

_IDENTITY = np.eye(3)
_TURN_MORE = 'take poses with each side of the sensor up and down, and some edges'


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
    mean, r = centred(reading)
    third = (r @ np.sum(r * r, axis=-2)[..., np.newaxis])[..., 0]
    centre, radius = sphere_of(r @ r.swapaxes(-1, -2), third, r.shape[-1])
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
    return _checked(*quadric(reading, DIAGONAL))


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
    return _checked(*quadric(reading, SYMMETRIC))


def _checked(mat_w: Floats, vec_v: Floats) -> tuple[Floats, Floats]:
    """Give the result as it is, but for an only sensor make sure that there is one."""
    if mat_w.ndim == 2 and not isfinite(mat_w[0, 0]):
        raise RefusedFitError('the poses lie on no ellipsoid', _TURN_MORE)
    return mat_w, vec_v


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
