# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The effect `offset_wander`: an offset that changes slowly without a known form.

The offset is a random process, expanded in its Karhunen-Loève modes

    w(t) = Σ_k a_k sin((k - ½) π τ) / ((k - ½) π),   τ from 0 to 1 over the poses

with independent amplitudes a_k of equal variance for each axis. It enters the equations through
the same columns as an offset. Its size is estimated by maximum likelihood: with the base projected
out, the residual along the singular vectors of the modes has the variances s² (1 + λ Λ_i). With a
fixed number of modes, the cost is linear in the number of poses.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .linear import held_out, Linear, Set
from ..table import Floats, Poses

_MODES = 60
"""Modes of each axis: the rest has less than 1 % of the variance of a random walk."""

_RATIOS = np.geomspace(1e-4, 1e6, 81)
_LARGEST_RATIO = 1e3
_LEAST_WHITE = 0.5
"""Smallest part of the measured variance that remains for the noise of the poses."""

SIGNIFICANT = 10.0
"""Twice the logarithm of the likelihood ratio above which a walk is named."""


@dataclass(frozen=True)
class Process:
    """
    The modes of a walk outside of the base.

    Parameters
    ----------
    axes : (m, r) array
        Orthonormal directions among the equations.
    values : (r,) array
        Variance along each of them, relative to the largest.

    """

    axes: Floats
    values: Floats


@dataclass(frozen=True)
class Walk:
    """
    A walk beside a set.

    Parameters
    ----------
    process : Process
        Its modes.
    ratio : float
        λ, its variance relative to the noise.
    score : float
        Score of the set with the walk.
    likelihood_ratio : float
        Twice the logarithm of the likelihood ratio against no walk, or against an offset that
        scatters from pose to pose.

    """

    process: Process
    ratio: float
    score: float
    likelihood_ratio: float

    def whitened(self, linear: Linear) -> Linear:
        """Return the equations whitened for the walk and the noise."""
        spread = 1.0 + self.ratio * self.process.values
        white = replace(linear, white=(self.process.axes, 1.0 - 1.0 / np.sqrt(spread)))
        return replace(white, residual=white.whitened(linear.residual),
                       columns=white.whitened(linear.columns),
                       penalty=float(np.sum(np.log(spread))) + _charge(linear))

    def residuals(self, linear: Linear, chosen: Set) -> tuple[Floats, Floats]:
        """Return the residual without the walk, and the same with each equation held out."""
        spread = 1.0 + self.ratio * self.process.values
        left = self.process.axes - chosen.onto @ (chosen.onto.T @ self.process.axes)
        precision = np.diag(1.0 / np.maximum(spread - 1.0, 1e-12)) + left.T @ left
        smooth = np.linalg.solve(precision, left.T)
        residual = chosen.residual - left @ (smooth @ chosen.residual)
        # Without its own equation each residual is P z over the diagonal of P.
        own = (1.0 - np.sum(linear.onto ** 2, axis=1) - np.sum(chosen.onto ** 2, axis=1)
               - np.sum(left * smooth.T, axis=1))
        return residual, held_out(residual, own)


def process_of(linear: Linear, poses: Poses) -> Process | None:
    """Return the modes of a walk; None if the times are not known."""
    if 'time' not in poses:
        return None
    time = poses['time']
    known = np.isfinite(time)
    if not np.any(known) or not np.ptp(time[known]) > 0.0:
        return None
    tau = np.where(known, time - np.min(time[known]), 0.0) / float(np.ptp(time[known]))
    number = np.pi * (np.arange(min(int(np.sum(known)), _MODES)) + 0.5)
    waves = np.sin(number * tau[:, np.newaxis])
    shapes = (waves / number)[linear.pose]
    modes = np.hstack([linear.offset[:, [axis]] * shapes for axis in range(3)])
    modes = modes - linear.onto @ (linear.onto.T @ modes)
    values, vectors = np.linalg.eigh(modes.T @ modes)
    kept = values > 1e-10 * values[-1]
    if not np.any(kept):
        return None
    return Process(modes @ (vectors[:, kept] / np.sqrt(values[kept])), values[kept] / values[-1])


def walk_beside(linear: Linear, chosen: Set, process: Process) -> Walk:
    """Return the most likely walk beside a set."""
    spread = 1.0 + _RATIOS[:, np.newaxis] * process.values
    taken = 1.0 - 1.0 / spread
    onto = process.axes.T @ chosen.onto
    along, own = process.axes.T @ linear.residual, chosen.onto.T @ linear.residual
    normal = np.eye(onto.shape[1]) - np.einsum('ri,lr,rj->lij', onto, taken, onto)
    side = own - (taken * along) @ onto
    explained = np.einsum('li,li->l', side,
                          np.linalg.solve(normal, side[:, :, np.newaxis])[:, :, 0])
    rss = float(linear.residual @ linear.residual) - taken @ along ** 2 - explained
    dof = linear.dof - chosen.onto.shape[1]
    allowed = (rss >= _LEAST_WHITE * dof if linear.worth else _RATIOS <= _LARGEST_RATIO)
    allowed[0] = True
    weight = linear.worth + linear.dof
    deviance = np.sum(np.log(spread), axis=1) + weight * np.log(
        (linear.worth + np.maximum(rss, 1e-300)) / (linear.worth + chosen.rss + 1e-300))
    best = int(np.argmin(np.where(allowed, deviance, np.inf)))
    fall = float(-deviance[best])
    return Walk(process, float(_RATIOS[best]), chosen.score + fall - _charge(linear),
                fall - _fall_by_scatter(linear, chosen))


def _fall_by_scatter(linear: Linear, chosen: Set) -> float:
    """
    Return twice the logarithm of the likelihood ratio of an offset that scatters.

    Poses that repeat worse than their samples have the same additional variance in g, which shows
    most where the samples vary little. This is no walk.

    """
    size = np.sum(linear.offset ** 2, axis=1)
    spread = 1.0 + _RATIOS[:, np.newaxis] * size / max(float(np.max(size)), 1e-300)
    rss = np.sum(chosen.residual ** 2 / spread, axis=1)
    deviance = np.sum(np.log(spread), axis=1) + (linear.worth + linear.dof) * np.log(
        (linear.worth + rss + 1e-300) / (linear.worth + chosen.rss + 1e-300))
    return max(float(-np.min(deviance)), 0.0)


def _charge(linear: Linear) -> float:
    """Return what a walk costs in the score: its size, and its choice among the candidates."""
    return float(np.log(max(linear.dof, 2)) + linear.choice)
