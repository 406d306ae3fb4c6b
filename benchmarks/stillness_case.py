# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Recordings with and without rests, and the rules that find the rests.

A simulated recording is a sequence of stretches: the sensor rests, is carried by hand to the next
orientation, and so on. By its kind it is also held in the hand, turned slowly, beside a person who
walks by, or beside a motor. Forces are in g, all else is SI.

A rule takes a recording and returns poses. Ours is the detector of the package. The two others are
simple, and get what ours has to find out: that the sensor rests in the first two seconds.
**variance**: the standard deviation over a sliding second, by axis, is below three times that of
the first two seconds, or 0.33 mg (imu_tk and others use a multiple of the variance in a first
rest). **gyro**: the mean rate over half a second is within 0.5 °/s of that of the first two
seconds. A pose is a stretch of a second or more; both treat the samples as independent.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import itertools
from typing import Literal, NamedTuple

from accel_calib.stillness import CaptureSettings, StillDetector
from accel_calib.table import Floats
from accel_calib.units import units_of
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

_FIRST = 2.0        # [s] known to be a rest
_MIN_DWELL = 1.0    # [s]
_TIMES = 3.0
_LEAST = 3.3e-4     # [g]
_TURNING = np.radians(0.5)


@dataclass(frozen=True)
class Sensor:
    """Noise of a sample [g], samples per second, and correlation time of the noise [s]."""

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
        Of the tremor, steps or vibration [g], or speed of the turning [°/s].
    time, reading, rate, force : arrays
        (n,) stamps; (n, 3) readings, angular rates and true specific force without vibration.
    rests : (m, 2) array of int
        Index of the first sample of each rest, and of the one after its last.
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
    """Draw a recording of a kind."""
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
    """Return (count, 3) noise of variance 1 with this correlation time [s]."""
    keep = np.exp(-1.0 / (rate * correlation)) if correlation > 0.0 else 0.0
    start = int(10.0 * correlation * rate)
    white = rng.normal(size=(count + start, 3))
    return np.asarray(lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)[start:])


def _stretches(rng: np.random.Generator, kind: str) -> list[tuple[int, float]]:
    """Return the stretches of a recording: what happens, and for how long [s]."""
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
    """Return a horizontal unit vector in the axes of the body: a turn about it tilts."""
    axis = np.cross(now.inv().apply([0.0, 0.0, 1.0]), rng.normal(size=3))
    return np.asarray(axis / np.linalg.norm(axis))


def _shaking(rng: np.random.Generator, kind: str, size: float,
             phase: np.ndarray[tuple[int, ...], np.dtype[np.intp]], rate: float) -> Floats:
    """Return (n, 3) accelerations without gravity [g]."""
    count = len(phase)
    carried = 0.08 * coloured(rng, count, rate, 0.05) * (phase == _CARRY)[:, np.newaxis]
    more: dict[str, Callable[[], Floats]] = {
        'tremor': lambda: (phase == _OTHER)[:, np.newaxis] * swinging(rng, count, rate, size,
                                                                      (5.0, 12.0), 0.6),
        'footsteps': lambda: _steps(rng, count, rate, size),
        'motor': lambda: swinging(rng, count, rate, size, (20.0, 80.0), 2.0)}
    return carried + (more[kind]() if kind in more else 0.0)


def swinging(rng: np.random.Generator, count: int, rate: float, size: float,
             band: tuple[float, float], jitter: float) -> Floats:
    """Return an oscillation in a fixed direction; its frequency [Hz] wanders by `jitter`."""
    frequency = rng.uniform(*band) + jitter * coloured(rng, count, rate, 1.0)[:, 0]
    phase = 2.0 * np.pi * np.cumsum(frequency) / rate
    direction = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    swing = np.sin(phase)[:, np.newaxis] * direction[0]
    return np.asarray(size * (swing + 0.4 * np.cos(phase)[:, np.newaxis] * direction[1]))


def _steps(rng: np.random.Generator, count: int, rate: float, size: float) -> Floats:
    """Return the steps of a person who walks by: shocks that ring and decay."""
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


class Pose(NamedTuple):
    """A still stretch: first and last stamp [s], mean and noise of the mean [g]."""

    start: float
    end: float
    mean: Floats
    noise: Floats


def ours(case: Case, gyro: bool) -> list[Pose]:
    """Return the dwells that the stillness detector finds."""
    rate = case.rate if gyro else np.full_like(case.rate, np.nan)
    samples = np.column_stack([case.time, case.reading, rate, np.full((len(rate), 2), np.nan)])
    detector = StillDetector(CaptureSettings(), units_of(case.units))
    detector.push(samples)
    detector.close()
    return [Pose(each.start, each.end, each.mean, each.std / np.sqrt(each.count))
            for each in detector.dwells()]


def variance(case: Case) -> list[Pose]:
    """Return the poses by a fixed threshold of the variance."""
    width = round(case.sensor.rate)
    first = case.reading[:round(_FIRST * case.sensor.rate)].std(axis=0)
    mean = _sliding(case.reading, width)
    spread = np.sqrt(np.maximum(_sliding(np.square(case.reading), width) - mean**2, 0.0))
    least = _LEAST if case.units == 'g' else 0.0
    return _poses(case, np.all(spread < np.maximum(_TIMES * first, least), axis=1))


def gyro(case: Case) -> list[Pose]:
    """Return the poses by a threshold of the mean rate."""
    bias = case.rate[:round(_FIRST * case.sensor.rate)].mean(axis=0)
    mean = _sliding(case.rate - bias, round(0.5 * case.sensor.rate))
    return _poses(case, np.linalg.norm(mean, axis=1) < _TURNING)


def _sliding(values: Floats, width: int) -> Floats:
    """Return means over windows centred on each sample; they are shorter at the ends."""
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low = np.maximum(index - width // 2, 0)
    high = np.minimum(index + (width + 1) // 2, len(values))
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, np.newaxis])


def _poses(case: Case, still: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[Pose]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    found = []
    for start, stop in edges.reshape(-1, 2):
        part = case.reading[start:stop]
        if len(part) >= _MIN_DWELL * case.sensor.rate:
            found.append(Pose(float(case.time[start]), float(case.time[stop - 1]),
                              part.mean(axis=0), part.std(axis=0, ddof=1) / np.sqrt(len(part))))
    return found
