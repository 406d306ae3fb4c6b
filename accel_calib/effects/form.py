# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The form of an effect: the sum of terms that `accel_calib.effects` describes."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.polynomial.legendre import leg2poly
from numpy.typing import NDArray

from ..table import Floats

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


def each_axis(value: Callable[[Any], Any], slope: Callable[[Any], Any]) -> list[Monomial]:
    """Return the monomials of a function of one component, for x, y and z."""
    return [Monomial(lambda x, y, z: value(x), lambda x, y, z: (slope(x), 0.0, 0.0)),
            Monomial(lambda x, y, z: value(y), lambda x, y, z: (0.0, slope(y), 0.0)),
            Monomial(lambda x, y, z: value(z), lambda x, y, z: (0.0, 0.0, slope(z)))]


MODES = 24
"""Number of cosines that an empirical curve can have."""


def _wave(turn: float) -> list[Monomial]:
    """Return the cosines over -1 to 1 g that turn by this angle [rad/g]."""
    return each_axis(
        lambda u: np.cos(turn * (np.clip(u, -1.0, 1.0) + 1.0)),
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

        def gradient(axis: int, *u: Any) -> tuple[Any, Any, Any]:
            c, size = cosine(*u)
            steep = u[axis] / size * _horner(slope, c)
            x, y, z = (steep * (towards - c * part / size)
                       + (_horner(self.polynomial, c) if k == axis else 0.0)
                       for k, (towards, part) in enumerate(zip(self.towards, u)))
            return x, y, z

        return [Monomial(lambda *u, axis=axis: u[axis] * _horner(self.polynomial, cosine(*u)[0]),
                         partial(gradient, axis)) for axis in range(3)]


ZONES = [Zone(degree, towards, leg2poly([0.0] * degree + [1.0]).tolist())
         for degree in DEGREES for towards in _directions(degree)]
"""Harmonics of all `DEGREES`, in their order."""

MONOMIALS: tuple[Monomial, ...] = (
    Monomial(lambda x, y, z: 1.0, lambda x, y, z: (0.0, 0.0, 0.0)),
    *each_axis(lambda u: u, lambda u: 1.0),
    *each_axis(lambda u: u * u, lambda u: 2.0 * u),
    *each_axis(lambda u: u * u * u, lambda u: 3.0 * u * u),
    *each_axis(lambda u: u * abs(u), lambda u: 2.0 * abs(u)),
    *each_axis(abs, np.sign),
    Monomial(lambda x, y, z: x * y, lambda x, y, z: (y, x, 0.0)),
    Monomial(lambda x, y, z: x * z, lambda x, y, z: (z, 0.0, x)),
    Monomial(lambda x, y, z: y * z, lambda x, y, z: (0.0, z, y)),
    *(monomial for mode in range(1, MODES + 1) for monomial in _wave(mode * np.pi / 2.0)),
    *(monomial for zone in ZONES for monomial in zone.monomials()),
)
"""1; u_i; u_i²; u_i³; u_i|u_i|; |u_i|; u_x u_y, u_x u_z, u_y u_z; cos(k π (u_i + 1) / 2) for each
k, constant beyond ±1 g; u_i P(c) for each of `ZONES`. The first four are affine."""

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


def by_axis(first: int) -> tuple[Term, ...]:
    """Return terms with one parameter and one monomial per axis."""
    return tuple(Term(axis, axis, first if first == ONE else first + axis) for axis in range(3))


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
        What the effect adds to the reading; by default an offset of each axis.
    factor : callable or None
        Factor of the terms; None: 1.
    needs, over : tuple of str
        Keys of the context that the factor uses; columns that it is a function of, if not `needs`.
    shape, shapes : tuple of str, callable or None
        Names of the s constants in which the effect is not linear; shapes that the search tries.
    usual : tuple of float
        Shape if none is stated, and the first that the search tries; empty: it must be stated.
    bounds : tuple of (float, float)
        Lowest and highest value of each shape constant; empty: those of `shapes`, widened.
    lagged : str
        Column of the temperature that acts, for the shape ``lag``, ``of_sensor``; else empty.
    family : {'', 'force', 'time'}
        Group of effects that can be confused with this one.
    includes : tuple of EffectKey
        The effects that this one contains. A model has either this effect or those.
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
        Whether a user has defined the effect (`OwnEffect`). A fit changes all of its shape.
    of_force : bool
        Whether the factor is a function of the force, too: of the column ``force`` of its context.
    scales : bool
        Whether its first parameter k scales the gains of the other effects, too: it adds k W u.

    """

    words: str
    term: str
    parameters: tuple[str, ...]
    unit: str
    typical: float
    plausible_g: float = 0.5
    terms: tuple[Term, ...] = by_axis(ONE)
    factor: Factor | None = None
    needs: tuple[str, ...] = ()
    shape: tuple[str, ...] = ()
    shapes: Shapes | None = None
    usual: tuple[float, ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()
    over: tuple[str, ...] = ()
    lagged: str = ''
    family: Family = ''
    includes: 'tuple[EffectKey, ...]' = ()
    base: str = ''
    known_orientation: bool = False
    repeatable_g: float = np.inf
    output: Callable[[Floats, Floats], Floats] | None = None
    own: bool = False
    of_force: bool = False
    scales: bool = False

    @cached_property
    def values(self) -> tuple[str, ...]:
        """Names of all values: parameters, then shape."""
        return self.parameters + self.shape

    @cached_property
    def linear(self) -> bool:
        """Whether the effect is part of V and W in every context."""
        return self.factor is None and self.output is None and not self.bends

    @cached_property
    def changes(self) -> str:
        """Return what the effect changes: ``offset``, ``gain``, or ``force`` if it bends."""
        if self.bends:
            return 'force'
        return 'offset' if all(term.monomial == ONE for term in self.terms) else 'gain'

    @cached_property
    def is_offset(self) -> bool:
        """Whether the effect is a part of V in every context."""
        return self.linear and all(term.monomial == ONE for term in self.terms)

    @cached_property
    def bends(self) -> bool:
        """Whether the effect is not affine in the force."""
        return self.of_force or any(term.monomial >= AFFINE for term in self.terms)

    def split(self, values: Floats) -> tuple[Floats, Floats]:
        """Split (p + s,) values into parameters and shape."""
        return values[:len(self.parameters)], values[len(self.parameters):]

    def filled(self, values: Floats) -> Floats:
        """Return (p,) to (p + s,) values as (p + s,), with the usual shape where none is given."""
        missing = len(self.values) - len(values)
        if self.usual and 0 < missing <= len(self.shape):
            return np.concatenate([values, self.usual[-missing:]])
        return values

    def shown(self, values: Floats) -> dict[str, float]:
        """Return (p + s,) values by name, without the shape constants at their usual value."""
        usual = dict(zip(self.shape, self.usual))
        return {name: value for name, value in zip(self.values, values.tolist(), strict=True)
                if usual.get(name) != value}

    def is_lagged(self, shape: Floats) -> bool:
        """Return whether the temperature of this effect lags behind, or runs ahead."""
        return bool(self.lagged) and bool(shape[0] != 0.0)

    def over_of(self, shape: Floats) -> tuple[str, ...]:
        """Return the columns that the factor is a function of with this shape."""
        return (self.lagged,) if self.is_lagged(shape) else self.over or self.needs


class EffectRecord(ABC):
    """
    An effect beyond the catalogue: what defines it, with a text form for files and messages.

    Equal records are the same effect.

    """

    @property
    @abstractmethod
    def entry(self) -> Effect:
        """Return the effect as the catalogue has them."""


EffectKey = str | EffectRecord
"""An effect of a model: its name in the catalogue, or its record."""

AT_POSES = ('since_turn', 'duration')
"""Columns that only poses have."""

_FITTED_SHAPES = ('tau', 'lag', 'memory')
"""Shape constants of the catalogue that a fit changes; the others are found once."""

_SHAPE_STEP = 1e-4
"""Step of the numerical derivative by a shape constant, relative to its size or its bounds."""


def difference(factor: Factor, context: Context, shape: Floats, place: int,
               bounds: Sequence[tuple[float, float]]) -> Floats:
    """Return the numerical derivative of a factor by one shape constant, inside its bounds."""
    low, high = bounds[place] if bounds else (-np.inf, np.inf)
    step = _SHAPE_STEP * (high - low if bounds else max(abs(shape[place]), 1.0))
    ends = np.array([shape, shape])
    ends[:, place] = np.clip([shape[place] - step, shape[place] + step], low, high)
    return (factor(context, ends[1]) - factor(context, ends[0])) / np.ptp(ends[:, place])


def fitted_places(effect: Effect, shape: Floats) -> list[int]:
    """Return the indices of the shape constants that a fit changes: none at its usual value."""
    usual = dict(enumerate(effect.usual))
    return [place for place, name in enumerate(effect.shape)
            if (effect.own or name in _FITTED_SHAPES) and usual.get(place) != shape[place]]


def matrix_terms(entries: Iterable[tuple[int, int, int, float]]) -> tuple[Term, ...]:
    """Return the terms of a matrix times the force, from (parameter, row, column, weight)."""
    return tuple(Term(parameter, row, FORCE + column, weight)
                 for parameter, row, column, weight in entries)


CROSS = matrix_terms(((0, 0, 1, 1.0), (0, 1, 0, 1.0), (1, 0, 2, 1.0), (1, 2, 0, 1.0),
                      (2, 1, 2, 1.0), (2, 2, 1, 1.0)))
ALL_AXES = tuple(Term(0, axis, FORCE + axis) for axis in range(3))
