# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Random sensors, directions and poses of the benchmarks.

The arithmetic of `Sensor` is written out here; it shares no code with the models and the
simulation of the package.

"""

from dataclasses import dataclass
from typing import NamedTuple

from accel_calib.geometry import spread_directions, unit
from accel_calib.statistics import rms
from accel_calib.table import COLUMNS, Floats, Poses
from accel_calib.units import MG
from generator import Simulated
import numpy as np
from shared import poses_of

NOISE = 3e-4
"""Standard deviation of a pose mean by axis [g]."""

QUIET = 5.0
"""Ratio of the scatter of poses to the noise that their samples show, where it is larger."""

NOISES = {'measured': '', 'differs': ', noise that differs by pose (e-fold)',
          'not given': ', noise not given', 'understated': ', a third of the noise stated',
          'scatter': f', scatter of {QUIET:g} times the noise, which differs (e-fold)'}
"""What the poses state of their noise, in words."""

SAMPLES = 100
JITTER = np.radians(8.0)


def tilt(directions: Floats, degrees: float, rng: np.random.Generator) -> Floats:
    """Turn each of (n, 3) directions by some degrees in each of two axes."""
    off = rng.normal(size=directions.shape) * np.radians(degrees)
    return unit(directions + off - directions * np.sum(off * directions, axis=1, keepdims=True))


def spread(count: int, rng: np.random.Generator) -> Floats:
    """Return directions spread over the sphere, in a random attitude, with jitter."""
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return unit(spread_directions(count) @ turned + JITTER * rng.normal(size=(count, 3)))


def simulated_poses(made: Simulated) -> Poses:
    """Return poses of the independent simulator of the tests, as the reader of tables does."""
    columns = {key: [made.columns[name] for name in column.names]
               for key, column in COLUMNS.items() if {*column.names} <= {*made.columns}}
    return poses_of(**{key: np.column_stack(parts) if len(parts) > 1 else parts[0]
                       for key, parts in columns.items()})


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

    def length_slopes(self, force: Floats) -> Floats:
        """Return the (n, 9) derivative of |force| by the values of model 10, at forces of 1 g."""
        # With a = û W⁻¹ the derivative by V_i is -a_i, and that by W_ij is -a_i u_j.
        a = force @ np.linalg.inv(self.gain)
        cross = [a[:, i] * force[:, j] + a[:, j] * force[:, i]
                 for i, j in ((0, 1), (0, 2), (1, 2))]
        return -np.column_stack([a, a * force, *cross])

    def values(self, model: str) -> Floats:
        """Return the true values of a model, in the order of `Model.vector`."""
        # W of model 9 is that of the sensing axes: lower triangular.
        gain = np.linalg.cholesky(self.gain @ self.gain.T) if model == '9' else self.gain
        diagonal = np.diag(gain) - 1.0
        symmetric, skew = (gain + gain.T) / 2.0, (gain - gain.T) / 2.0
        cross = symmetric[[0, 0, 1], [1, 2, 2]]
        parts = {'4': (diagonal[:1],), '7': (diagonal,), '10': (diagonal, cross)}
        return np.concatenate([self.offset, *parts.get(
            model, (diagonal, cross, skew[[2, 0, 1], [1, 2, 0]]))])


class Case(NamedTuple):
    """A sensor and its n poses."""

    sensor: Sensor
    poses: Poses  # in g
    force: Floats  # (n, 3) true specific force of each pose [g]
    noise: Floats  # (n, 1) true standard deviation of each pose, by axis, with its scatter [g]


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


def draw_case(rng: np.random.Generator, count: int, kind: str = '10', noise: str = 'measured'
              ) -> Case:
    """Draw a sensor, as `draw_sensor`, and poses spread over the sphere with one of `NOISES`."""
    each = np.full((count, 1), NOISE)
    if noise in ('differs', 'scatter'):
        each *= np.exp(rng.normal(size=(count, 1)))
    if noise == 'scatter':
        each /= QUIET
    sensor, force = draw_sensor(rng, kind), spread(count, rng)
    measured = np.sqrt(rng.chisquare(SAMPLES - 1, size=(count, 3)) / (SAMPLES - 1))
    true = np.hypot(each, NOISE if noise == 'scatter' else 0.0)
    stated = each / 3.0 if noise == 'understated' else each
    poses = poses_of(sensor.reading(force) + true * rng.normal(size=(count, 3)),
                     std=stated * np.sqrt(SAMPLES) * measured, count=np.full(count, SAMPLES))
    if noise == 'not given':
        poses = poses.without_columns('std', 'count')
    return Case(sensor, poses, force, true)
