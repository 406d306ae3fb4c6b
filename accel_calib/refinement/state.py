# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The start of a search: a model fitted to the poses kept, and its equations with the candidates.

A candidate is an effect with each shape that is tried. `linearised` projects the base of a model
out of the equations, for the candidates that the context of the poses allows.

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

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
import scipy

from .linear import Block, LEAST_OWN, Linear
from ..calibration import determines, NORM_MODELS
from ..effects import (
    add_history, Context, Effect, EffectKey, entry_of, factors_of, included, kind_of, linear_model,
    Model, MODELS)
from ..estimate import estimate, Fit, judge, kinds, left_out, NotConvergedError
from ..geometry import unit
from ..statistics import rms
from ..stillness import rounding_left
from ..table import Floats, Poses
from ..units import MG

WORTH = 4.0
"""ν, degrees of freedom that the measured noise counts as."""

_SHAPES_AT_ONCE = 60
"""If there are more shapes, evenly spread ones are tried first, then those beside the best."""

_SHAPES_ALIKE = 3.0
"""Number of neighbouring shapes that count as one independent trial."""

_CHI2_LEVEL = 1e-3
_CHI2_RATIO = 1.3
"""chi² per degree of freedom that still counts as noise: poses repeat worse than samples."""

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

_WARMER = 1e-3
"""Step of the derivative by the temperature [°C]."""

_IDEAL = Model({})


@dataclass(frozen=True)
class Candidate:
    """
    An effect to try with each of some shapes, which count as `tried` independent ones.

    `every` are its shapes, `places` the indices of those to try, increasing, and `factors`
    (places, t or 1, n) those of its terms at the poses, with any model.

    """

    effect: EffectKey
    entry: Effect
    every: tuple[Floats, ...]
    places: tuple[int, ...]
    tried: float
    factors: Floats

    @classmethod
    def of(cls, effect: EffectKey, entry: Effect, every: tuple[Floats, ...],
           places: Iterable[int], context: Context) -> Candidate:
        places = tuple(places)
        return cls(effect, entry, every, places, tried=max(len(places) / _SHAPES_ALIKE, 1.0),
                   factors=factors_of(effect, [every[place] for place in places], context))

    @cached_property
    def shapes(self) -> tuple[Floats, ...]:
        return tuple(self.every[place] for place in self.places)

    def beside(self, present: Floats | None, context: Context) -> Candidate:
        """Return the candidate at a force, with the shape of its values in a model, too."""
        if self.entry.of_force:
            self = Candidate.of(self.effect, self.entry, self.every, self.places, context)
        if present is None or len(self.shapes) < 2:
            return self
        shape = self.entry.split(present)[1]
        return replace(self, every=(*self.every, shape), places=(*self.places, len(self.every)),
                       factors=np.concatenate(
                           [self.factors, factors_of(self.effect, [shape], context)]))

    def finer(self, chosen: Floats | None, context: Context) -> Candidate:
        """Return the candidate with those shapes, too, that lie beside a chosen one."""
        at = next((place for place in self.places
                   if chosen is not None and np.array_equal(self.every[place], chosen)), None)
        if at is None or len(self.places) == len(self.every):
            return self
        around = self.places.index(at)
        first, *_, last = (-1, *self.places, len(self.every))[around:around + 3]
        further = _spread([place for place in range(first + 1, last) if place != at])
        return Candidate.of(self.effect, self.entry, self.every, sorted((*self.places, *further)),
                            context) if further else self

    def blocks(self, start: int, alike: int) -> Iterator[Block]:
        """Yield a block for each shape, from a column on; `alike` candidates are of one kind."""
        count, entry, searched = len(self.entry.parameters), self.entry, len(self.shapes) > 1
        for shape in self.shapes:
            new = searched and not np.array_equal(shape, entry.usual)
            yield Block(self.effect, shape, slice(start, start + count), entry, int(new),
                        tried=(self.tried if new else 1.0) * alike)
            start += count


def candidates(effects: Iterable[EffectKey], poses_g: Poses) -> Iterator[Candidate]:
    """Yield those of effects that the context of the poses allows."""
    context = poses_g.columns
    for effect in effects:
        entry = entry_of(effect)
        if entry.output is None and all(key in context for key in entry.needs):
            every = (np.zeros(0),) if entry.shapes is None else tuple(entry.shapes(context))
            if every:
                yield Candidate.of(effect, entry, every, _spread(range(len(every))), context)


def _spread(places: Sequence[int]) -> Sequence[int]:
    """Return at most `_SHAPES_AT_ONCE` evenly spread places."""
    return places[::max(-(-len(places) // _SHAPES_AT_ONCE), 1)]


def linearised(fit: Fit, base: tuple[EffectKey, ...], tried: Iterable[Candidate] = (),
               beside: Model = _IDEAL) -> Linear:
    """
    Return the linear problem at a fit, given the effects of the base, and the candidates.

    The columns of the model `beside` are projected out as those of the base.

    """
    near, model = fit.equations, fit.model
    held = Model({name: values for name, values in model.values.items() if name in base})
    further = Model({name: values for name, values in model.values.items() if name not in base})
    residual = near.residual
    if further.values:
        residual = residual + near.columns(further) @ amplitudes_of(further)
    onto = orthonormal(np.hstack([near.columns(held)[:, held.fitted], near.columns(beside)]))
    context = fit.context
    tried = [each.beside(further.values.get(each.effect), context) for each in tried]
    kinds_tried = [kind_of(each.effect) for each in tried]
    alike = Counter(kinds_tried)
    widths = [len(each.shapes) * len(each.entry.parameters) for each in tried]
    every, sizes = np.empty((sum(widths) + 1, len(near.pose))), np.empty(sum(widths))
    every[-1] = residual - onto @ (onto.T @ residual)
    blocks: list[Block] = []
    for each, kind, start, width in zip(
            tried, kinds_tried, np.cumsum([0, *widths]).tolist(), widths):
        own = slice(start, start + width)
        columns, sizes[own] = outside_of(onto, near.columns_of(each.effect, each.factors))
        every[own] = columns.T
        blocks += each.blocks(start, alike[kind])
    return Linear(
        onto=onto, pose=near.pose, blocks=tuple(blocks), every=every, sizes=sizes,
        worth=WORTH if near.noise_known else 0.0, dof=near.count - onto.shape[1],
        base_rss=float(every[-1] @ every[-1]), choice=2.0 * math.log(1.0 + len(alike)),
        offset=near.columns(Model({'offset': np.zeros(3)})))


def outside_of(onto: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return (m, c) columns of norm 1 with a base projected out, and their (c,) norms before."""
    sizes = _norms(columns)
    rows = columns.T / sizes[:, np.newaxis]
    rows -= (rows @ onto) @ onto.T
    return rows.T, np.where(sizes < np.inf, sizes, 1.0)


def orthonormal(columns: Floats) -> Floats:
    """Return orthonormal columns with the span of others."""
    if not columns.shape[1]:
        return columns
    vectors, scales, _ = np.linalg.svd(columns / _norms(columns), full_matrices=False)
    return np.asarray(vectors[:, scales > 1e-6 * scales[0]])


def _norms(columns: Floats) -> Floats:
    """Return the norms of columns, infinite for a column of zeros, which remains one."""
    sizes: Floats = np.sqrt(np.einsum('mc,mc->c', columns, columns))
    sizes[sizes < 1e-100] = np.inf  # products of smaller numbers underflow
    return sizes


def left_open(state: State) -> Model:
    """
    Return the offset and gains beside which an effect must show: none if the poses determine them.

    In few different attitudes, an effect could otherwise stand for a cross-axis gain that the
    model lacks, and be wrong in other attitudes.

    """
    largest = NORM_MODELS[-1]
    if len(kinds(state.poses_g)[0]) or determines(largest, unit(state.fit.equations.force)):
        return _IDEAL
    return linear_model(largest, np.eye(3), np.zeros(3))


def amplitudes_of(model: Model) -> Floats:
    """Return the (p,) values of a model with those of its shapes set to zero."""
    parts = [np.concatenate([values[:len(effect.parameters)], np.zeros(len(effect.shape))])
             for effect, values in zip(model.terms.effects, model.values.values(), strict=True)]
    return np.concatenate(parts)


@dataclass(frozen=True)
class State:
    """A model fitted to the poses kept."""

    fit: Fit

    @property
    def model(self) -> Model:
        """Return the fitted model, ΔR = I."""
        return self.fit.model

    @property
    def poses_g(self) -> Poses:
        """Return the poses kept, in g, with the column ``previous``."""
        return self.fit.poses_g

    @cached_property
    def linear(self) -> Linear:
        """Return the equations with all values of the model projected out, without candidates."""
        return linearised(self.fit, self.model.effects)

    @property
    def residual(self) -> Floats:
        """(m,) array, residuals of the equations with all values fitted."""
        return self.linear.residual if self.fit.beside is None else self.fit.residual

    @cached_property
    def rss(self) -> float:
        """Sum of squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def held_out(self) -> Floats:
        """(m,) array, each residual if its orientation is left out of the fit."""
        beside = self.fit.beside
        linear = self.linear if beside is None else linearised(beside, self.model.effects)
        return left_out(self.residual, linear.onto, linear.pose, self.fit.equations.force,
                        LEAST_OWN)[0]

    @property
    def dof(self) -> int:
        """Return the number of independent equations minus that of fitted values."""
        return self.linear.dof

    @property
    def is_noise(self) -> bool:
        """Return whether noise may explain the residual; True if the noise is not known."""
        return not self.fit.noise_known or is_noise(self.rss, self.dof)

    def refit_without(self, effects: Collection[EffectKey]) -> State | None:
        """Return the fit to the same poses without some effects; None without a sound fit."""
        return fitted_state(Model({name: values for name, values in self.model.values.items()
                                   if name not in effects}), self.poses_g)

    def gap_mg(self, residual: Floats) -> float:
        """Return the RMS over the new poses of (m,) residuals of the equations [mg]."""
        return rms(self._of_new(self.fit.equations.of_poses(residual))) * MG

    def _of_new(self, of_poses: Floats) -> Floats:
        return of_poses[self.poses_g['new'] > 0.0] if 'new' in self.poses_g else of_poses

    def mg_of_poses(self, residual: Floats) -> Floats:
        """Return the (n,) residuals of poses from (m,) residuals of the equations [mg]."""
        return self.fit.equations.of_poses(residual) * MG

    @property
    def floor_mg(self) -> float | None:
        """Return the residual expected of a correct model [mg]; None if the noise is unknown."""
        return rms(self._of_new(self.fit.noise_g)) * MG if self.fit.noise_known else None


def slope_of_temperature(fit: Fit) -> Floats:
    """Return the (n, 3) change of the readings of poses with the temperature [g/°C]."""
    context, force = fit.context, fit.equations.force
    if 'temperature' not in fit.model.over:
        return np.zeros(force.shape)
    warmer = {**context, 'temperature': context['temperature'] + _WARMER}
    return np.nan_to_num(fit.model.at(warmer).reading(force)
                         - fit.model.at(context).reading(force)) / _WARMER


def is_noise(rss: float, dof: float) -> bool:
    """Return whether measured noise explains a weighted sum of squares."""
    return bool(dof <= 0 or rss <= _CHI2_RATIO * dof
                or scipy.special.chdtrc(dof, rss) > _CHI2_LEVEL)


def beginning(poses_g: Poses, model: Model) -> State:
    """Return the state of a base model, fitted to all poses; `NotConvergedError` if that fails."""
    return State(estimate(model, add_history(poses_g, model)))


def fitted_state(model: Model, poses_g: Poses) -> State | None:
    """Return the state of a model fitted to poses; None without a sound fit."""
    try:
        return State(estimate(model, poses_g))
    except NotConvergedError:
        return None


def with_effect(model: Mapping[EffectKey, Floats], effect: EffectKey, values: Floats
                ) -> dict[EffectKey, Floats]:
    """Return the values of a model with one more effect, which replaces those it contains."""
    contained = included((effect,))
    return {**{key: part for key, part in model.items() if key not in contained}, effect: values}


def without(poses: Poses, out: Sequence[int] | NDArray[np.intp]) -> Poses:
    return poses.take(np.delete(np.arange(len(poses)), out))


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
