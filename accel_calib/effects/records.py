# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Effects beyond the catalogue, as records: curves without a known cause, and covariates.

An empirical curve changes a part of the reading, the carrier, smoothly with a variable. A
covariate is any quantity that the catalogue does not know. Files, JSON and messages have their
text form, such as ``empirical-gain.z-temperature-1-2``; `effect_named` reads it.

A curve is a sum of cosines. `formula_of` states it for a paper or for firmware: as the best of the
first of these groups whose error, RMS over the range, is below `_EXACT` of the size of the curve,
or half of its standard deviation: a line; a parabola, an exponential, a power; a polynomial of
degree 3, a sine; polynomials of degree 4, 5, 6; the cosines themselves. The constant of a form is
that of all axes. Expressions are valid in C and in Python.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
import math
from typing import Any

import numpy as np

from .catalogue import CATALOGUE, entry_of
from .form import (
    ALL_AXES, AXES, by_axis, Context, CROSS, DEGREES, Effect, EffectKey, EffectRecord, FORCE,
    MODES, ONE, Term, WAVE, ZONAL, ZONES)
from ..statistics import rms_of_rows
from ..table import column_of, CONTEXT, Floats, is_quantity
from ..units import MG

EMPIRICAL = 'empirical'
"""Kind of a smooth curve without a physical cause."""

CARRIERS: dict[str, tuple[str, ...]] = {
    'offset': AXES, 'gain': AXES, 'cross_axis': ('xy', 'xz', 'yz'), 'force': ('all',)}
"""What an empirical curve can change, with the names of its parts. The carrier ``force`` is the
common gain of all axes."""

_CARRIED = {'offset': by_axis(ONE), 'gain': by_axis(FORCE), 'cross_axis': CROSS, 'force': ALL_AXES}

VARIABLES: dict[str, str] = {
    'time': 'time', 'temperature': 'temperature', 'temperature_rate': 'rate of temperature',
    'supply_voltage': 'supply voltage', 'std': 'vibration', 'force': 'force along the axis',
    'direction': 'direction of the force'}
"""Quantities that an empirical curve can be a function of, by column, with their words."""

COVARIATES = {'offset': ('offset', ONE, 'g/unit'), 'gain': ('gain of each axis', FORCE, '1/unit')}
"""What a covariate changes in proportion to a quantity: words, monomial, unit of its values."""


@dataclass(frozen=True)
class EmpiricalCurve(EffectRecord):
    """
    An empirical curve: Σ_k c_k cos(k π s) over the modes k, 1 to `MODES`.

    The carrier, one of `CARRIERS` or a `part` of one, changes with one of `VARIABLES` or a
    quantity. s runs from 0 to 1 over its range in the poses; outside of it, the curve is constant.
    The modes of the variable ``direction`` are degrees of spherical harmonics.

    """

    carrier: str
    variable: str
    modes: tuple[int, ...]
    part: str = ''

    @property
    def changed(self) -> str:
        """Return the carrier with its part, such as ``gain.z``."""
        return f'{self.carrier}.{self.part}' if self.part else self.carrier

    def __str__(self) -> str:
        return '-'.join([EMPIRICAL, self.changed, self.variable, *map(str, self.modes)])

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the names of the parts of the carrier that change."""
        return (self.part,) if self.part else CARRIERS[self.carrier]

    @property
    def entry(self) -> Effect:
        return _entry_of_curve(self)


@dataclass(frozen=True)
class Covariate(EffectRecord):
    """
    An offset or a gain that changes by k (x - zero), by axis, with a quantity x.

    The zero is the mean over the poses. With the power 2, a square, k₂ (x - zero)², is added. With
    two columns it is k (x - zero_x) (y - zero_y): what neither column does alone.

    """

    part: str
    columns: tuple[str, ...]
    power: int = 1

    @property
    def variable(self) -> str:
        """Return the column, or both, such as ``humidity*pressure``."""
        return '*'.join(self.columns)

    def __str__(self) -> str:
        return f'{self.part}_covariate-{self.variable}{"-2" if self.power == 2 else ""}'

    @property
    def entry(self) -> Effect:
        return _entry_of_covariate(self)


def effect_named(text: str, own: Iterable[EffectRecord] = ()) -> EffectKey:
    """Return the effect with a name or text form, perhaps an own one; KeyError without one."""
    if text in CATALOGUE:
        return text
    for each in own:
        if str(each) == text:
            return each
    kind, *rest = text.split('-')
    found: EffectKey | None = None
    if kind == EMPIRICAL and len(rest) > 2 and all(mode.isdecimal() for mode in rest[2:]):
        carrier, _, part = rest[0].partition('.')
        modes = tuple(map(int, rest[2:]))
        pairs = ((each.carrier, each.variable) for each in curves_over(
            filter(is_quantity, rest[1:2])))
        if ((carrier, rest[1]) in pairs and part in ('', *CARRIERS[carrier])
                and list(modes) == sorted({*modes} & {*modes_of(rest[1])})):
            found = EmpiricalCurve(carrier, rest[1], modes, part)
    elif kind.removesuffix('_covariate') in COVARIATES and rest:
        columns = tuple(rest[0].split('*'))
        is_product = len(columns) == 2 and columns[0] < columns[1] and all(
            is_quantity(column) or column in CONTEXT for column in columns)
        if is_product or is_quantity(rest[0]):
            power = 2 if rest[1:] and not is_product else 1
            found = Covariate(kind.removesuffix('_covariate'), columns, power)
    if found is None or str(found) != text:
        raise KeyError(text)
    return found


def kind_of(effect: EffectKey) -> str:
    """Return the name of an effect without what it is a function of."""
    return str(effect).partition('-')[0]


def unchanged(effect: EffectKey) -> EffectKey:
    """Return an effect, for a change the effect that has changed."""
    return entry_of(effect).base or effect


def shown_name(effect: EffectKey) -> str:
    """Return the name of an effect among rivals; a covariate keeps its quantity."""
    if isinstance(effect, Covariate):
        return str(replace(effect, power=1))
    return kind_of(unchanged(effect))


def variable_of(effect: EffectKey) -> str:
    """Return the variable of a curve or a covariate; empty for others."""
    return effect.variable if isinstance(effect, EmpiricalCurve | Covariate) else ''


def variable_words(column: str) -> str:
    """Return the words of a variable: of `VARIABLES`, or of a quantity."""
    return VARIABLES.get(column) or column_of(column).meaning


def modes_of(variable: str) -> Sequence[int]:
    """Return the modes that an empirical curve over a variable can have."""
    return DEGREES if variable == 'direction' else range(1, MODES + 1)


def curves_over(quantities: Iterable[str] = ()) -> Iterator[EmpiricalCurve]:
    """Yield the curves of all carriers over `VARIABLES` and the quantities, with all modes."""
    for variable in (*VARIABLES, *quantities):
        for carrier in CARRIERS:
            if carrier == {'force': 'offset', 'direction': 'force'}.get(variable, carrier):
                yield EmpiricalCurve(carrier, variable, tuple(modes_of(variable)))


@lru_cache(maxsize=2048)
def _entry_of_curve(curve: EmpiricalCurve) -> Effect:
    variable, modes = curve.variable, curve.modes
    unit = 'g' if curve.carrier == 'offset' else 'g/g'
    if variable == 'direction':  # the gain of all axes as a sum of spherical harmonics
        zones = [number for number, zone in enumerate(ZONES) if zone.degree in modes]
        names = tuple(f'{degree}_{k}' for degree in modes for k in range(1, 2 * degree + 2))
        terms = tuple(Term(k, axis, ZONAL + 3 * number + axis)
                      for k, number in enumerate(zones) for axis in range(3))
        return Effect(f'gain as a smooth function of {VARIABLES["direction"]}',
                      'empirical curve', names, unit, 0.001, terms=terms, family='force')
    parts, of_force = curve.parts, variable == 'force'
    carried = [term._replace(parameter=parts.index(own)) for term in _CARRIED[curve.carrier]
               if (own := CARRIERS[curve.carrier][term.parameter]) in parts]
    terms = tuple(
        term._replace(
            parameter=k * len(parts) + term.parameter,
            monomial=WAVE + 3 * (mode - 1) + term.axis if of_force else term.monomial)
        for k, mode in enumerate(modes) for term in carried)
    names = tuple(f'{own}_{mode}' for mode in modes for own in parts)
    words = (f'{curve.changed.replace("_", "-")} as a smooth function of '
             f'{variable_words(variable)}')
    made = Effect(words, 'empirical curve', names, unit, 0.001, terms=terms)
    if of_force:
        return replace(made, family='force')
    return replace(made, factor=partial(_cosines, variable, modes, len(carried)),
                   needs=(variable,), shape=('low', 'high'), shapes=partial(_ends, variable))


def _variable(variable: str, context: Mapping[str, Any]) -> Floats:
    """Return the variable of an empirical curve; for vectors, its RMS over the axes."""
    values = np.asarray(context[variable], float)
    return rms_of_rows(values) if variable == 'std' else values


def _ends(variable: str, context: Context) -> Iterator[Floats]:
    """Yield the range of a variable."""
    values = _variable(variable, context)
    known = values[np.isfinite(values)]
    if len(known) and np.ptp(known) > 0.0:
        yield np.array([np.min(known), np.max(known)])


def _cosines(variable: str, modes: tuple[int, ...], terms: int, context: Mapping[str, Any],
             shape: Floats) -> Any:
    """Return the cosine of each term, (t, n), with several terms of each mode."""
    values = _variable(variable, context)
    share = np.clip((values - shape[0]) / max(shape[1] - shape[0], 1e-300), 0.0, 1.0)
    return np.repeat(np.cos(np.pi * np.multiply.outer(modes, share)), terms, axis=0)


@lru_cache(maxsize=2048)
def _entry_of_covariate(covariate: Covariate) -> Effect:
    columns, has_square = covariate.columns, covariate.power == 2
    what, monomial, unit = COVARIATES[covariate.part]
    terms = by_axis(monomial)
    names: tuple[str, ...] = AXES
    if has_square:
        terms += tuple(term._replace(parameter=3 + term.parameter) for term in terms)
        names += tuple(f'{axis}_square' for axis in AXES)

    def departure(context: Mapping[str, Any], shape: Floats) -> Any:
        """Return the product of all column - zero, and its square."""
        away = math.prod(context[each] - zero
                         for each, zero in zip(columns, shape, strict=True))
        return np.array([away] * 3 + [away ** 2] * 3) if has_square else away

    def means(context: Context) -> Iterator[Floats]:
        """Yield the means of columns with enough different values."""
        known = [context[column][np.isfinite(context[column])] for column in columns]
        if all(len(np.unique(values)) > covariate.power for values in known):
            yield np.array([np.mean(values) for values in known])

    return Effect(
        words=f'{what} that changes with {" times ".join(map(variable_words, columns))}',
        term=f'coefficient of {covariate.variable}', parameters=names, unit=unit, typical=np.inf,
        terms=terms, factor=departure, needs=columns, shapes=means,
        shape=('zero',) if len(columns) == 1 else tuple(f'zero_{each}' for each in columns),
        usual=(0.0,) * len(columns),
        includes=(replace(covariate, power=1),) if has_square else ())


_IN_MILLI = ('g', 'g/g', 'g/g²', 'g/g³', 'g/°C', 'g/°C²', 'g/°C³', 'g/h')
_WITHOUT_UNIT = ('of_sensor', 'form')
"""Constants of a shape that select one of two forms."""


def value_unit(effect: EffectKey, value_name: str) -> tuple[str, float]:
    """Return the unit of a value of an effect in reports, and the factor from the model's unit."""
    if value_name in _WITHOUT_UNIT:
        return '', 1.0
    entry = entry_of(effect)
    if value_name not in entry.parameters:
        if isinstance(effect, Covariate):
            return unit_of(effect.columns[entry.shape.index(value_name)]), 1.0
        return unit_of(effect.variable) if isinstance(effect, EmpiricalCurve) else (
            '' if entry.own else 's'), 1.0
    unit = entry.unit
    if value_name.endswith('_square'):
        unit = f'{unit}²'
    return (f'm{unit}', MG) if unit in _IN_MILLI else (unit, 1.0)


def unit_of(column: str) -> str:
    """Return the unit of a quantity of the context, with readings in g."""
    return 'g' if column == 'std' else column_of(column).unit


# ----------------------------------------------------------------------------- formulas

_EXACT = 0.04
"""Largest error of a form, RMS, relative to the difference of the extremes of the curve."""

_CONSTANTS = np.geomspace(0.05, 5.0, 93)
"""Constants of a form that are tried, relative to the range of the variable, or as a power."""

_WAVES = np.arange(0.5, MODES + 1.0, 0.025)
"""Half waves of a sine that are tried in the range of the variable."""

_Expression = Callable[[Sequence[float]], str]
_Form = tuple[Floats, _Expression]
"""The (k, g) functions of a form, and the expression of their k factors."""


def formula_of(effect: EffectKey, values: Floats, deviations: Mapping[str, float]) -> str:
    """
    Return the formula of an empirical curve; empty for others and over directions of the force.

    `values` (p,) are those of the curve in a model [g, or 1 for a gain], `deviations` the standard
    deviations of the parameters of the model. The formula is in mg or mg/g, and readings are in g
    in its variable.

    """
    if not isinstance(effect, EmpiricalCurve) or effect.variable == 'direction':
        return ''
    variable, modes, names = effect.variable, effect.modes, effect.parts
    spread = np.array([deviations.get(f'{effect}.{part}', 0.0) for part in effect.entry.values])
    low, high = (-1.0, 1.0) if variable == 'force' else values[-2:].tolist()
    share = np.linspace(0.0, 1.0, 201)
    waves = np.cos(np.pi * np.multiply.outer(np.array(modes), share))
    factors, sizes = (each[:len(names) * len(modes)].reshape(len(modes), len(names)).T * MG
                      for each in (values, spread))
    curves = factors @ waves
    noise = np.sqrt(np.mean(sizes ** 2 @ waves ** 2, axis=1))
    most = np.maximum(_EXACT * np.max(np.ptp(curves, axis=1)), 0.5 * noise) + 1e-12
    for group in _forms(share, high - low, modes):
        fits = [np.linalg.lstsq(functions.T, curves.T, rcond=None)[0].T for functions, _ in group]
        errors = [np.max(rms_of_rows(fit @ functions - curves) / most)
                  for fit, (functions, _) in zip(fits, group, strict=True)]
        best = int(np.argmin(errors))
        if errors[best] <= 1.0:
            break
    expression = group[best][1]
    unit = 'g' if variable == 'force' else unit_of(variable)
    each = ', '.join(f'{own} = {expression(row)}'
                     for own, row in zip(names, fits[best].tolist(), strict=True))
    return (f'{effect.carrier.replace("_", "-")} [m{effect.entry.unit}]: {each}; t = '
            f'{variable_words(variable)}{f" {_signed(-low)}" if low else ""}, from 0 to '
            f'{high - low:.6g} {unit}').rstrip()


def _forms(share: Floats, span: float, modes: Sequence[int]) -> Iterator[list[_Form]]:
    """Yield groups of forms over shares of a span; at last the cosines of the modes."""
    one = np.ones_like(share)
    yield [_polynomial(share, 1, span)]
    yield [_polynomial(share, 2, span),
           *((np.stack([one, np.exp(sign * share / shape)]),
              partial(_one_term, f'exp({words}/{shape * span:.5g})'))
             for shape in _CONSTANTS.tolist() for sign, words in ((-1.0, '-t'), (1.0, 't'))),
           *((np.stack([one, share ** power]),
              partial(_one_term, f'pow(t/{span:.5g}, {power:.5g})'))
             for power in _CONSTANTS.tolist())]
    angles = [(np.pi * waves, np.pi * waves * share) for waves in _WAVES.tolist()]
    yield [_polynomial(share, 3, span),
           *((np.stack([one, np.sin(angle), np.cos(angle)]), partial(_sine, rate / span))
             for rate, angle in angles)]
    for degree in (4, 5, 6):
        yield [_polynomial(share, degree, span)]
    yield [(np.cos(np.pi * np.multiply.outer(np.array(modes), share)), lambda row: ' '.join(
        f'{_signed(value)}*cos({np.pi * mode / span:.6g}*t)' for mode, value in zip(modes, row)))]


def _polynomial(share: Floats, degree: int, span: float) -> _Form:
    def expression(row: Sequence[float]) -> str:
        words = f'{row[-1] / span ** degree:.5g}'
        for power in range(degree - 1, -1, -1):
            words = f'{row[power] / span ** power:.5g} + t*({words})'
        return words

    return np.vander(share, degree + 1, increasing=True).T, expression


def _one_term(term: str, row: Sequence[float]) -> str:
    return f'{row[0]:.5g} {_signed(row[1])}*{term}'


def _sine(rate: float, row: Sequence[float]) -> str:
    size, angle = float(np.hypot(row[1], row[2])), float(np.arctan2(row[2], row[1]))
    return f'{row[0]:.5g} {_signed(size)}*sin({rate:.5g}*t {_signed(angle)})'


def _signed(value: float) -> str:
    return f'{"-" if value < 0.0 else "+"} {abs(value):.5g}'
