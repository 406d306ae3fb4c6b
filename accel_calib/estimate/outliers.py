# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Outliers: poses that were knocked or not still.

The pose with the largest residual against a fit of the other poses (externally studentised, with
the moderated variance of `accel_calib.estimate.fit.Fit`) is removed, and so on, several times. The
generalised extreme studentised deviate test (Rosner 1983) at `LEVEL` then decides how many of them
are outliers. In this test several outliers do not mask each other. Between the removals the fit is
updated to first order. Above `_MANY` poses, outliers no longer mask each other, and all poses that
are extreme relative to the median are removed at once.

A gross outlier can distort the first fit. `.robust` starts from poses that agree.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fit import ByPose, Fit
from .noise import belief_in
from ..table import Floats

LEVEL = 0.007
"""Probability that a pose of a set without outliers is removed."""

LARGEST_SHARE = 0.25
"""Largest share of the poses that can be left out."""

_LEAST_OWN = 1e-6
"""1 - leverage below this: this pose alone determines a parameter, and cannot be tested."""

_MANY = 200

_MEDIAN_OF_CHI2 = {1: 0.454936, 3: 2.365974}
"""Median of chi² by degrees of freedom."""

_DOUBT_BELOW = 0.01
"""Probability of the chi² of the poses left below which they contradict the measured noise."""

_DOUBTED = 1.0
"""Degrees of freedom that contradicted noise counts as."""


@dataclass(frozen=True)
class Outliers:
    """Poses to leave out, as (d,) indices among the poses of a fit, and the chi² of the others."""

    poses: NDArray[np.intp]
    chi2: float


def outliers(fit: Fit, total: int) -> Outliers:
    """
    Find the outliers among the poses of a fit.

    Parameters
    ----------
    fit : Fit
        Fit to the poses that are kept so far.
    total : int
        Number of poses before any was left out.

    Returns
    -------
    Outliers
        At most `LARGEST_SHARE` of all poses, and at most so many that the other equations identify
        them.

    """
    data = fit.by_pose
    limit = most_outliers(fit, total, int(data.rows.max())) - (total - len(data.rows))
    if limit <= 0:
        return Outliers(np.zeros(0, np.intp), fit.chi2)
    if len(data.rows) > _MANY:
        return _far_out(data, fit, limit)
    order = _removed_in_turn(data, fit, limit)
    count = order.extreme(belief_in(fit.noise_known))
    if count:
        left = fit.dof - int(np.sum(order.rows[:count]))
        count = order.extreme(belief_beside(left, order.rss[count], fit.noise_known))
    return Outliers(np.sort(order.pose[:count]), float(order.rss[count]))


def belief_beside(dof: int, chi2: float, noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as, given the chi² of the poses kept."""
    from scipy.special import chdtrc

    if noise_known and chdtrc(max(dof, 1), chi2) < _DOUBT_BELOW:
        return _DOUBTED
    return belief_in(noise_known)


def most_outliers(fit: Fit, total: int, rows: int = 1) -> int:
    """Return the largest number of poses to leave out, each with `rows` equations."""
    spare = fit.dof + rows * (total - len(fit.poses_g))
    return max(min(int(LARGEST_SHARE * total), spare // (2 * rows)), 0)


@dataclass(frozen=True)
class _Removed:
    """
    Poses removed in turn.

    Parameters
    ----------
    pose, rows : (k,) array of int
        Index of the removed pose, and its number of equations.
    size : (k,) array
        Squared residual of this pose against the others, in units of its variance.
    rss : (k + 1,) array
        Sum of squared residuals before each removal, and at the end.
    dof, count : int
        Degrees of freedom and number of poses at the start.

    """

    pose: NDArray[np.intp]
    rows: NDArray[np.int64]
    size: Floats
    rss: Floats
    dof: int
    count: int

    def extreme(self, belief: float) -> int:
        """Return how many of the removed poses are outliers."""
        removed = np.concatenate([[0], np.cumsum(self.rows)])
        dof = np.maximum(belief + self.dof - removed[1:], 1e-9)
        others = np.maximum(belief + self.rss[:-1] - self.size, 1e-300) / dof
        chance = beyond(self.size / self.rows / others, self.rows, dof)
        found = np.flatnonzero(chance < LEVEL / (self.count - np.arange(len(self.pose))))
        return int(found[-1]) + 1 if len(found) else 0


def beyond(ratio: Floats, rows: NDArray[np.int64], dof: Floats | float) -> Floats:
    """Return the probability of a larger ratio of variances by chance (F distribution)."""
    from scipy.special import fdtrc

    chance: Floats = fdtrc(rows, np.maximum(dof, 1.0), ratio)
    return chance


def _removed_in_turn(data: ByPose, fit: Fit, most: int) -> _Removed:
    """Remove the most extreme pose repeatedly, and update the fit to first order."""
    spread = data.spread
    flat = data.flat
    residual = data.residual - (flat @ (spread @ (flat.T @ data.residual.ravel()))).reshape(
        data.residual.shape)
    own, left = data.own(spread), np.ones(len(residual), bool)
    poses, sizes = [], []
    rss = [float(np.sum(residual ** 2))]
    for _ in range(most):
        size = _squared(own, residual) * left
        at = int(np.argmax(size / data.rows))
        poses.append(at)
        sizes.append(float(size[at]))
        rss.append(max(rss[-1] - sizes[-1], 0.0))
        moved = spread @ data.columns[at].T @ np.linalg.pinv(own[at])
        along = data.columns @ moved
        residual = residual + (along @ residual[at][:, np.newaxis])[:, :, 0]
        onto = data.columns @ (spread @ data.columns[at].T)
        own = own - along @ np.swapaxes(onto, 1, 2)
        spread = spread + moved @ data.columns[at] @ spread
        left[at] = False
    return _Removed(np.array(poses, np.intp), data.rows[poses], np.array(sizes), np.array(rss),
                    fit.dof, len(left))


def _squared(own: Floats, residual: Floats) -> Floats:
    """Return the squared residual of each pose against the others; 0 if it cannot be tested."""
    if residual.shape[1] == 1:
        alone = own[:, 0, 0]
        return np.where(alone > _LEAST_OWN,
                        residual[:, 0] ** 2 / np.maximum(alone, _LEAST_OWN), 0.0)
    size, axes = np.linalg.eigh(own)
    along = (np.swapaxes(axes, 1, 2) @ residual[:, :, np.newaxis])[:, :, 0]
    testable = size > _LEAST_OWN
    squares = np.where(testable, along ** 2 / np.where(testable, size, 1.0), 0.0)
    return np.sum(squares, axis=1)


def _far_out(data: ByPose, fit: Fit, limit: int) -> Outliers:
    """Find outliers among many poses, all at once, relative to the median."""
    alone = _squared(data.own(data.spread), data.residual)
    size = alone / data.rows
    usual = np.array([_MEDIAN_OF_CHI2[int(rows)] / rows for rows in data.rows])
    belief = belief_in(fit.noise_known)
    scale = float(np.median(size / usual))
    size = size * (belief + fit.dof) / (belief + scale * fit.dof)
    extreme = beyond(size, data.rows, belief + fit.dof) < LEVEL / len(size)
    largest = np.argsort(-size, kind='stable')[:limit]
    found = np.sort(largest[extreme[largest]])
    return Outliers(found, max(fit.chi2 - float(np.sum(alone[found])), 0.0))
