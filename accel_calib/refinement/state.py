# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A model fitted to the poses kept, and its equations with the candidates as columns.

A candidate is an effect with each shape that is tried. `linearised` projects the base of a model
out of the equations, for the candidates that the context of the poses allows.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np
from numpy.typing import NDArray
import scipy

from .linear import Block, LEAST_OWN, Linear, orthonormal, outside_of
from ..calibration import determines, NORM_MODELS
from ..effects import (
    add_history, Context, Effect, EffectKey, entry_of, factors_of, included, kind_of, linear_model,
    Model)
from ..estimate import estimate, Fit, kinds, left_out, NotConvergedError
from ..geometry import unit
from ..table import Floats, Poses
from ..units import MG, rms

WORTH = 4.0
"""ν, degrees of freedom that the measured noise counts as."""

_SHAPES_AT_ONCE = 60
"""If there are more shapes, evenly spread ones are tried first, then those beside the best."""

_SHAPES_ALIKE = 3.0
"""Number of neighbouring shapes that count as one independent trial."""

_CHI2_LEVEL = 1e-3
_CHI2_RATIO = 1.3
"""chi² per degree of freedom that still counts as noise: poses repeat worse than samples."""

_IDEAL = Model({})


@dataclass(frozen=True)
class Candidate:
    """
    An effect to try with each of some shapes, which count as `tried` independent ones.

    `every` are its shapes, `places` the indices of those to try, increasing, and `factors`
    (places, t or 1, n) those of its terms at the poses, with any model.

    """

    effect: EffectKey
    every: tuple[Floats, ...]
    places: tuple[int, ...]
    tried: float
    factors: Floats

    @classmethod
    def of(cls, effect: EffectKey, every: tuple[Floats, ...], places: Iterable[int],
           context: Context) -> Candidate:
        places = tuple(places)
        return cls(effect, every, places, max(len(places) / _SHAPES_ALIKE, 1.0),
                   factors_of(effect, [every[place] for place in places], context))

    @cached_property
    def shapes(self) -> tuple[Floats, ...]:
        return tuple(self.every[place] for place in self.places)

    @cached_property
    def entry(self) -> Effect:
        return entry_of(self.effect)

    def beside(self, present: Floats | None, context: Context) -> Candidate:
        """Return the candidate at a force, with the shape of its values in a model, too."""
        if self.entry.of_force:
            self = Candidate.of(self.effect, self.every, self.places, context)
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
        return Candidate.of(self.effect, self.every, sorted((*self.places, *further)), context
                            ) if further else self

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
                yield Candidate.of(effect, every, _spread(range(len(every))), context)


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
    tried = [each.beside(further.values.get(each.effect), fit.context) for each in tried]
    alike = Counter(kind_of(each.effect) for each in tried)
    widths = [len(each.shapes) * len(each.entry.parameters) for each in tried]
    every, sizes = np.empty((sum(widths) + 1, len(near.pose))), np.empty(sum(widths))
    every[-1] = residual - onto @ (onto.T @ residual)
    blocks: list[Block] = []
    for each, start, width in zip(tried, np.cumsum([0, *widths]).tolist(), widths):
        own = slice(start, start + width)
        columns, sizes[own] = outside_of(onto, near.columns_of(each.effect, each.factors))
        every[own] = columns.T
        blocks += each.blocks(start, alike[kind_of(each.effect)])
    return Linear(
        onto=onto, pose=near.pose, blocks=tuple(blocks), every=every, sizes=sizes,
        worth=WORTH if near.noise_known else 0.0, dof=near.count - onto.shape[1],
        base_rss=float(every[-1] @ every[-1]), choice=2.0 * math.log(1.0 + len(alike)),
        offset=near.columns(Model({'offset': np.zeros(3)})))


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


def is_noise(rss: float, dof: float) -> bool:
    """Return whether measured noise explains a weighted sum of squares."""
    return bool(dof <= 0 or rss <= _CHI2_RATIO * dof
                or scipy.special.chdtrc(dof, rss) > _CHI2_LEVEL)


def beginning(poses_g: Poses, model: Model) -> State:
    """Return the state of a base model, fitted to all poses; `NotConvergedError` if that fails."""
    return State(estimate(model, add_history(poses_g, model)))


def fitted_state(model: Model, poses_g: Poses, most: float = np.inf) -> State | None:
    """Return the state of a model fitted to poses; None without a sound fit below `most`."""
    try:
        return State(estimate(model, poses_g, most=most))
    except NotConvergedError:
        return None


def with_effect(model: Mapping[EffectKey, Floats], effect: EffectKey, values: Floats
                ) -> dict[EffectKey, Floats]:
    """Return the values of a model with one more effect, which replaces those it contains."""
    contained = included((effect,))
    return {**{key: part for key, part in model.items() if key not in contained}, effect: values}


def without(poses: Poses, out: Sequence[int] | NDArray[np.intp]) -> Poses:
    return poses.take(np.delete(np.arange(len(poses)), out))
