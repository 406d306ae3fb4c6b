# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects of the output: readings clipped at a limit, or on a grid.

Both effects act on the whole reading, so they are not columns of the equations. They are detected
in the readings themselves.

**Limit.** The samples of an axis at the limit of the sensor scatter less than those of any pose
away from the limit. Such a pose, and the poses so near the limit that some samples reach it, are
left out of the fit.

**Grid.** Samples on a grid of step q, with less noise than the step, are constant or alternate
between two multiples of q. Means of constant samples are multiples of q. A mean between two
multiples has samples with a larger variance. Both show q. Averaging does not remove the error of
such a mean. Its variance follows from that of the samples (see `accel_calib.capture.rule`). The
capture includes it in the noise of its poses; in other tables it is missing, and is added.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .state import beginning, State
from ..calibrate import with_history
from ..capture import rounding_left
from ..effects import Model
from ..estimate import judge, NotConvergedError
from ..table import Floats, Poses

_QUIET = 0.7
"""Largest scatter of clipped samples, relative to the smallest scatter away from the limit."""

_REACH = 2.0
"""Distance from the limit, in standard deviations, within which samples reach it."""

_LEAST_CONSTANT = 0.2
"""Share of readings without scatter above which only these readings define the grid."""

_CONSTANT = 1e-4
"""Largest relative difference of the scatter that a capture states for constant samples."""

_ON_GRID = 0.6
"""Smallest share of readings on the grid."""

_OFF_GRID = 0.05
"""Largest distance of a reading on the grid from a multiple of the step, in steps."""

_COARSEST_G, _FINEST_G = 0.1, 4e-5
"""Coarsest and finest step of a sensor [g]."""

_FINEST_ALTERNATING_G = 5e-4
"""Finest step for which alternating samples are examined [g]: a finer step needs more trials."""

_ALTERNATING = (0.05, 0.2)
"""Range of the mean variance of samples that alternate, but are not constant [steps²]."""

_TRIALS_PER_PERIOD = 16
"""Number of steps tried while the largest reading moves by one step."""

_SURE = 9.0
"""Logarithm of the odds against a correlation of alternating samples by chance."""

_LEAST_STEPS = 12
"""Smallest number of different readings in which a grid is detected."""

_LEAST_KEPT = 6
"""Smallest number of poses that are not at the limit."""

_CLEARLY = 10.0
"""Smallest decrease of the criterion if the poses at the limit are left out."""

_LEAST_OF_GRID = 0.25
"""Smallest variance of the residuals of readings on a grid, relative to that of the grid."""

_RELEVANT = 0.25
"""Smallest part of the variance of a mean that a relevant grid causes."""


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
    reading, std = poses_g.reading, poses_g['std']
    reach = _REACH * float(np.median(std))
    # The limits of the two sides of an axis differ in native units.
    extremes = np.array([np.min(reading, axis=0), np.max(reading, axis=0)])
    near = np.abs(reading - extremes[:, np.newaxis]) < reach
    away = ~np.any(near, axis=0)
    usual = np.min(std, axis=0, initial=np.inf, where=away)
    usual[np.isinf(usual)] = 0.0  # all poses are near the ends of an axis
    ends = np.any(near & (std < _QUIET * usual), axis=1)
    if not np.any(ends):
        return None
    limit = float(np.max(np.abs(extremes[ends])))
    at_limit = np.any(near & ends[:, np.newaxis], axis=0) | (np.abs(reading) > limit - reach)
    return Clipped(limit, np.flatnonzero(np.any(at_limit, axis=1)))


def grid_step(poses_g: Poses) -> float | None:
    """
    Return the step of a grid that causes most of the noise of the pose means.

    Returns
    -------
    float or None
        The step [g]; None without such a grid.

    """
    clip = clipped(poses_g)
    if clip is not None:  # readings at a limit are constant, too
        poses_g = poses_g.take(np.delete(np.arange(len(poses_g)), clip.poses))
    if not len(poses_g):
        return None
    step = _constant_step(poses_g) or _alternating_step(poses_g)
    if step is None or poses_g.noise is None:
        return step
    noise = np.median(np.square(poses_g.noise))
    return step if np.median(_rounding(poses_g, step)) >= _RELEVANT * noise else None


def _rounding(poses_g: Poses, step: float) -> Floats:
    """Return the (3,) variances of the pose means that a grid causes."""
    variance = np.zeros(3)
    if 'std' in poses_g:
        variance = np.mean(_varying(poses_g['std']), axis=0)
    return np.asarray(step ** 2 * rounding_left(variance / step ** 2))


def _is_constant(std: Floats) -> NDArray[np.bool_]:
    """Return which samples are constant: std is 0, or what a capture states instead."""
    return np.asarray(std <= max(float(np.min(std)) * (1.0 + _CONSTANT), 1e-9))


def _varying(std: Floats) -> Floats:
    """Return the variances of the samples, 0 for constant ones."""
    constant = _is_constant(std)
    return np.where(constant & (np.sum(constant) > 1), 0.0, std ** 2)


def _constant_step(poses_g: Poses) -> float | None:
    """Return the step of which the means of constant samples are multiples, or None."""
    values = _constant(poses_g)
    different = [np.unique(column) for column in values]
    apart = np.concatenate([np.diff(column) for column in different])
    apart = apart[apart > 1e-7]
    if sum(map(len, different)) < _LEAST_STEPS or not apart.size:
        return None
    stated = [] if 'std' not in poses_g else [np.sqrt(12.0) * np.min(poses_g['std'])]
    for step in (*stated, *_steps(apart)):  # a capture states q/√12 for constant samples
        if _FINEST_G < step <= _COARSEST_G and _on_grid(np.concatenate(values), step) >= _ON_GRID:
            return float(step)
    return None


def _constant(poses_g: Poses) -> list[Floats]:
    """Return the readings of each axis whose samples do not scatter, or all if these are few."""
    reading = poses_g.reading
    if 'std' in poses_g:
        still = _is_constant(poses_g['std'])
        if np.mean(still) > _LEAST_CONSTANT:
            return [reading[still[:, axis], axis] for axis in range(3)]
    return list(reading.T)


def _alternating_step(poses_g: Poses) -> float | None:
    """
    Return the step with which the variance of the samples repeats, or None.

    The variance is smallest for a mean on the grid, and largest half a step away from it.

    """
    if 'std' not in poses_g:
        return None
    mean, variance = poses_g.reading.ravel(), _varying(poses_g['std']).ravel()
    variance = np.minimum(variance, 4.0 * np.median(variance))  # a few shaken poses
    finest, coarsest = (np.sqrt(np.mean(variance) / part) for part in _ALTERNATING[::-1])
    coarsest, reach = min(coarsest, _COARSEST_G), float(np.max(np.abs(mean)))
    if not _FINEST_ALTERNATING_G < finest < coarsest or np.ptp(variance) == 0.0:
        return None
    tried = np.arange(1.0 / coarsest, 1.0 / finest, 1.0 / (_TRIALS_PER_PERIOD * reach))
    agreement = np.array([-np.corrcoef(np.cos(2.0 * np.pi * mean * each), variance)[0, 1]
                          for each in tried])
    best = int(np.argmax(agreement))
    step = 1.0 / float(tried[best])
    different = sum(len(np.unique(np.round(4.0 * axis / step))) for axis in poses_g.reading.T)
    odds = -0.5 * different * np.log(1.0 - min(float(agreement[best]), 1.0 - 1e-9) ** 2)
    return step if agreement[best] > 0.0 and odds > np.log(len(tried)) + _SURE else None


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
    std = np.sqrt(noise ** 2 + _rounding(poses_g, step))
    return poses_g.with_columns(std=std, count=np.ones(len(poses_g)))


def unclipped(poses_g: Poses, base: Model) -> tuple[State | None, Clipped | None]:
    """Return the fit with the poses at the limit, and these poses, if they cause a gap."""
    clip = clipped(poses_g)
    if clip is None or len(poses_g) - len(clip.poses) < _LEAST_KEPT:
        return None, None
    # Clipped samples hardly scatter, so their noise is meaningless: all weights are equal here.
    plain = Poses({key: values for key, values in poses_g.columns.items() if key != 'std'},
                  poses_g.row)
    kept = plain.take(np.delete(np.arange(len(plain)), clip.poses))
    if not any(_fits_better(model, plain, kept) for model in (base, _linear(base))):
        return None, None
    return _whole(plain, kept, base), clip


def _linear(base: Model) -> Model:
    """Return the base with offset, gains and cross-axis, which it may lack because of the clip."""
    values = {name: part for name, part in base.values.items() if name != 'gain'}
    for name in ('offset', 'axis_gain', 'cross_axis'):
        values.setdefault(name, np.zeros(3))
    return Model(values)


def _fits_better(model: Model, plain: Poses, kept: Poses) -> bool:
    """Return whether a model fits the poses clearly better without those at the limit."""
    try:
        without = beginning(kept, model)
    except NotConvergedError:
        return False
    if without.dof < 1:
        return False
    try:
        whole = beginning(plain, model)
    except NotConvergedError:
        return True
    return whole.linear.score(without.rss, float(len(plain) - len(kept)), 0.0) > _CLEARLY


def _whole(plain: Poses, kept: Poses, base: Model) -> State:
    """Return the base fitted to all poses, or to those kept if that does not converge."""
    try:
        return beginning(plain, base)
    except NotConvergedError:
        fitted = beginning(kept, base)
        return State(judge(fitted.model, with_history(plain, fitted.model)))


def off_grid(poses_g: Poses, base: Model) -> tuple[Poses, float | None]:
    """Return the poses with the noise of a coarse grid, and its step, if it causes the noise."""
    step = grid_step(poses_g)
    if step is None:
        return poses_g, None
    if _is_explained(beginning(poses_g, base)):
        return poses_g, step if _is_included(poses_g, step) else None
    on_grid = with_grid(poses_g, step)
    if poses_g.noise is None and not _is_all_noise(beginning(on_grid, base)):
        return poses_g, None  # perhaps only the digits of the file; the noise is different
    return on_grid, step


def _is_included(poses_g: Poses, step: float) -> bool:
    """Return whether the stated noise of the poses includes that of the grid."""
    if poses_g.noise is None:
        return False
    noise = np.median(np.square(poses_g.noise))
    return bool(noise >= _RELEVANT * np.median(_rounding(poses_g, step)))


def _is_all_noise(state: State) -> bool:
    """Return whether the residuals match the noise of the grid, neither larger nor smaller."""
    return state.is_noise and state.rss > _LEAST_OF_GRID * state.dof


def _is_explained(state: State) -> bool:
    """Return whether measured noise explains the residuals."""
    return state.fit.noise_known and state.is_noise
