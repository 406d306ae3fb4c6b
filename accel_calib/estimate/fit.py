# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The maximum likelihood fit of any list of effects to poses of any kind, by least squares.

`.equations` sets up the equations of the poses. Damped least squares (Levenberg 1944, Marquardt
1963) within bounds minimises the sum of their squared residuals; for a dozen poses,
`scipy.optimize.least_squares` takes several times as long, mostly because of overhead
(`benchmarks/speed.py`). The covariance is (JᵀJ)⁻¹ times the variance factor of `.equations`.

The bounds of each parameter limit its contribution to a reading to `Effect.plausible_g`. A fitted
shape constant stays near the values that the search tries. The effects of V and W have no bounds
here: native readings can have any offset, and known orientations any rotation.

**Prior.** Poses that do not determine all values are fitted with the spread of common sensors:
additional rows, 0 = L⁻¹ (values - mean) with L Lᵀ their covariance, in units of the noise (maximum
a posteriori). The rows are part of the cost, of JᵀJ and of the covariance, but not of the
residuals of the poses: chi² and the degrees of freedom are those of the poses. The number of
values that the poses determine is the sum of their leverages. The variance factor of the noise is
given, because it determines the weight of the prior.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .closed_form import along_quadrics
from .equations import belief_in, Equations, equations, measured, variance_factor
from ..effects import CHANGES, Context, fitted_places, LADDER, Model, parameter_names, with_vector
from ..errors import RefusedFitError
from ..geometry import orientations_of, unit
from ..table import Poses
from ..units import Floats, Indices

_MOST_STEPS = 60
_FIRST_DAMPING = 1e3   # relative to the smallest determined square
_LARGEST_DAMPING = 1e9

_NEAR = 1e-12
"""The fit has converged when a full step lowers the cost by less than this part."""

_NEAR_ENOUGH = 1e-3
"""If rounding or a kink prevents this, this part of the cost per degree of freedom is accepted: a
change of the values by 0.03 standard deviations."""

_AT_A_KINK = 1e3
"""Damping at which constants of own effects are held: they end where a pose is at a kink."""

_ROUNDING = 1e-20
"""Decreases of the cost below this are rounding errors [noise²]."""

_SINGULAR_STEP = 1e-6
"""Relative square of a singular value below which the residuals do not determine a combination."""

_SINGULAR_WITH_PRIOR = 1e-12
"""As `Point.singular`; a prior determines all combinations."""

_BLOCK = 8192
"""Number of equations that are reduced to a triangle at once."""

_SINGULAR = 1e-3
"""Relative singular value below which a combination of values is not determined."""

_OPEN = 1e-3
"""Part of a value in such combinations above which the value is not determined."""

_SMALLEST = 1e-12
"""A parameter with a smaller contribution has no bound [1/g]."""

_WHOLE = 1e-6
"""Rounding error of a sum of leverages."""

_SHAPE_ROOM = 5.0
"""Factor by which a fitted shape constant may exceed the range that the search tries."""


@dataclass(frozen=True)
class ByPose:
    """
    The equations of a fit by pose: k rows each, padded with 0, in units of the noise.

    They are `residual` (n, k), the derivative `columns` (n, k, q), the numbers of equations
    `rows` (n,), and the columns of a `prior` (r, q).

    """

    residual: Floats
    columns: Floats
    rows: NDArray[np.int64]
    prior: Floats | None = None

    @cached_property
    def _root(self) -> Floats:
        """(q, q) array, whose square with its transpose is (JᵀJ)⁻¹."""
        flat = self.columns.reshape(self.residual.size, self.columns.shape[2])
        normal = flat.T @ flat
        if self.prior is not None:
            normal = normal + self.prior.T @ self.prior
        scales, axes = np.linalg.eigh(normal)
        seen = scales > 1e-15 * scales[-1:]
        return np.asarray(axes / np.sqrt(np.where(seen, scales, np.inf)))

    @cached_property
    def spread(self) -> Floats:
        """(q, q) array, (JᵀJ)⁻¹."""
        return self._root @ self._root.T

    @cached_property
    def basis(self) -> Floats:
        """(n, k, q) array, orthonormal columns that span the derivative, without a prior."""
        return self.columns @ self._root

    @cached_property
    def own(self) -> Floats:
        """(n, k, k) array, I - leverage of each pose."""
        return np.asarray(np.eye(self.columns.shape[1]) - self.basis @ self.basis.swapaxes(1, 2))


def left_out(residual: Floats, basis: Floats, pose: Indices, force: Floats, least: float
             ) -> tuple[Floats, float]:
    """
    Return residuals under a fit of the other orientations, and how much of each these check.

    With H the hat matrix of the orthonormal (m, q) `basis`, the (m,) residuals g of an orientation
    are (I - H_gg)⁻¹ times those of the whole fit (PRESS, Allen 1974). Repeats of an orientation
    would predict each other. If the (n, 3) `force` has one orientation alone, its poses are left
    out one by one. The second result is the smallest eigenvalue of all I - H_gg, 0 if the fit
    needs an orientation; smaller ones than `least` are replaced by it.

    """
    fold = orientations_of(unit(force))
    fold = np.unique((fold if np.ptp(fold) else np.arange(len(fold)))[pose],
                     return_inverse=True)[1]
    order = np.argsort(fold, kind='stable')
    parts = np.split(order, np.flatnonzero(np.diff(fold[order])) + 1)
    # With B = `basis` of an orientation and BᵀB = A Λ Aᵀ, that is r + B A (I - Λ)⁻¹ Aᵀ Bᵀ r.
    share, axes = np.linalg.eigh([basis[rows].T @ basis[rows] for rows in parts])
    own = 1.0 - share
    weight = np.where(own < least, (1.0 - least) / np.maximum(share, least), 1.0) / np.maximum(
        own, least)
    onto = np.array([basis[rows].T @ residual[rows] for rows in parts])
    moved = np.einsum('gij,gj,gkj,gk->gi', axes, weight, axes, onto, optimize=True)
    return residual + np.sum(basis * moved[fold], axis=1), float(np.min(own, initial=1.0))


def by_pose(residual: Floats, columns: Floats, pose: Indices,
            prior: Floats | None = None) -> ByPose:
    """Return (m,) residuals and (m, q) columns by pose, given the (m,) pose of each equation."""
    rows, order = np.bincount(pose), np.argsort(pose, kind='stable')
    slot = np.arange(len(pose)) - np.repeat(np.cumsum(rows) - rows, rows)
    by_row = np.zeros((len(rows), int(rows.max())))
    derivative = np.zeros((*by_row.shape, columns.shape[1]))
    by_row[pose[order], slot] = residual[order]
    derivative[pose[order], slot] = columns[order]
    return ByPose(by_row, derivative, rows, prior)


@dataclass(frozen=True)
class Fit:
    """
    A model with ΔR = I at poses in g, with their equations, derivatives and covariance.

    Parameters
    ----------
    columns : (m, q) array
        Derivative of the prediction by the free values, in units of the noise.
    ties : (p, q) array
        Maps the free values to ``model.vector``.
    at_bound : bool
        Whether a value is at a bound.
    prior : Point or None
        Residuals and columns of the prior, in units of the noise; None without a prior.
    factor : float or None
        Known variance factor; None: from the residuals.
    beside : Fit or None
        The same beside a scatter of the poses, whose covariance it has.
    of_context : (p, p) array or float
        What errors in the context add to the covariance.

    """

    model: Model
    poses_g: Poses
    equations: Equations
    columns: Floats
    ties: Floats
    at_bound: bool = False
    prior: Point | None = None
    factor: float | None = None
    beside: Fit | None = None
    of_context: Floats | float = 0.0

    @cached_property
    def residual(self) -> Floats:
        """(m,) array, residuals in units of the noise."""
        return self.equations.residual

    @property
    def noise_known(self) -> bool:
        """Whether the noise of the poses was measured."""
        return self.equations.noise_known

    @property
    def context(self) -> Context:
        """Columns of the poses, with the force u of the equations [g]."""
        return {**self.poses_g.columns, 'force': self.equations.force}

    @cached_property
    def dof(self) -> int:
        """Return the number of independent equations minus that of free, determined values."""
        if self.prior is None:
            return self.equations.count - self.columns.shape[1]
        determined = float(np.sum((self.columns @ self.by_pose.spread) * self.columns))
        return int(self.equations.count - determined + _WHOLE)

    @cached_property
    def chi2(self) -> float:
        """Sum of the squared residuals in units of the noise."""
        return float(self.residual @ self.residual)

    @cached_property
    def variance(self) -> float:
        """Variance of a residual in units of the noise, moderated towards 1."""
        return (belief_in(self.noise_known) + self.chi2) / self.variance_dof

    @cached_property
    def variance_dof(self) -> float:
        """Degrees of freedom of `variance`."""
        return belief_in(self.noise_known) + self.dof

    @cached_property
    def by_pose(self) -> ByPose:
        """Return the equations by pose."""
        prior = None if self.prior is None else self.prior.columns
        return by_pose(self.residual, self.columns, self.equations.pose, prior)

    @cached_property
    def noise_g(self) -> Floats:
        """(n,) residual of each pose that noise alone causes [g]; the fit absorbs a part of it."""
        data = self.by_pose
        own = np.trace(data.own, axis1=1, axis2=2) - (data.columns.shape[1] - data.rows)
        return np.asarray(self.equations.scale * np.sqrt(np.maximum(own, 0.0)))

    @cached_property
    def _triangle(self) -> tuple[Floats, Floats]:
        """(m, q) R of the QR decomposition of the scaled columns, block by block; the scales."""
        columns, size = _scaled(self.columns)
        found = columns[:0]
        for first in range(0, len(columns), _BLOCK):
            found = np.asarray(np.linalg.qr(
                np.vstack([found, columns[first:first + _BLOCK]]), mode='r'))
        return found, size

    @cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the values that the poses do not determine."""
        columns, size = self._triangle
        few = len(columns) < len(size)  # only then are there axes beyond the singular values
        _, scales, axes = np.linalg.svd(columns, full_matrices=few)
        open_ = axes[np.sum(scales > _SINGULAR * scales[0]):] if len(scales) else axes
        part = np.linalg.norm(self.ties @ (open_ / size).T, axis=1)
        names = parameter_names(self.model.effects)
        return tuple(name for name, each in zip(names, part, strict=True)
                     if each > _OPEN * max(float(np.max(part)), 1e-300))

    @cached_property
    def covariance(self) -> Floats:
        """(p, p) array, covariance of ``model.vector`` [g²]; 0 for values that are not fitted."""
        if self.beside is not None:
            return self.beside.covariance + self.of_context
        columns, size = self._triangle
        if self.prior is not None:
            columns, size = _scaled(np.vstack([columns * size, self.prior.columns]))
        factor = self.ties @ (np.linalg.pinv(columns) / size[:, np.newaxis])
        return np.asarray(factor @ factor.T * self.variance_factor + self.of_context)

    @property
    def variance_factor(self) -> float:
        """Ratio of the stated variance to the variance predicted by the noise."""
        if self.factor is not None:
            return self.factor
        return variance_factor(self.chi2, self.dof, self.noise_known)


def _scaled(columns: Floats) -> tuple[Floats, Floats]:
    """Return columns of length 1, and the lengths; 1 for a column of zeros."""
    size = np.sqrt(np.sum(columns ** 2, axis=0))
    size[size == 0.0] = 1.0
    return columns / size, size


def judge(model: Model, poses_g: Poses, ties: Floats | None = None) -> Fit:
    """Return a model at poses without a fit; by default all values that a fit changes are free."""
    ties = np.eye(len(model.fitted))[:, model.fitted] if ties is None else ties
    near = equations(model, measured(poses_g))
    return Fit(model, poses_g, near, near.columns(model) @ ties, ties)


def stated(fit: Fit) -> Fit:
    """Return a fit beside a scatter as one with the measured noise, except its covariance."""
    if 'own_scatter' not in fit.poses_g:
        return fit
    measured_g = fit.poses_g.without_columns('own_scatter')
    return replace(judge(fit.model, measured_g, fit.ties), at_bound=fit.at_bound, beside=fit)


class NotConvergedError(RefusedFitError):
    """The fit did not converge, so it has no result."""

    def __init__(self) -> None:
        super().__init__('the fit did not converge, so it has no result',
                         'check the poses for mistakes, or take more poses')


@dataclass(frozen=True)
class Point:
    """
    The (m,) residuals and (m, q) derivative at some values, and the object they are from.

    The residuals may have kinks as functions of the values in the (q,) mask `kinked`.

    """

    residual: Floats
    columns: Floats
    source: Any = None
    singular: float = _SINGULAR_STEP
    kinked: NDArray[np.bool_] | None = None

    @cached_property
    def normal(self) -> Floats:
        """(q, q) array, JᵀJ."""
        return np.dot(self.columns.T, self.columns)

    @cached_property
    def cost(self) -> float:
        """Sum of the squared residuals; infinite if it or JᵀJ is not finite."""
        cost = float(np.dot(self.residual, self.residual))
        return cost if np.isfinite(cost) and np.all(np.isfinite(self.normal)) else np.inf


def solve(point_at: Callable[[Floats], Point], start: Floats, lower: Floats, upper: Floats,
          move: Callable[[Floats, Floats], Floats] = np.add) -> tuple[Floats, Point]:
    """
    Return the (q,) values from `lower` to `upper` of least squares, and the point there.

    `point_at` computes residuals and derivative at values, which may be so wild that numbers
    overflow; the step solves residual = columns · step. `move` returns the values after a step to
    first order, by default their sum. Raise `NotConvergedError` if the fit has not converged after
    `_MOST_STEPS` steps.

    """
    values = np.clip(start, lower, upper)
    now, damping = _try(point_at, values), 0.0
    held = np.zeros(len(values), bool)
    first = _FIRST_DAMPING * now.singular
    if not np.isfinite(now.cost):
        raise NotConvergedError
    for steps in range(_MOST_STEPS + 1):
        pull = now.columns.T @ now.residual
        free = ~(held | ((values <= lower) & (pull < 0.0)) | ((values >= upper) & (pull > 0.0)))
        size = np.sqrt(np.diag(now.normal))
        weight = free / np.where(size == 0.0, 1.0, size)
        # The step along the axes of the scaled JᵀJ is 0 along those that are not determined.
        scales, axes = np.linalg.eigh(now.normal * weight * weight[:, np.newaxis])
        determined = scales > now.singular * scales[-1]
        scales = np.where(determined, scales, 1.0)
        downhill = np.where(determined, axes.T @ (pull * weight), 0.0)
        fall = float(downhill / scales @ downhill)  # that the cost is predicted to have
        spare = max(len(now.residual) - len(values), 1)
        is_near = fall <= _NEAR_ENOUGH * now.cost / spare + _ROUNDING
        if (fall <= _NEAR * now.cost or fall < _ROUNDING or damping > _LARGEST_DAMPING
                or steps == _MOST_STEPS):
            break
        moved = np.clip(move(values, axes @ (downhill / (scales + damping)) * weight),
                        lower, upper)
        tried = _try(point_at, moved)
        if tried.cost < now.cost:
            values, now, damping = moved, tried, damping / 10.0
            damping = 0.0 if damping < first else damping
        elif damping > 0.0 and is_near:  # a kink, or rounding
            break
        else:
            damping = max(10.0 * damping, first)
            if now.kinked is not None and damping > _AT_A_KINK and np.any(held != now.kinked):
                held, damping = now.kinked, 0.0
    if not is_near:
        raise NotConvergedError
    return values, now


@np.errstate(all='ignore')
def _try(point_at: Callable[[Floats], Point], values: Floats) -> Point:
    """Return the point at values; one of infinite cost if they have no solution."""
    try:
        return point_at(values)
    except np.linalg.LinAlgError:
        return Point(np.array([np.inf]), np.zeros((1, len(values))))


@dataclass(frozen=True)
class Prior:
    """Distribution of the (9,) values of model 10 over sensors, before any pose [g], [g²]."""

    mean: Floats
    covariance: Floats

    @cached_property
    def root(self) -> Floats:
        """Return L, (9, 9), with L Lᵀ the covariance."""
        return np.linalg.cholesky(self.covariance)


def estimate(start: Model, poses_g: Poses, prior: Prior | None = None,
             factor: float | None = None) -> Fit:
    """
    Fit a model; raise `NotConvergedError` if the fit does not converge.

    Parameters
    ----------
    start : Model
        Effects with their start values, ΔR = I.
    poses_g : Poses
        Poses in g, of known, shared or unknown orientation, with the context of the effects.
    prior, factor : Prior and float, optional
        Distribution of the values of model 10 over sensors, and the variance factor of the noise
        beside it. By default it is 1 in the fit, and that of the residuals in the covariance.

    """
    if not np.any(start.fitted):
        return judge(start, poses_g)
    fitted, vector, poses = start.fitted, start.vector.copy(), measured(poses_g)
    kinked = np.array([effect.own and part in effect.shape for effect in start.terms.effects
                       for part in effect.values], bool)[fitted]

    def point_at(values: Floats) -> Point:
        vector[fitted] = values
        model = with_vector(start.effects, vector.copy())
        near = equations(model, poses)
        columns = near.columns(model)[:, fitted]
        if prior is None:
            return Point(near.residual, columns, (model, near), kinked=kinked)
        rows = np.linalg.inv(prior.root) * np.sqrt(factor or 1.0)
        return Point(np.concatenate([near.residual, rows @ (prior.mean - values)]),
                     np.vstack([columns, rows]), (model, near), _SINGULAR_WITH_PRIOR)

    lower, upper = _bounds(start, poses_g)
    lower, upper = lower[fitted], upper[fitted]
    values, found = solve(point_at, start.vector[fitted], lower, upper,
                          move=np.add if prior is None else along_quadrics)
    at_bound = bool(np.any((values <= lower) | (values >= upper)))
    model, near = found.source
    count = len(near.residual)
    own = None if prior is None else Point(found.residual[count:], found.columns[count:])
    return Fit(model, poses_g, near, found.columns[:count], np.eye(len(fitted))[:, fitted],
               at_bound=at_bound, prior=own, factor=factor)


def _bounds(start: Model, poses_g: Poses) -> tuple[Floats, Floats]:
    """Return (p,) lower and (p,) upper bounds of all values; they include the start values."""
    lower, upper = [], []
    for effect, (name, values) in zip(start.terms.effects, start.values.items(), strict=True):
        limits = np.full((2, len(values)), np.inf) * [[-1.0], [1.0]]
        if name not in LADDER and name not in CHANGES:
            basis = Model({name: values}).basis(unit(poses_g.reading), poses_g.columns).full
            size = np.max(np.linalg.norm(basis[:, :, :len(effect.parameters)], axis=1), axis=0)
            most = effect.plausible_g / np.maximum(size, effect.plausible_g * _SMALLEST)
            limits[:, :len(most)] = -most, most
            if effect.bounds:
                limits[:, len(most):] = np.transpose(effect.bounds)
            places = () if effect.bounds else fitted_places(effect, effect.split(values)[1])
            shapes = [*effect.shapes(poses_g.columns)] if effect.shapes and places else []
            for k in places:
                tried = [shape[k] for shape in shapes if k in fitted_places(effect, shape)]
                limits[:, len(most) + k] = (min(tried, default=0.0) / _SHAPE_ROOM,
                                            max(tried, default=np.inf) * _SHAPE_ROOM)
        lower.append(np.minimum(limits[0], values))
        upper.append(np.maximum(limits[1], values))
    return np.concatenate(lower), np.concatenate(upper)
