# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A model is a list of effects with their values; `correct` is the inverse of `predict`.

With the context fixed, the terms of all effects sum to an offset, a gain and bending terms:

    reading = V + W u + bend(u),   u = ΔR force

`Model.at` returns this form. The correction solves it for u by the iteration u <- W⁻¹ (reading - V
- bend(u)), which converges if the bending terms are small compared with the gain.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import Context, Effect, effect_named, EFFECTS, is_effect, PROCESSES
from .terms import Basis, sums, Terms, terms_of
from .thermal import Lag
from ..errors import InputError
from ..geometry import unit
from ..table import COLUMNS, Floats


@dataclass(frozen=True)
class ModelForm:
    """
    One of the models that consist of offset and gains.

    Parameters
    ----------
    effects : tuple of str
        Names of its effects.
    gains : int
        Number of parameters of W, apart from a rotation.
    norm : str
        Model with the same ellipsoid that |force| = 1 g alone determines.
    known_orientation : bool
        Whether it needs poses of known orientation, and then determines the axes of W.
    sensing_axes : bool
        Whether its axes are fixed to the sensing axes.

    """

    effects: tuple[str, ...]
    gains: int
    norm: str
    known_orientation: bool = False
    sensing_axes: bool = False

    @property
    def largest(self) -> str:
        """Name of the largest model for poses of the same kind."""
        return '12' if self.known_orientation else '10'


_WHOLE = ('offset', 'axis_gain', 'cross_axis', 'misalignment')

MODELS: dict[str, ModelForm] = {
    'ideal': ModelForm((), 0, 'ideal'),
    '4': ModelForm(('offset', 'gain'), 1, '4'),
    '7': ModelForm(('offset', 'axis_gain'), 3, '7'),
    '9': ModelForm(_WHOLE, 6, '10', sensing_axes=True),
    '10': ModelForm(('offset', 'axis_gain', 'cross_axis'), 6, '10'),
    '12': ModelForm(_WHOLE, 6, '10', known_orientation=True),
}
"""The models by name. Models 9 and 10 differ only in their axes: model 9 fixes the axes to the
sensing axes (ESGI'95 report), model 10 makes W symmetric (AN5286)."""

LARGEST_ITERATIONS = 100
CONVERGED_G = 1e-13
"""The iteration stops when u changes by less than this [g]."""

LARGEST_FORCE_G = 1e6
"""The iteration has diverged when u is larger than this [g]."""

FITTED_SHAPES = ('tau', 'lag')
"""Shape constants that a fit changes, unless they have their usual value; the others are found
once from the data."""

_SHAPE_STEP = 1e-4
"""Relative step of the numerical derivative by a shape constant; all others are analytic."""


_IDENTITY = np.eye(3)


def _identity() -> Floats:
    return np.eye(3)


@dataclass(frozen=True)
class AtContext:
    """
    A model with its context fixed, for each of n poses or in common for all poses.

    Parameters
    ----------
    mat_w : (n, 3, 3) or (3, 3) array
        W of each pose, or of all.
    vec_v : (n, 3) or (3,) array
        V of each pose, or of all [g].
    terms : Terms
        All terms of the model.
    bend : (b, n) or (b, 1) array
        Coefficients of the bending terms.

    """

    mat_w: Floats
    vec_v: Floats
    terms: Terms
    bend: Floats

    def _bend(self, u: Floats) -> Floats:
        """Return the (n, 3) reading that the bending terms add."""
        terms = self.terms
        values = terms.monomials_at(u)[terms.place[terms.bending]] * self.bend
        found: Floats = (terms.bends_to_axis @ values).T
        return found

    def reading(self, u: Floats) -> Floats:
        """Return the (n, 3) reading for the (n, 3) force u in the sensor axes [g]."""
        found = self.vec_v + times(self.mat_w, u)
        return found + self._bend(u) if len(self.bend) else found

    def slope(self, u: Floats) -> Floats:
        """Return the (n, 3, 3) derivative of the reading by the force u."""
        found = np.broadcast_to(self.mat_w, (len(u), 3, 3))
        if not len(self.bend):
            return found
        terms = self.terms
        parts = terms.gradients_at(u)[terms.place[terms.bending]] * self.bend[:, np.newaxis]
        return found + np.einsum('it,tjn->nij', terms.bends_to_axis, parts)

    def inverse_slope(self, u: Floats) -> Floats:
        """Return the inverse of `slope`, (n, 3, 3), or (3, 3) if it is the same for all poses."""
        return np.linalg.inv(self.slope(u) if len(self.bend) else self.mat_w)

    def force(self, reading: Floats) -> Floats:
        """Return the (n, 3) force u for a reading [g]; NaN where the iteration diverges."""
        inverse = np.linalg.inv(self.mat_w)
        affine = times(inverse, reading - self.vec_v)
        if not len(self.bend):
            return affine
        u = affine
        for _ in range(LARGEST_ITERATIONS):
            before = u
            u = affine - times(inverse, self._bend(u))
            u[~(np.max(np.abs(u), axis=1) < LARGEST_FORCE_G)] = np.nan
            change = np.max(np.abs(u - before), axis=1)
            if not np.any(change > CONVERGED_G):
                return u
        u[change > CONVERGED_G] = np.nan
        return u


def times(matrix: Floats, vectors: Floats) -> Floats:
    """Return matrix times vector for (n, 3) vectors and (3, 3) or (n, 3, 3) matrices."""
    if matrix.ndim == 2:
        return vectors @ matrix.T
    found: Floats = (matrix @ vectors[:, :, np.newaxis])[:, :, 0]
    return found


@dataclass(frozen=True)
class Model:
    """
    Effects and their values.

    Parameters
    ----------
    values : mapping of str to (p,) array
        Values of each effect, by its name in `accel_calib.effects.EFFECTS`. Without a shape that
        has usual values, these are added.
    rotation : (3, 3) array
        ΔR, transforms from the levelled frame to the sensor axes.

    """

    values: Mapping[str, Floats]
    rotation: Floats = field(default_factory=_identity)

    def __post_init__(self) -> None:
        filled = {}
        for name, values in self.values.items():
            if name in PROCESSES or not is_effect(name):
                raise ValueError(f'effect is {name!r}, expected one of {", ".join(EFFECTS)}')
            effect = effect_named(name)
            filled[name] = effect.filled(values)
            if np.shape(filled[name]) != (len(effect.values),):
                raise ValueError(f'effect {name} has values of shape {np.shape(values)}, expected '
                                 f'{len(effect.values)}')
        object.__setattr__(self, 'values', filled)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to make the model again; its caches contain functions."""
        return Model, (dict(self.values), self.rotation)

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(self.values)

    @cached_property
    def vector(self) -> Floats:
        """(p,) array of all values, in order."""
        return np.concatenate([np.zeros(0), *self.values.values()])

    @cached_property
    def terms(self) -> Terms:
        """Terms of the effects."""
        return terms_of(self.effects)

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the context that the model needs."""
        return tuple(dict.fromkeys(key for effect, shape in self._by_effect
                                   for key in effect.needs_of(shape)))

    @property
    def over(self) -> tuple[str, ...]:
        """Columns that the factors of the effects are functions of."""
        return tuple(dict.fromkeys(key for effect, shape in self._by_effect
                                   for key in effect.over_of(shape)))

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
        found = [np.zeros(0, bool)]
        for effect, shape in self._by_effect:
            own = np.ones(len(effect.values), bool)
            own[len(effect.parameters):] = np.isin(np.arange(len(shape)),
                                                   fitted_places(effect, shape))
            found.append(own)
        return np.concatenate(found)

    @property
    def _by_effect(self) -> list[tuple[Effect, Floats]]:
        """Effects with their shapes."""
        return list(zip(self.terms.effects, self._shapes, strict=True))

    @cached_property
    def linear_part(self) -> tuple[Floats, Floats]:
        """W (3, 3) and V (3,), from the effects that need no context [g]."""
        kept = {name: values for name, values in self.values.items()
                if effect_named(name).factor is None}
        here = Model(kept).at({})
        return here.mat_w, here.vec_v

    @cached_property
    def _shapes(self) -> list[Floats]:
        return [effect.split(values)[1]
                for effect, values in zip(self.terms.effects, self.values.values(), strict=True)]

    @cached_property
    def _without_context(self) -> AtContext:
        return self._at(np.ones((len(self.terms.weight), 1)))

    def at(self, context: Context) -> AtContext:
        """
        Return the model with its context fixed.

        Parameters
        ----------
        context : mapping of str to array
            Columns that the effects need, n rows each.

        Raises
        ------
        InputError
            If a column is missing.

        """
        if self.terms.fixed:
            return self._without_context
        return self._at(self._factors(context))

    def _factors(self, context: Context) -> Floats:
        check_context(self, context)
        rows = len(np.asarray(context[self.needs[0]])) if self.needs else 1
        return self.terms.factors(self._shapes, context, (rows,))

    def _at(self, factors: Floats) -> AtContext:
        """Sum the affine terms, given the (t, n) factors."""
        terms = self.terms
        sized = factors * (terms.weight * self.vector[terms.value])[:, np.newaxis]
        affine = (terms.to_affine @ sized).T
        mat_w = _IDENTITY + affine[:, 3:].reshape(-1, 3, 3)
        bend = sized[terms.bending]
        if terms.fixed:
            return AtContext(mat_w[0], affine[0, :3], terms, bend)
        return AtContext(mat_w, affine[:, :3], terms, bend)

    def basis(self, u: Floats, context: Context, direction: Floats | None = None) -> Basis:
        """
        Return the derivative of the reading by each value.

        Parameters
        ----------
        u : (n, 3) array
            Force in the sensor axes [g].
        context : mapping of str to array
            Columns that the effects need, n rows each.
        direction : (n, 3) array, optional
            If given, return the derivative of the basis along this direction of the force.

        Returns
        -------
        Basis
            The derivative, in the order of ``model.vector``.

        """
        terms = self.terms
        if direction is None:
            monomials = terms.monomials_at(u)
        else:
            monomials = np.einsum('mjn,nj->mn', terms.gradients_at(u), direction)
        plain = monomials[terms.place] * terms.weight[:, np.newaxis]
        if terms.fixed:
            return Basis(plain, terms.axis, terms.to_value)
        found = plain * self._factors(context)
        moved, of, index = self._by_shape(plain, context)
        return Basis(np.concatenate([found, moved]), np.concatenate([terms.axis, terms.axis[of]]),
                     np.hstack([terms.to_value, sums(index, terms.size)]))

    def _by_shape(self, plain: Floats, context: Context
                  ) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
        """Return the terms of the derivative by the fitted shape constants."""
        moved, of, index = [plain[:0]], [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        ends = np.cumsum(self.terms.count)
        for k, effect in enumerate(self.terms.effects):
            shape = self._shapes[k]
            which = np.arange(ends[k] - self.terms.count[k], ends[k])
            for place in fitted_places(effect, shape):
                values = self.vector[self.terms.value[which]][:, np.newaxis]
                if effect.factor is not None and np.any(values):
                    change = difference(effect.factor, context, shape, place)
                    moved.append(plain[which] * values * np.nan_to_num(change))
                    of.append(which)
                    start = self.terms.starts[k] + len(effect.parameters) + place
                    index.append(np.full(len(which), start, np.intp))
        return np.concatenate(moved), np.concatenate(of), np.concatenate(index)


def difference(factor: Callable[[Mapping[str, Any], Floats], Any], context: Context,
               shape: Floats, place: int) -> Floats:
    """Return the numerical derivative of a factor by one shape constant."""
    step = np.zeros(len(shape))
    step[place] = _SHAPE_STEP * max(abs(shape[place]), 1.0)
    change: Floats = (factor(context, shape + step) - factor(context, shape - step)) / (
        2.0 * step[place])
    return change


def parameter_names(effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the values of these effects, such as ``offset.x``, in vector order."""
    return tuple(f'{name}.{part}' for name in effects for part in effect_named(name).values)


def fitted_places(effect: Effect, shape: Floats) -> list[int]:
    """
    Return the indices of the shape constants that a fit changes.

    A constant at its usual value, such as a lag of 0, is not fitted: the effect stays the plain
    one.

    """
    usual = dict(enumerate(effect.usual))
    return [place for place, name in enumerate(effect.shape)
            if name in FITTED_SHAPES and usual.get(place) != shape[place]]


def with_vector(effects: tuple[str, ...], vector: Floats) -> Model:
    """Return the model of these effects with the (p,) vector of all values and ΔR = I."""
    sizes = [len(effect_named(name).values) for name in effects]
    parts = np.split(vector, np.cumsum(sizes)[:-1]) if sizes else []
    return Model(dict(zip(effects, parts, strict=True)))


def with_linear_part(mat_w: Floats, vec_v: Floats, rotation: Floats | None = None) -> Model:
    """
    Return the model whose gain is W and whose offset is V.

    Parameters
    ----------
    mat_w : (3, 3) array
        Gain; its skew part becomes `misalignment`.
    vec_v : (3,) array
        Zero-g offset [g].
    rotation : (3, 3) array, optional
        ΔR.

    """
    values = linear_values(mat_w, vec_v)
    kept = [*MODELS['10'].effects, *(['misalignment'] if np.any(values['misalignment']) else [])]
    return Model({name: values[name] for name in kept},
                 _IDENTITY if rotation is None else rotation)


def linear_values(mat_w: Floats, vec_v: Floats) -> dict[str, Floats]:
    """Return the values of the effects of `LADDER` from W (3, 3) and V (3,) [g]."""
    symmetric, skew = (mat_w + mat_w.T) / 2, (mat_w - mat_w.T) / 2
    return {'offset': np.array(vec_v, float), 'gain': np.array([np.trace(mat_w) / 3.0 - 1.0]),
            'axis_gain': np.diag(mat_w) - 1.0, 'cross_axis': symmetric[[0, 0, 1], [1, 2, 2]],
            'misalignment': skew[[2, 0, 1], [1, 2, 0]]}


def check_context(model: Model, context: Mapping[str, Any]) -> None:
    """
    Check that the context holds what the effects of the model need.

    Raises
    ------
    InputError
        If a column is missing.

    """
    missing = [', '.join(COLUMNS[key].names) for key in model.needs if key not in context]
    if missing:
        raise InputError(f'the effects of the model need {" and ".join(missing)}, which the input '
                         'does not have', 'record these columns together with the readings')


def predict(model: Model, force: Floats, context: Context) -> Floats:
    """
    Compute the readings of a sensor.

    Parameters
    ----------
    model : Model
        The sensor.
    force : (n, 3) array
        Specific force in the levelled frame [g].
    context : mapping of str to array
        Columns that the effects need, n rows each.

    Returns
    -------
    (n, 3) array
        Readings [g].

    """
    return reading_of(model, force @ model.rotation.T, context)


def reading_of(model: Model, u: Floats, context: Context) -> Floats:
    """Return the (n, 3) readings for the (n, 3) force u in the sensor axes [g]."""
    reading = model.at(context).reading(u)
    for effect, values in zip(model.terms.effects, model.values.values(), strict=True):
        if effect.output is not None:
            reading = effect.output(reading, values)
    return reading


def sensor_force(model: Model, reading: Floats, context: Context) -> Floats:
    """
    Compute the specific force in the sensor axes from the readings.

    Parameters
    ----------
    model : Model
        The sensor.
    reading : (n, 3) array
        Readings [g].
    context : mapping of str to array
        Columns that the effects need, n rows each.

    Returns
    -------
    (n, 3) array
        u [g].

    Raises
    ------
    InputError
        If the effects are so large that the force of a reading is not unique.

    """
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
    Compute the specific force from the readings; the inverse of `predict`.

    Parameters
    ----------
    model : Model
        The sensor.
    reading : (n, 3) array
        Readings [g].
    context : mapping of str to array
        Columns that the effects need, n rows each.

    Returns
    -------
    (n, 3) array
        Specific force in the levelled frame [g].

    Raises
    ------
    InputError
        If the effects are so large that the force of a reading is not unique.

    """
    return sensor_force(model, reading, context) @ model.rotation


def parameter_basis(model: Model, u: Floats, context: Context) -> Floats:
    """Return the (n, 3, p) derivative of the reading by each value, at (n, 3) forces u [g]."""
    return model.basis(u, context).full


def force_slope(model: Model, u: Floats, context: Context) -> Floats:
    """Return the (n, 3, 3) derivative of the reading by the force u in the sensor axes."""
    return model.at(context).slope(u)


def length_rows(model: Model, u: Floats, context: Context) -> Floats:
    """Return the (n, 3) derivative of |u| by the reading: ûᵀA⁻¹, with A the slope."""
    return times(np.swapaxes(model.at(context).inverse_slope(u), -1, -2), unit(u))
