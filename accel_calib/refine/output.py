# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects of the output: readings clipped at a limit, or on a grid.

Both effects act on the whole reading, so they are not columns of the equations. They are detected
in the readings themselves. If the samples of a pose hardly scatter on an axis with an extreme
reading, the sensor clips. This pose, and the poses so near the limit that some samples reach it,
are left out of the fit. If pose means are multiples of a step that is coarse compared with the
noise, the step q adds a variance of q²/12 that averaging does not remove.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .candidates import fall
from .state import beginning, State
from ..model import Model
from ..table import Floats, Poses

_LEAST_CLIPPED = 2
"""Smallest number of poses at the limit."""

_QUIET = 0.25
"""Largest scatter of clipped samples, relative to the median scatter."""

_REACH = 2.0
"""Distance from the limit, in standard deviations, within which samples reach it."""

_LEAST_CONSTANT = 0.2
"""Share of readings without scatter above which only these readings define the grid."""

_ON_GRID = 0.6
"""Smallest share of readings on the grid."""

_OFF_GRID = 0.05
"""Largest distance of a reading on the grid from a multiple of the step, in steps."""

_COARSEST_G = 0.1
"""Coarsest step of a sensor [g]."""

_LEAST_STEPS = 12
"""Smallest number of different readings in which a grid is detected."""

_LEAST_KEPT = 6
"""Smallest number of poses that are not at the limit."""

_CLEARLY = 10.0
"""Smallest decrease of the criterion if the poses at the limit are left out."""

_LEAST_OF_GRID = 0.25
"""Smallest variance of the residuals of readings on a grid, relative to that of the grid."""

_COARSE = 1.0
"""Smallest ratio of q/√12 to the noise of a pose mean for a relevant grid."""


@dataclass(frozen=True)
class Clipped:
    """
    The limit of the sensor, and the poses at the limit.

    Parameters
    ----------
    limit_g : float
        The limit of the readings [g].
    poses : (d,) array of int
        Indices of the poses.

    """

    limit_g: float
    poses: NDArray[np.intp]


def clipped(poses_g: Poses) -> Clipped | None:
    """Return the poses at a limit, detected by the scatter of their samples, or None."""
    if 'std' not in poses_g:
        return None
    size, scatter = np.abs(poses_g.reading), float(np.median(poses_g['std']))
    limit = float(np.max(size))
    near = size > limit - _REACH * scatter
    quiet = near & (poses_g['std'] < _QUIET * scatter)
    at_limit = np.flatnonzero(np.any(near, axis=1))
    if not np.any(quiet) or len(at_limit) < _LEAST_CLIPPED:
        return None
    return Clipped(limit, at_limit)


def grid_step(poses_g: Poses) -> float | None:
    """
    Return the step of a grid that contains the pose means.

    Returns
    -------
    float or None
        The step [g]; None without a grid that is coarse compared with the noise.

    """
    values = _constant(poses_g)
    different = [np.unique(column) for column in values]
    apart = np.concatenate([np.diff(column) for column in different])
    apart = apart[apart > 1e-7]
    if sum(map(len, different)) < _LEAST_STEPS or not apart.size:
        return None
    noise = 0.0 if poses_g.noise is None else float(np.median(poses_g.noise))
    for step in _steps(apart):
        if step / np.sqrt(12.0) < max(_COARSE * noise, 1e-5):
            return None
        if step <= _COARSEST_G and _on_grid(np.concatenate(values), step) >= _ON_GRID:
            return float(step)
    return None


def _constant(poses_g: Poses) -> list[Floats]:
    """Return the readings of each axis whose samples do not scatter, or all if these are few."""
    reading = poses_g.reading
    if 'std' in poses_g:
        still = poses_g['std'] < 1e-9
        if np.mean(still) > _LEAST_CONSTANT:
            return [reading[still[:, axis], axis] for axis in range(3)]
    return list(reading.T)


def _steps(apart: Floats) -> Floats:
    """Return the steps to try: typical smallest distances, and 1/2 and 1/3 of them."""
    smallest = np.quantile(apart, np.linspace(0.0, 0.7, 15), method='nearest')
    return np.unique(np.concatenate([smallest / part for part in (1, 2, 3)]))[::-1]


def _on_grid(values: Floats, step: float) -> float:
    """Return the share of readings that are multiples of the step."""
    steps = values / step
    return float(np.mean(np.abs(steps - np.round(steps)) < _OFF_GRID))


def with_grid(poses_g: Poses, step: float) -> Poses:
    """Return the poses with the variance of the grid added to their noise."""
    noise = np.zeros_like(poses_g.reading) if poses_g.noise is None else poses_g.noise
    std = np.sqrt(noise ** 2 + step ** 2 / 12.0)
    return poses_g.with_columns(std=std, count=np.ones(len(poses_g)))


def unclipped(poses_g: Poses, base: Model) -> tuple[State | None, Clipped | None]:
    """Return the fit with the poses at the limit, and these poses, if they cause a gap."""
    clip = clipped(poses_g)
    if clip is None or len(poses_g) - len(clip.poses) < _LEAST_KEPT:
        return None, None
    # Clipped samples hardly scatter, so their noise is meaningless: all weights are equal here.
    plain = Poses({key: values for key, values in poses_g.columns.items() if key != 'std'},
                  poses_g.row)
    whole, kept = beginning(plain, base), beginning(
        plain.take(np.delete(np.arange(len(plain)), clip.poses)), base)
    gained = fall(max(whole.fitted.rss - kept.fitted.rss, 0.0), whole.fitted.rss, whole.dof,
                  float(len(clip.poses)))
    return (whole, clip) if gained > _CLEARLY else (None, None)


def off_grid(poses_g: Poses, base: Model) -> tuple[Poses, float | None]:
    """Return the poses with the noise of a coarse grid, and its step, if their noise lacks it."""
    step = grid_step(poses_g)
    if step is None or beginning(poses_g, base).is_down_to_noise:
        return poses_g, None
    on_grid = with_grid(poses_g, step)
    if poses_g.noise is None and not _is_all_noise(beginning(on_grid, base)):
        return poses_g, None  # perhaps only the digits of the file; the noise is different
    return on_grid, step


def _is_all_noise(state: State) -> bool:
    """Return whether the residuals match the noise of the grid, neither larger nor smaller."""
    return state.is_noise and state.fitted.rss > _LEAST_OF_GRID * state.dof
