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

λ is at least 1. τ relative to the median noise, and √(λ - 1), have the prior of Cauchy (Gelman
2006): a scatter of more than a few times the noise is less probable.

"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .fit import Fit
from ..table import Poses
from ..units import Floats

_CLEARLY = 2.0
"""Smallest evidence for a scatter (Kass and Raftery 1995: positive)."""

_USUAL = 3.0
"""Scale of the prior of τ, relative to the median noise, and of √(λ - 1)."""

_TRIED = np.arange(-7.0, 7.1, 0.25)
"""Logarithms of τ relative to the median noise, and of √(λ - 1), that are tried. Between them, the
deviance is nearly a parabola."""

_ENOUGH = 1000
"""Number of poses from which τ is estimated; more are not needed."""


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
    return poses_g.with_columns(own_scatter=np.full(poses_g.reading.shape, size_g))


def with_scatter_of(fit: Fit, poses_g: Poses) -> Poses:
    """Return poses with the scatter that those of a fit state; unchanged if they state none."""
    if 'own_scatter' not in fit.poses_g:
        return poses_g
    return beside_scatter(poses_g, float(fit.poses_g['own_scatter'][0, 0]))


def enough(count: int) -> NDArray[np.bool_]:
    """Return which of `count` poses suffice for a scatter."""
    return np.arange(count) % max(-(-count // _ENOUGH), 1) == 0


def scatter_of(fit: Fit, among: NDArray[np.bool_] | None = None) -> Scatter:
    """
    Return the scatter of the poses of a fit; none if their noise is not known.

    It is estimated from the poses `among` them, (n,); fits are only compared by the same poses.

    """
    among = enough(len(fit.poses_g)) if among is None else among
    few = among[fit.equations.pose]
    sigma = fit.equations.scale[fit.equations.pose[few]]
    columns = fit.columns[few] * sigma[:, np.newaxis]
    count = len(sigma) - columns.shape[1]
    if not fit.noise_known or count < 1:
        return Scatter(0.0, 0.0, 0.0)
    middle = float(np.median(sigma))
    more = np.append(0.0, (middle * np.exp(_TRIED)) ** 2)
    # The (r,) logarithms of the determinants, and weighted squares, of the module: from the (m,)
    # residual and an orthonormal basis (m, q) of the derivatives [g], and (r, m) variances.
    residual, onto = fit.residual[few] * sigma, np.linalg.qr(columns)[0]
    variance = sigma ** 2 + more[:, np.newaxis]
    weight, width = 1.0 / variance, onto.shape[1]
    products = (onto[:, :, np.newaxis] * onto[:, np.newaxis]).reshape(len(onto), width ** 2)
    normal = (weight @ products).reshape(len(weight), width, width)
    side = (residual * weight) @ onto
    explained = np.sum(side * np.linalg.solve(normal, side[..., np.newaxis])[..., 0], axis=1)
    size = np.sum(np.log(variance), axis=1) + np.linalg.slogdet(normal)[1]
    squares = weight @ residual ** 2 - explained
    nothing = float(size[0] + squares[0])
    if squares[0] <= count:
        return Scatter(0.0, nothing, nothing)
    prior = 2.0 * np.log1p((np.exp(_TRIED) / _USUAL) ** 2)
    factor = 1.0 + np.exp(2.0 * _TRIED)
    without = _lowest(size[0] + count * np.log(factor) + squares[0] / factor + prior)[1]
    log, least = _lowest(size[1:] + squares[1:] + prior)
    return Scatter(middle * float(np.exp(log)), least, min(nothing, without))


def _lowest(deviance: Floats) -> tuple[float, float]:
    """Return where in `_TRIED` a deviance is lowest, and its value there."""
    at = int(np.clip(np.argmin(deviance), 1, len(deviance) - 2))
    before, here, after = deviance[at - 1:at + 2]
    slope, bend = (after - before) / 2.0, max(before - 2.0 * here + after, 1e-12)
    shift = float(np.clip(-slope / bend, -1.0, 1.0))
    step = float(_TRIED[1] - _TRIED[0])
    return (float(_TRIED[at]) + shift * step,
            float(here + slope * shift + bend * shift ** 2 / 2.0))
