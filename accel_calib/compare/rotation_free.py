# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The parameters of a calibration that do not depend on its axes, and their uncertainty.

|force| depends on W only through W Wᵀ: a rotation of the axes of the force, W -> W Q, does not
change it. Calibrations with different axes (model 9 in the sensing axes, 10 symmetric, 12 and
levelled ones rotated) are therefore compared in V and in S = (W Wᵀ)^(1/2), the symmetric factor of
the polar decomposition W = S Q. The derivative of S solves S dS + dS S = dW Wᵀ + W dWᵀ.

Effects that depend on the context are evaluated at one context, as parts of V and W. Effects with
bending terms add their own parameters.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..calibrate import Calibration
from ..effects import Context, EFFECTS
from ..model import force_slope, parameter_basis, reading_of
from ..table import Floats
from ..units import STANDARD_GRAVITY

NAMES = ('offset.x', 'offset.y', 'offset.z', 'gain.x', 'gain.y', 'gain.z', 'gain.xy', 'gain.xz',
         'gain.yz')
"""V, and the diagonal and the upper triangle of S."""

_ENTRIES = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])
_STEP = 1e-4


@dataclass(frozen=True)
class RotationFree:
    """
    The parameters of a calibration that do not depend on its axes.

    Parameters
    ----------
    names : tuple of str
        `NAMES`, and the parameters of effects with bending terms.
    values : (t,) array
        Values of the parameters [g].
    slope : (t, p) array
        Derivative of the parameters by ``calibration.model.vector``.
    axes : (3, 3) array
        Q ΔR, the rotation from the levelled frame to the axes of S.
    reading_scale, force_scale : float
        Factors from readings and forces in the local g of the calibration to the common unit.

    """

    names: tuple[str, ...]
    values: Floats
    slope: Floats
    axes: Floats
    reading_scale: float
    force_scale: float

    @property
    def vec_v(self) -> Floats:
        """V, (3,) [g]."""
        return self.values[:3]

    @property
    def mat_s(self) -> Floats:
        """S, (3, 3)."""
        return _symmetric(self.values[3:9])


def rotation_free(calibration: Calibration, context: Context, per_g: float) -> RotationFree:
    """
    Return the parameters of a calibration that do not depend on its axes.

    Parameters
    ----------
    calibration : Calibration
        A calibration with any model.
    context : mapping of str to array
        Columns that the effects need, one row.
    per_g : float
        Native reading that counts as 1 g; not used for other units.

    Returns
    -------
    RotationFree
        The parameters at this context.

    """
    model = calibration.model
    origin, axes = np.zeros((1, 3)), np.eye(3)
    vec_v = reading_of(model, origin, context)[0]
    mat_w = force_slope(model, origin, context)[0]
    slope_v = parameter_basis(model, origin, context)[0]
    either = [np.array([parameter_basis(model, sign * _STEP * axis[np.newaxis], context)[0]
                        for axis in axes]) for sign in (1.0, -1.0)]
    slope_w = np.swapaxes(either[0] - either[1], 0, 1) / (2.0 * _STEP)  # (row, column, p)
    mat_s, slope_s = _polar(mat_w, slope_w)
    reading_scale, force_scale = _scales(calibration, per_g)
    gain_scale = reading_scale / force_scale
    own = [k for k, name in enumerate(calibration.parameters)
           if EFFECTS[name.split('.')[0]].bends]
    size = len(model.vector)
    return RotationFree(
        (*NAMES, *(calibration.parameters[k] for k in own)),
        np.concatenate([vec_v * reading_scale, mat_s[_ENTRIES] * gain_scale, model.vector[own]]),
        np.concatenate([slope_v * reading_scale, slope_s[_ENTRIES] * gain_scale,
                        np.eye(size)[own]]),
        np.linalg.solve(mat_s, mat_w) @ model.rotation, reading_scale, force_scale)


def _scales(calibration: Calibration, per_g: float) -> tuple[float, float]:
    """Return the factors from readings and forces to the common unit, standard g or native."""
    units = calibration.units
    if units.name == 'native':
        return units.per_g / per_g, 1.0
    scale = units.per_g / STANDARD_GRAVITY if units.name == 'm/s2' else 1.0
    return scale, scale


def _symmetric(entries: Floats) -> Floats:
    matrix = np.zeros((3, 3))
    matrix[_ENTRIES] = entries
    return matrix + np.triu(matrix, 1).T


def _polar(mat_w: Floats, slope_w: Floats) -> tuple[Floats, Floats]:
    """Return S (3, 3) and its (3, 3, p) derivative from W and the (3, 3, p) derivative of W."""
    squared, vectors = np.linalg.eigh(mat_w @ mat_w.T)
    roots = np.sqrt(squared)
    half = np.einsum('ijp,kj->ikp', slope_w, mat_w)
    turned = np.einsum('ia,ijp,jb->abp', vectors, half + np.swapaxes(half, 0, 1), vectors)
    turned = turned / np.add.outer(roots, roots)[:, :, np.newaxis]
    return (vectors * roots) @ vectors.T, np.einsum('ia,abp,jb->ijp', vectors, turned, vectors)
