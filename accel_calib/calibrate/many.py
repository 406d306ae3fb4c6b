# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A fleet: the same fit for many sensors in one call over arrays.

Closed form, maximum likelihood, disturbed poses and stated uncertainty are those of a single
sensor (`.fit`), for sensors that took equally many poses of unknown orientation. A sensor whose
poses do not carry the model is told by its dilution and has NaN for its values.

"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from . import closed_form
from .disturbed import extreme, ROUNDS
from .geometry import dilution_of, LARGEST_DILUTION, NORM_MODELS, poses_needed
from .norm_fit import Form, form_of, noise_along, Solution, solution_at, solve
from .uncertainty import believable, variance_factor
from .unknown import CLOSED_FORMS, Method, METHODS
from ..errors import RefusedFitError
from ..table import Floats
from ..units import MG, Units

_BLOCK = 500
"""Sensors at a time: their arrays stay in the cache."""


@dataclass(frozen=True)
class Fleet:
    """
    Fits of m sensors; NaN for a sensor that could not be fitted.

    Parameters
    ----------
    fitted : (m,) array of bool
        Whether its poses carry the model and the fit converged.
    offset : (m, 3) array
        V, in the unit of the readings.
    gain : (m, 3, 3) array
        W: dimensionless, or native units per g.
    covariance : (m, p, p) array
        Of the values of the effects, in the order of ``model.vector`` [g].
    rejected : (m, n) array of bool
        Disturbed poses, left out.
    rms_mg : (m,) array
        Gap over the poses kept [mg].
    dilution : (m,) array
        Largest error of |force| over the sphere, over that of a pose.

    """

    fitted: NDArray[np.bool_]
    offset: Floats
    gain: Floats
    covariance: Floats
    rejected: NDArray[np.bool_]
    rms_mg: Floats
    dilution: Floats


def fit_many(reading: Floats, units: Units, *, model: str = '10', method: Method = 'ml',
             noise: Floats | None = None) -> Fleet:
    """
    Fit many sensors that took equally many poses.

    Parameters
    ----------
    reading : (m, n, 3) array
        Pose means of m sensors, in the unit of the readings.
    units : Units
        That unit; native units find their own scale, sensor by sensor.
    model : {'4', '7', '10'}
        The model.
    method : {'ml', 'algebraic'}
        As `fit_poses`.
    noise : (m, n, 3) array, optional
        Standard deviation of the pose means, in the unit of the readings.

    Returns
    -------
    Fleet
        The fits.

    Raises
    ------
    RefusedFitError
        If there are fewer poses than the model needs.

    """
    if model not in NORM_MODELS or method not in METHODS:
        raise ValueError(f'model {model!r}, method {method!r}; expected {NORM_MODELS}, {METHODS}')
    if reading.ndim != 3 or reading.shape[2] != 3:
        raise ValueError(f'readings have shape {reading.shape}, expected (m, n, 3)')
    if reading.shape[1] < poses_needed(model):
        raise RefusedFitError(f'{reading.shape[1]} poses a sensor, model {model} needs at least '
                              f'{poses_needed(model)}', 'take more, or use a smaller model')
    blocks = [slice(k, k + _BLOCK) for k in range(0, max(len(reading), 1), _BLOCK)]
    parts = [_fit_block(reading[at], units, model, method, None if noise is None else noise[at])
             for at in blocks]
    return Fleet(*(np.concatenate([getattr(part, each.name) for part in parts])
                   for each in fields(Fleet)))


def _fit_block(reading: Floats, units: Units, model: str, method: Method, noise: Floats | None
               ) -> Fleet:
    """Fit some of the sensors."""
    per_g: Floats | float = units.per_g
    if units.name == 'native':
        per_g = closed_form.fit_4(reading)[0][:, :1, :1]
    reading_g = reading / per_g
    known = believable(None if noise is None else noise / per_g)
    form = form_of(model)
    start = form.free(*CLOSED_FORMS[model](reading_g))
    sound = np.isfinite(start.sum(axis=1))
    start = np.where(sound[:, np.newaxis], start, form.free(np.eye(3), np.zeros(3)))
    sigma = noise_along(form, start, reading_g, known)
    found = solution_at(form, start, reading_g, sigma)
    middle = np.median(sigma, axis=1)[:, np.newaxis, np.newaxis]
    stretched = np.where(sound, dilution_of(model, found.jacobian * middle), np.inf)
    fitted = stretched <= LARGEST_DILUTION
    kept = np.ones(reading.shape[:2], bool)
    if method == 'ml':
        found, kept, converged = _likeliest(form, found.free, reading_g, known, fitted)
        fitted = fitted & converged
    return _fleet(form, found, kept, fitted, stretched, per_g, units, known is not None)


def _likeliest(form: Form, start: Floats, reading: Floats, noise: Floats | None,
               fitted: NDArray[np.bool_]) -> tuple[Solution, NDArray[np.bool_],
                                                   NDArray[np.bool_]]:
    """Find the likeliest values and leave disturbed poses out; which are kept, what converged."""
    free, kept, converged = start.copy(), np.ones(reading.shape[:2], bool), fitted.copy()
    todo = np.flatnonzero(fitted)
    for _ in range(ROUNDS + 1):
        at, now = reading[todo], None if noise is None else noise[todo]
        sigma = np.where(kept[todo], noise_along(form, free[todo], at, now), np.inf)
        found, converged[todo] = solve(form, free[todo], at, sigma)
        free[todo] = found.free
        out = extreme(found.weighted, found.jacobian, kept[todo], noise is not None,
                      reading.shape[1])
        kept[todo] &= ~out
        todo = todo[out.any(axis=1)]
        if not len(todo):
            break
    sigma = np.where(kept, noise_along(form, free, reading, noise), np.inf)
    return solution_at(form, free, reading, sigma), kept, converged


def _fleet(form: Form, found: Solution, kept: NDArray[np.bool_], fitted: NDArray[np.bool_],
           stretched: Floats, per_g: Floats | float, units: Units, noise_known: bool) -> Fleet:
    """Make the record."""
    count, size = kept.sum(axis=1), found.jacobian.shape[2]
    information = np.swapaxes(found.jacobian, 1, 2) @ found.jacobian
    information = np.where(fitted[:, np.newaxis, np.newaxis], information, np.eye(size))
    factor = variance_factor((found.weighted ** 2).sum(axis=1), count - size, noise_known)
    spread = np.linalg.inv(information) * factor[:, np.newaxis, np.newaxis]
    values = found.free @ form.linear.T
    values = np.where(fitted[:, np.newaxis], values, np.nan)
    gain = np.eye(3) + values[:, 3:].reshape(-1, 3, 3)
    scale = np.broadcast_to(np.asarray(per_g, float).reshape(-1, 1), (len(kept), 1))
    rms = np.sqrt((np.where(kept, found.residual, 0.0) ** 2).sum(axis=1) / count)
    return Fleet(fitted, values[:, :3] * scale,
                 gain * (scale[..., np.newaxis] if units.name == 'native' else 1.0),
                 np.where(fitted[:, np.newaxis, np.newaxis], spread, np.nan), ~kept,
                 np.where(fitted, rms, np.nan) * MG, stretched)
