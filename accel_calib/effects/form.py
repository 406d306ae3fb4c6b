# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The form of an effect: terms, each the product of a factor of the context and a monomial.

A term adds parameter · factor · weight · monomial to one axis of the reading. Monomials are
functions of the components of the force.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
import re
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leg2poly
from numpy.typing import NDArray

from ..errors import InputError
from ..table import Floats, is_quantity

Context = Mapping[str, NDArray[Any]]
"""Context of readings by column: arrays with n rows, or one row without the first axis."""

AXES = ('x', 'y', 'z')

Family = Literal['', 'force', 'time']
"""Effects of one family can be confused: nonlinearities on the 1 g sphere, trends in time."""

TO_SEPARATE: dict[Family, str] = {
    'force': 'on the 1 g sphere they overlap by up to 98 %; to separate them, take more poses '
             'between the faces, or apply forces other than 1 g (a centrifuge)',
    'time': 'let the temperature both rise and fall, and repeat the same orientations at other '
            'times',
    '': 'vary one while the other stays the same',
}
"""Advice on how to separate effects of one family, or of different families."""


class Monomial(NamedTuple):
    """A function of x, y, z and its derivatives by them, for floats and for arrays."""

    value: Callable[[Any, Any, Any], Any]
    gradient: Callable[[Any, Any, Any], tuple[Any, Any, Any]]


def _of_axis(axis: int, value: Callable[[Any], Any], slope: Callable[[Any], Any]) -> Monomial:
    return (Monomial(lambda x, y, z: value(x), lambda x, y, z: (slope(x), 0.0, 0.0)),
            Monomial(lambda x, y, z: value(y), lambda x, y, z: (0.0, slope(y), 0.0)),
            Monomial(lambda x, y, z: value(z), lambda x, y, z: (0.0, 0.0, slope(z))))[axis]


def _each_axis(value: Callable[[Any], Any], slope: Callable[[Any], Any]) -> list[Monomial]:
    return [_of_axis(axis, value, slope) for axis in range(3)]


MODES = 24
"""Number of cosines that an empirical curve can have."""


def _wave(mode: int) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return the cosine of a mode over -1 to 1 g, and its slope."""
    turn = mode * np.pi / 2.0
    return (lambda u: np.cos(turn * (np.clip(u, -1.0, 1.0) + 1.0)),
            lambda u: -turn * np.sin(turn * (np.clip(u, -1.0, 1.0) + 1.0)) * (abs(u) < 1.0))


DEGREES = (3, 4, 5, 6)
"""Degrees of the spherical harmonics of which a gain that depends on the direction consists. Those
of lower degree are offsets, gains and cross-axis gains."""

_CONE = np.radians(80.0)
"""Angle from z of the directions of the harmonics: at 80° their Gram matrices have condition
numbers of 4 to 11."""


def _directions(degree: int) -> list[list[float]]:
    """Return 2 n + 1 unit vectors; the Legendre polynomials P_n about them span degree n."""
    turn = 2.0 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
    around = np.sin(_CONE) * np.column_stack([np.cos(turn), np.sin(turn)])
    found: list[list[float]] = np.insert(around, 2, np.cos(_CONE), axis=1).tolist()
    return found


def _horner(polynomial: list[float], x: Any) -> Any:
    total = polynomial[-1]
    for value in polynomial[-2::-1]:
        total = total * x + value
    return total


class Zone(NamedTuple):
    """
    P(c), the Legendre polynomial of the cosine c between the force and a direction.

    `polynomial` has its coefficients by power of c.

    """

    degree: int
    towards: list[float]
    polynomial: list[float]

    def monomials(self) -> list[Monomial]:
        """Return u_i P(c) for each axis i."""
        (a, b, d), slope = self.towards, [k * value for k, value in enumerate(self.polynomial)][1:]

        def cosine(x: Any, y: Any, z: Any) -> tuple[Any, Any]:
            size = (x * x + y * y + z * z + 1e-300) ** 0.5
            return (a * x + b * y + d * z) / size, size

        def value(axis: int, *u: Any) -> Any:
            return u[axis] * _horner(self.polynomial, cosine(*u)[0])

        def gradient(axis: int, *u: Any) -> tuple[Any, Any, Any]:
            c, size = cosine(*u)
            steep = u[axis] / size * _horner(slope, c)
            x, y, z = (steep * (towards - c * part / size)
                       + (_horner(self.polynomial, c) if k == axis else 0.0)
                       for k, (towards, part) in enumerate(zip(self.towards, u)))
            return x, y, z

        return [Monomial(partial(value, axis), partial(gradient, axis)) for axis in range(3)]


ZONES = [Zone(degree, towards, leg2poly([0.0] * degree + [1.0]).tolist())
         for degree in DEGREES for towards in _directions(degree)]
"""Harmonics of all `DEGREES`, in their order."""

MONOMIALS: list[Monomial] = [
    Monomial(lambda x, y, z: 1.0, lambda x, y, z: (0.0, 0.0, 0.0)),
    *_each_axis(lambda u: u, lambda u: 1.0),
    *_each_axis(lambda u: u * u, lambda u: 2.0 * u),
    *_each_axis(lambda u: u * u * u, lambda u: 3.0 * u * u),
    *_each_axis(lambda u: u * abs(u), lambda u: 2.0 * abs(u)),
    *_each_axis(abs, np.sign),
    Monomial(lambda x, y, z: x * y, lambda x, y, z: (y, x, 0.0)),
    Monomial(lambda x, y, z: x * z, lambda x, y, z: (z, 0.0, x)),
    Monomial(lambda x, y, z: y * z, lambda x, y, z: (0.0, z, y)),
    *(monomial for mode in range(1, MODES + 1) for monomial in _each_axis(*_wave(mode))),
    *(monomial for zone in ZONES for monomial in zone.monomials()),
]
"""1; u_i; u_i²; u_i³; u_i|u_i|; |u_i|; u_x u_y, u_x u_z, u_y u_z; cos(k π (u_i + 1) / 2) for each
k, constant beyond ±1 g; u_i P(c) for each of `ZONES`. The first four are affine. Those of a user's
own effects follow."""

ONE, FORCE, SQUARE, CUBE, ODD_SQUARE, SIZE, PRODUCT, WAVE = 0, 1, 4, 7, 10, 13, 16, 19
ZONAL = WAVE + 3 * MODES
"""First index of each kind in `MONOMIALS`; a kind by axis has three entries."""

AFFINE = 4
"""Monomials below this index are 1, u_x, u_y, u_z."""

PRODUCTS = {(0, 1): PRODUCT, (0, 2): PRODUCT + 1, (1, 2): PRODUCT + 2}


class Term(NamedTuple):
    """One term of an effect: indices of its parameter, axis and monomial; constant factor."""

    parameter: int
    axis: int
    monomial: int
    weight: float = 1.0


Factor = Callable[[Mapping[str, Any], Floats], Any]
"""Context, shape -> factor of all terms, (n,), or of each term, (t, n); one row has no axis n."""

Shapes = Callable[[Context], Iterator[Floats]]
"""Context of the poses -> shapes to try."""


@dataclass(frozen=True)
class Effect:
    """
    One named physical cause of a difference between reading and specific force.

    Parameters
    ----------
    words, term : str
        Short description; name in IEEE 1293 or in data sheets.
    parameters : tuple of str
        Names of the p parameters.
    unit : str
        Unit of each parameter.
    typical : float
        Typical size in common parts, in `unit`.
    plausible_g : float
        Largest contribution to the reading of a working accelerometer [g]; infinite: no limit.
    terms : tuple of Term
        What the effect adds to the reading.
    factor : callable or None
        Factor of the terms; None: 1.
    needs, over : tuple of str
        Keys of the context that the factor uses; columns that it is a function of, if not those in
        `needs`.
    shape : tuple of str
        Names of the s constants in which the effect is not linear.
    shapes : callable or None
        Shapes that the search tries; None for an effect without shape.
    usual : tuple of float
        Shape where a file or a command does not state it, and the first that the search tries;
        empty: the shape must be stated.
    lagged : str
        Column of the temperature that acts, for the shape ``lag``, ``of_sensor``; else empty.
    family : {'', 'force', 'time'}
        Group of effects that can be confused with this one.
    includes : tuple of str
        Names of the effects that this one contains. A model has either this effect or those.
    base : str
        Name of the effect that changes, for an effect of `CHANGES`; empty for other effects.
    known_orientation : bool
        Whether only poses of known orientation show the effect.
    repeatable_g : float
        Largest change between calibrations of one sensor [g]; a larger one: another sensor.
    output : callable or None
        (n, 3) readings, (p,) values -> (n, 3) readings, for an effect on the whole reading, which
        cannot be corrected.
    own : bool
        Whether a user has defined the effect (`OwnEffect`).

    """

    words: str
    term: str
    parameters: tuple[str, ...]
    unit: str
    typical: float
    plausible_g: float
    terms: tuple[Term, ...]
    factor: Factor | None = None
    needs: tuple[str, ...] = ()
    shape: tuple[str, ...] = ()
    shapes: Shapes | None = None
    usual: tuple[float, ...] = ()
    over: tuple[str, ...] = ()
    lagged: str = ''
    family: Family = ''
    includes: tuple[str, ...] = ()
    base: str = ''
    known_orientation: bool = False
    repeatable_g: float = np.inf
    output: Callable[[Floats, Floats], Floats] | None = None
    own: bool = False

    @cached_property
    def values(self) -> tuple[str, ...]:
        """Names of all values: parameters, then shape."""
        return self.parameters + self.shape

    @cached_property
    def linear(self) -> bool:
        """Whether the effect is part of V and W in every context."""
        return self.factor is None and self.output is None and not self.bends

    @cached_property
    def is_slow_offset(self) -> bool:
        """Whether the effect is an offset that changes with time, or with what changes slowly."""
        return self.family == 'time' and all(term.monomial == ONE for term in self.terms)

    @cached_property
    def is_offset(self) -> bool:
        """Whether the effect is a part of V in every context."""
        return self.linear and all(term.monomial == ONE for term in self.terms)

    @cached_property
    def bends(self) -> bool:
        """Whether the effect is not affine in the force."""
        return any(term.monomial >= AFFINE for term in self.terms)

    def split(self, values: Floats) -> tuple[Floats, Floats]:
        """Split (p + s,) values into parameters and shape."""
        return values[:len(self.parameters)], values[len(self.parameters):]

    def filled(self, values: Floats) -> Floats:
        """Return (p,) or (p + s,) values as (p + s,), with the usual shape where none is given."""
        if self.usual and np.shape(values) == (len(self.parameters),):
            return np.concatenate([values, self.usual])
        return values

    def shown(self, values: Floats) -> dict[str, float]:
        """Return (p + s,) values by name, without the shape constants at their usual value."""
        usual = dict(zip(self.shape, self.usual))
        return {name: value for name, value in zip(self.values, values.tolist(), strict=True)
                if usual.get(name) != value}

    def is_lagged(self, shape: Floats) -> bool:
        """Return whether the temperature of this effect lags behind, or runs ahead."""
        return bool(self.lagged) and bool(shape[0] != 0.0)

    def needs_of(self, shape: Floats) -> tuple[str, ...]:
        """Return the columns that the effect needs with this shape; a lag needs the time."""
        return (*self.needs, 'time') if self.is_lagged(shape) else self.needs

    def over_of(self, shape: Floats) -> tuple[str, ...]:
        """Return the columns that the factor is a function of with this shape."""
        return (self.lagged,) if self.is_lagged(shape) else self.over or self.needs


FITTED_SHAPES = ('tau', 'lag')
"""Shape constants that a fit changes, unless they have their usual value; the others are found
once from the data."""

_SHAPE_STEP = 1e-4
"""Relative step of the numerical derivative by a shape constant; all others are analytic."""


def difference(factor: Factor, context: Context, shape: Floats, place: int) -> Floats:
    """Return the numerical derivative of a factor by one shape constant."""
    step = np.zeros(len(shape))
    step[place] = _SHAPE_STEP * max(abs(shape[place]), 1.0)
    change: Floats = (factor(context, shape + step) - factor(context, shape - step)) / (
        2.0 * step[place])
    return change


def fitted_places(effect: Effect, shape: Floats) -> list[int]:
    """
    Return the indices of the shape constants that a fit changes.

    A constant at its usual value, such as a lag of 0, is not fitted: the effect stays the plain
    one.

    """
    usual = dict(enumerate(effect.usual))
    return [place for place, name in enumerate(effect.shape)
            if name in FITTED_SHAPES and usual.get(place) != shape[place]]


def by_axis(first: int) -> tuple[Term, ...]:
    """Return terms with one parameter and one monomial per axis."""
    step = 0 if first == ONE else 1
    return tuple(Term(axis, axis, first + step * axis) for axis in range(3))


def matrix_terms(*entries: tuple[int, int, int, float]) -> tuple[Term, ...]:
    """Return the terms of a matrix times the force, from (parameter, row, column, weight)."""
    return tuple(Term(parameter, row, FORCE + column, weight)
                 for parameter, row, column, weight in entries)


CROSS = matrix_terms((0, 0, 1, 1.0), (0, 1, 0, 1.0), (1, 0, 2, 1.0), (1, 2, 0, 1.0),
                     (2, 1, 2, 1.0), (2, 2, 1, 1.0))
ALL_AXES = tuple(Term(0, axis, FORCE + axis) for axis in range(3))


_NAME = re.compile(r'[a-z][a-z0-9_]{0,63}')

_PROBED_G = np.linspace(-1.47, 1.53, 48)
_PROBE_STEP_G = 1e-6
_SLOPE_ERROR = 1e-3
"""Forces at which the slope of a form is compared with differences, and the largest error."""


def _same(u: Any) -> Any:
    return u


@dataclass(frozen=True)
class OwnEffect:
    """
    An effect of a user: each axis reads k · form(u) · change(x) more, with one k for each axis.

    Parameters
    ----------
    name, words : str
        Name, of small letters, digits and ``_``, and short description.
    typical : float
        Typical size of k, in `unit`.
    unit : str
        Unit of k.
    form, slope : callable, optional
        Function of the force u along the axis [g], and its derivative by u. Both take and return
        arrays. Without them, form is 1: an offset.
    variable : str
        Column x that the effect is a function of; empty: of the force alone.
    change : callable
        Function of this column, from array to array; by default x itself.

    Raises
    ------
    InputError
        If a part is not usable, or the slope is not the derivative of the form.

    """

    name: str
    words: str
    typical: float
    unit: str = 'g'
    form: Callable[[Any], Any] | None = None
    slope: Callable[[Any], Any] | None = None
    variable: str = ''
    change: Callable[[Any], Any] = _same

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise self._refused('has no usable name, expected small letters, digits and _')
        if not 0.0 < self.typical < np.inf:
            raise self._refused(f'has the typical size {self.typical}, expected a number above 0')
        if (self.form is None) is not (self.slope is None):
            raise self._refused('has only one of form and slope, expected both or none')
        if self.variable and not is_quantity(self.variable) and self.variable not in _ALONE:
            raise self._refused(f'is a function of {self.variable!r}, expected one of '
                                f'{", ".join(_ALONE)}, or the name of another column')
        if self.form is not None and self.slope is not None:
            self._check_slope(self.form, self.slope)

    def _check_slope(self, form: Callable[[Any], Any], slope: Callable[[Any], Any]) -> None:
        stated = np.broadcast_to(slope(_PROBED_G), _PROBED_G.shape)
        real = (form(_PROBED_G + _PROBE_STEP_G) - form(_PROBED_G - _PROBE_STEP_G)) / (
            2.0 * _PROBE_STEP_G)
        error = np.abs(stated - real) / np.maximum(np.abs(real), 1.0)
        worst = int(np.argmax(error))
        if not error[worst] < _SLOPE_ERROR:
            raise self._refused(f'has the slope {stated[worst]:.4g} at {_PROBED_G[worst]:.3g} g, '
                                f'expected {real[worst]:.4g}, the derivative of its form')

    def _refused(self, what: str) -> InputError:
        return InputError(f'the effect {self.name!r} {what}', 'correct its definition')

    def entry(self, first: int) -> Effect:
        """Return the effect, with the index of the first of its `monomials`."""
        factor = partial(_own_factor, self.variable, self.change) if self.variable else None
        return Effect(
            self.words, 'own effect', AXES, self.unit, self.typical, 0.5,
            by_axis(ONE if self.form is None else first), factor,
            (self.variable,) if self.variable else (), own=True)

    @property
    def monomials(self) -> list[Monomial]:
        """Return the form by axis, to be added to `MONOMIALS`; empty for an offset."""
        return [] if self.form is None or self.slope is None else _each_axis(self.form, self.slope)


_ALONE = ('time', 'temperature', 'supply_voltage')
"""Columns of one number that an own effect can be a function of, besides quantities."""


def _own_factor(variable: str, change: Callable[[Any], Any], context: Mapping[str, Any],
                shape: Floats) -> Any:
    return change(context[variable])
