# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Sets of poses for the benchmark of trust: sensors, directions, noise, knocks, placement.

The sensors are drawn and read here, with arithmetic of its own, not by the package's simulation.

"""

from __future__ import annotations

from dataclasses import dataclass, replace

from accel_calib.calibrate import Calibration
from accel_calib.sphere import random_directions, spread_directions
from accel_calib.table import Floats, numbered, Poses
from accel_calib.units import MG
import numpy as np

NOISE = 3e-4
"""Standard deviation of a pose mean by axis [g]."""

SAMPLES = 100
JITTER = np.radians(8.0)
FACES = np.vstack([np.eye(3), -np.eye(3)])
_FRESH = 300


@dataclass(frozen=True)
class Sensor:
    """Reading = W force + V; arrays in g."""

    gain: Floats
    offset: Floats

    def reading(self, force: Floats) -> Floats:
        """Give what it reads under these (n, 3) forces."""
        return force @ self.gain.T + self.offset

    def lengths(self, reading: Floats) -> Floats:
        """Give |force| of these (n, 3) readings."""
        return np.linalg.norm(np.linalg.solve(self.gain, (reading - self.offset).T), axis=0)


@dataclass(frozen=True)
class Case:
    """A sensor, its poses, and where they were: rows of the truth are those of the poses."""

    sensor: Sensor
    poses: Poses
    force: Floats
    shows_mg: Floats


def draw_sensor(rng: np.random.Generator, kind: str) -> Sensor:
    """Draw a sensor that needs 4, 7, 10 or 12 parameters: errors of a few percent."""
    gain = np.eye(3) * (1.0 + 0.02 * rng.normal())
    if kind != '4':
        gain = np.diag(1.0 + 0.02 * rng.normal(size=3))
    if kind in ('10', '12'):
        for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), 0.01 * rng.normal(size=3)):
            gain[i, j] = gain[j, i] = value
    if kind == '12':
        gain = gain + np.cross(np.eye(3), 0.01 * rng.normal(size=3))
    return Sensor(gain, 0.03 * rng.normal(size=3))


def spread(count: int, rng: np.random.Generator) -> Floats:
    """Spread directions over the sphere, turned anyhow, with some jitter."""
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return unit(spread_directions(count) @ turned + JITTER * rng.normal(size=(count, 3)))


def unit(vectors: Floats) -> Floats:
    """Give (n, 3) vectors at length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def draw(rng: np.random.Generator, count: int, kind: str = '10', *, noise: Floats | float = NOISE,
         stated: float = 1.0, force: Floats | None = None) -> Case:
    """
    Draw a sensor and its poses.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of all chance.
    count : int
        Poses.
    kind : {'4', '7', '10', '12'}
        What the sensor needs.
    noise : float or (count,) array
        Of a pose mean by axis [g].
    stated : float
        What the poses say their noise is, over what it is.
    force : (count, 3) array, optional
        Directions; without it they are spread.

    """
    sensor = draw_sensor(rng, kind)
    force = spread(count, rng) if force is None else force
    each = np.broadcast_to(np.asarray(noise, float), (count,))[:, np.newaxis]
    measured = np.sqrt(rng.chisquare(SAMPLES - 1, size=(count, 3)) / (SAMPLES - 1))
    columns = {'reading': sensor.reading(force) + each * rng.normal(size=(count, 3)),
               'std': stated * each * np.sqrt(SAMPLES) * measured,
               'count': np.full(count, float(SAMPLES))}
    return Case(sensor, Poses(columns, numbered(columns)), force, np.zeros(count))


def knock(case: Case, rng: np.random.Generator, count: int, size: float = 0.05) -> Case:
    """Knock so many poses in any direction; by how much shows in |a| is told [mg]."""
    rows = rng.choice(len(case.poses), count, replace=False)
    reading = case.poses.reading.copy()
    reading[rows] += size * random_directions(count, rng)
    shows = np.abs(case.sensor.lengths(reading) - case.sensor.lengths(case.poses.reading)) * MG
    return replace(case, poses=case.poses.with_columns(reading=reading), shows_mg=shows)


def misplaced(rng: np.random.Generator, count: int, degrees: float) -> Case:
    """Draw six faces and more of known orientation, each placed so many degrees off."""
    said = np.vstack([FACES, spread(count - 6, rng)])
    across = unit(np.cross(said, random_directions(count, rng)))
    angle = np.radians(degrees)
    case = draw(rng, count, '12', force=np.cos(angle) * said + np.sin(angle) * across)
    return replace(case, poses=case.poses.with_columns(reference=said))


def without_noise(case: Case) -> Case:
    """Take the noise away that the poses state."""
    kept = {key: values for key, values in case.poses.columns.items()
            if key not in ('std', 'count')}
    return replace(case, poses=Poses(kept, case.poses.row))


def error_mg(calibration: Calibration, sensor: Sensor, rng: np.random.Generator) -> float:
    """Give the RMS error of |a| on fresh directions [mg]."""
    force = calibration.correct(sensor.reading(random_directions(_FRESH, rng)))
    return float(np.sqrt(np.mean((np.linalg.norm(force, axis=1) - 1.0) ** 2))) * MG
