# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Random sensors, directions and poses of the benchmarks.

The arithmetic of `Sensor`, its readings and derivatives is written out here; it shares no code
with the models and the simulation of the package.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

from accel_calib.effects import Model, model_with
from accel_calib.geometry import spread_directions, unit
from accel_calib.statistics import rms
from accel_calib.table import COLUMNS, concatenated, Floats, numbered, Poses
from accel_calib.units import MG
from generator import Simulated
import numpy as np
from scipy.signal import lfilter

NOISE = 3e-4
"""Standard deviation of a pose mean by axis [g]."""

SAMPLES = 100
JITTER = np.radians(8.0)
FACES = np.vstack([np.eye(3), -np.eye(3)])


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) unit vectors, uniformly distributed over the sphere."""
    return unit(rng.normal(size=(count, 3)))


def tilt(directions: Floats, degrees: float, rng: np.random.Generator) -> Floats:
    """Turn each of (n, 3) directions by some degrees in each of two axes."""
    off = rng.normal(size=directions.shape) * np.radians(degrees)
    return unit(directions + off - directions * np.sum(off * directions, axis=1, keepdims=True))


def spread(count: int, rng: np.random.Generator) -> Floats:
    """Return directions spread over the sphere, in a random attitude, with jitter."""
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return unit(spread_directions(count) @ turned + JITTER * rng.normal(size=(count, 3)))


def draw_model(rng: np.random.Generator, offset: float = 0.03) -> Model:
    """Draw a sensor with offset, gains and cross-axis gains, as a model of the package."""
    sizes = {'offset': offset, 'axis_gain': 0.02, 'cross_axis': 0.01}
    return model_with({name: rng.normal(size=3) * size for name, size in sizes.items()})


def draw_noise(rng: np.random.Generator, count: int, rate_hz: float, correlation: float
               ) -> Floats:
    """Return (count, 3) noise of variance 1 with this correlation time [s]."""
    keep = np.exp(-1.0 / (rate_hz * correlation)) if correlation > 0.0 else 0.0
    start = int(10.0 * correlation * rate_hz)
    white = rng.normal(size=(count + start, 3))
    return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)[start:])


def join(poses: Poses, more: Poses) -> Poses:
    """Return poses followed by others."""
    columns = concatenated([poses, more]).columns
    return Poses(columns, numbered(columns))


def poses_of(made: Simulated) -> Poses:
    """Return poses of the independent simulator of the tests, as the reader of tables does."""
    columns = {}
    for key, column in COLUMNS.items():
        parts = [made.columns[name] for name in column.names if name in made.columns]
        if len(parts) == len(column.names):
            columns[key] = np.column_stack(parts) if len(parts) > 1 else parts[0]
    return Poses(columns, numbered(columns))


def length_error_mg(force: Floats) -> float:
    """Return the RMS error of |force| [mg]."""
    return rms(np.linalg.norm(force, axis=1) - 1.0) * MG


@dataclass(frozen=True)
class Sensor:
    """Reading = W force + V; arrays in g."""

    gain: Floats
    offset: Floats

    def reading(self, force: Floats) -> Floats:
        """Return the readings of (n, 3) forces."""
        return force @ self.gain.T + self.offset

    def lengths(self, reading: Floats) -> Floats:
        """Return |force| of (n, 3) readings."""
        return np.linalg.norm(np.linalg.solve(self.gain, (reading - self.offset).T), axis=0)

    def values(self, model: str) -> Floats:
        """
        Return the true values of a model, in the order of `Model.vector`.

        Offset; gain of model 4, gains of the others; cross-axis xy, xz, yz; misalignment. W of
        model 9 is that of the sensing axes: lower triangular, from a Cholesky decomposition.

        """
        gain = np.linalg.cholesky(self.gain @ self.gain.T) if model == '9' else self.gain
        diagonal = np.diag(gain) - 1.0
        symmetric, skew = (gain + gain.T) / 2.0, (gain - gain.T) / 2.0
        cross = symmetric[[0, 0, 1], [1, 2, 2]]
        parts = {'4': (diagonal[:1],), '7': (diagonal,), '10': (diagonal, cross)}
        return np.concatenate([self.offset, *parts.get(
            model, (diagonal, cross, skew[[2, 0, 1], [1, 2, 0]]))])

    def length_slopes(self, force: Floats) -> Floats:
        """
        Return the (n, 9) derivative of |force| by the values of model 10, at true forces of 1 g.

        With a = û W⁻¹ the derivative by V_i is -a_i, and that by W_ij is -a_i u_j.

        """
        a = force @ np.linalg.inv(self.gain)
        cross = [a[:, i] * force[:, j] + a[:, j] * force[:, i]
                 for i, j in ((0, 1), (0, 2), (1, 2))]
        return -np.column_stack([a, a * force, *cross])


@dataclass(frozen=True)
class Case:
    """A sensor and its n poses."""

    sensor: Sensor
    poses: Poses  # in g
    force: Floats  # (n, 3) true specific force of each pose [g]
    noise: Floats  # (n,) true standard deviation of each pose, by axis, with its scatter [g]
    shows_mg: Floats  # (n,) change of |force| by a knock; 0 if the pose was not knocked


def draw_sensor(rng: np.random.Generator, kind: str = '10') -> Sensor:
    """Draw a sensor of 4, 7, 10 or 12 parameters, with errors of a few percent."""
    gain = np.eye(3) * (1.0 + 0.02 * rng.normal())
    if kind != '4':
        gain = np.diag(1.0 + 0.02 * rng.normal(size=3))
    if kind in ('10', '12'):
        for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), 0.01 * rng.normal(size=3)):
            gain[i, j] = gain[j, i] = value
    if kind == '12':
        gain = gain + np.cross(np.eye(3), 0.01 * rng.normal(size=3))
    return Sensor(gain, 0.03 * rng.normal(size=3))


def draw_case(rng: np.random.Generator, count: int, kind: str = '10', *,
              noise: Floats | float = NOISE, scatter: float = 0.0, stated: float = 1.0,
              force: Floats | None = None) -> Case:
    """
    Draw a sensor and its poses.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of all random numbers.
    count : int
        Number of poses.
    kind : {'4', '7', '10', '12'}
        Number of parameters of the sensor.
    noise : float or (count,) array
        Standard deviation of a pose mean, by axis [g].
    scatter : float
        Standard deviation of a pose beyond this noise, which its samples do not show [g].
    stated : float
        Ratio of the noise that the poses state to their real noise.
    force : (count, 3) array, optional
        Directions; by default they are spread over the sphere.

    """
    sensor = draw_sensor(rng, kind)
    force = spread(count, rng) if force is None else force
    each = np.broadcast_to(np.asarray(noise, float), (count,))[:, np.newaxis]
    true = np.hypot(each, scatter)
    measured = np.sqrt(rng.chisquare(SAMPLES - 1, size=(count, 3)) / (SAMPLES - 1))
    columns = {'reading': sensor.reading(force) + true * rng.normal(size=(count, 3)),
               'std': stated * each * np.sqrt(SAMPLES) * measured,
               'count': np.full(count, float(SAMPLES))}
    return Case(sensor, Poses(columns, numbered(columns)), force, true[:, 0], np.zeros(count))


def knock(case: Case, rng: np.random.Generator, count: int, size: float = 0.05) -> Case:
    """Return the case with some poses knocked in random directions, by `size` [g]."""
    rows = rng.choice(len(case.poses), count, replace=False)
    reading = case.poses.reading.copy()
    reading[rows] += size * random_directions(count, rng)
    shows = np.abs(case.sensor.lengths(reading) - case.sensor.lengths(case.poses.reading)) * MG
    return replace(case, poses=case.poses.with_columns(reading=reading), shows_mg=shows)


def misplace(rng: np.random.Generator, count: int, degrees: float) -> Case:
    """Draw poses of known orientation, six faces and others, each misplaced by an angle."""
    stated = np.vstack([FACES, spread(count - 6, rng)])
    across = unit(np.cross(stated, random_directions(count, rng)))
    angle = np.radians(degrees)
    case = draw_case(rng, count, '12', force=np.cos(angle) * stated + np.sin(angle) * across)
    return replace(case, poses=case.poses.with_columns(reference=stated))
