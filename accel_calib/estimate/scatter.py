# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses that repeat worse than their samples: a variance that all of them have in common.

The noise of a mean falls with the number of samples, but what differs from pose to pose does not:
the sensor settles, warms up, is pressed against the table. With σ the noise of the mean, the
variance of a reading is then σ² + τ² with one τ for all poses, and not λ σ² as in `.equations`.
If the noise of the poses differs, the quiet ones would have far too much weight. Both hypotheses
are judged by the restricted likelihood (Patterson and Thompson 1971). With e the residuals, B the
derivatives by the values [g], and W the inverse of the variances, twice its negative logarithm is

    log |W⁻¹| + log |BᵀWB| + min_k (e - B k)ᵀW (e - B k)

λ is at least 1, and τ has the prior of Cauchy (Gelman 2006): a scatter of more than a few times
the noise is less probable.

"""

from typing import NamedTuple

import numpy as np
import scipy

from .fit import Fit
from ..table import Poses
from ..units import Floats

_CLEARLY = 4.0
"""Smallest evidence for a scatter: odds of 7 to 1 (Kass and Raftery 1995: positive)."""

_LEAST_DOF = 8
"""Degrees of freedom below which a scatter and a mistake in one pose look alike."""

_USUAL = 3.0
"""Scale of the prior of τ, relative to the median noise."""

_RANGE = 7.0
_STEP = 0.02
"""Range of log τ around the logarithm of the median noise, and its largest error."""

_ENOUGH = 2000
"""Number of equations from which τ is estimated; more are not needed."""


class Scatter(NamedTuple):
    """
    The size of a scatter τ [g], 0 if there is none, and how well it explains the residuals.

    `deviance` is twice the negative logarithm of its likelihood, and `without` that of λ.

    """

    size_g: float
    deviance: float
    without: float

    @property
    def evidence(self) -> float:
        """Return twice the logarithm of the ratio of the likelihoods of τ and λ."""
        return self.without - self.deviance

    @property
    def shows(self) -> bool:
        return self.evidence > _CLEARLY


def beside_scatter(poses_g: Poses, size_g: float) -> Poses:
    """Return poses with a scatter [g] in addition to their noise."""
    return poses_g.with_columns(scatter=np.full(poses_g.reading.shape, size_g))


def scatter_of(fit: Fit) -> Scatter:
    """Return the scatter of the poses of a fit; none if their noise is not known."""
    few = slice(None, None, -(-len(fit.residual) // _ENOUGH))
    sigma = fit.equations.scale[fit.equations.pose[few]]
    columns = fit.columns[few] * sigma[:, np.newaxis]
    count = len(sigma) - columns.shape[1]
    if not fit.noise_known or count < _LEAST_DOF:
        return Scatter(0.0, 0.0, 0.0)
    equations = _Weighted(fit.residual[few] * sigma, np.linalg.qr(columns)[0], sigma ** 2)
    size, squares = equations.beside(0.0)
    factor = max(squares / count, 1.0)
    without = size + count * float(np.log(factor)) + squares / factor
    middle = float(np.median(sigma))
    if factor == 1.0:
        return Scatter(0.0, without, without)

    def deviance(log: float) -> float:
        ratio = float(np.exp(log))
        prior = 2.0 * float(np.log1p((ratio / _USUAL) ** 2))
        return sum(equations.beside((middle * ratio) ** 2)) + prior

    found = scipy.optimize.minimize_scalar(deviance, bounds=(-_RANGE, _RANGE),
                                           options={'xatol': _STEP})
    return Scatter(middle * float(np.exp(found.x)), float(found.fun), without)


class _Weighted(NamedTuple):
    """Residuals (m,) [g], an orthonormal basis (m, q) of the derivatives, and variances (m,)."""

    residual: Floats
    onto: Floats
    variance: Floats

    def beside(self, more: float) -> tuple[float, float]:
        """Return the determinants and the weighted squares of the module for more variance."""
        variance = self.variance + more
        weight = 1.0 / np.sqrt(variance)
        basis, triangle = np.linalg.qr(self.onto * weight[:, np.newaxis])
        left = self.residual * weight
        left = left - basis @ (basis.T @ left)
        size = np.sum(np.log(variance)) + 2.0 * np.sum(np.log(np.abs(np.diag(triangle))))
        return float(size), float(left @ left)
