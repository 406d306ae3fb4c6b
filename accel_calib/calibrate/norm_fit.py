# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit V and W to |force| = 1 g: Levenberg and Marquardt's way, one sensor or many at once.

All arrays may have leading axes, one for each sensor. With u = W⁻¹ (reading - V), û its direction
and a = ûᵀ W⁻¹, the residual is |u| - 1; it moves by -a_i with V_i and by -a_i u_j with W_ij. A
`Form` says how the free values make up V and W.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .sensing_axes import TIES
from .uncertainty import USUAL_NOISE_G
from ..model import Model, MODELS, parameter_names, with_vector
from ..table import Floats

_MOST_STEPS = 50
_SMALL_FALL = 1e-12
_SMALL_STEP_G = 1e-13
_FIRST_DAMPING = 1e-3


@dataclass(frozen=True)
class Form:
    """
    How the q free values of a model make up its values, and V and W.

    Parameters
    ----------
    effects : tuple of str
        The model's effects.
    ties : (p, q) array
        From the free values to those of the effects.
    linear : (12, q) array
        From the free values to V and, row by row, W - I.

    """

    effects: tuple[str, ...]
    ties: Floats
    linear: Floats

    def model(self, free: Floats) -> Model:
        """Make the model with these (q,) free values."""
        return with_vector(self.effects, self.ties @ free)

    def free(self, mat_w: Floats, vec_v: Floats) -> Floats:
        """Give the (..., q) free values of W (..., 3, 3) and V (..., 3), as near as they come."""
        added = (mat_w - np.eye(3)).reshape(*mat_w.shape[:-2], 9)
        return np.concatenate([vec_v, added], axis=-1) @ np.linalg.pinv(self.linear).T


@cache
def form_of(name: str) -> Form:
    """Give the form of model 4, 7, 9 or 10."""
    effects = MODELS[name]
    size = len(parameter_names(effects))
    ties = TIES if name == '9' else np.eye(size)
    columns = []
    for values in ties.T:
        mat_w, vec_v = with_vector(effects, values).linear_part
        columns.append(np.concatenate([vec_v, (mat_w - np.eye(3)).ravel()]))
    return Form(effects, ties, np.column_stack(columns))


@dataclass(frozen=True)
class Solution:
    """
    What fitted values leave, for one sensor or many.

    Parameters
    ----------
    free : (..., q) array
        The free values.
    residual : (..., n) array
        |force| - 1 of each pose [g].
    sigma : (..., n) array
        Its noise [g].
    jacobian : (..., n, q) array
        Derivative of residual / sigma.

    """

    free: Floats
    residual: Floats
    sigma: Floats
    jacobian: Floats

    @property
    def weighted(self) -> Floats:
        """(..., n) array, residuals over their noise."""
        return self.residual / self.sigma


def _forces(form: Form, free: Floats, reading: Floats) -> tuple[Floats, Floats, Floats]:
    """Give u (..., n, 3), |u| (..., n, 1) and a (..., n, 3)."""
    values = free @ form.linear.T
    mat_w = np.eye(3) + values[..., 3:].reshape(*values.shape[:-1], 3, 3)
    inverse = np.linalg.inv(mat_w)
    u = (reading - values[..., np.newaxis, :3]) @ np.swapaxes(inverse, -1, -2)
    length = np.sqrt(np.sum(u * u, axis=-1, keepdims=True))
    return u, length, u / length @ inverse


def noise_along(form: Form, free: Floats, reading: Floats, noise: Floats | None) -> Floats:
    """Give the (..., n) noise of |u| from the (..., n, 3) noise of the readings, if known [g]."""
    if noise is None:
        return np.full(reading.shape[:-1], USUAL_NOISE_G)
    a = _forces(form, free, reading)[2]
    return np.sqrt(np.sum((a * noise) ** 2, axis=-1))


def solution_at(form: Form, free: Floats, reading: Floats, sigma: Floats) -> Solution:
    """
    Say what these free values leave.

    Parameters
    ----------
    form : Form
        What is free.
    free : (..., q) array
        The free values.
    reading : (..., n, 3) array
        Pose means [g].
    sigma : (..., n) array
        Noise of each |force| [g]; infinite for a pose that is left out.

    """
    u, length, a = _forces(form, free, reading)
    weighted = a / -sigma[..., np.newaxis]
    gains = weighted[..., :, np.newaxis] * u[..., np.newaxis, :]
    moved = np.concatenate([weighted, gains.reshape(*u.shape[:-1], 9)], axis=-1)
    return Solution(free, length[..., 0] - 1.0, sigma, moved @ form.linear)


def solve(form: Form, start: Floats, reading: Floats, sigma: Floats
          ) -> tuple[Solution, NDArray[np.bool_]]:
    """
    Find the free values that make the weighted squares least.

    Parameters
    ----------
    form : Form
        What is free.
    start : (..., q) array
        Free values to begin with; NaN gives no result.
    reading : (..., n, 3) array
        Pose means [g].
    sigma : (..., n) array
        Noise of each |force| [g]; infinite for a pose that is left out.

    Returns
    -------
    Solution, (...) array of bool
        Where it ended, and whether it converged.

    """
    now = solution_at(form, start, reading, sigma)
    cost = np.sum(now.weighted ** 2, axis=-1)
    damping, done = np.zeros(cost.shape), ~np.isfinite(cost)
    for _ in range(_MOST_STEPS):
        step, fall = _step(now, damping, done)
        small = np.max(np.abs(step), axis=-1) <= _SMALL_STEP_G
        done = done | small | (fall <= _SMALL_FALL * cost)
        if done.all():
            break
        tried = solution_at(form, now.free + step * ~done[..., np.newaxis], reading, sigma)
        cost_tried = np.sum(tried.weighted ** 2, axis=-1)
        better = cost_tried <= cost
        damping = np.where(better, damping / 10.0, np.maximum(10.0 * damping, _FIRST_DAMPING))
        now, cost = _where(better, tried, now), np.where(better, cost_tried, cost)
    return now, done & np.isfinite(cost)


def _step(now: Solution, damping: Floats, done: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Give the damped Gauss-Newton step, (..., q), and by how much the cost would fall."""
    transposed = np.swapaxes(now.jacobian, -1, -2)
    normal = transposed @ now.jacobian
    slope = (transposed @ now.weighted[..., np.newaxis])[..., 0]
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    identity = np.eye(normal.shape[-1])
    damped = normal + (damping[..., np.newaxis] * diagonal)[..., np.newaxis] * identity
    damped = np.where(done[..., np.newaxis, np.newaxis], identity, damped)
    step = -np.linalg.solve(damped, slope[..., np.newaxis])[..., 0]
    return step, -np.sum(step * slope, axis=-1)


def _where(chosen: NDArray[np.bool_], one: Solution, other: Solution) -> Solution:
    """Take, sensor by sensor, one solution or the other."""
    if chosen.all():
        return one
    by_value, by_row = chosen[..., np.newaxis], chosen[..., np.newaxis, np.newaxis]
    return Solution(np.where(by_value, one.free, other.free),
                    np.where(by_value, one.residual, other.residual), one.sigma,
                    np.where(by_row, one.jacobian, other.jacobian))
