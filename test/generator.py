# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A simulator of a still accelerometer that shares no code with the package.

The results of the package are tested with this simulator. It is therefore independent: it is based
only on the table of effects, and uses only numpy. A set of poses is simulated sample by sample:
the true specific force u in the sensor axes, the common errors V + W u, the contributions of the
hidden effects, the vibration of each sample, and the limits and the grid of the output. Then mean
and standard deviation of the samples of each pose are computed. Temperature, supply, time, rate
and variance are always recorded, also if they have no effect.

Forces are in g, and up is positive. The columns are those of a pose table in m/s², with rad/s, °C,
V and s.

The size of an effect
---------------------
Common errors absorb a part of each effect. The size of an effect is the rest of its contribution
to |a| after a least squares fit of the 9 free parameters of V and symmetric W, relative to the
noise of each pose mean in |a|, RMS over the poses. The values of the effects are scaled to the
requested size. There are two exceptions. For quantisation, the error in g is that of another
effect of the requested size, but the sample noise is small compared with the step, so the size is
larger. Saturation clips at least `LEAST_CLIPPED` poses, even if the size is then larger.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

STANDARD_GRAVITY = 9.80665
REFERENCE_TEMPERATURE = 25.0
NOMINAL_SUPPLY = 3.3
HOUR = 3600.0

LEAST_CLIPPED = 3
"""Smallest number of clipped poses; a single clipped pose looks like an outlier."""

QUIET_STEP = 20.0
"""Ratio of the step of a coarse grid to the sample noise."""

PAIRS = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Axes i, j of cross coupling: k u_i u_j is added to axis i."""

OUTSIDE = ('ripple', 'temperature_rate', 'periodic_offset', 'repeatability')
"""Effects that can be hidden but are not in the catalogue."""


@dataclass(frozen=True)
class Setup:
    """
    Settings of the simulation of a set.

    Parameters
    ----------
    poses, samples : int
        Number of poses, and of samples per pose.
    noise_mg, step_mg : float
        Smallest standard deviation of the samples of an axis, and step of the output [mg].
    shaking : float
        Largest ratio of the standard deviation of the samples to the smallest one.
    temperature : {'wandering', 'rising'}
        Course of the temperature.
    rates : {'any', 'small', 'sizeable'}
        Angular rates; any: one of the others. They are sizeable if a lever arm is hidden.
    hysteresis : {'unit', 'sign', 'previous'}
        Quantity to which hysteresis is proportional, by axis: the unit vector from the present
        force to the previous one, the sign of this difference, or the previous force.
    start : float
        Time of the first pose [s].
    knocked : int
        Number of poses with an error of 10 to 50 mg.
    dropped : tuple of str
        Columns that the table does not have.

    """

    poses: int = 60
    samples: int = 100
    noise_mg: float = 3.0
    step_mg: float = 0.1
    shaking: float = 4.0
    temperature: str = 'wandering'
    rates: str = 'any'
    hysteresis: str = 'unit'
    start: float = 0.0
    knocked: int = 0
    dropped: tuple[str, ...] = ()


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
    temperature, supply : (n,) array
        Temperature [°C] and supply [V].
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


@dataclass(frozen=True)
class Simulated:
    """
    A set of poses and the truth about it.

    Parameters
    ----------
    columns : mapping of str to (n,) array
        Columns of the pose table.
    truth : mapping of str to mapping of str to float
        Values of each hidden effect: g, g/g, g/g², g/g³, g/°C, 1/°C, g/h, m, s.
    sizes : mapping of str to float
        Size of each hidden effect.
    knocked : mapping of int to float
        Rows of knocked poses, 1-based, and the error of |a| by the knock [g].
    noise : (n,) array
        Standard deviation of the pose mean in |a| [g].
    around : Around
        The truth about each pose.
    traits : Traits
        The truth about the sensor.
    values : mapping of str to (p,) array
        Values of each hidden effect in the order of `basis`; limit or step of an effect on the
        output.
    setup : Setup
        Settings of the simulation.

    """

    columns: Mapping[str, Floats]
    truth: Mapping[str, Mapping[str, float]]
    sizes: Mapping[str, float]
    knocked: Mapping[int, float]
    noise: Floats
    around: Around
    traits: Traits
    values: Mapping[str, Floats]
    setup: Setup


def simulate(rng: np.random.Generator, hidden: Mapping[str, float] | None = None,
             setup: Setup = Setup()) -> Simulated:
    """
    Return simulated poses of a random sensor.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of all random numbers.
    hidden : mapping of str to float
        Sizes of the hidden effects, by name in `EFFECTS`.
    setup : Setup
        Settings of the simulation.

    Returns
    -------
    Simulated
        The pose table and the truth.

    """
    hidden = hidden or {}
    turning = 'lever_arm' in hidden or setup.rates == 'sizeable'
    around = _around(rng, setup, turning)
    traits = _traits(rng, setup, around.elapsed)
    values: dict[str, Floats] = {}
    if 'quantisation' in hidden:
        typical = float(np.median(noise_in_norm(around, traits)))
        values['quantisation'] = np.array([hidden['quantisation'] * np.sqrt(12.0) * typical])
        quiet = float(values['quantisation'][0] / QUIET_STEP / np.sqrt(np.mean(around.sigma ** 2)))
        around = replace(around, shaking=around.shaking * quiet, sigma=around.sigma * quiet)
    for name in hidden:
        if name in EFFECTS and name not in ON_OUTPUT:
            values[name] = _scaled(rng, name, hidden[name], around, traits)
    if 'saturation' in hidden:
        values['saturation'] = _rail(hidden['saturation'], values, around, traits)
    unknown = set(hidden) - set(values)
    if unknown:
        raise ValueError(f'hidden effects {unknown}, expected some of {list(EFFECTS)}')
    return _measured(rng, setup, around, traits, values)


def again(rng: np.random.Generator, before: Simulated) -> Simulated:
    """
    Return other poses of the same sensor, at the same times and temperatures.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of all random numbers.
    before : Simulated
        The set to repeat in other orientations, without knocks.

    """
    setup = replace(before.setup, knocked=0)
    turning = bool(np.max(np.abs(before.around.rate)) > 0.1)
    fresh = _around(rng, replace(setup, rates='sizeable' if turning else 'small'), turning)
    ratio = float(np.mean(before.around.sigma) / np.mean(fresh.sigma))
    quiet = ratio if 'quantisation' in before.values else 1.0
    spread = float(np.std(before.around.supply) / np.std(fresh.supply))
    around = replace(fresh, elapsed=before.around.elapsed, temperature=before.around.temperature,
                     supply=NOMINAL_SUPPLY + spread * (fresh.supply - NOMINAL_SUPPLY),
                     shaking=quiet * fresh.shaking, sigma=quiet * fresh.sigma)
    return _measured(rng, setup, around, before.traits, before.values)


def write_csv(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write a pose table."""
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0)


def _around(rng: np.random.Generator, setup: Setup, turning: bool) -> Around:
    """Return random orientation, time and context of each pose."""
    n = setup.poses
    force = _unit(rng.normal(size=(n, 3)))
    elapsed = np.cumsum(rng.uniform(10.0, 60.0, n))
    elapsed = elapsed - elapsed[0]
    temperature = _temperature(rng, elapsed / elapsed[-1], setup.temperature == 'rising')
    supply = rng.uniform(3.0, 3.6, n)
    turning = turning or (bool(rng.integers(2)) and setup.rates == 'any')
    real = _unit(rng.normal(size=(n, 3))) * rng.uniform(1.0, 5.0, (n, 1))
    rate = rng.normal(size=(n, 3)) * 0.002 + real * turning
    sigma = setup.noise_mg * 1e-3 * setup.shaking ** rng.uniform(size=(n, 3))
    shaking = rng.normal(size=(n, 3, setup.samples)) * sigma[:, :, np.newaxis]
    return Around(force, elapsed, temperature, supply, rate, shaking, sigma)


def _temperature(rng: np.random.Generator, share: Floats, rising: bool) -> Floats:
    """Return random temperatures between 10 and 40 °C at these shares of the time span."""
    waves = rng.uniform(1.5, 5.0, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = np.sum(np.sin(2.0 * np.pi * np.outer(share, waves) + phases), axis=1)
    bend, low, span = rng.uniform(0.5, 3.0), rng.uniform(10.0, 20.0), rng.uniform(10.0, 19.0)
    if rising:
        rise = low + span * (1.0 - np.exp(-bend * share)) / (1.0 - np.exp(-bend))
        return np.sort(rise + 0.1 * wave)
    return 10.0 + 30.0 * (wave - np.min(wave)) / np.ptp(wave)


def _traits(rng: np.random.Generator, setup: Setup, elapsed: Floats) -> Traits:
    """Return the random properties of a sensor."""
    n, span = len(elapsed), elapsed[-1]
    gain = np.eye(3) + np.diag(rng.normal(size=3) * 0.02)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        gain[i, j] = gain[j, i] = rng.normal() * 0.01
    late = rng.integers(int(np.ceil(0.2 * n)), int(0.8 * n) + 1)
    walk = np.cumsum(rng.normal(size=(n, 3)) * np.sqrt(np.diff(elapsed, prepend=0.0))[:, None],
                     axis=0)
    return Traits(rng.normal(size=3) * 0.05, gain, rng.uniform(0.05, 0.4) * span,
                  float(elapsed[late - 1:late + 1].mean()), rng.uniform(0.1, 0.3) * span,
                  rng.uniform(0.2, 0.6, 3), rng.uniform(0.0, 2.0 * np.pi, 3), walk,
                  rng.normal(size=(n, 3)), setup.hysteresis)


def _by_axis(shape: Callable[[Around, Traits], Floats]) -> Callable[[Around, Traits], Floats]:
    """Return the (n, 3, 3) basis of an (n, 3) shape, with one value per axis."""
    def basis(around: Around, traits: Traits) -> Floats:
        return shape(around, traits)[:, :, np.newaxis] * np.eye(3)

    return basis


def _same(series: Callable[[Around, Traits], Floats]) -> Callable[[Around, Traits], Floats]:
    """Make (n, 3, 3) of an (n,) series that adds to each axis whatever the force."""
    return _by_axis(lambda a, t: np.repeat(series(a, t)[:, np.newaxis], 3, axis=1))


def _coupling(around: Around, traits: Traits) -> Floats:
    u = around.force
    basis = np.zeros((len(u), 3, len(PAIRS)))
    for k, (i, j) in enumerate(PAIRS):
        basis[:, i, k] = u[:, i] * u[:, j]
    return basis


def _ratiometric(around: Around, traits: Traits) -> Floats:
    plain = plain_reading(around, traits)
    return (plain * (around.supply / NOMINAL_SUPPLY - 1.0)[:, np.newaxis])[:, :, np.newaxis]


def _hysteresis(around: Around, traits: Traits) -> Floats:
    u = around.force
    before = np.vstack([u[:1], u[:-1]])
    shapes = {'unit': _unit(before - u), 'sign': np.sign(before - u),
              'previous': np.where(np.arange(len(u))[:, np.newaxis] > 0, before, 0.0)}
    return shapes[traits.hysteresis]


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
    'offset_temperature': _same(lambda a, t: a.temperature - REFERENCE_TEMPERATURE),
    'gain_temperature': _by_axis(
        lambda a, t: a.force * (a.temperature - REFERENCE_TEMPERATURE)[:, np.newaxis]),
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
    'ripple': _by_axis(lambda a, t: np.sin(2.0 * np.pi * a.force / t.period + t.phase)),
    'temperature_rate': _same(lambda a, t: np.gradient(a.temperature, a.elapsed)),
    'periodic_offset': _same(
        lambda a, t: np.sin(2.0 * np.pi * a.elapsed / t.beat + t.phase[0])),
    'repeatability': _by_axis(lambda a, t: t.scatter),
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


def noise_in_norm(around: Around, traits: Traits) -> Floats:
    """Return the (n,) standard deviations of |a| of the pose means [g]."""
    rows = around.force @ np.linalg.inv(traits.gain)
    return np.linalg.norm(rows * around.sigma, axis=1) / np.sqrt(around.shaking.shape[2])


def size_of(added: Floats, around: Around, traits: Traits) -> float:
    """
    Return the size of an effect.

    Parameters
    ----------
    added : (n, 3) array
        Contribution of the effect to the mean readings [g].
    around, traits : Around, Traits
        The poses and the sensor.

    """
    u = around.force
    shift = np.linalg.norm(u + added @ np.linalg.inv(traits.gain).T, axis=1) - 1.0
    design = np.hstack([u, u ** 2, u[:, [0, 0, 1]] * u[:, [1, 2, 2]]])
    noise = noise_in_norm(around, traits)
    weighted = shift / noise
    design = design / noise[:, np.newaxis]
    left = weighted - design @ np.linalg.lstsq(design, weighted, rcond=None)[0]
    return float(np.sqrt(np.mean(left ** 2)))


def _scaled(rng: np.random.Generator, name: str, wanted: float, around: Around,
            traits: Traits) -> Floats:
    """Return random values of an effect, scaled to a size."""
    basis = basis_of(name, around, traits)
    values = rng.normal(size=basis.shape[2]) * 1e-3 / np.sqrt(np.mean(basis ** 2))
    for _ in range(6):
        values = values * wanted / size_of(basis @ values, around, traits)
    return values


def _samples(values: Mapping[str, Floats], around: Around, traits: Traits) -> Floats:
    """Return the (n, 3, samples) output before limits and grid [g]."""
    reading = plain_reading(around, traits)
    for name, value in values.items():
        if name not in ON_OUTPUT:
            reading = reading + basis_of(name, around, traits) @ value
    return reading[:, :, np.newaxis] + around.shaking


def _rail(wanted: float, values: Mapping[str, Floats], around: Around,
          traits: Traits) -> Floats:
    """Return the (1,) limit at which saturation has a size [g]."""
    samples = _samples(values, around, traits)
    farthest = np.sort(np.max(np.abs(np.mean(samples, axis=2)), axis=1))
    low, high = 0.5, float(farthest[-1 - LEAST_CLIPPED])
    for _ in range(30):
        rail = (low + high) / 2.0
        lost = np.mean(np.clip(samples, -rail, rail) - samples, axis=2)
        low, high = (rail, high) if size_of(lost, around, traits) > wanted else (low, rail)
    return np.array([(low + high) / 2.0])


def _measured(rng: np.random.Generator, setup: Setup, around: Around, traits: Traits,
              values: Mapping[str, Floats]) -> Simulated:
    """Return the set of the averaged samples."""
    samples = _samples(values, around, traits)
    rows = np.sort(rng.choice(setup.poses, setup.knocked, replace=False))
    knocks = _unit(rng.normal(size=(len(rows), 3))) * rng.uniform(0.01, 0.05, (len(rows), 1))
    samples[rows] += knocks[:, :, np.newaxis]
    added = np.linalg.norm(around.force[rows] + knocks @ np.linalg.inv(traits.gain).T, axis=1)
    rail = float(values['saturation'][0]) if 'saturation' in values else np.inf
    step = float(values['quantisation'][0]) if 'quantisation' in values else setup.step_mg * 1e-3
    output = np.clip(np.round(samples / step) * step, -rail, rail)
    return Simulated(
        _columns(output, around, setup), {name: _named(name, values[name], traits)
                                          for name in values},
        {name: _size(name, values, around, traits) for name in values},
        dict(zip((rows + 1).tolist(), (added - 1.0).tolist(), strict=True)),
        noise_in_norm(around, traits), around, traits, values, setup)


def _size(name: str, values: Mapping[str, Floats], around: Around, traits: Traits) -> float:
    """Return the size of a hidden effect."""
    if name not in ON_OUTPUT:
        return size_of(basis_of(name, around, traits) @ values[name], around, traits)
    samples, limit = _samples(values, around, traits), float(values[name][0])
    output = (np.clip(samples, -limit, limit) if name == 'saturation'
              else np.round(samples / limit) * limit)
    return size_of(np.mean(output - samples, axis=2), around, traits)


def _named(name: str, values: Floats, traits: Traits) -> dict[str, float]:
    """Return the values of an effect with the names and units of the catalogue."""
    if name == 'supply_ratio':  # W u is about its mean gain times u
        parts = np.array([np.trace(traits.gain) / 3.0, *traits.offset]) * values[0]
        return dict(zip(('gain', 'x', 'y', 'z'), parts.tolist(), strict=True))
    names = {'cross_coupling': tuple(f'{"xyz"[i]}_{"xyz"[i]}{"xyz"[j]}' for i, j in PAIRS),
             'saturation': ('limit',), 'quantisation': ('step',)}
    factor = HOUR if name == 'offset_drift' else 1.0
    named = dict(zip(names.get(name, ('x', 'y', 'z')), (values * factor).tolist(), strict=True))
    more = {'warm_up': {'tau': traits.tau}, 'offset_step': {'instant': traits.instant}}
    return {**named, **more.get(name, {})}


def _columns(output: Floats, around: Around, setup: Setup) -> dict[str, Floats]:
    """Return the columns of the pose table."""
    mean = np.mean(output, axis=2) * STANDARD_GRAVITY
    std = np.std(output, axis=2, ddof=1) * STANDARD_GRAVITY
    columns = {'time': np.round(setup.start + around.elapsed, 3)}
    columns.update(zip(('ax', 'ay', 'az'), mean.T))
    columns.update(zip(('std_x', 'std_y', 'std_z'), std.T))
    columns['count'] = np.full(setup.poses, float(setup.samples))
    columns['temperature'] = np.round(around.temperature, 2)
    columns['supply_voltage'] = np.round(around.supply, 4)
    columns.update(zip(('gx', 'gy', 'gz'), np.round(around.rate, 5).T))
    return {name: column for name, column in columns.items() if name not in setup.dropped}
