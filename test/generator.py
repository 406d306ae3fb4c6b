# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A simulator of a still accelerometer that shares no code with the package.

The results of the package are tested with this simulator. It is therefore independent: it is based
only on the table of effects (`generator_effects`), and uses only numpy. A set of poses is
simulated sample by sample: the true specific force u in the sensor axes, the common errors
V + W u, the contributions of the hidden effects, the vibration of each sample, and the limits and
the grid of the output. Then mean and standard deviation of the samples of each pose are computed.
Temperature, supply, time, rate and variance are always recorded, also if they have no effect.

Forces are in g, and up is positive. The columns are those of a pose table in m/s², with rad/s, °C,
V and s.

The size of an effect
---------------------
Common errors absorb a part of each effect. The size of an effect is the rest of its contribution
to |a| after a least squares fit of the 9 free parameters of V and symmetric W, relative to the
noise of each pose mean in |a|, RMS over the poses. The values of the effects are scaled to the
requested size. There are two exceptions. For quantisation, the error in g is that of another
effect of the requested size, but the sample noise is small compared with the step, so the size is
larger. Saturation clips at least `LEAST_CLIPPED` poses, even if the size is then larger. The noise
is that of the samples, also if the poses repeat worse (`Setup.understated`).
"""

from collections.abc import Callable, Mapping
import csv
from dataclasses import dataclass, replace
from pathlib import Path

from generator_effects import (
    Around, basis_of, EFFECTS, Floats, HOUR, NOMINAL_SUPPLY, ON_OUTPUT, OUTSIDE, PAIRS,
    plain_reading, STANDARD_GRAVITY, Traits, unit)
import numpy as np

__all__ = ['again', 'Around', 'basis_of', 'EFFECTS', 'measure', 'ON_OUTPUT', 'OUTSIDE', 'Setup',
           'simulate', 'Simulated', 'STANDARD_GRAVITY', 'write_csv']

LEAST_CLIPPED = 3
"""Smallest number of clipped poses; a single clipped pose looks like an outlier."""

QUIET_STEP = 20.0
"""Ratio of the step of a coarse grid to the sample noise."""

DEGREES = 3.0
"""Degrees of freedom of the heavy-tailed errors of the poses."""

_STEPS = 40
"""Largest number of steps in which the values are scaled; very large effects need damped steps."""

_TONES = 64
"""Number of frequencies of the 1/f noise; they are evenly spread over the octaves."""


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
    hysteresis : {'unit', 'sign', 'memory'}
        Quantity to which hysteresis is proportional, by axis: the unit vector from the present
        force to the previous one, the sign of this difference, or the unit vector and a part of
        that of the turn before.
    knocked : int
        Number of poses with an error of 10 to 50 mg.
    dropped : tuple of str
        Columns that the table does not have.
    lag : float
        Time constant between the temperatures of the sensing element and of the thermometer [s].
        Positive: the thermometer lags behind. Negative: the sensing element lags behind.
    understated : float
        Ratio of the scatter of repeated poses to that of the means of their samples, 1 or more.
    heavy : bool
        Whether the errors of the pose means follow Student's t instead of the normal
        distribution, with the same variance.
    repeats : int
        Number of successive poses with the same orientation.

    """

    poses: int = 60
    samples: int = 100
    noise_mg: float = 3.0
    step_mg: float = 0.1
    shaking: float = 4.0
    temperature: str = 'wandering'
    rates: str = 'any'
    hysteresis: str = 'unit'
    knocked: int = 0
    dropped: tuple[str, ...] = ()
    lag: float = 0.0
    understated: float = 1.0
    heavy: bool = False
    repeats: int = 1


@dataclass(frozen=True)
class Simulated:
    """
    A set of poses and the truth about it.

    Parameters
    ----------
    columns : mapping of str to (n,) array
        Columns of the pose table.
    truth : mapping of str to mapping of str to float
        Values of each hidden effect: g, g/g, g/g², g/g³, g/°C, g/°C², 1/°C, g s/°C, g/h, 1/h, m,
        s.
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
    knocked: Mapping[int, float]
    noise: Floats
    around: Around
    traits: Traits
    values: Mapping[str, Floats]
    setup: Setup


def simulate(rng: np.random.Generator, hidden: Mapping[str, float] | None = None,
             setup: Setup = Setup()) -> Simulated:
    """Return simulated poses of a random sensor; `hidden` are sizes of effects in `EFFECTS`."""
    hidden = hidden or {}
    turning = 'lever_arm' in hidden or setup.rates == 'sizeable'
    around = _around(rng, setup, turning)
    traits = _traits(rng, setup, around)
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
    return measure(rng, setup, around, traits, values)


def again(rng: np.random.Generator, before: Simulated) -> Simulated:
    """
    Return other poses of the same sensor, at the same times and temperatures, without knocks.

    The random walk and the 1/f noise of the offset are also the same. The scatter of each pose is
    not.

    """
    setup = replace(before.setup, knocked=0)
    turning = bool(np.max(np.abs(before.around.rate)) > 0.1)
    fresh = _around(rng, replace(setup, rates='sizeable' if turning else 'small'), turning)
    ratio = float(np.mean(before.around.sigma) / np.mean(fresh.sigma))
    quiet = ratio if 'quantisation' in before.values else 1.0
    spread = float(np.std(before.around.supply) / np.std(fresh.supply))
    around = replace(fresh, elapsed=before.around.elapsed, temperature=before.around.temperature,
                     recorded=before.around.recorded, warming=before.around.warming,
                     supply=NOMINAL_SUPPLY + spread * (fresh.supply - NOMINAL_SUPPLY),
                     shaking=quiet * fresh.shaking, sigma=quiet * fresh.sigma)
    traits = replace(before.traits, scatter=rng.normal(size=(setup.poses, 3)))
    return measure(rng, setup, around, traits, before.values)


def write_csv(path: Path, columns: Mapping[str, Floats]) -> None:
    """Write a pose table."""
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def _around(rng: np.random.Generator, setup: Setup, turning: bool) -> Around:
    """Return random orientation, time and context of each pose."""
    n = setup.poses
    force = unit(rng.normal(size=(n, 3)))
    if setup.repeats > 1:
        force = force[np.arange(n) // setup.repeats]
    elapsed = np.cumsum(rng.uniform(10.0, 60.0, n))
    elapsed = elapsed - elapsed[0]
    course = _temperature(rng, elapsed / elapsed[-1], setup.temperature == 'rising')
    temperature, recorded, warming = _lagging(course, elapsed, setup.lag)
    supply = rng.uniform(3.0, 3.6, n)
    turning = turning or (bool(rng.integers(2)) and setup.rates == 'any')
    real = unit(rng.normal(size=(n, 3))) * rng.uniform(1.0, 5.0, (n, 1))
    rate = rng.normal(size=(n, 3)) * 0.002 + real * turning
    sigma = setup.noise_mg * 1e-3 * setup.shaking ** rng.uniform(size=(n, 3))
    return Around(force, elapsed, temperature, recorded, warming, supply, rate,
                  _shaking(rng, setup, sigma), sigma)


def _shaking(rng: np.random.Generator, setup: Setup, sigma: Floats) -> Floats:
    """Return the (n, 3, samples) errors of the samples, and of the pose as a whole [g]."""
    shaking = rng.normal(size=(*sigma.shape, setup.samples)) * sigma[:, :, np.newaxis]
    of_mean = sigma / np.sqrt(setup.samples)
    if setup.heavy:
        error = rng.standard_t(DEGREES, size=sigma.shape) * np.sqrt(1.0 - 2.0 / DEGREES)
        shaking -= np.mean(shaking, axis=2, keepdims=True)
        return shaking + (error * setup.understated * of_mean)[:, :, np.newaxis]
    if setup.understated > 1.0:
        error = rng.normal(size=sigma.shape) * np.sqrt(setup.understated ** 2 - 1.0)
        shaking += (error * of_mean)[:, :, np.newaxis]
    return shaking


def _temperature(rng: np.random.Generator, share: Floats, rising: bool
                 ) -> Callable[[Floats], Floats]:
    """
    Return a random course of the temperature [°C], between 10 and 40 °C at the poses.

    It is a function of sorted shares of the time span; `share` are those of the poses. `rising`:
    the temperature only rises.

    """
    waves = rng.uniform(1.5, 5.0, 3)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    bend, low, span = rng.uniform(0.5, 3.0), rng.uniform(10.0, 20.0), rng.uniform(10.0, 19.0)

    def wave(at: Floats) -> Floats:
        summed: Floats = np.sum(np.sin(2.0 * np.pi * np.outer(at, waves) + phases), axis=1)
        return summed

    def rise(at: Floats) -> Floats:
        settled = (1.0 - np.exp(-bend * at)) / (1.0 - np.exp(-bend))
        return np.sort(low + span * settled + 0.1 * wave(at))

    least, most = np.min(wave(share)), np.max(wave(share))
    return rise if rising else lambda at: 10.0 + 30.0 * (wave(at) - least) / (most - least)


_MOMENT = 0.1
"""Time over which the rate of the temperature is taken [s]."""


def _lagging(course: Callable[[Floats], Floats], elapsed: Floats, lag: float
             ) -> tuple[Floats, Floats, Floats]:
    """
    Return temperatures at the poses [°C], and the rate of the first of them [°C/s].

    The first one is that of the sensing element, the second one that of the thermometer.

    """
    span = elapsed[-1]
    if lag == 0.0:
        temperature = course(elapsed / span)
        after, before = (course((elapsed + side * _MOMENT) / span) for side in (0.5, -0.5))
        return temperature, temperature, (after - before) / _MOMENT
    times = np.arange(0.0, span + 1.0)  # one second apart
    ahead = course(times / span)
    behind = low_passed(ahead, abs(lag))
    own, other = (ahead, behind) if lag > 0.0 else (behind, ahead)
    return (np.interp(elapsed, times, own), np.interp(elapsed, times, other),
            np.interp(elapsed, times, np.gradient(own)))


def low_passed(series: Floats, constant: float) -> Floats:
    """Return the first-order low pass of a series with one value per second, from a rest."""
    passed, share = [float(series[0])], 1.0 - np.exp(-1.0 / constant)
    for target in (series[1:] + series[:-1]) / 2.0:
        passed.append(passed[-1] + share * (float(target) - passed[-1]))
    return np.array(passed)


def _traits(rng: np.random.Generator, setup: Setup, around: Around) -> Traits:
    """Return the random properties of a sensor."""
    elapsed = around.elapsed
    n, span = len(elapsed), elapsed[-1]
    more = rng.spawn(1)[0]  # leaves the sets as they were before these properties
    gain = np.eye(3) + np.diag(rng.normal(size=3) * 0.02)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        gain[i, j] = gain[j, i] = rng.normal() * 0.01
    instant = _instant(rng, elapsed)
    walk = np.cumsum(rng.normal(size=(n, 3)) * np.sqrt(np.diff(elapsed, prepend=0.0))[:, None],
                     axis=0)
    knee = np.min(around.temperature) + more.uniform(0.4, 0.7) * np.ptp(around.temperature)
    return Traits(rng.normal(size=3) * 0.05, gain, rng.uniform(0.05, 0.4) * span, instant,
                  rng.uniform(0.1, 0.3) * span, rng.uniform(0.2, 0.6, 3),
                  rng.uniform(0.0, 2.0 * np.pi, 3), walk, rng.normal(size=(n, 3)),
                  setup.hysteresis, more.uniform(0.1, 0.3, 3), float(knee),
                  _instant(more, elapsed), more.uniform(0.1, 0.3) * span, _flicker(more, elapsed),
                  unit(more.normal(size=3)), more.uniform(10.0, 60.0), more.uniform(0.3, 0.9))


def _instant(rng: np.random.Generator, elapsed: Floats) -> float:
    """Return a random instant between two poses, in the middle 60 % of the poses [s]."""
    n = len(elapsed)
    late = rng.integers(int(np.ceil(0.2 * n)), int(0.8 * n) + 1)
    return float(elapsed[late - 1:late + 1].mean())


def _flicker(rng: np.random.Generator, elapsed: Floats) -> Floats:
    """Return (n, 3) noise of the same power in each octave, from two spans to a pose interval."""
    frequencies = np.geomspace(0.5 / elapsed[-1], 0.5 / np.mean(np.diff(elapsed)), _TONES)
    angle = 2.0 * np.pi * np.outer(elapsed, frequencies)
    sines, cosines = rng.normal(size=(2, _TONES, 3))
    return np.asarray(np.sin(angle) @ sines + np.cos(angle) @ cosines)


def noise_in_norm(around: Around, traits: Traits) -> Floats:
    """Return the (n,) standard deviations of |a| of the pose means [g]."""
    rows = around.force @ np.linalg.inv(traits.gain)
    return np.linalg.norm(rows * around.sigma, axis=1) / np.sqrt(around.shaking.shape[2])


def size_of(added: Floats, around: Around, traits: Traits) -> float:
    """Return the size of an effect that adds these (n, 3) parts to the mean readings [g]."""
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
    for step in range(_STEPS):
        ratio = wanted / size_of(basis @ values, around, traits)
        if step > 5 and abs(ratio - 1.0) < 0.01:
            break
        values = values * (ratio if step < 6 else np.sqrt(ratio))
    return values


def _samples(values: Mapping[str, Floats], around: Around, traits: Traits) -> Floats:
    """Return the (n, 3, samples) output before limits and grid [g]."""
    reading = plain_reading(around, traits)
    for name, value in values.items():
        if name not in ON_OUTPUT:
            reading = reading + basis_of(name, around, traits) @ value
    return reading[:, :, np.newaxis] + around.shaking


def _rail(wanted: float, values: Mapping[str, Floats], around: Around, traits: Traits) -> Floats:
    """Return the (1,) limit at which saturation has a size [g]."""
    samples = _samples(values, around, traits)
    farthest = np.sort(np.max(np.abs(np.mean(samples, axis=2)), axis=1))
    low, high = 0.5, float(farthest[-1 - LEAST_CLIPPED])
    for _ in range(30):
        rail = (low + high) / 2.0
        lost = np.mean(np.clip(samples, -rail, rail) - samples, axis=2)
        low, high = (rail, high) if size_of(lost, around, traits) > wanted else (low, rail)
    return np.array([(low + high) / 2.0])


def measure(rng: np.random.Generator, setup: Setup, around: Around, traits: Traits,
            values: Mapping[str, Floats]) -> Simulated:
    """Return the set of the averaged samples."""
    samples = _samples(values, around, traits)
    rows = np.sort(rng.choice(setup.poses, setup.knocked, replace=False))
    knocks = unit(rng.normal(size=(len(rows), 3))) * rng.uniform(0.01, 0.05, (len(rows), 1))
    samples[rows] += knocks[:, :, np.newaxis]
    added = np.linalg.norm(around.force[rows] + knocks @ np.linalg.inv(traits.gain).T, axis=1)
    rail = float(values['saturation'][0]) if 'saturation' in values else np.inf
    step = float(values['quantisation'][0]) if 'quantisation' in values else setup.step_mg * 1e-3
    output = np.clip(np.round(samples / step) * step, -rail, rail)
    return Simulated(
        _columns(output, around, setup), {name: _named(name, values[name], traits)
                                          for name in values},
        dict(zip((rows + 1).tolist(), (added - 1.0).tolist(), strict=True)),
        noise_in_norm(around, traits), around, traits, values, setup)


def _named(name: str, values: Floats, traits: Traits) -> dict[str, float]:
    """Return the values of an effect with the names and units of the catalogue."""
    if name == 'supply_ratio':
        parts = np.array([1.0, *traits.offset]) * values[0]
        return dict(zip(('gain', 'x', 'y', 'z'), parts.tolist(), strict=True))
    names = {'cross_coupling': tuple(f'{"xyz"[i]}_{"xyz"[i]}{"xyz"[j]}' for i, j in PAIRS),
             'saturation': ('limit',), 'quantisation': ('step',),
             'cross_axis_temperature': ('xy', 'xz', 'yz')}
    factor = HOUR if name in ('offset_drift', 'gain_drift') else 1.0
    named = dict(zip(names.get(name, ('x', 'y', 'z')), (values * factor).tolist(), strict=True))
    more = {'warm_up': {'tau': traits.tau}, 'offset_step': {'instant': traits.instant},
            'gain_step': {'instant': traits.gain_instant}, 'creep': {'tau': traits.relaxation}}
    if traits.hysteresis == 'memory':
        more['hysteresis'] = {'memory': traits.memory}
    return {**named, **more.get(name, {})}


def _columns(output: Floats, around: Around, setup: Setup) -> dict[str, Floats]:
    """Return the columns of the pose table."""
    mean = np.mean(output, axis=2) * STANDARD_GRAVITY
    std = np.std(output, axis=2, ddof=1) * STANDARD_GRAVITY
    columns = {'time': np.round(around.elapsed, 3)}
    columns.update(zip(('ax', 'ay', 'az'), mean.T))
    columns.update(zip(('std_x', 'std_y', 'std_z'), std.T))
    columns['count'] = np.full(setup.poses, float(setup.samples))
    columns['temperature'] = np.round(around.recorded, 2)
    columns['supply_voltage'] = np.round(around.supply, 4)
    columns.update(zip(('gx', 'gy', 'gz'), np.round(around.rate, 5).T))
    return {name: column for name, column in columns.items() if name not in setup.dropped}
