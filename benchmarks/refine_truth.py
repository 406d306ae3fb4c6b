# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The fair reference of the refinement: the true form, fitted to the same poses.

Offset, symmetric gain, the values of the effects and the time constant of a warm-up are fitted
together by least squares on |a| = 1 g, weighted by the true noise, from the truth on. No search:
nothing can be named wrongly here.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from generator import basis_of, ON_OUTPUT, OUTSIDE, Simulated, STANDARD_GRAVITY
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.floating[Any]]

WITHOUT_FORM = (*ON_OUTPUT, *OUTSIDE, 'offset_wander')
"""What is no function with a few values."""

_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_SWEEPS = 7


@dataclass(frozen=True)
class _Form:
    """The effects that were hidden, and how large their values are."""

    names: tuple[str, ...]
    scales: tuple[float, ...]
    widths: tuple[int, ...]


def reading_of(made: Simulated) -> Floats:
    """Give the (n, 3) readings in g."""
    return np.column_stack([made.columns[name] for name in ('ax', 'ay', 'az')]) / STANDARD_GRAVITY


def true_form_gap_mg(made: Simulated, fresh: Simulated) -> float | None:
    """
    Give the gap in fresh poses that the true form leaves, RMS [mg].

    Parameters
    ----------
    made : Simulated
        The poses it is fitted to.
    fresh : Simulated
        Other poses of the same sensor.

    Returns
    -------
    float or None
        None where what is hidden has no form that can be fitted.

    """
    if any(name in WITHOUT_FORM for name in made.values):
        return None
    form = _Form(tuple(made.values),
                 tuple(float(np.linalg.norm(value)) for value in made.values.values()),
                 tuple(len(value) for value in made.values.values()))
    free = np.concatenate([
        made.traits.offset, [made.traits.gain[i, j] for i, j in _SYMMETRIC], [1.0],
        *(value / scale for value, scale in zip(made.values.values(), form.scales, strict=True))])

    def weighted(x: Floats) -> Floats:
        return _errors(x, form, made) / made.noise

    found = least_squares(weighted, free, x_scale='jac')
    left = _errors(found.x, form, fresh)
    return float(np.sqrt(np.mean(left ** 2)) * 1e3)


def _errors(free: Floats, form: _Form, made: Simulated) -> Floats:
    """Give |u| - 1 of each pose, u found from the reading by sweeps."""
    gain = np.zeros((3, 3))
    for value, (i, j) in zip(free[3:9], _SYMMETRIC, strict=True):
        gain[i, j] = gain[j, i] = value
    traits = replace(made.traits, offset=free[:3], gain=gain, tau=made.traits.tau * free[9])
    parts = np.split(free[10:], np.cumsum(form.widths)[:-1])
    linear = np.linalg.solve(gain, (reading_of(made) - free[:3]).T).T
    inverse, u = np.linalg.inv(gain).T, linear
    for _ in range(_SWEEPS if form.names else 0):
        around = replace(made.around, force=u)
        added = sum(basis_of(name, around, traits) @ (part * scale)
                    for name, part, scale in zip(form.names, parts, form.scales, strict=True))
        u = linear - added @ inverse
    return np.linalg.norm(u, axis=1) - 1.0
