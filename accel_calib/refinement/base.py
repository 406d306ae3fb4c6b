# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The poses that a search starts from.

**Long tables.** A sample of a long table bounds the time and the memory of a refinement; such
tables come from machines, or are samples in place of poses. With `MOST` equations a refinement
takes 10 s and 300 MB as a rule, and about a minute and 900 MB in the worst case: all context, and
noise that no effect explains. A pose has one equation, or three if its orientation is known or
shared. The sample takes one pose out of each part of the table. The place in the part changes by
the golden ratio, so that a table that repeats the same turns gives all of them.

**Stored calibration as the base.** The calibration is the simulation, and the new poses are the
measurement. The poses of the calibration are added to the new poses, without their times, because
the clocks of two recordings can differ. If the file was edited by hand, or the new poses are
partly those of the calibration and contradict it, the readings that the calibration predicts
replace its measured ones.

**Effects of the output** act on the whole reading: readings clipped at a limit, or on a grid. They
are not columns of the equations, so they are detected in the readings themselves.

**Limit.** The samples of an axis at the limit of the sensor scatter less than those of any pose
away from the limit. Such a pose, and the poses so near the limit that some samples reach it, are
left out of the fit.

**Grid.** Samples on a grid of step q, with less noise than the step, are constant or alternate
between two multiples of q. Means of constant samples are multiples of q. A mean between two
multiples has samples with a larger variance. Both show q. Averaging does not remove the error of
such a mean. Its variance follows from that of the samples (see `accel_calib.stillness.rule`). The
capture includes it in the noise of its poses; in other tables it is missing, and is added.

"""

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
import scipy

from .state import beginning, fitted_state, State, without
from ..calibration import Calibration, in_g
from ..effects import add_history, included, Model, MODELS
from ..estimate import estimate, judge
from ..finding import has
from ..geometry import unit
from ..stillness import rounding_left
from ..table import Floats, Poses

MOST = 6000
"""Largest number of equations that a refinement uses."""

_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0

_QUIET = 0.7
"""Largest scatter of clipped samples, relative to the smallest scatter away from the limit."""

_STILL = 0.2
_LEAST_PILED = 2
"""Smallest number of readings at the ends of axes whose samples scatter less; one whose samples
scatter less than `_STILL` of the others counts twice."""

_REACH = 2.0
"""Distance from the limit, in standard deviations, within which samples reach it."""

_LEAST_CONSTANT = 0.2
"""Share of readings without scatter above which only these readings define the grid."""

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


_SAME = 0.999
"""Quantile of chi² below which a stored calibration agrees with poses of its fit."""

_EQUAL = 1e-9
"""Relative difference below which numbers of a quantity are equal."""

_OF_READING = 0.1
"""Scatter of the ratio of a quantity to the length of the readings below which it is computed from
them, relative to the scatter of the length."""


def causes(poses_g: Poses) -> tuple[str, ...]:
    """Return the quantities that vary, other than row numbers and lengths of the readings."""
    length, found = np.linalg.norm(poses_g.reading, axis=1), []
    for key in poses_g.quantities:
        values = poses_g[key]
        known = values[np.isfinite(values)]
        if not len(known) or np.ptp(known) <= _EQUAL * np.max(np.abs(known)):
            continue
        steps, ratio = np.diff(values), values / length
        counts_rows = np.all(np.abs(steps - steps[:1]) <= _EQUAL * np.abs(steps[:1]))
        is_length = (np.std(ratio) * np.mean(length)
                     < _OF_READING * np.std(length) * np.abs(np.mean(ratio)))
        if not counts_rows and not is_length:
            found.append(key)
    return tuple(found)


def sampled(poses: Poses) -> Poses:
    """Return the poses for `MOST` equations, and as many of those of a stored calibration."""
    most = MOST // (3 if {'reference', 'orientation'} & set(poses.columns) else 1)
    if len(poses) <= most:
        return poses
    new = poses['new'] > 0.0 if 'new' in poses else np.ones(len(poses), bool)
    parts = []
    for part in (np.flatnonzero(new), np.flatnonzero(~new)):
        count = len(part)
        kept = _spread(count, most)
        if 'orientation' in poses and count > most:
            group = np.unique(poses['orientation'][part], return_inverse=True)[1]
            groups = int(group.max()) + 1
            whole = np.flatnonzero(np.isin(group, _spread(groups, max(most * groups // count, 1))))
            if most // 2 <= len(whole) <= 2 * most:
                kept = whole  # all poses of some orientations
        parts.append(part[kept])
    return poses.take(np.sort(np.concatenate(parts)))


def _spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Return at most `wanted` different indices, one out of each part of the range."""
    if count <= wanted:
        return np.arange(count)
    part = np.arange(wanted)
    return np.unique(((part + part * _GOLDEN % 1.0) * (count / wanted)).astype(np.intp))


@dataclass(frozen=True)
class Clipped:
    """The limit of the readings [g], and the (d,) indices of the poses at the limit."""

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
    quiet = near & (std < _QUIET * usual)
    # Samples pile up at a limit, which is that of all axes; one pose may be quiet by chance.
    seen = 'at_limit' in poses_g and bool(np.any(poses_g['at_limit']))  # by the capture
    piled = np.sum(quiet) + np.sum(near & (std < _STILL * usual))
    if not np.any(quiet) or (piled < _LEAST_PILED and not seen):
        return None
    ends = np.any(quiet, axis=1)
    limit = float(np.max(np.abs(extremes[ends])))
    at_limit = np.any(near & ends[:, np.newaxis], axis=0) | (np.abs(reading) > limit - reach)
    return Clipped(limit, np.flatnonzero(np.any(at_limit, axis=1)))


def grid_step(poses_g: Poses) -> float | None:
    """Return the step of a grid that causes most of the noise of the pose means [g], or None."""
    clip = clipped(poses_g)
    if clip is not None:  # readings at a limit are constant, too
        poses_g = without(poses_g, clip.poses)
    if not len(poses_g):
        return None
    step = _constant_step(poses_g) or _alternating_step(poses_g)
    if step is None or poses_g.noise is None:
        return step
    noise = np.median(np.square(poses_g.noise))
    return step if np.median(_rounding(poses_g, step)) >= _RELEVANT * noise else None


def _rounding(poses_g: Poses, step: float) -> Floats:
    """Return the (3,) variances of the pose means that a grid causes."""
    variance = np.mean(_varying(poses_g['std']), axis=0) if 'std' in poses_g else np.zeros(3)
    return np.asarray(step ** 2 * rounding_left(variance / step ** 2))


def _is_constant(std: Floats) -> NDArray[np.bool_]:
    """Return which samples are constant: std is 0, or q/√12 within 1e-4, by a capture."""
    return np.asarray(std <= max(float(np.min(std)) * (1.0 + 1e-4), 1e-9))


def _varying(std: Floats) -> Floats:
    """Return the variances of the samples, 0 for constant ones."""
    constant = _is_constant(std)
    return np.where(constant & (np.sum(constant) > 1), 0.0, std ** 2)


def _constant_step(poses_g: Poses) -> float | None:
    """Return the step of which the means of constant samples are multiples, or None."""
    values, stated = list(poses_g.reading.T), list[float]()
    if 'std' in poses_g:
        stated = [np.sqrt(12.0) * np.min(poses_g['std'])]  # by a capture, for constant samples
        still = _is_constant(poses_g['std'])
        if np.mean(still) > _LEAST_CONSTANT:
            values = [column[which] for column, which in zip(values, still.T, strict=True)]
    different = [np.unique(column) for column in values]
    apart = np.concatenate([np.diff(column) for column in different])
    apart = apart[apart > 1e-7]
    if sum(map(len, different)) < _LEAST_STEPS or not apart.size:
        return None
    # Typical smallest distances are multiples of the step.
    smallest = np.quantile(apart, np.linspace(0.0, 0.7, 15), method='nearest')
    steps = np.unique(np.concatenate([smallest / part for part in (1, 2, 3)]))[::-1]
    for step in (*stated, *steps):
        if _FINEST_G < step <= _COARSEST_G:
            number = np.concatenate(values) / step
            if np.mean(np.abs(number - np.round(number)) < _OFF_GRID) >= _ON_GRID:
                return float(step)
    return None


def _alternating_step(poses_g: Poses) -> float | None:
    """Return the step with which the variance repeats (least for means on the grid), or None."""
    if 'std' not in poses_g:
        return None
    mean, variance = poses_g.reading.ravel(), _varying(poses_g['std']).ravel()
    variance = np.minimum(variance, 4.0 * np.median(variance))  # a few shaken poses
    finest, coarsest = (np.sqrt(np.mean(variance) / part) for part in _ALTERNATING[::-1])
    coarsest, reach = min(coarsest, _COARSEST_G), float(np.max(np.abs(mean)))
    if not _FINEST_ALTERNATING_G < finest < coarsest or np.ptp(variance) == 0.0:
        return None
    tried = np.arange(1.0 / coarsest, 1.0 / finest, 1.0 / (_TRIALS_PER_PERIOD * reach))
    agreement = -_correlations(mean, variance, tried)
    best = int(np.argmax(agreement))
    step = 1.0 / float(tried[best])
    different = sum(len(np.unique(np.round(4.0 * axis / step))) for axis in poses_g.reading.T)
    odds = -0.5 * different * np.log(1.0 - min(float(agreement[best]), 1.0 - 1e-9) ** 2)
    return step if agreement[best] > 0.0 and odds > np.log(len(tried)) + _SURE else None


def _correlations(mean: Floats, variance: Floats, tried: Floats) -> Floats:
    """
    Return the correlation of a variance with the cosine of a mean, at evenly spaced frequencies.

    With exp(i (a + b)) = exp(i a) exp(i b), few exponentials are computed.

    """
    count, width = len(mean), math.isqrt(len(tried)) + 1
    coarse = np.exp(2j * np.pi * np.outer(tried[::width], mean))
    fine = np.exp(2j * np.pi * np.outer(tried[:width] - tried[0], mean))

    def summed(one: Any, other: Any) -> Floats:
        return np.asarray((one @ other.T).real.ravel()[:len(tried)])

    cosines, squares = summed(coarse, fine), 0.5 * (count + summed(coarse ** 2, fine ** 2))
    spread, away = squares - cosines ** 2 / count, variance - np.mean(variance)
    return summed(coarse * away, fine) / np.sqrt(
        np.maximum(spread, 1e-12 * count) * np.sum(away ** 2))


def unclipped(poses_g: Poses, base: Model) -> tuple[State | None, Clipped | None]:
    """Return the fit with the poses at the limit, and these poses, if they cause a gap."""
    clip = clipped(poses_g)
    if clip is None or len(poses_g) - len(clip.poses) < _LEAST_KEPT:
        return None, None
    # Clipped samples hardly scatter, so their noise is meaningless: all weights are equal here.
    plain = poses_g.without_columns('std')
    kept = without(plain, clip.poses)
    # The base may lack offset, gains and cross-axis because of the clip.
    linear = MODELS['10'].effects
    values = {name: part for name, part in base.values.items() if name not in included(linear)}
    values |= {name: np.zeros(3) for name in linear if name not in values}
    for model in (base, Model(values)):
        fewer = fitted_state(model, add_history(kept, model))
        if fewer is None or fewer.dof < 1:
            continue
        whole = fitted_state(model, add_history(plain, model))
        if whole is None or whole.linear.score(
                fewer.rss, float(len(plain) - len(kept)), 0.0) > _CLEARLY:
            break
    else:
        return None, None
    whole = fitted_state(base, add_history(plain, base))
    if whole is None:  # it converges only without the poses at the limit
        model = beginning(kept, base).model
        whole = State(judge(model, add_history(plain, model)))
    return whole, clip


def off_grid(poses_g: Poses, base: Model) -> tuple[Poses, float | None]:
    """Return the poses with the noise of a coarse grid, and its step, if it causes the noise."""
    step = grid_step(poses_g)
    if step is None:
        return poses_g, None
    plain, noise, rounding = beginning(poses_g, base), poses_g.noise, _rounding(poses_g, step)
    if noise is not None and plain.fit.noise_known and plain.is_noise:
        is_included = np.median(np.square(noise)) >= _RELEVANT * np.median(rounding)
        return poses_g, step if is_included else None
    variance = np.zeros_like(poses_g.reading) if noise is None else noise ** 2
    on_grid = poses_g.with_columns(std=np.sqrt(variance + rounding), count=np.ones(len(poses_g)))
    if noise is None:
        state = beginning(on_grid, base)
        if not state.is_noise or state.rss <= _LEAST_OF_GRID * state.dof:
            return poses_g, None  # perhaps only the digits of the file; the noise is different
    return on_grid, step


def beside_stored(poses_g: Poses, calibration: Calibration, model: Model) -> Poses:
    """
    Return new poses in g followed by those of a stored calibration, with the column ``new``.

    The ways between the poses of the calibration are those that `model` corrects.
    Return only the new poses, without this column, if the calibration has no effects or no poses,
    or was fitted to some of the new poses and still agrees with them.

    """
    stored = add_history(in_g(calibration.poses, calibration.units), model)
    stored = stored.take(np.isin(stored.row, calibration.used_poses.row))
    if not len(stored) or not calibration.model.effects:
        return poses_g
    new, old = ({tuple(row) for row in poses.reading.round(7).tolist()}  # files round
                for poses in (poses_g, stored))
    shared, edited = not new.isdisjoint(old), has(calibration.noted, 'edited')
    if shared and not edited:
        as_stored = Model(calibration.model.values)
        fit = estimate(as_stored, poses_g)
        excess = judge(as_stored, calibration.held(poses_g)).chi2 - fit.chi2
        worse = max(fit.chi2 / max(fit.dof, 1), 1.0)
        if excess / worse < scipy.special.chdtri(len(as_stored.vector), 1.0 - _SAME):
            return poses_g  # a fit is no better than the calibration
    if shared or edited:  # with the readings that the calibration predicts in their directions
        here = calibration.model.at(stored.columns)
        stored = stored.with_columns(reading=here.reading(unit(here.force(stored.reading))))
    ours, count = {**poses_g.columns, 'new': np.ones(len(poses_g))}, len(stored)
    optional = ('temperature', 'supply_voltage', 'rate', 'previous', *poses_g.quantities)
    unknown = {key: np.full((count, *ours[key].shape[1:]), np.nan)
               for key in optional if key in ours}
    theirs = {**unknown, **stored.columns, 'new': np.zeros(count)}
    if 'time' in calibration.ranges:  # limited to the range of the calibration
        ours['time'] = np.clip(ours['time'], *calibration.ranges['time'])
    elif 'time' in ours:
        theirs['time'] = np.full(count, np.nan)
    columns = {key: np.concatenate([values, theirs[key]])
               for key, values in ours.items() if key in theirs}
    joined = Poses({**columns, **_orientations(poses_g, stored)}, _rows(poses_g, stored))
    return joined if joined.noise is not None else joined.without_columns('std', 'count')


def with_stored(poses: Poses, calibration: Calibration) -> Poses:
    """Return poses followed by those of a stored calibration, in the unit of the readings."""
    stored = calibration.used_poses
    columns = {key: np.concatenate([poses[key], stored[key]]) for key in poses.columns
               if key in stored}
    return replace(poses, columns={**columns, **_orientations(poses, stored)},
                   row=_rows(poses, stored))


def _orientations(poses: Poses, stored: Poses) -> dict[str, Floats]:
    """Return the joined column ``orientation``, if one has it; stored poses share none of ours."""
    if 'orientation' not in poses and 'orientation' not in stored:
        return {}
    ours, theirs = (each['orientation'] if 'orientation' in each else np.arange(float(len(each)))
                    for each in (poses, stored))
    return {'orientation': np.concatenate([ours, np.min(ours) - 1.0 - theirs + np.min(theirs)])}


def _rows(poses: Poses, stored: Poses) -> NDArray[np.int64]:
    return np.concatenate([poses.row, int(poses.row.max()) + 1 + np.arange(len(stored))])
