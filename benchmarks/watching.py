# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drift monitoring: the delay until a change is reported, and the false alarms.

Each set draws a sensor, calibrates it (model 10) from poses spread over the sphere, and monitors
it rest by rest. Changes below `drift_warn` are ignored::

    python benchmarks/watching.py --seed 2030 --markdown docs/figures/watching.md

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibration import Calibration, fit_poses  # noqa: E402
from accel_calib.comparison import compared, Drift, rest_errors  # noqa: E402
from accel_calib.effects import Model, model_with, predict, simulate_poses  # noqa: E402
from accel_calib.geometry import spread_directions  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
from accel_calib.units import MG, units_of  # noqa: E402
from directions import random_directions  # noqa: E402
from figures import Line, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

Attitudes = Callable[[int, np.random.Generator], Floats]

SHIFT, KNOCK = 0.005, 0.05
"""Size of a lasting change, and of a knock [g]."""

LEAST = 0.01 / 9.80665
"""The default of `drift_warn` [g]."""

BEFORE, AFTER = 10, 30
"""Rests before and after a change."""

LIMITS = """\
Limits: with 0.5 mg of noise a change sometimes needs a fourth rest. 12 such poses state 1 mg or
more for some rests, and ten rests show only roughly how well the sensor repeats. With 1 mg of
noise a change of 5 mg is hardly larger than the stated uncertainty. Rests in which an offset is
perpendicular to up do not show it. In random attitudes any three errors look like some offset, so
that knocks are ruled out only if three rests show it clearly. Alarms occur where the sensor
repeats ten times worse than its samples state and 12 poses cannot show it, and where one rest in
twelve is knocked."""


def same(count: int, rng: np.random.Generator) -> Floats:
    """Rest in one attitude."""
    return np.repeat(random_directions(1, rng), count, axis=0)


def few(count: int, rng: np.random.Generator) -> Floats:
    """Rest in five attitudes, in any order."""
    return random_directions(5, rng)[rng.integers(0, 5, count)]


@dataclass(frozen=True)
class Sensor:
    """
    A kind of sensor.

    Parameters
    ----------
    poses : int
        Poses of its calibration.
    noise : float
        Noise of a pose mean, by axis [g].
    repeats : float
        Scatter of the pose means that their samples do not show [g].
    near_faces : bool
        Whether the poses are near the faces instead of spread over the sphere.

    """

    poses: int = 12
    noise: float = 0.0003
    repeats: float = 0.0
    near_faces: bool = False

    def scattered(self, reading: Floats, rng: np.random.Generator) -> Floats:
        """Add the scatter that the samples do not show."""
        return reading + self.repeats * rng.normal(size=reading.shape)

    def made(self, rng: np.random.Generator) -> tuple[Model, Calibration]:
        """Draw a sensor and calibrate it."""
        truth = model_with({'offset': 0.05 * rng.normal(size=3),
                            'axis_gain': 0.02 * rng.normal(size=3),
                            'cross_axis': 0.01 * rng.normal(size=3)})
        up, jitter = spread_directions(self.poses), 0.1
        if self.near_faces:
            up, jitter = np.vstack([np.eye(3), -np.eye(3)] * (self.poses // 6)), 0.04
        up = up + jitter * rng.normal(size=up.shape)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        poses = simulate_poses(truth, up, rng, noise_g=10.0 * self.noise, samples=100)
        poses = poses.with_columns(reading=self.scattered(poses.reading, rng))
        return truth, fit_poses(poses, units_of('g'), model='10')

    def monitored(self, made: tuple[Model, Calibration], up: Floats, shift: Floats,
                  rng: np.random.Generator) -> list[bool]:
        """Return after each rest whether a change is reported."""
        truth, calibration = made
        reading = predict(truth, up, {}) + shift + self.noise * rng.normal(size=up.shape)
        state, reported = Drift(calibration), []
        for rest in rest_errors(calibration, self.scattered(reading, rng),
                                np.full(up.shape, self.noise), {}):
            state = compared(state, rest, LEAST)
            reported.append(state.change is not None)
        return reported


def delay(sensor: Sensor, attitudes: Attitudes, *, offset: bool, rng: np.random.Generator) -> int:
    """Return the number of rests after which a change is reported; 0: before it happens."""
    made = sensor.made(rng)
    up = attitudes(BEFORE + AFTER, rng)
    way = random_directions(1, rng) if offset else up * rng.choice([-1.0, 1.0])
    shift = SHIFT * way * (np.arange(BEFORE + AFTER) >= BEFORE)[:, np.newaxis]
    reported = sensor.monitored(made, up, shift, rng)
    return 0 if any(reported[:BEFORE]) else [*reported[BEFORE:], True].index(True) + 1


def delays(what: str, sensor: Sensor, attitudes: Attitudes, sets: int, rng: np.random.Generator,
           *, offset: bool = False, asked: bool = True) -> Line:
    """Return the line of the delay until a change is reported."""
    found = np.array([delay(sensor, attitudes, offset=offset, rng=rng) for _ in range(sets)])
    shares = [100.0 * np.mean((found > 0) & (found <= rests)) for rests in (3, 4, 6, AFTER)]
    words = (f'{shares[0]:.1f} %; within 4: {shares[1]:.1f}, 6: {shares[2]:.1f}, '
             f'{AFTER}: {shares[3]:.1f} %')
    met = bool(shares[0] == 100.0) if asked else None
    return Line(f'{what}, {sensor.noise * MG:g} mg, {sensor.poses} poses', words,
                '100 % within 3' if asked else '', sets, met)


def alarms(what: str, sensor: Sensor, attitudes: Attitudes, sets: int, rests: int,
           rng: np.random.Generator, *, knocked: float = 0.0) -> Line:
    """Return the line of false alarms."""
    count = wrong = 0
    for _ in range(sets):
        made = sensor.made(rng)
        knock = KNOCK * random_directions(rests, rng)
        knock[rng.random(rests) >= knocked] = 0.0
        reported = np.array(sensor.monitored(made, attitudes(rests, rng), knock, rng), int)
        begun = int(np.sum(np.diff(reported, prepend=0) == 1))
        count, wrong = count + begun, wrong + bool(begun)
    words = f'{count} in {sets * rests:,} rests ({wrong} of {sets} sensors)'
    return Line(f'{what}, {sensor.noise * MG:g} mg, {sensor.poses} poses', words, '0', sets,
                count == 0)


def one_knock(sets: int, rng: np.random.Generator) -> Line:
    """Return the line of single knocks."""
    count, sensor = 0, Sensor()
    for _ in range(sets):
        made, up = sensor.made(rng), same(12, rng)
        knock = KNOCK * random_directions(1, rng) * (np.arange(12) == 5)[:, np.newaxis]
        count += any(sensor.monitored(made, up, knock, rng))
    return Line('one rest knocked by 50 mg, reported as a change', f'{count}', '0', sets,
                count == 0)


def lines(sets: int, long: int, rests: int, seed: int) -> list[Line]:
    """Return all lines."""
    rng = np.random.default_rng(seed)
    sensors = [Sensor(poses, noise) for noise in (0.0001, 0.0003, 0.0005, 0.001)
               for poses in (12, 36)]
    found = [delays('5 mg of length at each rest, one attitude', sensor, same, sets, rng,
                    asked=sensor.noise < 0.001) for sensor in sensors]
    found += [delays('5 mg of length at each rest, any attitude', sensor, random_directions, sets,
                     rng, asked=sensor.noise < 0.001) for sensor in sensors]
    found += [delays('5 mg of offset, any attitude', sensor, random_directions, sets, rng,
                     offset=True, asked=False) for sensor in sensors]
    found += [one_knock(sets, rng)]
    for what, attitudes in (('one attitude', same), ('five attitudes', few),
                            ('any attitude', random_directions)):
        found += [alarms(f'alarms, {what}', Sensor(), attitudes, long, rests, rng)]
    part = max(long // 4, 1)
    found += [
        alarms('alarms, one attitude', Sensor(12, 0.001), same, part, rests, rng),
        alarms('alarms, poses near the faces, any attitude', Sensor(18, near_faces=True),
               random_directions, part, rests, rng),
        alarms('alarms, repeats to 0.3 mg, any attitude', Sensor(36, 0.0001, 0.0003),
               random_directions, part, rests, rng),
        alarms('alarms, repeats to 0.3 mg, any attitude', Sensor(12, 0.0001, 0.0003),
               random_directions, part, rests, rng),
        alarms('alarms, repeats to 1 mg, any attitude', Sensor(12, 0.0001, 0.001),
               random_directions, part, rests, rng),
        alarms('alarms, 2 % of rests knocked, any attitude', Sensor(), random_directions, part,
               rests, rng, knocked=0.02),
        alarms('alarms, 8 % of rests knocked, one attitude', Sensor(), same, part, rests, rng,
               knocked=0.08),
        alarms('alarms, 8 % of rests knocked, any attitude', Sensor(), random_directions, part,
               rests, rng, knocked=0.08)]
    return found


def heading(given: argparse.Namespace) -> str:
    """Return the heading of the page."""
    command = (f'python benchmarks/watching.py --sets {given.sets} --long {given.long} --rests '
               f'{given.rests} --seed {given.seed}')
    return f"""# Figures of drift monitoring

Made by `{command} --markdown FILE`.
The noise is that of a pose mean, by axis; {BEFORE} rests precede the change. A change of length by
5 mg is fully visible at each rest. An offset of 5 mg is visible by the cosine of its angle to up,
2.9 mg RMS over all attitudes. Changes below 1 mg are ignored."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--sets', type=int, default=200, help='sensors per kind of change')
    options.add_argument('--long', type=int, default=20, help='sensors monitored for alarms')
    options.add_argument('--rests', type=int, default=10000, help='rests of each of these sensors')
    given = options.parse_args(arguments)
    text = table(lines(given.sets, given.long, given.rests, given.seed))
    publish(f'{heading(given)}\n\n{text}\n\n{LIMITS}\n', given.markdown)


if __name__ == '__main__':
    main()
