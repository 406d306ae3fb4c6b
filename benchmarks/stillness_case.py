# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Recordings of a sensor that is put down, held, turned slowly, walked past, or sits by a motor.

Every recording is a row of stretches: the sensor rests, is carried by hand to the next
orientation, and so on; what else happens depends on the kind. All is in g, s and rad/s.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import itertools
from typing import Literal

from accel_calib.table import Floats
import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

KINDS = ('plain', 'tremor', 'turning', 'footsteps', 'motor')
NOISES_MG = (0.3, 1.0, 3.0, 5.0)
NOISY_MG = 50.0
RATES_HZ = (50.0, 100.0, 200.0, 1000.0)
CORRELATION_S = (0.0, 0.0, 0.02, 0.2)
_REST, _CARRY, _OTHER = 0, 1, 2
_GYRO_NOISE = 2e-3    # [rad/s]
_GYRO_BIAS = 1.5e-2   # [rad/s], by axis


@dataclass(frozen=True)
class Sensor:
    """Noise of a sample [g], samples a second, and correlation time of the noise [s]."""

    noise: float
    rate: float
    correlation: float


@dataclass(frozen=True)
class Case:
    """
    A recording with its truth.

    Parameters
    ----------
    kind : str
        Of `KINDS`.
    sensor : Sensor
        The sensor.
    size : float
        Of what happens: tremor, steps or vibration [g], or the speed of turning [°/s].
    time, reading, rate, force : arrays
        Stamps, (n, 3) readings, angular rates, and the true specific force without vibration.
    rests : (m, 2) array of int
        First sample of each rest, and the one after its last.
    moving : (n,) array of bool
        Whether the sensor is carried, held or turned.
    units : {'g', 'native'}
        Unit of the readings.

    """

    kind: str
    sensor: Sensor
    size: float
    time: Floats
    reading: Floats
    rate: Floats
    force: Floats
    rests: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    moving: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    units: Literal['g', 'native'] = 'g'


def case_of(kind: str, seed: int, number: int, noisy: bool = False) -> Case:
    """Draw a recording."""
    rng = np.random.default_rng([seed, KINDS.index(kind), number, noisy])
    sensor = Sensor(1e-3 * float(NOISY_MG if noisy else rng.choice(NOISES_MG)),
                    float(rng.choice(RATES_HZ)), float(rng.choice(CORRELATION_S)))
    size = {'plain': 0.0, 'tremor': 1e-3 * 10.0**rng.uniform(0.0, 1.0),
            'turning': 0.5 * 10.0**rng.uniform(0.0, 1.0),
            'footsteps': 1e-3 * 10.0**rng.uniform(0.3, 1.3),
            'motor': 1e-3 * 10.0**rng.uniform(0.3, 1.5)}[kind]
    stretches = _stretches(rng, kind)
    turn, phase = _motion(rng, kind, size, stretches, sensor.rate)
    force = turn.inv().apply([0.0, 0.0, 1.0])
    shaken = force + _shaking(rng, kind, size, phase, sensor.rate)
    reading = shaken + sensor.noise * coloured(rng, len(force), sensor.rate, sensor.correlation)
    # rotvec of R(k)⁻¹ R(k+1) is the body's own rate.
    steps = (turn[:-1].inv() * turn[1:]).as_rotvec() * sensor.rate
    rate = np.vstack([steps[:1], steps]) + rng.normal(size=3) * _GYRO_BIAS
    rate += _GYRO_NOISE * rng.normal(size=rate.shape)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(phase)) + 1, [len(phase)]])
    rests = [(a, b) for a, b in itertools.pairwise(edges) if phase[a] == _REST]
    return Case(kind, sensor, size, np.arange(len(force)) / sensor.rate, reading, rate, force,
                np.array(rests), phase != _REST)


def coloured(rng: np.random.Generator, count: int, rate: float, correlation: float) -> Floats:
    """Give (count, 3) noise of variance 1 with this correlation time [s]."""
    keep = np.exp(-1.0 / (rate * correlation)) if correlation > 0.0 else 0.0
    start = int(10.0 * correlation * rate)
    white = rng.normal(size=(count + start, 3))
    return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)[start:])


def _stretches(rng: np.random.Generator, kind: str) -> list[tuple[int, float]]:
    """Give what happens and for how long [s]."""
    found: list[tuple[int, float]] = []
    for _ in range(10):
        found += [(_REST, rng.uniform(2.5, 8.0)), (_CARRY, rng.uniform(0.8, 2.0))]
        if kind == 'tremor':
            found += [(_OTHER, rng.uniform(3.0, 8.0)), (_CARRY, rng.uniform(0.8, 2.0))]
        if kind == 'turning' and rng.random() < 0.5:
            found.append((_OTHER, rng.uniform(3.0, 12.0)))
        elif kind == 'turning':   # no carrying before it: the rest turns into a slow turn
            found.insert(-1, (_OTHER, rng.uniform(3.0, 12.0)))
    return found


def _motion(rng: np.random.Generator, kind: str, size: float,
            stretches: list[tuple[int, float]], rate: float
            ) -> tuple[Rotation, np.ndarray[tuple[int, ...], np.dtype[np.intp]]]:
    now = Rotation.random(random_state=rng)
    turns, phases = [], []
    for phase, seconds in stretches:
        share = (np.arange(round(seconds * rate)) + 1.0) / round(seconds * rate)
        if phase == _CARRY:
            by = rng.normal(size=3)
            by *= rng.uniform(0.6, 2.6) / np.linalg.norm(by)
            path = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        else:
            turning = kind == 'turning' and phase == _OTHER
            by = _level_axis(rng, now) * np.radians(size) * seconds * turning
            path = share
        turn = now * Rotation.from_rotvec(path[:, np.newaxis] * by)
        now = turn[-1]
        turns.append(turn.as_quat())
        phases.append(np.full(len(share), phase))
    return Rotation.from_quat(np.concatenate(turns)), np.concatenate(phases)


def _level_axis(rng: np.random.Generator, now: Rotation) -> Floats:
    """Give a unit vector normal to the vertical, in the body: turning about it tilts."""
    axis = np.cross(now.inv().apply([0.0, 0.0, 1.0]), rng.normal(size=3))
    return np.asarray(axis / np.linalg.norm(axis))


def _shaking(rng: np.random.Generator, kind: str, size: float,
             phase: np.ndarray[tuple[int, ...], np.dtype[np.intp]], rate: float) -> Floats:
    """Give (n, 3) accelerations beside gravity."""
    count = len(phase)
    carried = 0.08 * coloured(rng, count, rate, 0.05) * (phase == _CARRY)[:, np.newaxis]
    more: dict[str, Callable[[], Floats]] = {
        'tremor': lambda: (phase == _OTHER)[:, np.newaxis] * _swinging(rng, count, rate, size,
                                                                       (5.0, 12.0), 0.6),
        'footsteps': lambda: _steps(rng, count, rate, size),
        'motor': lambda: _swinging(rng, count, rate, size, (20.0, 80.0), 2.0)}
    return carried + (more[kind]() if kind in more else 0.0)


def _swinging(rng: np.random.Generator, count: int, rate: float, size: float,
              band: tuple[float, float], jitter: float) -> Floats:
    """Give a swing of one frequency [Hz], which wanders by `jitter`, in a fixed direction."""
    frequency = rng.uniform(*band) + jitter * coloured(rng, count, rate, 1.0)[:, 0]
    phase = 2.0 * np.pi * np.cumsum(frequency) / rate
    direction = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    swing = np.sin(phase)[:, np.newaxis] * direction[0]
    return np.asarray(size * (swing + 0.4 * np.cos(phase)[:, np.newaxis] * direction[1]))


def _steps(rng: np.random.Generator, count: int, rate: float, size: float) -> Floats:
    """Give the steps of somebody who walks by: knocks that ring and die away."""
    time = np.arange(0.0, 0.6, 1.0 / rate)
    ringing = np.exp(-time / 0.08) * np.sin(2.0 * np.pi * rng.uniform(12.0, 30.0) * time)
    struck = np.zeros((count, 3))
    at = np.cumsum(rng.normal(0.55, 0.04, int(count / rate)))
    loud = size * np.abs(np.sin(2.0 * np.pi * at / 9.0))
    index = (at * rate).astype(int)
    kept = index < count
    direction = rng.normal(size=(int(kept.sum()), 3)) * 0.3 + [0.0, 0.0, 1.0]
    struck[index[kept]] += loud[kept, np.newaxis] * direction
    return np.asarray(lfilter(ringing, [1.0], struck, axis=0))
