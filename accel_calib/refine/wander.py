# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The effect `offset_wander`: an offset that changes slowly without a known form.

The offset is a random walk w(t), expanded in its Karhunen-Loève modes

    w(t) = Σ_k a_k sin((k - ½) π τ) / ((k - ½) π),   τ from 0 to 1 over the poses

with independent amplitudes a_k of equal variance for each axis. It enters the equations through
the same columns as an offset. Its size is estimated by restricted maximum likelihood (Patterson
and Thompson 1971): with the model projected out, the residual z along the singular vectors of the
modes has the variances s² (1 + λ Λ_i). With a fixed number of modes the cost is linear in the
number of poses.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .least_squares import Projected
from ..estimate.equations import Equations
from ..model import Model
from ..table import Floats

_MODES = 60
"""Modes of each axis: the rest has less than 1 % of the variance of a random walk."""

_RATIOS = np.geomspace(1e-4, 1e6, 81)
_LARGEST_RATIO = 1e3
_LEAST_WHITE = 0.5
"""Smallest part of the measured variance that remains for the noise of the poses."""

_NO_CHANGE = 1e-9
"""Directions that are shrunk by less than this part are left out."""

_OFFSET = Model({'offset': np.zeros(3)})


@dataclass(frozen=True)
class Wander:
    """
    A random walk of the offset.

    Parameters
    ----------
    fall : float
        Decrease of the information criterion.
    likelihood_ratio : float
        Twice the logarithm of the likelihood ratio against no walk.
    residual : (m,) array
        Residual minus the estimated walk.
    held_out : (m,) array
        The same, with each equation predicted from the others.
    axes, shrink : (m, r) array, (r,) array
        Directions of the walk among the equations, and the factor that whitens each.

    """

    fall: float
    likelihood_ratio: float
    residual: Floats
    held_out: Floats
    axes: Floats
    shrink: Floats

    def whitened(self, columns: Floats) -> Floats:
        """Return (m,) or (m, q) columns, whitened for the sum of walk and noise."""
        along = self.axes.T @ columns
        return columns - self.axes @ ((1.0 - self.shrink) * along.T).T


def wander(equations: Equations, fitted: Projected, time: Floats) -> Wander:
    """
    Estimate a random walk of the offset.

    Parameters
    ----------
    equations : Equations
        Equations near the model.
    fitted : Projected
        The equations with the model projected out.
    time : (n,) array
        Times of the poses [s]; NaN for poses before the walk begins.

    """
    modes = _modes(equations, time)
    outside = modes - fitted.onto @ (fitted.onto.T @ modes)
    vectors, singular, _ = np.linalg.svd(outside, full_matrices=False)
    largest = max(float(singular[0]) ** 2, 1e-300)
    values = singular ** 2 / largest
    along = vectors.T @ fitted.residual
    squared, dof = along ** 2, equations.count - fitted.onto.shape[1]
    rest = max(fitted.rss - float(np.sum(squared)), 0.0)
    spread = 1.0 + _RATIOS[:, np.newaxis] * values
    scale = (np.sum(squared / spread, axis=1) + rest) / dof
    allowed = scale >= _LEAST_WHITE if equations.noise_known else _RATIOS <= _LARGEST_RATIO
    allowed[0] = True
    deviance = np.sum(np.log(spread), axis=1) + dof * np.log(np.maximum(scale, 1e-300))
    best = int(np.argmin(np.where(allowed, deviance, np.inf)))
    ratio = float(dof * np.log(max(fitted.rss, 1e-300) / dof) - deviance[best])
    taken = 1.0 - 1.0 / spread[best]
    residual = fitted.residual - vectors @ (taken * along)
    # Without its own equation each residual is P z over the diagonal of P.
    diagonal = 1.0 - np.sum(fitted.onto ** 2, axis=1) - vectors ** 2 @ taken
    axes, size, _ = np.linalg.svd(modes, full_matrices=False)
    shrink = 1.0 / np.sqrt(1.0 + _RATIOS[best] * size ** 2 / largest)
    shrunk = shrink < 1.0 - _NO_CHANGE
    axes, shrink = axes[:, shrunk], shrink[shrunk]
    return Wander(ratio - np.log(max(dof, 2)), ratio, residual,
                  residual / np.maximum(diagonal, 0.02), axes, shrink)


def _modes(equations: Equations, time: Floats) -> Floats:
    """Return the (m, 3 k) columns of the modes."""
    known = np.isfinite(time)
    first = np.min(time[known])
    tau = np.where(known, time - first, 0.0) / max(float(np.ptp(time[known])), 1e-300)
    number = np.pi * (np.arange(min(int(np.sum(known)), _MODES)) + 0.5)
    shapes = np.sin(number * tau[:, np.newaxis]) / number
    offset = equations.columns(_OFFSET)
    return np.hstack([offset[:, [axis]] * shapes[equations.pose] for axis in range(3)])
