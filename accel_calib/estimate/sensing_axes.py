# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The 9-parameter model: shifts, scales and the angles between the sensing axes (ESGI'95 report).

Sensing axis i is a unit vector f_i with the reading m_i = b_i (f_i · a) + s_i. The reference axes
e are fixed to the sensing axes by e1 = f1 and e2 in the f1-f2 plane, so that in these axes

    f1 = (1, 0, 0)
    f2 = (cos φ, sin φ, 0)
    f3 = (cos ψ, cos ξ, cos η),  cos² η = 1 - cos² ξ - cos² ψ,
                                 cos ξ = (cos θ - cos φ cos ψ) / sin φ

with φ between f1 and f2, ψ between f1 and f3, and θ between f2 and f3. The rows f_i form the
matrix T̄ᵒʳᵗʰ of the report (its eq. 11 needs the transpose of its eq. 12), and W = diag(b) T̄ᵒʳᵗʰ
is lower triangular. The angles need not be small.

|force| does not depend on the axes of the force. This model is therefore fitted as model 10 and
then rotated (`lower_triangular`). `TIES` maps its nine parameters to the twelve values of the
model.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..model import MODELS, parameter_names
from ..table import Floats


def _ties() -> Floats:
    """Return the (12, 9) matrix from offset and lower triangle of W to the values of the model."""
    names = parameter_names(MODELS['9'])
    ties = np.zeros((len(names), 9))
    for k in range(6):  # offset and axis_gain
        ties[k, k] = 1.0
    # An entry (i, j) below the diagonal is half cross-axis, half rotation.
    for k, (pair, axis, sign) in enumerate((('xy', 'z', 1), ('xz', 'y', -1), ('yz', 'x', 1))):
        ties[names.index(f'cross_axis.{pair}'), 6 + k] = 0.5
        ties[names.index(f'misalignment.{axis}'), 6 + k] = 0.5 * sign
    return ties


TIES = _ties()
"""(12, 9) matrix from offset and lower triangle of W to the values of model 9."""


@dataclass(frozen=True)
class SensingAxes:
    """
    The nine parameters of the ESGI'95 report.

    Parameters
    ----------
    shifts : (3,) array
        s, in the unit of the readings.
    scales : (3,) array
        b > 0, in the unit of the readings per unit of force.
    phi, psi, theta : float
        Angles between f1 and f2, f1 and f3, f2 and f3 [rad].

    """

    shifts: Floats
    scales: Floats
    phi: float
    psi: float
    theta: float


def sensing_axes(mat_w: Floats, vec_v: Floats) -> SensingAxes:
    """Return shifts, scales and angles of W (3, 3) and V (3,), for W in any axes."""
    scales = np.linalg.norm(mat_w, axis=1)
    cosines = (mat_w @ mat_w.T) / np.outer(scales, scales)
    phi, psi, theta = np.arccos(np.clip(cosines[[0, 0, 1], [1, 2, 2]], -1.0, 1.0))
    return SensingAxes(np.array(vec_v), scales, float(phi), float(psi), float(theta))


def lower_triangular(mat_w: Floats) -> Floats:
    """
    Rotate the axes of W so that e1 = f1 and e2 is in the f1-f2 plane.

    Parameters
    ----------
    mat_w : (3, 3) array
        Gain in any axes.

    Returns
    -------
    (3, 3) array
        W Q for the rotation Q that makes it lower triangular with a positive diagonal.

    """
    return np.linalg.cholesky(mat_w @ mat_w.T)
