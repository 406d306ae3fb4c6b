# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The effects that the independent simulator can hide: what each adds to the readings.

An effect is a basis: the (n, 3, p) derivative of the readings by its p values, at the true force
and context of each pose. `OUTSIDE` lists the effects that the catalogue of the package does not
have. This module shares no code with the package either.

"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

STANDARD_GRAVITY = 9.80665
REFERENCE_TEMPERATURE = 25.0
NOMINAL_SUPPLY = 3.3
HOUR = 3600.0

PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Axes i, j of cross coupling: k u_i u_j is added to axis i."""

COUPLES = ((0, 1), (0, 2), (1, 2))
"""Axes i, j of symmetric cross-axis gain: k u_j is added to axis i, and k u_i to axis j."""

STEEP = 1.5
"""Width of the change of offset or gain at a knee [°C]."""

OUTSIDE = ('ripple', 'periodic_offset', 'repeatability', 'quartic', 'quintic', 'dead_zone',
           'gain_temperature_quadratic', 'gain_temperature_steep', 'cross_axis_temperature',
           'gain_periodic', 'offset_temperature_knee', 'offset_supply_quadratic', 'wander_1f',
           'oblique_cubic', 'oblique_hinge')
"""Effects that can be hidden but are not in the catalogue."""


@dataclass(frozen=True)
class Around:
    """
    The truth about each pose; arrays of n rows.

    Parameters
    ----------
    force : (n, 3) array
        u [g].
    elapsed : (n,) array
        Time since the first pose [s].
    temperature, recorded : (n,) array
        Temperature of the sensing element, and of the thermometer [°C].
    warming : (n,) array
        Rate of the temperature of the sensing element [°C/s].
    supply : (n,) array
        Supply [V].
    rate : (n, 3) array
        Angular rate [rad/s].
    shaking : (n, 3, samples) array
        Contribution of vibration and noise to each sample [g].
    sigma : (n, 3) array
        Standard deviation of this contribution [g].

    """

    force: Floats
    elapsed: Floats
    temperature: Floats
    recorded: Floats
    warming: Floats
    supply: Floats
    rate: Floats
    shaking: Floats
    sigma: Floats


@dataclass(frozen=True)
class Traits:
    """
    Random properties of a sensor and a set, except for the values of the effects.

    Parameters
    ----------
    offset, gain : (3,) and (3, 3) array
        V [g] and W.
    tau, instant, beat : float
        Time constant of the warm-up, instant of the step, period of the periodic offset [s].
    period, phase : (3,) array
        Period [g] and phase [rad] of the ripple, by axis.
    walk, scatter : (n, 3) array
        Random walk in time, and random numbers for each pose.
    hysteresis : str
        As in `Setup.hysteresis`.
    width : (3,) array
        Width of the dead zone [g], by axis.
    knee : float
        Temperature above which the gain changes, and at which the offset changes [°C].
    gain_instant, gain_beat : float
        Instant of the step and period of the periodic part of the gain [s].
    flicker : (n, 3) array
        1/f noise in time.
    oblique : (3,) array
        Unit vector along which the oblique effects are a function of the force.
    relaxation, memory : float
        Time constant of the creep [s], and part of a hysteresis that the turn before the last one
        leaves.

    """

    offset: Floats
    gain: Floats
    tau: float
    instant: float
    beat: float
    period: Floats
    phase: Floats
    walk: Floats
    scatter: Floats
    hysteresis: str
    width: Floats
    knee: float
    gain_instant: float
    gain_beat: float
    flicker: Floats
    oblique: Floats
    relaxation: float
    memory: float


def unit(vectors: Floats) -> Floats:
    """Return (…, 3) vectors with length 1; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def _by_axis(shape: Callable[[Around, Traits], Floats]) -> Callable[[Around, Traits], Floats]:
    """Return the (n, 3, 3) basis of an (n, 3) shape, with one value per axis."""
    def basis(around: Around, traits: Traits) -> Floats:
        return shape(around, traits)[:, :, np.newaxis] * np.eye(3)

    return basis


def _same(series: Callable[[Around, Traits], Floats]) -> Callable[[Around, Traits], Floats]:
    """Make (n, 3, 3) of an (n,) series that adds to each axis whatever the force."""
    return _by_axis(lambda a, t: np.repeat(series(a, t)[:, np.newaxis], 3, axis=1))


def _of_gain(series: Callable[[Around, Traits], Floats]) -> Callable[[Around, Traits], Floats]:
    """Make (n, 3, 3) of an (n,) series that the gain of each axis follows."""
    return _by_axis(lambda a, t: a.force * series(a, t)[:, np.newaxis])


def _warm(around: Around) -> Floats:
    return around.temperature - REFERENCE_TEMPERATURE


def _coupling(around: Around, traits: Traits) -> Floats:
    u = around.force
    basis = np.zeros((len(u), 3, len(PAIRS)))
    for k, (i, j) in enumerate(PAIRS):
        basis[:, i, k] = u[:, i] * u[:, j]
    return basis


def _cross_axis_temperature(around: Around, traits: Traits) -> Floats:
    u, warm = around.force, _warm(around)
    basis = np.zeros((len(u), 3, len(COUPLES)))
    for k, (i, j) in enumerate(COUPLES):
        basis[:, i, k] = u[:, j] * warm
        basis[:, j, k] = u[:, i] * warm
    return basis


def _ratiometric(around: Around, traits: Traits) -> Floats:
    plain = plain_reading(around, traits)
    return (plain * (around.supply / NOMINAL_SUPPLY - 1.0)[:, np.newaxis])[:, :, np.newaxis]


def _hysteresis(around: Around, traits: Traits) -> Floats:
    u = around.force
    before = np.vstack([u[:1], u[:-1]])
    way = unit(before - u)
    shapes = {'unit': way, 'sign': np.sign(before - u),
              'memory': way + traits.memory * np.vstack([np.zeros(3), way[:-1]])}
    return shapes[traits.hysteresis]


def _creep(around: Around, traits: Traits) -> Floats:
    """Return what is left of the relaxation since the pose before, along the way from it."""
    u, since = around.force, np.diff(around.elapsed, prepend=0.0)
    way = unit(np.vstack([u[:1], u[:-1]]) - u)
    return way * np.exp(-since / traits.relaxation)[:, np.newaxis]


def _centripetal(around: Around, traits: Traits) -> Floats:
    omega = around.rate[:, np.newaxis, :]
    added: Floats = np.cross(omega, np.cross(omega, np.eye(3)))
    return np.swapaxes(added, 1, 2) / STANDARD_GRAVITY


EFFECTS: dict[str, Callable[[Around, Traits], Floats] | None] = {
    'quadratic': _by_axis(lambda a, t: a.force ** 2),
    'cubic': _by_axis(lambda a, t: a.force ** 3),
    'odd_quadratic': _by_axis(lambda a, t: a.force * np.abs(a.force)),
    'gain_asymmetry': _by_axis(lambda a, t: np.abs(a.force)),
    'cross_coupling': _coupling,
    'offset_temperature': _same(lambda a, t: _warm(a)),
    'gain_temperature': _of_gain(lambda a, t: _warm(a)),
    'supply_ratio': _ratiometric,
    'offset_drift': _same(lambda a, t: a.elapsed),
    'warm_up': _same(lambda a, t: np.exp(-a.elapsed / t.tau)),
    'offset_wander': _by_axis(lambda a, t: t.walk),
    'offset_step': _same(lambda a, t: np.where(a.elapsed > t.instant, 1.0, 0.0)),
    'vibration_rectification': _by_axis(lambda a, t: np.var(a.shaking, axis=2, ddof=1)),
    'hysteresis': _by_axis(_hysteresis),
    'lever_arm': _centripetal,
    'saturation': None,
    'quantisation': None,
    'temperature_rate': _same(lambda a, t: a.warming),
    'offset_temperature_quadratic': _same(lambda a, t: _warm(a) ** 2),
    'gain_drift': _of_gain(lambda a, t: a.elapsed),
    'gain_step': _of_gain(lambda a, t: np.where(a.elapsed > t.gain_instant, 1.0, 0.0)),
    'ripple': _by_axis(lambda a, t: np.sin(2.0 * np.pi * a.force / t.period + t.phase)),
    'periodic_offset': _same(
        lambda a, t: np.sin(2.0 * np.pi * a.elapsed / t.beat + t.phase[0])),
    'repeatability': _by_axis(lambda a, t: t.scatter),
    'quartic': _by_axis(lambda a, t: a.force ** 4),
    'quintic': _by_axis(lambda a, t: a.force ** 5),
    'dead_zone': _by_axis(lambda a, t: -a.force * np.exp(-(a.force / t.width) ** 2)),
    'gain_temperature_quadratic': _of_gain(lambda a, t: _warm(a) ** 2),
    'gain_temperature_steep': _of_gain(
        lambda a, t: STEEP * np.logaddexp(0.0, (a.temperature - t.knee) / STEEP)),
    'cross_axis_temperature': _cross_axis_temperature,
    'gain_periodic': _of_gain(
        lambda a, t: np.sin(2.0 * np.pi * a.elapsed / t.gain_beat + t.phase[1])),
    'offset_temperature_knee': _same(lambda a, t: np.tanh((a.temperature - t.knee) / STEEP)),
    'offset_supply_quadratic': _same(lambda a, t: (a.supply / NOMINAL_SUPPLY - 1.0) ** 2),
    'wander_1f': _by_axis(lambda a, t: t.flicker),
    'oblique_cubic': _same(lambda a, t: (a.force @ t.oblique) ** 3),
    'oblique_hinge': _same(lambda a, t: np.maximum(a.force @ t.oblique, 0.0)),
    'creep': _by_axis(_creep),
}
"""The (n, 3, p) basis of each effect with p values; None for effects on the output."""

ON_OUTPUT = ('saturation', 'quantisation')


def plain_reading(around: Around, traits: Traits) -> Floats:
    """Return the (n, 3) readings V + W u [g]."""
    return traits.offset + around.force @ traits.gain.T


def basis_of(name: str, around: Around, traits: Traits) -> Floats:
    """Return the (n, 3, p) derivative of the reading by the values of an effect [g]."""
    shape = EFFECTS[name]
    if shape is None:
        raise ValueError(f'{name} acts on the output')
    return shape(around, traits)
