# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Outliers, and the weight of the measured noise in tests and in the covariance.

The pose with the largest residual against a fit of the other poses (externally studentised, with
the moderated variance of `accel_calib.estimate.fit.Fit`) is removed, and so on, several times. The
generalised extreme studentised deviate test (Rosner 1983) at `LEVEL` then decides how many of them
are outliers. In this test several outliers do not mask each other. Between the removals the fit is
updated to first order. Above `_MANY` poses, outliers no longer mask each other, and all poses that
are extreme relative to the median are removed at once.

A gross outlier can distort the first fit. `fit_norm` then starts from poses that agree.

**Noise.** The variance of a residual is λ times the variance predicted by the noise of its pose.
Either the noise is correct and λ = 1, or poses repeat worse or better than their samples predict,
with log λ uniformly distributed from log 0.01 to log 10⁴. The residuals decide between both
(Bayes' rule with the likelihood λ^(-dof/2) exp(-chi²/2λ)). The distribution of a parameter is then
a mixture of normal distributions, and its stated variance is such that ±1.96 standard deviations
contain 95 % of it. If the noise was not measured, λ is estimated from the residuals alone, and the
mixture is Student's t. Without degrees of freedom, the noise of a common sensor is assumed.

In tests the measured noise counts as a number of degrees of freedom (moderated variance, Smyth
2004).

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..table import Floats

if TYPE_CHECKING:
    from .fit import Point

_BELIEF = 8.0
_BELIEF_IN_USUAL = 3.0
"""Degrees of freedom in a test that measured noise, and assumed noise, count as."""

_RIGHT = 0.7
"""Prior probability that the measured noise is correct."""

_INTERVAL = 0.95
_NORMAL = 1.959964
_SCALES = np.logspace(-2.0, 4.0, 121)
_ONE = 40
"""Values of λ; index of λ = 1."""

_BEYOND = 1e3
"""chi² per degree of freedom above which the measured noise is ignored."""

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


def belief_in(noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as in a test."""
    return _BELIEF if noise_known else _BELIEF_IN_USUAL


@cache
def _grid() -> tuple[Floats, Floats]:
    """Return (k,) half widths, and the (m, k) part of N(0, λ) within each of them."""
    from scipy.special import ndtr

    width = np.geomspace(0.15, 250.0, 141)
    return width, 2.0 * ndtr(width / np.sqrt(_SCALES)[:, np.newaxis]) - 1.0


def variance_factor(chi2: float, dof: int, noise_known: bool) -> float:
    """
    Return the ratio of the stated variance to the variance predicted by the noise.

    `chi2` is the sum of the squared residuals in units of the noise, or of `USUAL_NOISE_G` if the
    noise was not measured. `dof` is the number of equations minus that of free values.

    """
    if dof <= 0:
        return 1.0 if noise_known else _student(_BELIEF_IN_USUAL)
    if not noise_known or chi2 > _BEYOND * dof:
        return chi2 / dof * _student(dof)
    return _of_mixture(chi2, dof)


def _student(dof: float) -> float:
    """Return the squared ratio of the 95 % intervals of Student's t and a normal variable."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + _INTERVAL / 2.0) / _NORMAL) ** 2


def _of_mixture(chi2: float, dof: int) -> float:
    """Return the factor for measured noise, which may be correct."""
    width, held = _grid()
    likelihood = (chi2 * (1.0 - 1.0 / _SCALES) - dof * np.log(_SCALES)) / 2.0
    largest = np.max(likelihood)
    weight = np.exp(likelihood - largest) * (1.0 - _RIGHT)
    weight[_ONE] += _RIGHT * len(_SCALES) * np.exp(-largest)
    part = (weight / np.sum(weight)) @ held
    above = int(np.argmax(part >= _INTERVAL))
    share = (_INTERVAL - part[above - 1]) / (part[above] - part[above - 1])
    between = width[above - 1] * (width[above] / width[above - 1]) ** share
    return float(between / _NORMAL) ** 2


@dataclass(frozen=True)
class ByPose:
    """
    The equations of a fit by pose: k rows each, padded with 0.

    `residual` (n, k) and the derivative `columns` (n, k, q) are in units of the noise; `rows` (n,)
    are the numbers of equations; `prior` has the rows of a prior.

    """

    residual: Floats
    columns: Floats
    rows: NDArray[np.int64]
    prior: Point | None = None

    @cached_property
    def spread(self) -> Floats:
        """(q, q) array, (JᵀJ)⁻¹."""
        flat = self.flat
        normal = flat.T @ flat
        if self.prior is not None:
            normal = normal + self.prior.columns.T @ self.prior.columns
        return np.linalg.pinv(normal, hermitian=True)

    @property
    def downhill(self) -> Floats:
        """(q,) array, Jᵀ times the residuals; zero at the solution."""
        along = self.flat.T @ self.residual.ravel()
        return along if self.prior is None else along + self.prior.columns.T @ self.prior.residual

    @property
    def flat(self) -> Floats:
        """(n k, q) array, the derivative with one row per equation."""
        return self.columns.reshape(self.residual.size, self.columns.shape[2])

    def own(self, spread: Floats) -> Floats:
        """Return the (n, k, k) matrices I - leverage of each pose."""
        return (np.eye(self.columns.shape[1])
                - self.columns @ spread @ np.swapaxes(self.columns, 1, 2))


def by_pose(residual: Floats, columns: Floats, pose: NDArray[np.intp],
            prior: Point | None = None) -> ByPose:
    """Return (m,) residuals and (m, q) columns by pose, given the (m,) pose of each equation."""
    rows = np.bincount(pose)
    count = len(rows)
    if len(pose) == count:
        order = np.argsort(pose)
        return ByPose(residual[order][:, np.newaxis], columns[order][:, np.newaxis], rows, prior)
    order = np.argsort(pose, kind='stable')
    slot = np.arange(len(pose)) - np.repeat(np.cumsum(rows) - rows, rows)
    by_row = np.zeros((count, int(rows.max())))
    derivative = np.zeros((*by_row.shape, columns.shape[1]))
    by_row[pose[order], slot] = residual[order]
    derivative[pose[order], slot] = columns[order]
    return ByPose(by_row, derivative, rows, prior)


@dataclass(frozen=True)
class Outliers:
    """Poses to leave out, as (d,) indices among the poses of a fit, and the chi² of the others."""

    poses: NDArray[np.intp]
    chi2: float


def outliers_among(data: ByPose, chi2: float, dof: int, total: int, *, noise_known: bool
                   ) -> Outliers:
    """
    Find the outliers among poses, given their equations at a fit.

    `chi2` and `dof` are as in `variance_factor`; `total` includes the poses left out before.

    """
    rows = int(data.rows.max())
    out = total - len(data.rows)
    limit = _limit(dof + rows * out, total, rows) - out
    if limit <= 0:
        return Outliers(np.zeros(0, np.intp), chi2)
    if len(data.rows) > _MANY:
        return _far_out(data, chi2, dof, limit, noise_known=noise_known)
    order = _removed_in_turn(data, dof, limit)
    count = order.extreme(belief_in(noise_known))
    if count:
        left = dof - int(np.sum(order.rows[:count]))
        count = order.extreme(belief_beside(left, order.rss[count], noise_known))
    return Outliers(np.sort(order.pose[:count]), float(order.rss[count]))


def belief_beside(dof: int, chi2: float, noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as, given the chi² of the poses kept."""
    from scipy.special import chdtrc

    if noise_known and chdtrc(max(dof, 1), chi2) < _DOUBT_BELOW:
        return _DOUBTED
    return belief_in(noise_known)


def _limit(spare: int, total: int, rows: int) -> int:
    """Return the largest number of poses to leave out, each with `rows` equations."""
    return max(min(int(LARGEST_SHARE * total), spare // (2 * rows)), 0)


@dataclass(frozen=True)
class _Removed:
    """
    Poses removed in turn.

    `pose` and `rows` (k,) are the index and the number of equations of each; `size` (k,) its
    squared residual against the others, in units of its variance; `rss` (k + 1,) the sum of
    squared residuals before each removal, and at the end; `dof` and `count` belong to the start.

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


def _removed_in_turn(data: ByPose, dof: int, most: int) -> _Removed:
    """Remove the most extreme pose repeatedly, and update the fit to first order."""
    flat, (count, rows) = data.flat, data.residual.shape
    onto = flat @ data.spread
    residual, left = data.residual.ravel() - onto @ data.downhill, np.ones(count, bool)
    own = data.own(data.spread)
    removed, solved = np.empty((2, len(flat), most * rows))  # columns of I - leverage
    poses, sizes = [], []
    rss = [float(residual @ residual)]
    for k in range(0, most * rows, rows):
        size = _squared(own, residual.reshape(count, rows))
        at = int(np.argmax(np.where(left, size / data.rows, -1.0)))
        poses.append(at)
        sizes.append(float(size[at]))
        rss.append(max(rss[-1] - sizes[-1], 0.0))
        part, now = slice(rows * at, rows * at + rows), slice(k, k + rows)
        column = -onto @ flat[part].T - removed[:, :k] @ solved[part, :k].T
        column[part] += np.eye(rows)
        inverse = 1.0 / own[at] if rows == 1 and own[at] > 0.0 else np.linalg.pinv(own[at])
        removed[:, now], solved[:, now] = column, column @ inverse
        residual = residual - solved[:, now] @ residual[part]
        own -= (solved[:, now].reshape(count, rows, rows)
                @ np.swapaxes(column.reshape(count, rows, rows), 1, 2))
        left[at] = False
    return _Removed(np.array(poses, np.intp), data.rows[poses], np.array(sizes), np.array(rss),
                    dof, len(left))


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


def _far_out(data: ByPose, chi2: float, dof: int, limit: int, *, noise_known: bool
             ) -> Outliers:
    """Find outliers among many poses, all at once, relative to the median."""
    alone = _squared(data.own(data.spread), data.residual)
    size = alone / data.rows
    usual = np.where(data.rows == 1, _MEDIAN_OF_CHI2[1], _MEDIAN_OF_CHI2[3]) / data.rows
    belief = belief_in(noise_known)
    scale = float(np.median(size / usual))
    size = size * (belief + dof) / (belief + scale * dof)
    extreme = beyond(size, data.rows, belief + dof) < LEVEL / len(size)
    largest = np.argsort(-size, kind='stable')[:limit]
    found = np.sort(largest[extreme[largest]])
    return Outliers(found, max(chi2 - float(np.sum(alone[found])), 0.0))
