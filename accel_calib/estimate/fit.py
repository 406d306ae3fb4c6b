# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The fit of any list of effects to poses of any kind: maximum likelihood by least squares.

The poses give equations (`.equations`), `.solve` minimises the sum of their squares, and the
covariance is (JᵀJ)⁻¹ times what `.noise` makes of the residuals: poses often repeat worse than
their samples say.

Each parameter is bounded so that it contributes no more to a reading than `Effect.plausible_g`,
and a fitted shape constant stays near those that a search tries. The effects of V and W are not
bounded here: native readings may have any offset, and known orientations any rotation.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from .equations import Equations, equations, noise_of
from .noise import belief_in, variance_factor
from .solve import NOWHERE, Point, solve
from ..effects import CHANGES, effect_named, LADDER
from ..model import FITTED_SHAPES, fitted_values, Model, parameter_names, with_vector
from ..sphere import unit
from ..table import Floats, Poses

_SINGULAR = 1e-3
_OPEN = 1e-3
"""Relative singular value below which a combination is not determined; part of a value in it."""

_SMALLEST = 1e-12
"""A parameter that contributes less than this is not bounded [1/g]."""

_SHAPE_ROOM = 5.0
"""Factor by which a fitted shape constant may leave the range of those that a search tries."""


@dataclass(frozen=True)
class Fit:
    """
    A model at the poses, and what these say of it.

    Parameters
    ----------
    model : Model
        The model, ΔR = I.
    poses_g : Poses
        The poses, in g.
    equations : Equations
        Their equations near the model.
    columns : (m, q) array
        Derivative of the prediction by the free values, per noise.
    ties : (p, q) array
        From the free values to ``model.vector``.
    at_bound : bool
        Whether a value is at the bound of what is plausible.

    """

    model: Model
    poses_g: Poses
    equations: Equations
    columns: Floats
    ties: Floats
    at_bound: bool = False

    @cached_property
    def residual(self) -> Floats:
        """(m,) array, residuals in units of the noise."""
        return self.equations.residual

    @property
    def noise_known(self) -> bool:
        """Whether the noise of the poses was measured."""
        return self.equations.noise_known

    @property
    def dof(self) -> int:
        """Independent equations less free values."""
        return self.equations.count - self.columns.shape[1]

    @cached_property
    def chi2(self) -> float:
        """Sum of the squared residuals over their noise."""
        return float(self.residual @ self.residual)

    @property
    def variance(self) -> float:
        """Variance of a residual in units of the noise: 1 as far as the noise is believed."""
        return (belief_in(self.noise_known) + self.chi2) / self.variance_dof

    @property
    def variance_dof(self) -> float:
        """Degrees of freedom of `variance`."""
        return belief_in(self.noise_known) + self.dof

    @cached_property
    def orthonormal(self) -> Floats:
        """(m, q) array, columns that span the derivative."""
        return np.linalg.qr(self.columns)[0]

    @cached_property
    def leverage(self) -> Floats:
        """(m,) array, the share of each equation in its own prediction."""
        return np.minimum(np.sum(self.orthonormal ** 2, axis=1), 1.0)

    @cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the values that the poses do not determine."""
        size = np.linalg.norm(self.columns, axis=0)
        size[size == 0.0] = 1.0
        _, scales, axes = np.linalg.svd(self.columns / size, full_matrices=True)
        open_ = axes[np.sum(scales > _SINGULAR * scales[0]):] if len(scales) else axes
        part = np.linalg.norm(self.ties @ (open_ / size).T, axis=1)
        names = parameter_names(self.model.effects)
        return tuple(name for name, each in zip(names, part, strict=True)
                     if each > _OPEN * max(float(np.max(part)), 1e-300))

    @cached_property
    def covariance(self) -> Floats:
        """(p, p) array, covariance of ``model.vector`` [g²]; 0 for values that are not fitted."""
        size = np.linalg.norm(self.columns, axis=0)
        size[size == 0.0] = 1.0
        factor = self.ties @ (np.linalg.pinv(self.columns / size) / size[:, np.newaxis])
        spread: Floats = factor @ factor.T
        return spread * variance_factor(self.chi2, self.dof, self.noise_known)


def free_of(effects: tuple[str, ...]) -> Floats:
    """Return the (p, q) matrix from the fitted values of these effects to all their values."""
    fitted = fitted_values(effects)
    return np.eye(len(fitted))[:, fitted]


def judge(model: Model, poses_g: Poses, ties: Floats | None = None) -> Fit:
    """
    Return a model at poses, without a fit; arguments as of `Fit`.

    By default each fitted value of the effects is free.

    """
    ties = free_of(model.effects) if ties is None else ties
    near = equations(model, poses_g, noise_of(poses_g))
    return Fit(model, poses_g, near, near.columns(model) @ ties, ties)


def estimate(start: Model, poses_g: Poses) -> Fit:
    """
    Fit a model.

    Parameters
    ----------
    start : Model
        Effects with the values to begin with, ΔR = I.
    poses_g : Poses
        In g, of known, shared or unknown orientation, with the context that the effects need.

    Returns
    -------
    Fit
        At the solution.

    Raises
    ------
    NotConvergedError
        If the fit does not converge.

    """
    fitted, noise = fitted_values(start.effects), noise_of(poses_g)
    vector = start.vector.copy()

    def model_at(values: Floats) -> Model:
        vector[fitted] = values
        return with_vector(start.effects, vector.copy())

    def point_at(values: Floats) -> Point:
        model = model_at(values)
        with np.errstate(all='ignore'):
            try:
                near = equations(model, poses_g, noise)
                return Point(near.residual, near.columns(model)[:, fitted])
            except np.linalg.LinAlgError:
                return NOWHERE

    if not np.any(fitted):
        return judge(start, poses_g)
    lower, upper = _bounds(start, poses_g)
    lower, upper = lower[fitted], upper[fitted]
    values, _ = solve(point_at, start.vector[fitted], lower, upper)
    at_bound = bool(np.any((values <= lower) | (values >= upper)))
    return replace(judge(model_at(values), poses_g), at_bound=at_bound)


def _bounds(start: Model, poses_g: Poses) -> tuple[Floats, Floats]:
    """Return the lower and the upper bounds of all values, (p,) each; the start is within."""
    lower, upper = [], []
    for name, values in start.values.items():
        effect = effect_named(name)
        limits = np.full((2, len(values)), np.inf) * [[-1.0], [1.0]]
        if name not in LADDER and name not in CHANGES:
            size = _largest_contribution(Model({name: values}), poses_g)
            most = effect.plausible_g / np.maximum(size, effect.plausible_g * _SMALLEST)
            limits[:, :len(most)] = -most, most
            for k, part in enumerate(effect.shape):
                if part in FITTED_SHAPES and effect.shapes is not None:
                    tried = [shape[k] for shape in effect.shapes(poses_g.columns)]
                    limits[:, len(most) + k] = (min(tried, default=0.0) / _SHAPE_ROOM,
                                                max(tried, default=np.inf) * _SHAPE_ROOM)
        lower.append(np.minimum(limits[0], values))
        upper.append(np.maximum(limits[1], values))
    return np.concatenate(lower), np.concatenate(upper)


def _largest_contribution(model: Model, poses_g: Poses) -> Floats:
    """Return the largest reading that a value of 1 of each parameter adds at the poses, (p,)."""
    basis = model.basis(unit(poses_g.reading), poses_g.columns).full
    parameters = len(model.terms.effects[0].parameters)
    return np.max(np.linalg.norm(basis[:, :, :parameters], axis=1), axis=0)
