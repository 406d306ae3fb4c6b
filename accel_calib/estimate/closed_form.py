# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Closed forms: the cost functions of AN5286 and the ESGI'95 report, without weights.

Poses of unknown orientation lie on a quadric (see `accel_calib.estimate.quadric`). For model 4 the
quadric is a sphere, fitted by linear least squares. For model 7 its axes are parallel to those of
the sensor, and for model 10 they have any direction.

Poses of known orientation satisfy reading = X force + y, linear in X and y (ESGI'95 report,
section 3).

"""

from __future__ import annotations

import numpy as np

from .quadric import centred, DIAGONAL, quadric, sphere_of, SYMMETRIC
from ..errors import counted, RefusedFitError
from ..table import Floats

_FACE_COSINE = np.cos(np.radians(20.0))
"""A reading within 20° of a sensor axis is one of the six faces."""

_IDENTITY = np.eye(3)


def closed_form(name: str, reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit a model to poses of unknown orientation.

    Parameters
    ----------
    name : {'4', '7', '9', '10'}
        The model; model 9 is model 10 in other axes.
    reading : (..., n, 3) array
        Readings in any unit, at least as many as free parameters. Leading axes are separate sets.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W, in the unit of the readings per g, and V; NaN for a set that is not on an ellipsoid.

    """
    if name == '4':
        return fit_4(reading)
    return quadric(reading, DIAGONAL if name == '7' else SYMMETRIC)


def fit_4(reading: Floats) -> tuple[Floats, Floats]:
    """
    Fit an offset and one gain for all axes (AN5286 eq. 10-14).

    Parameters
    ----------
    reading : (..., n, 3) array
        Readings in any unit, n >= 4. Leading axes are separate sets.

    Returns
    -------
    (..., 3, 3) array, (..., 3) array
        W, in the unit of the readings per g, and V.

    """
    mean, r = centred(reading)
    third = (r @ np.sum(r * r, axis=-2)[..., np.newaxis])[..., 0]
    centre, radius = sphere_of(r @ r.swapaxes(-1, -2), third, r.shape[-1])
    return radius[..., np.newaxis, np.newaxis] * _IDENTITY, mean + centre


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
        raise RefusedFitError(f'the known forces of {counted(len(reading), "pose")} lie in a '
                              'plane, expected three dimensions', 'take poses with each side of '
                              'the sensor up and down, and some edges')
    return solution[:3].T, solution[3]


def faces(reading: Floats) -> Floats | None:
    """
    Return the direction of up in each pose, if the poses are exactly the six faces.

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
