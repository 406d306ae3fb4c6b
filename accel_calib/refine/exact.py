# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The joint fit of a model to poses of every kind: Gauss-Newton on the equations.

Shapes that come from the data themselves (start, instant) stay; the time constant is fitted with
all other values.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .equations import Equations, equations
from ..calibrate.likelihood import covariance_of as covariance_of_fit
from ..effects import EFFECTS
from ..errors import InputError
from ..model import Model, parameter_basis, sensor_force, with_vector
from ..table import Floats, Poses

_ITERATIONS = 12
_CONVERGED = 1e-6


def free_values(effects: tuple[str, ...]) -> NDArray[np.bool_]:
    """Tell which values of these effects are fitted, (p,)."""
    return np.array([part in EFFECTS[name].parameters or part == 'tau'
                     for name in effects for part in EFFECTS[name].values], bool)


def columns_of(model: Model, near: Equations, poses_g: Poses) -> Floats:
    """Give the (m, f) columns of the free values of a model."""
    basis = parameter_basis(model, near.force, poses_g.columns)
    columns: Floats = near.seen(basis[:, :, free_values(model.effects)])
    return columns


def fit_exactly(model: Model, poses_g: Poses, noise: Floats | None) -> Model:
    """
    Fit all values of a model.

    Parameters
    ----------
    model : Model
        Where to begin, ΔR = I.
    poses_g : Poses
        In g, with the context that its effects need.
    noise : (n, 3) array or None
        Noise of the pose means [g].

    Returns
    -------
    Model
        The fitted model.

    """
    free = free_values(model.effects)
    for _ in range(_ITERATIONS if np.any(free) else 0):
        near = equations(model, poses_g, noise)
        columns = columns_of(model, near, poses_g)
        sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        change = np.linalg.lstsq(columns / sizes, near.residual, rcond=1e-7)[0] / sizes
        model = _moved(model, _limited(change, model, free), free, poses_g)
        if np.max(np.abs(columns @ change), initial=0.0) < _CONVERGED * max(
                1.0, float(np.linalg.norm(near.residual))):
            break
    return model


def _moved(model: Model, change: Floats, free: NDArray[np.bool_], poses_g: Poses) -> Model:
    """Change the free values, by less where the effects could not be undone after it."""
    for share in (1.0, 0.3, 0.1, 0.0):
        vector = model.vector.copy()
        vector[free] += share * change
        moved = with_vector(model.effects, vector)
        try:
            sensor_force(moved, poses_g.reading, poses_g.columns)
        except InputError:
            continue
        return moved
    return model


def _limited(change: Floats, model: Model, free: NDArray[np.bool_]) -> Floats:
    """Keep time constants from leaping: at most half of themselves a step."""
    names = np.array([part for name in model.effects for part in EFFECTS[name].values])
    taus, now = names[free] == 'tau', model.vector[free]
    limit = np.where(taus, 0.5 * np.abs(now), np.inf)
    limited: Floats = np.clip(change, -limit, limit)
    return limited


def covariance_of(model: Model, poses_g: Poses, noise: Floats | None) -> Floats:
    """Give the (p, p) covariance of all values; zero for those that are not fitted."""
    near = equations(model, poses_g, noise)
    columns = columns_of(model, near, poses_g)
    free = free_values(model.effects)
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    scaled = covariance_of_fit(columns / sizes, near.residual, noise is not None,
                               near.count - columns.shape[1])
    covariance = np.zeros((len(free), len(free)))
    covariance[np.ix_(free, free)] = scaled / np.outer(sizes, sizes)
    return covariance
