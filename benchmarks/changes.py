# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Changes of a sensor: whether repeat runs show them, and after how many rests monitoring does.

A set of `compare` draws a sensor; the poses of its runs are spread evenly in a random attitude. A
set of `watching` draws a sensor, calibrates it (model 10) from poses spread over the sphere, and
monitors it rest by rest.

"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from accel_calib.calibration import Calibration, fit_poses
from accel_calib.comparison import (
    compare as compare_runs, compared, Comparison, Drift, rest_errors)
from accel_calib.effects import Model, model_with, predict, simulate_poses
from accel_calib.geometry import rotation_from_rpy, spread_directions, unit
from accel_calib.table import Floats
from accel_calib.units import MG
from figures import check, Frame, Line, share, table, tell
import numpy as np
from shared import FACES, G, random_directions, sensor as draw_sensor

# ------------------------------------------------------------------------------------ repeat runs

CHANGE_G = 1e-3
NOISES = {'known': '', 'unknown': ', noise not given',
          'twice': ', noise really twice that of the samples',
          'scatter': ', scatter of 5 to 50 times the noise'}
"""What the poses state of their noise; for 'scatter', it differs up to ten times."""

MORE = {'twice': np.sqrt(3.0), 'scatter': 5.0}
"""Standard deviation of what is added to the poses, over their noise."""


@dataclass(frozen=True)
class Case:
    """
    The runs of one set.

    `cross_axis` is a factor on the cross-axis gain of a common sensor. Where the result is as
    small as the noise, ``auto`` chooses sometimes model 7, sometimes 10.

    """

    runs: int
    poses: int = 12  # per run
    model: str = '10'  # that is fitted
    noise: str = 'known'  # of `NOISES`
    cross_axis: float = 1.0

    @property
    def words(self) -> str:
        """Return the case in words, for the table."""
        small = '' if self.cross_axis == 1.0 else f' (cross-axis {self.cross_axis * 10:.1f} mg/g)'
        return (f'{self.runs} runs of {self.poses} poses, model {self.model}{small}'
                + NOISES[self.noise])


CASES = (*(Case(runs) for runs in (2, 5, 20)), Case(2, 24), Case(5, 24),
         *(Case(runs, model='auto', cross_axis=0.03) for runs in (2, 5, 20)),
         *(Case(runs, noise='unknown') for runs in (2, 5, 20)),
         *(Case(runs, noise='twice') for runs in (2, 5, 20)),
         *(Case(2, poses, noise='scatter') for poses in (12, 24, 60)))


def fit_run(model: Model, case: Case, rng: np.random.Generator) -> Calibration:
    """Simulate a run and fit it."""
    attitude = rotation_from_rpy(*rng.uniform(-np.pi, np.pi, 3))
    poses = simulate_poses(model, spread_directions(case.poses) @ attitude.T, rng)
    if case.noise == 'unknown':
        poses = poses.without_columns('std', 'count')
    if case.noise in MORE:
        more = MORE[case.noise] * rng.normal(size=poses.reading.shape) * np.asarray(poses.noise)
        poses = poses.with_columns(reading=poses.reading + more)
    if case.noise == 'scatter':
        poses = poses.with_columns(std=poses['std'] * rng.uniform(0.1, 1.0, (case.poses, 1)))
    return fit_poses(poses, G, model=case.model)


def compare_set(index: int, seed: int, number: int) -> tuple[Comparison, Comparison, int]:
    """Compare the runs unchanged and with one changed; return both, and which one changed."""
    case, rng = CASES[index], np.random.default_rng([seed, index, number])
    values = draw_sensor(rng).values
    values = {**values, 'cross_axis': values['cross_axis'] * case.cross_axis}
    runs = [fit_run(model_with(values), case, rng) for _ in range(case.runs)]
    offset = values['offset'].copy()
    offset[rng.integers(3)] += CHANGE_G * rng.choice([-1.0, 1.0])
    changed, which = list(runs), int(rng.integers(case.runs))
    changed[which] = fit_run(model_with({**values, 'offset': offset}), case, rng)
    return compare_runs(runs), compare_runs(changed), which


def lines_of(case: Case, found: Sequence[tuple[Comparison, Comparison, int]]) -> Iterator[Line]:
    is_judged = case.noise in ('known', 'unknown')
    yield share(f'{case.words}: equal runs reported to differ',
                (not same.agree for same, _, _ in found), most=5.0 if is_judged else np.inf)
    yield share(f'{case.words}: 1 mg in one run detected',
                (not changed.agree for _, changed, _ in found))
    if case.runs > 2:
        yield share(f'{case.words}: the changed run named',
                    (changed.outlier == which for _, changed, which in found))
    if case.runs > 5:
        ratio = np.median([each.ratio for same, _, _ in found for each in same.parameters
                           if each.ratio])
        yield Line(f'{case.words}: spread of a parameter over its stated deviation, median',
                   f'{ratio:.2f}', len(found))


def compare(frame: Frame, sets: int = 200, seed: int = 1) -> Iterator[str]:
    """Yield the page of repeat runs; `sets` is that of each case, half of 20 runs."""
    lines: list[Line] = []
    for index, case in enumerate(CASES):
        count = max(sets // 2 if case.runs > 5 else sets, 1)
        lines += lines_of(case, frame.run_sets(compare_set, count, index, seed))
    yield table(lines)


# -------------------------------------------------------------------------------------- monitoring

Attitudes = Callable[[int, np.random.Generator], Floats]

SHIFT, KNOCK = 0.005, 0.05
"""Size of a lasting change, and of a knock [g]."""

LEAST = 0.01 / 9.80665
"""The default of `drift_warn` [g]."""

BEFORE, AFTER = 10, 30
"""Rests before and after a change."""


def rest_in_one(count: int, rng: np.random.Generator) -> Floats:
    """Rest in one attitude."""
    return np.repeat(random_directions(1, rng), count, axis=0)


def rest_in_five(count: int, rng: np.random.Generator) -> Floats:
    """Rest in five attitudes, in any order."""
    return random_directions(5, rng)[rng.integers(0, 5, count)]


@dataclass(frozen=True)
class Sensor:
    """A kind of sensor."""

    poses: int = 12  # of its calibration
    noise: float = 0.0003  # of a pose mean, by axis [g]
    repeats: float = 0.0  # scatter of the pose means that their samples do not show [g]
    near_faces: bool = False  # whether the poses are near the faces, not spread over the sphere

    @property
    def words(self) -> str:
        """Return noise and poses in words, for the table."""
        return f'{self.noise * MG:g} mg, {self.poses} poses'

    def calibrate(self, rng: np.random.Generator) -> tuple[Model, Calibration]:
        """Draw a sensor and calibrate it."""
        truth = draw_sensor(rng)
        up, jitter = spread_directions(self.poses), 0.1
        if self.near_faces:
            up, jitter = np.vstack([FACES] * (self.poses // 6)), 0.04
        up = unit(up + jitter * rng.normal(size=up.shape))
        poses = simulate_poses(truth, up, rng, noise_g=10.0 * self.noise, samples=100)
        scatter = self.repeats * rng.normal(size=up.shape)
        return truth, fit_poses(poses.with_columns(reading=poses.reading + scatter), G, model='10')

    def monitor(self, made: tuple[Model, Calibration], up: Floats, shift: Floats,
                rng: np.random.Generator) -> list[bool]:
        """Return after each rest whether a change is reported."""
        truth, calibration = made
        reading = predict(truth, up, {}) + shift + self.noise * rng.normal(size=up.shape)
        reading = reading + self.repeats * rng.normal(size=up.shape)
        state, reported = Drift(calibration), []
        for rest in rest_errors(calibration, reading, np.full(up.shape, self.noise), {}):
            state = compared(state, rest, LEAST)
            reported.append(state.change is not None)
        return reported


def delay_line(what: str, sensor: Sensor, attitudes: Attitudes, sets: int,
               rng: np.random.Generator, *, offset: bool = False) -> Line:
    """Return the line of the number of rests until a change is reported; 0: before it happens."""
    found = []
    for _ in range(sets):
        made = sensor.calibrate(rng)
        up = attitudes(BEFORE + AFTER, rng)
        way = random_directions(1, rng) if offset else up * rng.choice([-1.0, 1.0])
        shift = SHIFT * way * (np.arange(BEFORE + AFTER) >= BEFORE)[:, np.newaxis]
        reported = sensor.monitor(made, up, shift, rng)
        found.append(0 if any(reported[:BEFORE])
                     else [*reported[BEFORE:], True].index(True) + 1)
    each, asked = np.array(found), not offset and sensor.noise < 0.001
    shares = [100.0 * np.mean((each > 0) & (each <= rests)) for rests in (3, 4, 6, AFTER)]
    tell(what, sensor.words)
    return Line(f'{what}, {sensor.words}', f'{shares[0]:.1f} %; within 4: {shares[1]:.1f}, 6: '
                f'{shares[2]:.1f}, {AFTER}: {shares[3]:.1f} %', sets,
                '100 % within 3' if asked else '', bool(shares[0] == 100.0) if asked else None)


def alarm_line(what: str, sensor: Sensor, attitudes: Attitudes, sets: int, rests: int,
               rng: np.random.Generator, *, knocked: float = 0.0) -> Line:
    """Return the line of false alarms, with a share of the rests knocked."""
    count = wrong = 0
    for _ in range(sets):
        made = sensor.calibrate(rng)
        knock = KNOCK * random_directions(rests, rng)
        knock[rng.random(rests) >= knocked] = 0.0
        reported = np.array(sensor.monitor(made, attitudes(rests, rng), knock, rng), int)
        begun = int(np.sum(np.diff(reported, prepend=0) == 1))
        count, wrong = count + begun, wrong + bool(begun)
    tell('alarms', what, sensor.words)
    return check(f'alarms, {what}, {sensor.words}', f'{count} in {sets * rests:,} rests ({wrong} '
                 f'of {sets} sensors)', count, least=0, most=0, sets=sets)


def watching(frame: Frame, sets: int = 200, long: int = 20, rests: int = 10_000, seed: int = 1
             ) -> Iterator[str]:
    """Yield the page: `sets` sensors for each change, and `long` over `rests` each for alarms."""
    lines = []
    rng, one, anywhere = np.random.default_rng(seed), rest_in_one, random_directions
    sensors = [Sensor(poses, noise) for noise in (0.0001, 0.0003, 0.0005, 0.001)
               for poses in (12, 36)]
    for what, attitudes in (('one', one), ('any', anywhere)):
        for sensor in sensors:
            lines.append(delay_line(f'5 mg of length at each rest, {what} attitude', sensor,
                                    attitudes, sets, rng))
    lines += [delay_line('5 mg of offset, any attitude', sensor, anywhere, sets, rng, offset=True)
              for sensor in sensors]
    reported = 0
    for _ in range(sets):
        made, up = Sensor().calibrate(rng), rest_in_one(12, rng)
        knock = KNOCK * random_directions(1, rng) * (np.arange(12) == 5)[:, np.newaxis]
        reported += any(Sensor().monitor(made, up, knock, rng))
    lines.append(check('one rest knocked by 50 mg, reported as a change', f'{reported}', reported,
                       least=0, most=0, sets=sets))
    for what, sensor, attitudes, knocked in (
            ('one attitude', Sensor(), one, 0.0), ('five attitudes', Sensor(), rest_in_five, 0.0),
            ('any attitude', Sensor(), anywhere, 0.0),
            ('one attitude', Sensor(12, 0.001), one, 0.0),
            ('poses near the faces, any attitude', Sensor(18, near_faces=True), anywhere, 0.0),
            ('repeats to 0.3 mg, any attitude', Sensor(36, 0.0001, 0.0003), anywhere, 0.0),
            ('repeats to 0.3 mg, any attitude', Sensor(12, 0.0001, 0.0003), anywhere, 0.0),
            ('repeats to 1 mg, any attitude', Sensor(12, 0.0001, 0.001), anywhere, 0.0),
            ('2 % of rests knocked, any attitude', Sensor(), anywhere, 0.02),
            ('8 % of rests knocked, one attitude', Sensor(), one, 0.08),
            ('8 % of rests knocked, any attitude', Sensor(), anywhere, 0.08)):
        count = long if sensor == Sensor() and not knocked else max(long // 4, 1)
        lines.append(alarm_line(what, sensor, attitudes, count, rests, rng, knocked=knocked))
    yield table(lines)
