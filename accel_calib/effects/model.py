# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A model is a list of effects with their values: `predict` readings, and `correct` them.

With the context fixed, the terms of all effects sum to an offset, a gain and bending terms:

    reading = V + W u + bend(u),   u = ΔR force

`Model.at` returns this form. The correction solves it for u by the iteration u <- W⁻¹ (reading - V
- bend(u)), which converges if the bending terms are small compared with the gain. Forces and
readings are in g; `accel_calib.units` converts them.

"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import accumulate
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .catalogue import CATALOGUE, EFFECTS, entry_of, linear_values, MODELS, PROCESSES
from .form import (
    AFFINE, AT_POSES, Context, difference, Effect, EffectKey, fitted_places, FORCE, MONOMIALS, ONE)
from .thermal import Lag
from ..errors import InputError
from ..geometry import unit
from ..table import column_of, Floats, is_quantity, Record
from ..units import Indices

LARGEST_ITERATIONS = 100
CONVERGED_G = 1e-13
"""The iteration stops when u changes by less than this [g]."""

LARGEST_FORCE_G = 1e6
"""The iteration has diverged when u is larger than this [g]."""

_IDENTITY = np.eye(3)


@dataclass(frozen=True)
class Terms:
    """
    The t terms of a list of effects as arrays, so that a model adds all of them at once.

    `parts` are the values of each effect among all p values, and `rows` its terms. Each term has
    its index `monomial` in `MONOMIALS` and its `place` in `monomials` (those that are used), the
    `axis` of the reading, the place of its `value` among all values, and its constant factor
    `weight`; (t,) arrays.

    `to_affine` (12, t) sums the affine terms into V and, row by row, W - I, `to_value` (p, t) sums
    terms by value, and `bends_to_axis` (3, b) sums by axis the terms `bending` (b,), which bend
    with the force. `scaling` is the index of a term that scales gains, of its value, and (g,) of
    the terms that it scales; None without one. `fixed` is whether all terms are independent of the
    context, and `of_force` the own effects that are functions of the force, too.

    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    rows: tuple[slice, ...]
    monomials: tuple[int, ...]
    monomial: Indices
    place: Indices
    axis: Indices
    value: Indices
    weight: Floats
    to_affine: Floats
    to_value: Floats
    bending: Indices
    bends_to_axis: Floats
    scaling: tuple[int, int, Indices] | None
    fixed: bool
    of_force: tuple[EffectKey, ...]

    def monomials_at(self, u: Floats) -> Floats:
        """Return the (m, n) monomials of (n, 3) forces."""
        x, y, z = u.T
        found = np.empty((len(self.monomials), len(u)))
        for k, index in enumerate(self.monomials):
            found[k] = MONOMIALS[index].value(x, y, z)
        return found

    def plain(self, u: Floats, direction: Floats | None = None) -> Floats:
        """
        Return the (t, n) terms for values and factors of 1, at (n, 3) forces.

        With a `direction`, (n, 3), return their derivative along this direction of the force.

        """
        monomials = self.monomials_at(u) if direction is None else np.einsum(
            'kin,ni->kn', self.gradients_at(u), direction)
        return monomials[self.place] * self.weight[:, np.newaxis]

    def gradients_at(self, u: Floats) -> Floats:
        """Return the (m, 3, n) derivatives of the monomials by the force."""
        x, y, z = u.T
        found = np.empty((len(self.monomials), 3, len(u)))
        for k, index in enumerate(self.monomials):
            for axis, part in enumerate(MONOMIALS[index].gradient(x, y, z)):
                found[k, axis] = part
        return found


@lru_cache(maxsize=512)
def terms_of(keys: tuple[EffectKey, ...]) -> Terms:
    """Return the terms of effects; ValueError for a name that is not in the catalogue."""
    for key in keys:
        if isinstance(key, str) and (key not in CATALOGUE or key in PROCESSES):
            raise ValueError(f'effect is {key!r}, expected one of {", ".join(EFFECTS)}')
    effects = tuple(map(entry_of, keys))
    used = sorted({term.monomial for effect in effects for term in effect.terms} | {ONE})
    ends = [[0, *accumulate(map(len, each))] for each in (
        [effect.values for effect in effects], [effect.terms for effect in effects])]
    parts, rows = (tuple(map(slice, each, each[1:])) for each in ends)
    terms = [(term, part.start + term.parameter) for effect, part in zip(effects, parts)
             for term in effect.terms]
    monomial, place, axis, value = np.array([
        (term.monomial, used.index(term.monomial), term.axis, at) for term, at in terms],
        np.intp).reshape(-1, 4).T.copy()
    is_affine = monomial < AFFINE
    slot = np.where(monomial == ONE, axis, 3 + 3 * axis + monomial - FORCE)
    bending = np.flatnonzero(~is_affine)
    scaling: tuple[int, int, Indices] | None = None
    for effect, part, own in zip(effects, parts, rows):
        if effect.scales:
            gains = np.flatnonzero((monomial >= FORCE) & is_affine)
            scaling = own.start, part.start, gains[(gains < own.start) | (gains >= own.stop)]
            break
    return Terms(
        effects=effects, parts=parts, rows=rows, monomials=tuple(used), monomial=monomial,
        place=place, axis=axis, value=value,
        weight=np.array([term.weight for term, _ in terms], float),
        to_affine=_sums(np.where(is_affine, slot, -1), 12),
        to_value=_sums(value, ends[0][-1]), bending=bending,
        bends_to_axis=_sums(axis[bending], 3), scaling=scaling,
        fixed=all(effect.factor is None for effect in effects),
        of_force=tuple(key for key, effect in zip(keys, effects) if effect.of_force))


def _sums(index: Indices, size: int) -> Floats:
    """Return the (size, t) matrix that sums t numbers by their index."""
    return (index == np.arange(size)[:, np.newaxis]).astype(float)


@dataclass(frozen=True)
class Basis:
    """
    Derivative of the reading: (t, n) terms, and (p, t) sums by value.

    Each term has its `place` in the monomials of the model and the `axis` of the reading. The
    terms of s shapes of an effect are (s, t, n). The p values of each shape follow each other.

    """

    terms: Floats
    place: Indices
    axis: Indices
    to_value: Floats

    @property
    def full(self) -> Floats:
        """(n, 3, p) array, the derivative."""
        by_axis = np.stack([self.to_value[:, self.axis == axis]
                            @ self.terms[..., self.axis == axis, :] for axis in range(3)])
        moved = np.moveaxis(by_axis, -1, 0)
        return moved.reshape(*moved.shape[:2], math.prod(moved.shape[2:]))

    def along(self, rows: Floats) -> Floats:
        """Return the (n, p) product of the derivative with an (n, 3) row per pose."""
        return replace(self, terms=self.terms * rows.T[self.axis]).summed

    @property
    def summed(self) -> Floats:
        """(n, p) array, the sums over the axes."""
        found = self.to_value @ self.terms
        return found.reshape(math.prod(found.shape[:-1]), found.shape[-1]).T


@dataclass(frozen=True)
class AtContext:
    """
    A model with its context fixed, for each of n poses or in common for all poses.

    W is (n, 3, 3) or (3, 3), V (n, 3) or (3,) [g]; `bend` (b, n) or (b, 1) are the coefficients of
    the bending terms among `terms`. `own` returns what own effects of the force add to the reading
    at (n, 3) forces, None: there are none.

    """

    mat_w: Floats
    vec_v: Floats
    terms: Terms
    bend: Floats
    own: Callable[[Floats], Floats] | None = None

    @cached_property
    def bends(self) -> bool:
        """Whether the reading is not affine in the force."""
        return bool(len(self.bend)) or self.own is not None

    def _bend(self, u: Floats) -> Floats:
        """Return the (n, 3) reading beyond V + W u."""
        terms = self.terms
        values = terms.monomials_at(u)[terms.place[terms.bending]] * self.bend
        found = (terms.bends_to_axis @ values).T
        return found if self.own is None else found + self.own(u)

    def reading(self, u: Floats) -> Floats:
        """Return the (n, 3) reading for the (n, 3) force u in the sensor axes [g]."""
        found = self.vec_v + times(self.mat_w, u)
        return found + self._bend(u) if self.bends else found

    def slope(self, u: Floats) -> Floats:
        """Return the (n, 3, 3) derivative of the reading by the force u."""
        found = np.broadcast_to(self.mat_w, (len(u), 3, 3))
        if len(self.bend):
            terms = self.terms
            parts = terms.gradients_at(u)[terms.place[terms.bending]] * self.bend[:, np.newaxis]
            found = found + np.einsum('it,tjn->nij', terms.bends_to_axis, parts)
        return found if self.own is None else found + own_slope(self.own, u)

    def inverse_slope(self, u: Floats) -> Floats:
        """Return the inverse of `slope`, (n, 3, 3), or (3, 3) if it is the same for all poses."""
        return np.linalg.inv(self.slope(u)) if self.bends else self._inverse

    @cached_property
    def _inverse(self) -> Floats:
        return np.linalg.inv(self.mat_w)

    def force(self, reading: Floats) -> Floats:
        """Return the (n, 3) force u for a reading [g]; NaN where the iteration diverges."""
        affine = times(self._inverse, reading - self.vec_v)
        if not self.bends:
            return affine
        u = affine
        for _ in range(LARGEST_ITERATIONS):
            before = u
            u = affine - times(self._inverse, self._bend(u))
            u[~(np.max(np.abs(u), axis=1) < LARGEST_FORCE_G)] = np.nan
            change = np.max(np.abs(u - before), axis=1)
            if not np.any(change > CONVERGED_G):
                return u
        u[change > CONVERGED_G] = np.nan
        return u


_FORCE_STEP_G = 1e-5
"""Step of the numerical derivative of own effects by the force [g]."""


def own_slope(own: Callable[[Floats], Floats], u: Floats) -> Floats:
    """Return the (n, 3, 3) numerical derivative of a function of (n, 3) forces."""
    return np.stack([own(u + step) - own(u - step) for step in _FORCE_STEP_G * _IDENTITY],
                    axis=2) / (2.0 * _FORCE_STEP_G)


def times(matrix: Floats, vectors: Floats) -> Floats:
    """Return matrix times vector for (n, 3) vectors and (3, 3) or (n, 3, 3) matrices."""
    if matrix.ndim == 2:
        return vectors @ matrix.T
    return (matrix @ vectors[:, :, np.newaxis])[:, :, 0]


@dataclass(frozen=True, eq=False)
class Model(Record):
    """
    Effects and their values.

    Parameters
    ----------
    values : mapping of EffectKey to (p,) array
        Values of each effect, by its name in `accel_calib.effects.EFFECTS` or its record. Without
        a shape that has usual values, these are added.
    rotation : (3, 3) array
        ΔR, transforms from the levelled frame to the sensor axes.

    """

    values: Mapping[EffectKey, Floats]
    rotation: Floats = field(default_factory=_IDENTITY.copy)
    terms: Terms = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        terms, filled = terms_of(tuple(self.values)), dict[EffectKey, Floats]()
        for part, effect, (name, values) in zip(terms.parts, terms.effects, self.values.items()):
            expected = (part.stop - part.start,)
            filled[name] = values if np.shape(values) == expected else effect.filled(values)
            if np.shape(filled[name]) != expected:
                raise ValueError(f'effect {name} has values of shape {np.shape(values)}, expected '
                                 f'{expected[0]}')
        object.__setattr__(self, 'values', filled)
        object.__setattr__(self, 'terms', terms)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make the model again; its terms and caches contain functions."""
        return Model, (dict(self.values), self.rotation)

    @cached_property
    def effects(self) -> tuple[EffectKey, ...]:
        """Effects, in order: names of the catalogue, and records."""
        return tuple(self.values)

    @cached_property
    def vector(self) -> Floats:
        """(p,) array of all values, in order."""
        return np.concatenate([np.zeros(0), *self.values.values()])

    @cached_property
    def needs(self) -> tuple[str, ...]:
        """Keys of the context that the model needs; a lag needs the time."""
        return tuple(dict.fromkeys(key for effect, shape in self._by_effect for key in (
            *effect.needs, *(['time'] if effect.is_lagged(shape) else []))))

    @cached_property
    def over(self) -> tuple[str, ...]:
        """Columns that the factors of the effects are functions of."""
        return tuple(dict.fromkeys(key for effect, shape in self._by_effect
                                   for key in effect.over_of(shape)))

    @cached_property
    def neutral(self) -> Mapping[str, float]:
        """
        Value that counts as no change of each column that samples may lack; NaN: none.

        These are the quantities, and what only poses have.

        """
        found = dict[str, float]()
        for effect, shape in self._by_effect:
            zeros = shape if len(shape) == len(effect.needs) else (
                [np.mean(shape) if len(shape) else np.nan] * len(effect.needs))
            found.update((key, np.nan if effect.own else float(zero))
                         for key, zero in zip(effect.needs, zeros, strict=True)
                         if is_quantity(key) or key in AT_POSES)
        return found

    @cached_property
    def lags(self) -> Mapping[str, Lag]:
        """Lag of the temperature by the column of the temperature that acts; no lag: absent."""
        return {effect.lagged: Lag(float(shape[0]), bool(shape[1]))
                for effect, shape in self._by_effect if effect.is_lagged(shape)}

    @cached_property
    def stated(self) -> NDArray[np.bool_]:
        """(p,) mask of the values that are shown: all but shapes at their usual value."""
        return np.array([part in effect.shown(values) for effect, values in zip(
            self.terms.effects, self.values.values(), strict=True) for part in effect.values],
            bool)

    @cached_property
    def fitted(self) -> NDArray[np.bool_]:
        """(p,) mask of the values that a fit changes."""
        return np.array([is_fitted for effect, shape in self._by_effect for is_fitted in (
            *[True] * len(effect.parameters),
            *(place in fitted_places(effect, shape) for place in range(len(shape))))], bool)

    @cached_property
    def _by_effect(self) -> list[tuple[Effect, Floats]]:
        """Effects with their shapes."""
        return [(effect, values[len(effect.parameters):]) for effect, values in zip(
            self.terms.effects, self.values.values(), strict=True)]

    @cached_property
    def linear_part(self) -> tuple[Floats, Floats]:
        """W (3, 3) and V (3,), from the effects that need no context [g]."""
        kept = self if self.terms.fixed else Model({
            name: values for effect, (name, values) in zip(self.terms.effects, self.values.items())
            if effect.factor is None})
        return kept.at({}).mat_w, kept.at({}).vec_v

    @cached_property
    def _without_context(self) -> AtContext:
        return self._at(np.ones((len(self.terms.weight), 1)))

    def at(self, context: Context) -> AtContext:
        """Return the model at columns of n rows; raise InputError if a needed one is missing."""
        if self.terms.fixed:
            return self._without_context
        alone, scales = self._factors(context, None)
        found = self._at(alone * scales)
        if not self.terms.of_force:
            return found
        own = Model({name: self.values[name] for name in self.terms.of_force})
        return replace(found, own=lambda u: own._at(own._factors(context, u)[0]).vec_v)

    def _factors(self, context: Context, u: Floats | None) -> tuple[Floats, Floats]:
        """
        Return the (t, n) factors of each effect alone, and by what another effect scales them.

        A factor is 0 where its context is NaN. Without (n, 3) forces u, those of own effects of
        the force are 0, too. The scales are (t, 1) if no effect scales others.

        """
        check_context(self, context)
        known = context if u is None else {**context, 'force': u}
        of_force = u is not None and self.terms.of_force
        count = len(known['force' if of_force else self.needs[0]]) if of_force or self.needs else 1
        found = np.ones((len(self.terms.weight), count))
        for rows, (effect, shape) in zip(self.terms.rows, self._by_effect, strict=True):
            if effect.factor is not None:
                skipped = effect.of_force and u is None
                found[rows] = 0.0 if skipped else effect.factor(known, shape)
        np.nan_to_num(found, copy=False)
        scales = np.ones((len(found), 1))
        if self.terms.scaling is not None:
            term, value, scaled = self.terms.scaling
            scales = np.ones_like(found)
            scales[scaled] += self.vector[value] * found[term]
        return found, scales

    def _at(self, factors: Floats) -> AtContext:
        """Sum the affine terms, given the (t, n) factors."""
        terms = self.terms
        sized = factors * (terms.weight * self.vector[terms.value])[:, np.newaxis]
        affine = (terms.to_affine @ sized).T
        mat_w, vec_v = _IDENTITY + affine[:, 3:].reshape(-1, 3, 3), affine[:, :3]
        if terms.fixed:
            mat_w, vec_v = mat_w[0], vec_v[0]
        return AtContext(mat_w, vec_v, terms, sized[terms.bending])

    def basis(self, u: Floats, context: Context, direction: Floats | None = None) -> Basis:
        """
        Return the derivative of the reading by each value, in the order of ``model.vector``.

        `u` is the (n, 3) force in the sensor axes [g]. `context` has n rows of the columns that
        the effects need. With a `direction`, (n, 3), the result is the derivative of the basis
        along this direction of the force.

        """
        return self.basis_of(self.terms.plain(u, direction), context, u)

    def basis_of(self, plain: Floats, context: Context, u: Floats) -> Basis:
        """Return the same from the (t, n) terms for values and factors of 1."""
        if self.terms.fixed:
            return replace(self.rows, terms=plain)
        alone, scales = self._factors(context, u)
        context = {**context, 'force': u}
        found = [plain * (alone * scales)]
        for rows, _, slope in self._changes:
            change = (alone[rows] * alone[slope] if isinstance(slope, int) else
                      np.nan_to_num(slope(context)) * scales[rows])
            values = self.vector[self.terms.value[rows]][:, np.newaxis]
            found.append(plain[rows] * values * change)
        return replace(self.rows, terms=np.concatenate(found))

    @cached_property
    def rows(self) -> Basis:
        """Return the basis for values, factors and forces of 1: which term has which value."""
        terms, every = self.terms, np.arange(len(self.terms.weight))
        which = np.concatenate([every, *(every[rows] for rows, _, _ in self._changes)])
        value = np.concatenate([terms.value, *(np.full(len(every[rows]), value)
                                               for rows, value, _ in self._changes)])
        return Basis(terms.weight[which, np.newaxis], terms.place[which], terms.axis[which],
                     _sums(value, len(self.vector)))

    @cached_property
    def _changes(self) -> list[tuple[slice | Indices, int, Callable[[Context], Floats] | int]]:
        """
        Return the rows of terms whose factor a value changes, the value, and the derivative by it.

        These are fitted shape constants, and a gain that scales others (the index of its term).

        """
        terms = self.terms
        found: list[Any] = [
            (rows, part.stop - len(shape) + place, partial(
                difference, effect.factor, shape=shape, place=place, bounds=effect.bounds))
            for part, rows, (effect, shape) in zip(terms.parts, terms.rows, self._by_effect)
            if effect.factor is not None and np.any(self.vector[terms.value[rows]])
            for place in fitted_places(effect, shape)]
        if terms.scaling is not None:
            term, value, scaled = terms.scaling
            found.append((scaled, value, term))
        return found


class EachShape(NamedTuple):
    """The terms of an effect with s shapes, by their (s, t or 1, n) factors at the poses."""

    terms: Terms
    factors: Floats

    def basis_of(self, plain: Floats, context: Context, u: Floats) -> Basis:
        """Return the derivative of the reading by the parameters; see `Model.basis_of`."""
        terms, parameters = self.terms, len(self.terms.effects[0].parameters)
        return Basis(plain * self.factors, terms.place, terms.axis, terms.to_value[:parameters])


def factors_of(effect: EffectKey, shapes: Iterable[Floats], context: Context) -> Floats:
    """
    Return the (s, t or 1, n) factors of the terms of an effect with s shapes, at poses in g.

    Without a column ``force`` [g], the force is that of the readings.

    """
    factor = entry_of(effect).factor
    if factor is None:
        return np.ones((1, 1, 1))
    if 'reading' in context:
        context = {'force': context['reading'], **context}
    return np.nan_to_num([np.atleast_2d(factor(context, shape)) for shape in shapes])


def with_vector(effects: tuple[EffectKey, ...], vector: Floats) -> Model:
    """Return the model of these effects with the (p,) vector of all values and ΔR = I."""
    parts = terms_of(effects).parts
    return Model({name: vector[part] for name, part in zip(effects, parts, strict=True)})


def check_context(model: Model, context: Mapping[str, Any]) -> None:
    """Check that the context holds what the effects of the model need; raise InputError."""
    missing = [', '.join(column_of(key).names) for key in model.needs if key not in context]
    if missing:
        raise InputError(f'the effects of the model need {" and ".join(missing)}, which the input '
                         'does not have', 'record these columns together with the readings, or '
                         'state them for each pose that is simulated')


def linear_model(name: str, mat_w: Floats, vec_v: Floats) -> Model:
    """Return one of the models with gain W (3, 3), offset V (3,) [g] and ΔR = I."""
    values = linear_values(mat_w, vec_v)
    return Model({effect: values[effect] for effect in MODELS[name].effects})


def predict(model: Model, force: Floats, context: Context, noise: Floats | float = 0.0) -> Floats:
    """
    Return the (n, 3) readings of a sensor [g].

    `force` is the (n, 3) specific force in the levelled frame [g]. `context` has the columns that
    the effects need, n rows each. The `noise` [g] is that before the output. Raise `InputError` if
    a column is missing.

    """
    reading = model.at(context).reading(force @ model.rotation.T) + noise
    for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
        if effect.output is not None:
            reading = effect.output(reading, values)
    return reading


def sensor_force(model: Model, reading: Floats, context: Context) -> Floats:
    """Return the (n, 3) specific force in the sensor axes [g]; arguments as in `correct`."""
    u = model.at(context).force(reading)
    if np.any(np.isnan(u) & ~np.isnan(reading)):
        raise too_large()
    return u


def too_large() -> InputError:
    """Return the error for a reading whose force is not unique."""
    return InputError('the effects of the model are too large to be corrected at this reading',
                      'calibrate again, with readings in the range in which the sensor is used')


def correct(model: Model, reading: Floats, context: Context) -> Floats:
    """
    Return the (n, 3) specific force in the levelled frame [g]; the inverse of `predict`.

    `reading` is (n, 3) [g], and `context` as in `predict`. Raise `InputError` if a column is
    missing, or the effects are so large that the force of a reading is not unique.

    """
    return sensor_force(model, reading, context) @ model.rotation


def length_rows(model: Model, u: Floats, context: Context) -> Floats:
    """Return the (n, 3) derivative of |u| by the reading: ûᵀA⁻¹, with A the slope."""
    return times(np.swapaxes(model.at(context).inverse_slope(u), -1, -2), unit(u))
