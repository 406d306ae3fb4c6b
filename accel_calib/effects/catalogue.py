# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The catalogue: one entry for each effect with a known cause."""

from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np

from .form import (
    ALL_AXES, AXES, by_axis, Context, CROSS, CUBE, Effect, EffectKey, Factor, FORCE, matrix_terms,
    ODD_SQUARE, ONE, PRODUCTS, SIZE, SQUARE, Term)
from .thermal import acting_temperature, rate_at
from ..table import Floats
from ..units import STANDARD_GRAVITY

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which the temperature effects are zero [°C], as in data sheets."""

NOMINAL_SUPPLY = 3.3
"""Supply voltage at which `supply_ratio` is zero [V]."""

HOUR = 3600.0

_ROTATION = matrix_terms(((0, 2, 1, 1.0), (0, 1, 2, -1.0), (1, 0, 2, 1.0), (1, 2, 0, -1.0),
                          (2, 1, 0, 1.0), (2, 0, 1, -1.0)))
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


_MEMORIES = (0.25, 0.5, 0.75, 1.0)
"""Parts of a hysteresis that the turn before the last one leaves, to try."""

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


def _lagged_warming(key: str) -> Factor:
    """Return the factor of an effect whose acting temperature is the column `key`."""
    def factor(context: Mapping[str, Any], shape: Floats) -> Any:
        lag, of_sensor = shape
        acting = (acting_temperature(context, key, lag, bool(of_sensor)) if lag
                  else context['temperature'])
        return acting - REFERENCE_TEMPERATURE

    return factor


def _motion(context: Mapping[str, Any], shape: Floats) -> Floats:
    """
    Return the unit vector towards the previous pose, or in form 1 its sign by axis.

    Beside it counts what the turn before it leaves: `memory` times its vector or sign.

    """
    form, memory = shape
    towards, earlier = (np.asarray(context[key], float).T if key in context else 0.0
                        for key in ('previous', 'earlier'))
    last, one_before = (np.sign(way) if form else way for way in (towards, earlier))
    return np.asarray(last + memory * one_before)


def _motions(context: Context) -> Iterator[Floats]:
    """Yield the forms without memory, then with memories if two turns lead to a pose."""
    yield from np.array([[0.0, 0.0], [1.0, 0.0]])
    if np.any(context.get('earlier', 0.0)):
        yield from np.array([*product((0.0, 1.0), _MEMORIES)])


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


def _after(context: Mapping[str, Any], shape: Floats) -> Any:
    return np.asarray(context['time'] >= shape[0], float)


def _centripetal(context: Mapping[str, Any], shape: Floats) -> Floats:
    """
    Return the (9, n) entries of ω×(ω×·) per metre [g], row by row.

    dω/dt×· is left out: poses have none, and the derivative of a measured rate is mostly noise.

    """
    rate = np.asarray(context['rate'], float).T
    squared = np.sum(rate ** 2, axis=0)
    entries = [rate[i] * rate[j] - (squared if i == j else 0.0)
               for i in range(3) for j in range(3)]
    return np.array(entries) / STANDARD_GRAVITY


_bending, _in_time = partial(Effect, family='force'), partial(Effect, family='time')
_LAG = ('lag', 'of_sensor')

EFFECTS: dict[str, Effect] = {
    'offset': Effect('zero-g offset', 'bias K0, zero-g offset', AXES, 'g', 0.1, plausible_g=1.0,
                     repeatable_g=0.03),
    'gain': Effect('one gain for all axes', 'scale factor K1, sensitivity', ('all',), 'g/g', 0.03,
                   terms=ALL_AXES, repeatable_g=0.015),
    'axis_gain': Effect(
        'gain of each axis', 'scale factor K1, sensitivity', AXES, 'g/g', 0.03,
        terms=by_axis(FORCE), includes=('gain',), repeatable_g=0.015),
    'cross_axis': Effect(
        'cross-axis gain, symmetric', 'cross-axis sensitivity', ('xy', 'xz', 'yz'), 'g/g', 0.02,
        terms=CROSS, repeatable_g=0.015),
    'misalignment': Effect(
        'rotation of the sensing axes', 'input-axis misalignment', AXES, 'g/g', 0.02,
        plausible_g=np.inf, terms=_ROTATION, known_orientation=True),
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
        'g/°C', 0.001, factor=_lagged_warming('temperature_of_offset'), needs=('temperature',),
        shape=_LAG, shapes=_lags, usual=(0.0, 0.0), lagged='temperature_of_offset'),
    'offset_temperature_quadratic': _in_time(
        'offset that changes with the square of temperature', 'second-order TCO', AXES, 'g/°C²',
        1e-5, needs=('temperature',),
        factor=lambda context, shape: (context['temperature'] - REFERENCE_TEMPERATURE) ** 2),
    'offset_temperature_cubic': _in_time(
        'offset that changes with the cube of temperature', 'third-order TCO', AXES, 'g/°C³',
        1e-7, needs=('temperature',),
        factor=lambda context, shape: (context['temperature'] - REFERENCE_TEMPERATURE) ** 3),
    'gain_temperature': _in_time(
        'gain that changes with temperature', 'sensitivity temperature coefficient TCS', AXES,
        '1/°C', 0.0003, terms=by_axis(FORCE), factor=_lagged_warming('temperature_of_gain'),
        needs=('temperature',), shape=_LAG, shapes=_lags, usual=(0.0, 0.0),
        lagged='temperature_of_gain'),
    'temperature_rate': _in_time(
        'offset in proportion to the rate of the temperature', 'thermal gradient sensitivity',
        AXES, 'g·s/°C', 0.02, factor=lambda context, shape: rate_at(context),
        needs=('time', 'temperature'), over=('temperature_rate',)),
    'supply_ratio': Effect(
        'offset and gain in proportion to the supply', 'ratiometric output', ('gain', *AXES),
        'g/g', 1.0, plausible_g=1.0, terms=_SUPPLY, needs=('supply_voltage',), scales=True,
        factor=lambda context, shape: context['supply_voltage'] / NOMINAL_SUPPLY - 1.0),
    'offset_drift': _in_time(
        'offset that drifts with time', 'bias drift', AXES, 'g/h', 0.0005, factor=_since,
        needs=('time',), shape=('start',), shapes=_from_start),
    'warm_up': _in_time(
        'offset that settles after power-on', 'turn-on transient', AXES, 'g', 0.005,
        needs=('time',), shape=('start', 'tau'), shapes=_taus, factor=lambda context, shape:
        np.exp(-np.maximum(context['time'] - shape[0], 0.0) / max(shape[1], 1e-9))),
    'offset_step': _in_time(
        'offset that jumps at an instant', 'bias shift after shock', AXES, 'g', 0.005,
        factor=_after, needs=('time',), shape=('instant',), shapes=_instants),
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
        'g/g²', 0.002, needs=('std',),
        factor=lambda context, shape: np.asarray(context['std'], float).T ** 2),
    'hysteresis': Effect(
        'offset that depends on the previous pose', 'hysteresis', AXES, 'g', 0.001,
        factor=_motion, needs=('previous',), shape=('form', 'memory'), shapes=_motions,
        usual=(0.0, 0.0)),
    'creep': Effect(
        'offset that relaxes after a turn', 'creep', AXES, 'g', 0.001, factor=_creep,
        needs=('time', 'previous'), shape=('tau',), shapes=_relaxations, over=('since_turn',)),
    'lever_arm': Effect(
        'centripetal force away from the axis of rotation', 'size effect', AXES, 'm', 0.1,
        plausible_g=5.0, terms=_LEVER, factor=_centripetal, needs=('rate',)),
    'saturation': Effect(
        'readings clipped at a limit', 'full-scale range', ('limit',), 'g', 2.0,
        plausible_g=np.inf, terms=(),
        output=lambda reading, limit: np.clip(reading, -limit[0], limit[0])),
    'quantisation': Effect(
        'readings on a grid', 'resolution', ('step',), 'g', 0.001, plausible_g=np.inf, terms=(),
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
"""Random processes. `accel_calib.refinement` names them; a model cannot contain them."""

LADDER = ('offset', 'gain', 'axis_gain', 'cross_axis', 'misalignment')
"""The effects that make up V and W. Every sensor has them; models 4 to 12 consist of them."""

CHANGES: dict[str, Effect] = {
    f'{name}_change': replace(EFFECTS[name], words=f'change of the {EFFECTS[name].words}',
                              factor=lambda context, shape: context['new'], needs=('new',),
                              includes=tuple(f'{each}_change' for each in EFFECTS[name].includes),
                              base=name)
    for name in LADDER}
"""Changes of a sensor since its stored calibration; see `accel_calib.refinement`. The column
``new`` is 1 for poses taken since then and 0 for the poses of the calibration."""

CATALOGUE: Mapping[str, Effect] = ChainMap(EFFECTS, PROCESSES, CHANGES)
"""All effects with a name."""


def entry_of(effect: EffectKey) -> Effect:
    """Return the entry of an effect; KeyError for a name that the catalogue lacks."""
    return CATALOGUE[effect] if isinstance(effect, str) else effect.entry


class ParameterName(str):
    """The name of a value of an effect, such as ``offset.x``, which keeps the effect."""

    effect: EffectKey

    @classmethod
    def of(cls, effect: EffectKey, part: str) -> 'ParameterName':
        made = cls(f'{effect}.{part}')
        made.effect = effect
        return made


@lru_cache(maxsize=512)
def parameter_names(effects: tuple[EffectKey, ...]) -> tuple[str, ...]:
    """Return the names of the values of these effects, in vector order."""
    return tuple(ParameterName.of(effect, part)
                 for effect in effects for part in entry_of(effect).values)


def included(effects: Iterable[EffectKey]) -> set[EffectKey]:
    """Return the effects that these effects contain."""
    return {each for effect in effects for each in entry_of(effect).includes}


@dataclass(frozen=True)
class ModelForm:
    """
    One of the models that consist of offset and gains.

    W has `gains` parameters, apart from a rotation. `norm` is the model with the same ellipsoid
    that |force| = 1 g alone determines. Poses of `known_orientation` determine the axes of W; with
    `sensing_axes`, they are fixed to the sensing axes.

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


def linear_values(mat_w: Floats, vec_v: Floats) -> dict[str, Floats]:
    """Return the values of the effects of `LADDER` from W (3, 3) and V (3,) [g]."""
    symmetric, skew = (mat_w + mat_w.T) / 2, (mat_w - mat_w.T) / 2
    return {'offset': np.array(vec_v, float), 'gain': np.array([np.trace(mat_w) / 3.0 - 1.0]),
            'axis_gain': np.diag(mat_w) - 1.0, 'cross_axis': symmetric[[0, 0, 1], [1, 2, 2]],
            'misalignment': skew[[2, 0, 1], [1, 2, 0]]}
