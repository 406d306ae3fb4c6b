# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The catalogue: one entry for each effect with a known cause, and curves without one.

Two kinds of effects are made from their names: an empirical curve, with which a part of the
reading, the carrier, changes smoothly with a variable (`empirical_name`), and a covariate, which
is any quantity that the catalogue does not know (`covariate_names`).

"""

from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import combinations
import math
from typing import Any

import numpy as np

from .form import (
    ALL_AXES, AXES, by_axis, Context, CROSS, CUBE, DEGREES, Effect, Factor, FORCE, matrix_terms,
    MODES, ODD_SQUARE, ONE, PRODUCTS, SIZE, SQUARE, Term, WAVE, ZONAL, ZONES)
from .thermal import acting_temperature, rate_at
from ..table import column_of, CONTEXT, Floats, is_quantity
from ..units import MG, STANDARD_GRAVITY

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which the temperature effects are zero [°C], as in data sheets."""

NOMINAL_SUPPLY = 3.3
"""Supply voltage at which `supply_ratio` is zero [V]."""

HOUR = 3600.0

_ROTATION = matrix_terms((0, 2, 1, 1.0), (0, 1, 2, -1.0), (1, 0, 2, 1.0), (1, 2, 0, -1.0),
                         (2, 1, 0, 1.0), (2, 0, 1, -1.0))
_COUPLED = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
_SUPPLY = (*ALL_AXES, *(Term(1 + axis, axis, ONE) for axis in range(3)))
_LEVER = tuple(Term(parameter, axis, ONE) for axis in range(3) for parameter in range(3))

_TAUS = 40
"""Number of time constants to try; a coarser grid leads to spurious second effects."""

_LEAST_SIDE = 5
"""Smallest number of poses on each side of a step; with 3, a step absorbs any single outlier."""


def _times(context: Context) -> Floats:
    time: Floats = np.sort(context['time'])
    return time[np.isfinite(time)]


def _from_start(context: Context) -> Iterator[Floats]:
    time = _times(context)
    if len(time) and time[-1] > time[0]:
        yield time[:1]


def _taus(context: Context) -> Iterator[Floats]:
    """Yield start and time constant; the constants are 1/60 to 3/2 of the time span."""
    for start in _from_start(context):
        span = _times(context)[-1] - start[0]
        for tau in np.geomspace(span / 60.0, span * 1.5, _TAUS):
            yield np.array([start[0], tau])


def _instants(context: Context) -> Iterator[Floats]:
    """Yield the instants between successive poses, with enough poses on each side."""
    time = _times(context)
    middles = (time[1:] + time[:-1]) / 2.0
    for instant in np.unique(middles[_LEAST_SIDE - 1:len(middles) - _LEAST_SIDE + 1]):
        yield np.array([instant])


_LAGS = 20
"""Number of lags to try for each kind of lag."""

_LEAST_LAG = 10.0
"""Smallest lag to try [s]; over a shorter time the temperature of a sensor hardly changes."""


def _lags(context: Context) -> Iterator[Floats]:
    """Yield no lag, then lags of the die and of the sensor, up to a third of the time span."""
    yield np.zeros(2)
    if 'time' not in context or 'temperature' not in context:
        return
    time = np.unique(_times(context))
    if len(time) < _LEAST_SIDE or np.ptp(context['temperature']) == 0.0:
        return
    least = max(float(np.median(np.diff(time))) / 3.0, _LEAST_LAG)
    most = (time[-1] - time[0]) / 3.0
    if most > least:
        for of_sensor in (0.0, 1.0):
            for lag in np.geomspace(least, most, _LAGS):
                yield np.array([lag, of_sensor])


def _warming_to(power: int) -> Factor:
    return lambda context, shape: (context['temperature'] - REFERENCE_TEMPERATURE) ** power


def _lagged_warming(key: str) -> Factor:
    """Return the factor of an effect whose acting temperature is the column `key`."""
    def factor(context: Mapping[str, Any], shape: Floats) -> Any:
        lag, of_sensor = shape
        acting = (acting_temperature(context, key, lag, bool(of_sensor)) if lag
                  else context['temperature'])
        return acting - REFERENCE_TEMPERATURE

    return factor


def _motion(context: Mapping[str, Any], shape: Floats) -> Floats:
    """Return the unit vector towards the previous pose, or in form 1 its sign by axis."""
    towards: Floats = np.asarray(context['previous'], float).T
    return np.sign(towards) if shape[0] else towards


def _creep(context: Mapping[str, Any], shape: Floats) -> Floats:
    """Return the way times the mean over the pose of what is left of the relaxation."""
    tau = max(shape[0], 1e-9)
    ends = context.get('duration', 0.0) / tau
    left = np.exp(-context.get('since_turn', 0.0) / tau) * np.where(
        ends > 0.0, -np.expm1(-ends) / np.maximum(ends, 1e-300), 1.0)
    return np.asarray(context['previous'], float).T * left


def _relaxations(context: Context) -> Iterator[Floats]:
    """Yield time constants, if poses differ in the time since the turn."""
    if 'since_turn' not in context:
        return
    times = np.nan_to_num(context['since_turn'] + context.get('duration', 0.0))
    if np.ptp(times) > 0.0:
        for tau in np.geomspace(max(np.ptp(times) / 60.0, 0.1), np.ptp(times) * 1.5, _TAUS):
            yield np.array([tau])


def _since(context: Mapping[str, Any], shape: Floats) -> Any:
    return (context['time'] - shape[0]) / HOUR


def _settling(context: Mapping[str, Any], shape: Floats) -> Any:
    start, tau = shape
    return np.exp(-np.maximum(context['time'] - start, 0.0) / max(tau, 1e-9))


def _after(context: Mapping[str, Any], shape: Floats) -> Any:
    return np.asarray(context['time'] >= shape[0], float)


def _centripetal(context: Mapping[str, Any], shape: Floats) -> Floats:
    """Return the (9, n) entries of ω×(ω×·) per metre [g], row by row."""
    rate = np.asarray(context['rate'], float).T
    squared = np.sum(rate ** 2, axis=0)
    entries = [rate[i] * rate[j] - (squared if i == j else 0.0)
               for i in range(3) for j in range(3)]
    return np.array(entries) / STANDARD_GRAVITY


_bending = partial(Effect, plausible_g=0.5, family='force')
_in_time = partial(Effect, plausible_g=0.5, family='time')
_LAG = ('lag', 'of_sensor')

EFFECTS: dict[str, Effect] = {
    'offset': Effect('zero-g offset', 'bias K0, zero-g offset', AXES, 'g', 0.1, 1.0,
                     by_axis(ONE), repeatable_g=0.03),
    'gain': Effect('one gain for all axes', 'scale factor K1, sensitivity', ('all',), 'g/g', 0.03,
                   0.5, ALL_AXES, repeatable_g=0.015),
    'axis_gain': Effect('gain of each axis', 'scale factor K1, sensitivity', AXES, 'g/g', 0.03,
                        0.5, by_axis(FORCE), includes=('gain',), repeatable_g=0.015),
    'cross_axis': Effect('cross-axis gain, symmetric', 'cross-axis sensitivity',
                         ('xy', 'xz', 'yz'), 'g/g', 0.02, 0.5, CROSS, repeatable_g=0.015),
    'misalignment': Effect('rotation of the sensing axes', 'input-axis misalignment', AXES, 'g/g',
                           0.02, np.inf, _ROTATION, known_orientation=True),
    'quadratic': _bending('square of the force', 'second-order coefficient K2', AXES, 'g/g²',
                          0.001, terms=by_axis(SQUARE)),
    'cubic': _bending('cube of the force', 'third-order coefficient K3', AXES, 'g/g³', 0.001,
                      terms=by_axis(CUBE)),
    'odd_quadratic': _bending('force times its magnitude', 'odd quadratic coefficient Koq', AXES,
                              'g/g²', 0.001, terms=by_axis(ODD_SQUARE)),
    'gain_asymmetry': _bending('gain that differs between + and -', 'scale-factor asymmetry', AXES,
                               'g/g', 0.002, terms=by_axis(SIZE)),
    'cross_coupling': _bending(
        'product of two axes', 'cross-coupling coefficients Kip, Kio',
        tuple(f'{AXES[i]}_{AXES[i]}{AXES[j]}' for i, j in _COUPLED), 'g/g²', 0.001,
        terms=tuple(Term(k, i, PRODUCTS[min(i, j), max(i, j)])
                    for k, (i, j) in enumerate(_COUPLED))),
    'offset_temperature': _in_time(
        'offset that changes with temperature', 'zero-g offset temperature coefficient TCO', AXES,
        'g/°C', 0.001, terms=by_axis(ONE), factor=_lagged_warming('temperature_of_offset'),
        needs=('temperature',), shape=_LAG, shapes=_lags, usual=(0.0, 0.0),
        lagged='temperature_of_offset'),
    'offset_temperature_quadratic': _in_time(
        'offset that changes with the square of temperature', 'second-order TCO', AXES, 'g/°C²',
        1e-5, terms=by_axis(ONE), factor=_warming_to(2), needs=('temperature',)),
    'offset_temperature_cubic': _in_time(
        'offset that changes with the cube of temperature', 'third-order TCO', AXES, 'g/°C³',
        1e-7, terms=by_axis(ONE), factor=_warming_to(3), needs=('temperature',)),
    'gain_temperature': _in_time(
        'gain that changes with temperature', 'sensitivity temperature coefficient TCS', AXES,
        '1/°C', 0.0003, terms=by_axis(FORCE), factor=_lagged_warming('temperature_of_gain'),
        needs=('temperature',), shape=_LAG, shapes=_lags, usual=(0.0, 0.0),
        lagged='temperature_of_gain'),
    'temperature_rate': _in_time(
        'offset in proportion to the rate of the temperature', 'thermal gradient sensitivity',
        AXES, 'g·s/°C', 0.02, terms=by_axis(ONE), factor=lambda context, shape: rate_at(context),
        needs=('time', 'temperature'), over=('temperature_rate',)),
    'supply_ratio': Effect(
        'offset and gain in proportion to the supply', 'ratiometric output', ('gain', *AXES),
        'g/g', 1.0, 1.0, _SUPPLY,
        lambda context, shape: context['supply_voltage'] / NOMINAL_SUPPLY - 1.0,
        ('supply_voltage',), scales=True),
    'offset_drift': _in_time(
        'offset that drifts with time', 'bias drift', AXES, 'g/h', 0.0005, terms=by_axis(ONE),
        factor=_since, needs=('time',), shape=('start',), shapes=_from_start),
    'warm_up': _in_time(
        'offset that settles after power-on', 'turn-on transient', AXES, 'g', 0.005,
        terms=by_axis(ONE), factor=_settling, needs=('time',), shape=('start', 'tau'),
        shapes=_taus),
    'offset_step': _in_time(
        'offset that jumps at an instant', 'bias shift after shock', AXES, 'g', 0.005,
        terms=by_axis(ONE), factor=_after, needs=('time',), shape=('instant',),
        shapes=_instants),
    'gain_drift': _in_time(
        'gain that drifts with time', 'scale-factor drift', AXES, '1/h', 0.0005,
        terms=by_axis(FORCE), factor=_since, needs=('time',), shape=('start',),
        shapes=_from_start),
    'gain_step': _in_time(
        'gain that jumps at an instant', 'scale-factor shift after shock', AXES, 'g/g', 0.005,
        terms=by_axis(FORCE), factor=_after, needs=('time',), shape=('instant',),
        shapes=_instants),
    'vibration_rectification': Effect(
        'offset that grows with vibration', 'vibration rectification coefficient VRC', AXES,
        'g/g²', 0.002, 0.5, by_axis(ONE),
        lambda context, shape: np.asarray(context['std'], float).T ** 2, ('std',)),
    'hysteresis': Effect('offset that depends on the previous pose', 'hysteresis', AXES, 'g',
                         0.001, 0.5, by_axis(ONE), _motion, ('previous',), ('form',),
                         lambda context: iter(np.array([[0.0], [1.0]])), usual=(0.0,)),
    'creep': Effect('offset that relaxes after a turn', 'creep', AXES, 'g', 0.001, 0.5,
                    by_axis(ONE), _creep, ('time', 'previous'), ('tau',), _relaxations,
                    over=('since_turn',)),
    'lever_arm': Effect('centripetal force away from the axis of rotation', 'size effect', AXES,
                        'm', 0.1, 5.0, _LEVER, _centripetal, ('rate',)),
    'saturation': Effect(
        'readings clipped at a limit', 'full-scale range', ('limit',), 'g', 2.0, np.inf, (),
        output=lambda reading, limit: np.clip(reading, -limit[0], limit[0])),
    'quantisation': Effect(
        'readings on a grid', 'resolution', ('step',), 'g', 0.001, np.inf, (),
        output=lambda reading, step: np.round(reading / step[0]) * step[0]),
}
"""All effects that are functions of the force and the context."""

OFFSET_POWERS = ('offset', 'offset_temperature', 'offset_temperature_quadratic',
                 'offset_temperature_cubic')
"""The effects that make the offset a polynomial in the temperature, by the power."""

WANDER = 'offset_wander'
PROCESSES: dict[str, Effect] = {
    WANDER: _in_time('offset that changes slowly without a known form', 'bias random walk', (),
                     'g', 0.001, terms=(), needs=('time',))}
"""Random processes. `accel_calib.refine` names them; a model cannot contain them."""

LADDER = ('offset', 'gain', 'axis_gain', 'cross_axis', 'misalignment')
"""The effects that make up V and W. Every sensor has them; models 4 to 12 consist of them."""

CHANGES: dict[str, Effect] = {
    f'{name}_change': replace(EFFECTS[name], words=f'change of the {EFFECTS[name].words}',
                              factor=lambda context, shape: context['new'], needs=('new',),
                              includes=tuple(f'{each}_change' for each in EFFECTS[name].includes),
                              base=name)
    for name in LADDER}
"""Changes of a sensor since its stored calibration; see `accel_calib.refine`. The column ``new``
is 1 for poses taken since then and 0 for the poses of the calibration."""

EMPIRICAL = 'empirical'
"""Name of a smooth curve without a physical cause; see `empirical_name`."""

CARRIERS: dict[str, tuple[str, ...]] = {
    'offset': AXES, 'gain': AXES, 'cross_axis': ('xy', 'xz', 'yz'), 'force': ('all',)}
"""What an empirical curve can change, with the names of its parts. Each part alone is a carrier,
too, such as ``gain.z``. The carrier ``force`` is the common gain of all axes."""

VARIABLES: dict[str, str] = {
    'time': 'time', 'temperature': 'temperature', 'temperature_rate': 'rate of temperature',
    'supply_voltage': 'supply voltage', 'std': 'vibration', 'force': 'force along the axis',
    'direction': 'direction of the force'}
"""Quantities that an empirical curve can be a function of, by column, with their words."""


def variable_words(variable: str) -> str:
    """Return the words of a variable: of `VARIABLES`, a quantity, or a product of two columns."""
    return ' times '.join(VARIABLES.get(column) or column_of(column).meaning
                          for column in variable.split(_TIMES))


_CARRIED = {'offset': by_axis(ONE), 'gain': by_axis(FORCE), 'cross_axis': CROSS, 'force': ALL_AXES}


def empirical_name(carrier: str, variable: str, modes: Iterable[int]) -> str:
    """
    Return the name of an empirical curve: Σ_k c_k cos(k π s) over the modes k, 1 to `MODES`.

    The carrier, one of `CARRIERS` or a part of one, changes with one of `VARIABLES` or a quantity.
    s runs from 0 to 1 over its range in the poses; outside of it, the curve is constant. The
    modes of the variable ``direction`` are degrees of spherical harmonics.

    """
    return '-'.join([EMPIRICAL, carrier, variable, *map(str, modes)])


def curve_pairs(quantities: Iterable[str] = ()) -> Iterator[tuple[str, str]]:
    """Yield the carriers and variables of empirical curves; the quantities are variables, too."""
    for variable in (*VARIABLES, *quantities):
        for carrier in CARRIERS:
            if carrier == {'force': 'offset', 'direction': 'force'}.get(variable, carrier):
                yield carrier, variable


def modes_of(variable: str) -> Sequence[int]:
    """Return the modes that an empirical curve over a variable can have."""
    return DEGREES if variable == 'direction' else range(1, MODES + 1)


def empirical_parts(name: str) -> tuple[str, str, tuple[int, ...]]:
    """Return carrier, variable and modes of an empirical curve; `KeyError` for another name."""
    first, *rest = name.split('-')
    if first != EMPIRICAL or len(rest) < 3 or not all(part.isdecimal() for part in rest[2:]):
        raise KeyError(name)
    modes = tuple(int(part) for part in rest[2:])
    whole, dot, part = rest[0].partition('.')
    pairs = curve_pairs(filter(is_quantity, rest[1:2]))
    if ((whole, rest[1]) not in pairs or (dot and part not in CARRIERS[whole])
            or list(modes) != sorted(set(modes)) or not set(modes) <= set(modes_of(rest[1]))):
        raise KeyError(name)
    return rest[0], rest[1], modes


def _empirical(name: str) -> Effect:
    carrier, variable, modes = empirical_parts(name)
    if variable == 'direction':  # the gain of all axes as a sum of spherical harmonics
        zones = [number for number, zone in enumerate(ZONES) if zone.degree in modes]
        return Effect(
            f'gain as a smooth function of {VARIABLES["direction"]}', 'empirical curve',
            tuple(f'{degree}_{k}' for degree in modes for k in range(1, 2 * degree + 2)), 'g/g',
            0.001, 0.5, tuple(Term(k, axis, ZONAL + 3 * number + axis)
                              for k, number in enumerate(zones) for axis in range(3)),
            family='force')
    whole, _, part = carrier.partition('.')
    parts, of_force = (part,) if part else CARRIERS[whole], variable == 'force'
    carried = [term._replace(parameter=parts.index(own)) for term in _CARRIED[whole]
               if (own := CARRIERS[whole][term.parameter]) in parts]
    terms = tuple(
        term._replace(parameter=k * len(parts) + term.parameter,
                      monomial=WAVE + 3 * (mode - 1) + term.axis if of_force else term.monomial)
        for k, mode in enumerate(modes) for term in carried)
    names = tuple(f'{own}_{mode}' for mode in modes for own in parts)
    words = f'{carrier.replace("_", "-")} as a smooth function of {variable_words(variable)}'
    curve = partial(Effect, words, 'empirical curve', names, 'g', 0.001, 0.5, terms)
    if of_force:
        return curve(family='force')
    return curve(factor=partial(_cosines, variable, modes, len(carried)), needs=(variable,),
                 shape=('low', 'high'), shapes=partial(_ends, variable))


def _variable(variable: str, context: Mapping[str, Any]) -> Floats:
    """Return the variable of an empirical curve; for vectors, its RMS over the axes."""
    values = np.asarray(context[variable], float)
    return np.sqrt(np.mean(values ** 2, axis=-1)) if variable == 'std' else values


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


COVARIATES = {'offset_covariate': ('offset', ONE, 'g/unit'),
              'gain_covariate': ('gain of each axis', FORCE, '1/unit')}
"""What a covariate changes in proportion to a quantity: words, monomial, unit of its values."""

_CURVED, _TIMES = '2', '*'


def covariate_names(quantities: Iterable[str]) -> Iterator[str]:
    """
    Yield the names of the covariates of quantities, such as ``offset_covariate-pressure``.

    It adds k (pressure - zero), by axis, with the mean over the poses as zero. With ``-2`` at the
    end it adds a square, k₂ (pressure - zero)², too.

    """
    for quantity in quantities:
        for kind in COVARIATES:
            yield f'{kind}-{quantity}'
            yield f'{kind}-{quantity}-{_CURVED}'


def product_names(columns: Iterable[str]) -> Iterator[str]:
    """
    Yield the names of covariates of a product, such as ``offset_covariate-humidity*pressure``.

    It adds k (humidity - zero) (pressure - zero), by axis: what neither column does alone.

    """
    for pair in combinations(sorted(columns), 2):
        yield from (f'{kind}-{_TIMES.join(pair)}' for kind in COVARIATES)


def kind_of(name: str) -> str:
    """Return the name of an effect without the variable, for one made from its name."""
    return name.partition('-')[0]


def variable_of(name: str) -> str:
    """Return the variable of an effect made from its name; empty for others."""
    if kind_of(name) == EMPIRICAL:
        return empirical_parts(name)[1]
    return name.split('-')[1] if kind_of(name) in COVARIATES else ''


def _covariate(name: str) -> Effect:
    kind, _, rest = name.partition('-')
    variable, *curved = rest.split('-')
    columns = tuple(variable.split(_TIMES))
    is_product = len(columns) == 2 and columns[0] < columns[1] and all(
        is_quantity(column) or column in CONTEXT for column in columns)
    if not (is_quantity(variable) and curved in ([], [_CURVED])) and not (
            is_product and not curved):
        raise KeyError(name)
    what, monomial, unit = COVARIATES[kind]
    terms = by_axis(monomial)
    names: tuple[str, ...] = AXES
    if curved:
        terms += tuple(term._replace(parameter=3 + term.parameter) for term in terms)
        names += tuple(f'{axis}_square' for axis in AXES)
    return Effect(
        f'{what} that changes with {variable_words(variable)}', f'coefficient of {variable}',
        names, unit, np.inf, 0.5, terms, partial(_departure, columns, bool(curved)), columns,
        tuple(f'zero_{column}' for column in columns) if is_product else ('zero',),
        partial(_means, columns, 3 if curved else 2), (0.0,) * len(columns),
        includes=(f'{kind}-{variable}',) if curved else ())


def _departure(columns: Sequence[str], curved: bool, context: Mapping[str, Any], shape: Floats
               ) -> Any:
    """Return the product of all column - zero; for a curved covariate its square, too."""
    away = math.prod(context[column] - zero for column, zero in zip(columns, shape, strict=True))
    return np.array([away] * 3 + [away ** 2] * 3) if curved else away


def _means(columns: Sequence[str], least: int, context: Context) -> Iterator[Floats]:
    """Yield the means of columns that have at least this number of different values."""
    known = [context[column][np.isfinite(context[column])] for column in columns]
    if all(len(np.unique(values)) >= least for values in known):
        yield np.array([np.mean(values) for values in known])


OWN: dict[str, Effect] = {}
"""Effects of the user that this process knows."""


def is_effect(name: str) -> bool:
    """Return whether an effect has this name."""
    try:
        effect_named(name)
    except KeyError:
        return False
    return True


@cache
def effect_named(name: str) -> Effect:
    """Return the effect with this name: of the catalogue, own, a covariate, or a curve."""
    known = ChainMap(EFFECTS, PROCESSES, CHANGES, OWN)
    if name in known:
        return known[name]
    return _covariate(name) if kind_of(name) in COVARIATES else _empirical(name)


@cache
def parameter_names(effects: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the values of these effects, such as ``offset.x``, in vector order."""
    return tuple(f'{name}.{part}' for name in effects for part in effect_named(name).values)


def included(names: Iterable[str]) -> set[str]:
    """Return the names of the effects that these effects contain."""
    return {each for name in names for each in effect_named(name).includes}


_IN_MILLI = ('g', 'g/g', 'g/g²', 'g/g³', 'g/°C', 'g/°C²', 'g/°C³', 'g/h')
_WITHOUT_UNIT = ('of_sensor', 'form')
"""Constants of a shape that select one of two forms."""


def value_unit(effect_name: str, value_name: str) -> tuple[str, float]:
    """Return the unit of a value of an effect in reports, and the factor from the model's unit."""
    if value_name in _WITHOUT_UNIT:
        return '', 1.0
    effect, variable = effect_named(effect_name), variable_of(effect_name)
    if value_name not in effect.parameters:
        column = value_name.removeprefix('zero_') if _TIMES in variable else variable
        return unit_of(column) if variable else '' if effect.own else 's', 1.0
    unit = curve_unit(effect_name) if kind_of(effect_name) == EMPIRICAL else effect.unit
    if value_name.endswith('_square'):
        unit = f'{unit}²'
    return (f'm{unit}', MG) if unit in _IN_MILLI else (unit, 1.0)


def curve_unit(name: str) -> str:
    """Return the unit of an empirical curve."""
    return 'g' if empirical_parts(name)[0].startswith('offset') else 'g/g'


def unit_of(column: str) -> str:
    """Return the unit of a quantity of the context, with readings in g."""
    return 'g' if column == 'std' else column_of(column).unit
