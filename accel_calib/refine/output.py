# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects of the output: readings that end at a limit, or lie on a grid.

Both act on the whole reading and are no columns beside the others; they show in the readings
themselves. Where the samples of a pose hardly scatter on an axis at its extreme, the sensor clips:
that pose, and the others so near the limit that some samples reach it, are left out of the fit.
Where pose means are multiples of a step that is coarse against the noise, the step q adds a
variance of q²/12 that no averaging removes.

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
_QUIET = 0.25
"""Largest scatter of clipped samples over that of others."""

_REACH = 2.0
"""Standard deviations from the limit within which samples reach it."""

_LEAST_CONSTANT = 0.2
"""Share of readings from which those whose samples do not scatter define the grid alone."""

_ON_GRID = 0.6
_OFF_GRID = 0.05
"""Distance from a multiple of the step, in steps, within which a reading is on the grid."""

_COARSEST_G = 0.1
_LEAST_STEPS = 12
"""Coarsest step of a sensor [g]; readings that differ, at least, to see a grid in them."""

_LEAST_KEPT = 6
_CLEARLY = 10.0
"""Decrease of the criterion for poses at the limit to be left out."""

_LEAST_OF_GRID = 0.25
"""Least variance of the residuals of readings on a grid, over that of the grid."""

_COARSE = 1.0
"""Least q/√12 over the noise of a pose mean for a grid to matter."""


@dataclass(frozen=True)
class Clipped:
    """
    Poses at the limit of the sensor.

    Parameters
    ----------
    limit_g : float
        Where readings end.
    poses : (d,) array of int
        Indices of the poses.

    """

    limit_g: float
    poses: NDArray[np.intp]


def clipped(poses_g: Poses) -> Clipped | None:
    """Return the poses that end at a limit, from the scatter of their samples, or None."""
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
    Find the step of a grid on which the pose means lie.

    Returns
    -------
    float or None
        The step [g]; None if there is none that is coarse against the noise.

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
    """Return the readings of each axis whose samples do not scatter; all, if few are so."""
    reading = poses_g.reading
    if 'std' in poses_g:
        still = poses_g['std'] < 1e-9
        if np.mean(still) > _LEAST_CONSTANT:
            return [reading[still[:, axis], axis] for axis in range(3)]
    return list(reading.T)


def _steps(apart: Floats) -> Floats:
    """Return the steps to try: typical smallest distances and their simple parts."""
    smallest = np.quantile(apart, np.linspace(0.0, 0.7, 15), method='nearest')
    return np.unique(np.concatenate([smallest / part for part in (1, 2, 3)]))[::-1]


def _on_grid(values: Floats, step: float) -> float:
    """Return the share of readings that are multiples of the step."""
    steps = values / step
    return float(np.mean(np.abs(steps - np.round(steps)) < _OFF_GRID))


def with_grid(poses_g: Poses, step: float) -> Poses:
    """Return the poses with the variance of the grid in their noise."""
    noise = np.zeros_like(poses_g.reading) if poses_g.noise is None else poses_g.noise
    std = np.sqrt(noise ** 2 + step ** 2 / 12.0)
    return poses_g.with_columns(std=std, count=np.ones(len(poses_g)))


def unclipped(poses_g: Poses, base: Model) -> tuple[State | None, Clipped | None]:
    """Return the poses at the limit of the sensor, if leaving them out closes a gap."""
    clip = clipped(poses_g)
    if clip is None or len(poses_g) - len(clip.poses) < _LEAST_KEPT:
        return None, None
    # Clipped samples hardly scatter, so their noise means nothing: all weigh the same here.
    plain = Poses({key: values for key, values in poses_g.columns.items() if key != 'std'},
                  poses_g.row)
    whole, kept = beginning(plain, base), beginning(
        plain.take(np.delete(np.arange(len(plain)), clip.poses)), base)
    gained = fall(max(whole.fitted.rss - kept.fitted.rss, 0.0), whole.fitted.rss, whole.dof,
                  float(len(clip.poses)))
    return (whole, clip) if gained > _CLEARLY else (None, None)


def off_grid(poses_g: Poses, base: Model) -> tuple[Poses, float | None]:
    """Return the poses with the noise of a coarse grid, if that is what their noise leaves out."""
    step = grid_step(poses_g)
    if step is None or beginning(poses_g, base).is_down_to_noise:
        return poses_g, None
    on_grid = with_grid(poses_g, step)
    if poses_g.noise is None and not _all_of_it(beginning(on_grid, base)):
        return poses_g, None  # the digits of the file, perhaps: the noise is another one
    return on_grid, step


def _all_of_it(state: State) -> bool:
    """Return whether the noise of the grid is what the residuals show, no less and no more."""
    return state.is_noise and state.fitted.rss > _LEAST_OF_GRID * state.dof
