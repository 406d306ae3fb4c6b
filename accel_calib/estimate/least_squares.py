# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Damped least squares (Levenberg 1944, Marquardt 1963) within bounds.

`scipy.optimize.least_squares` solves the same problem. For a dozen poses it takes several times as
long, mostly because of overhead (`benchmarks/fits.py`).

"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefusedFitError
from ..table import Floats

_MOST_STEPS = 60
_FIRST_DAMPING = 1e3   # relative to the smallest determined square
_LARGEST_DAMPING = 1e9

_NEAR = 1e-12
"""The fit has converged when a full step lowers the cost by less than this part."""

_NEAR_ENOUGH = 1e-5
"""If rounding prevents this, the fit accepts this part of the cost per degree of freedom."""

_ROUNDING = 1e-20
"""Decreases of the cost below this are rounding errors [noise²]."""

_SINGULAR_STEP = 1e-6
"""Relative square of a singular value below which the residuals do not determine a combination."""


class NotConvergedError(RefusedFitError):
    """The fit did not converge, so it has no result."""

    def __init__(self) -> None:
        super().__init__('the fit did not converge, so it has no result',
                         'check the poses for mistakes, or take more poses')


class Point(NamedTuple):
    """The (m,) residuals and (m, q) derivative at some values, and the object they are from."""

    residual: Floats
    columns: Floats
    source: Any = None
    singular: float = _SINGULAR_STEP

    @property
    def cost(self) -> float:
        """Sum of the squared residuals; infinite if a residual or derivative is not finite."""
        cost = float(self.residual @ self.residual)
        return cost if np.isfinite(cost) and np.all(np.isfinite(self.columns)) else np.inf


NOWHERE = Point(np.array([np.inf]), np.zeros((1, 1)))
"""A point without a prediction; its cost is infinite."""


def solve(point_at: Callable[[Floats], Point], start: Floats, lower: Floats, upper: Floats,
          move: Callable[[Floats, Floats], Floats] = np.add) -> tuple[Floats, Point]:
    """
    Compute the values that minimise the sum of squared residuals.

    Parameters
    ----------
    point_at : callable
        (q,) values -> residuals and derivative. The step solves residual = columns · step.
    start : (q,) array
        Start values.
    lower, upper : (q,) array
        Bounds of the values.
    move : callable
        Values and step to first order -> values after the step; by default their sum.

    Returns
    -------
    (q,) array, Point
        The values at the minimum, with residuals and derivative.

    Raises
    ------
    NotConvergedError
        If the fit has not converged after `_MOST_STEPS` steps.

    """
    values = np.clip(start, lower, upper)
    now, damping = point_at(values), 0.0
    first = _FIRST_DAMPING * now.singular
    if not np.isfinite(now.cost):
        raise NotConvergedError
    for _ in range(_MOST_STEPS):
        free = _free(values, now, lower, upper)
        full, fall = _step(now, free, 0.0)
        if fall <= _NEAR * now.cost or fall < _ROUNDING or damping > _LARGEST_DAMPING:
            break
        step = full if damping == 0.0 else _step(now, free, damping)[0]
        tried_at = np.clip(move(values, step), lower, upper)
        tried = point_at(tried_at)
        if tried.cost < now.cost:
            values, now, damping = tried_at, tried, damping / 10.0
            damping = 0.0 if damping < first else damping
        else:
            damping = max(10.0 * damping, first)
    _, fall = _step(now, _free(values, now, lower, upper), 0.0)
    spare = max(len(now.residual) - len(values), 1)
    if not fall <= _NEAR_ENOUGH * now.cost / spare + _ROUNDING:
        raise NotConvergedError
    return values, now


def _free(values: Floats, now: Point, lower: Floats, upper: Floats) -> NDArray[np.bool_]:
    """Return which values are free: not at a bound beyond which the cost would decrease."""
    downhill = now.columns.T @ now.residual
    held = ((values <= lower) & (downhill < 0.0)) | ((values >= upper) & (downhill > 0.0))
    return ~held


def _step(now: Point, free: NDArray[np.bool_], damping: float) -> tuple[Floats, float]:
    """
    Return the (q,) damped Gauss-Newton step, and the predicted decrease of the cost.

    Combinations of values that the residuals do not determine are not changed.

    """
    columns = now.columns * free
    size = np.sqrt(np.sum(columns ** 2, axis=0))
    size[size == 0.0] = 1.0
    columns = columns / size
    scales, axes = np.linalg.eigh(columns.T @ columns)
    downhill = axes.T @ (columns.T @ now.residual)
    determined = scales > now.singular * scales[-1]
    along = np.where(determined, downhill, 0.0) / (np.where(determined, scales, 1.0) + damping)
    return axes @ along / size, float(along @ downhill)
