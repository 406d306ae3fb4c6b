# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Number of poses until an effect is named beside its twin: planned poses against random ones.

Twins are effects that 24 poses often cannot separate: quadratic and gain_asymmetry; cubic and
odd_quadratic; offset_temperature and offset_drift with a temperature that rises with time. The
sets are those of an independent generator (`test/generator.py`) in which one of the twins is
hidden, one is named with the other as its rival, and none has a probability of 95 %.

More poses of the same sensor are then taken. By the plan: its first pose, and then the first pose
of the next plan. At random: a random direction, at a random temperature within the range of the
first poses. A set ends when one twin has a probability of 95 %, or after 40 poses.

The expected probability is compared with the outcome of the whole first plan: the probability that
`refine` then gives to the hidden effect.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
import multiprocessing
import os
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')  # each process has one core

from accel_calib.calibration import PlannedPose  # noqa: E402
from accel_calib.refinement import refine, Refinement, Step  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, parser, publish, table  # noqa: E402
from generator import Around, basis_of, plain_reading, Setup, simulate, Simulated  # noqa: E402
from generator_effects import Floats, STANDARD_GRAVITY, unit  # noqa: E402
import numpy as np  # noqa: E402
from refine_case import poses_of  # noqa: E402

TWINS = (('quadratic', 'gain_asymmetry', 3.0, 'wandering'),
         ('cubic', 'odd_quadratic', 3.0, 'wandering'),
         ('offset_temperature', 'offset_drift', 2.0, 'rising'))
"""Twins, the size of the hidden one, and the course of the temperature."""

CERTAIN = 0.95
MOST = 40
TRIES = 400
INTERVAL = 35.0
"""Usual time between poses [s]."""

_SUPPLY = 3.3


@dataclass(frozen=True)
class Wanted:
    """A pose to take: direction that points up, temperature [°C], time since the first [s]."""

    up: Floats
    temperature: float
    elapsed: float


@dataclass(frozen=True)
class Outcome:
    """
    The result of one set.

    Parameters
    ----------
    planned, random : float
        Number of poses until a name is certain; infinite: more than `MOST`.
    planned_right, random_right : bool
        Whether that name is the hidden effect.
    before, expected, after : float
        Probability of the hidden effect before the plan, that of the right one that the plan
        states, and that of the hidden effect with all poses of the plan.
    length : int
        Number of poses of the first plan.

    """

    planned: float
    random: float
    planned_right: bool
    random_right: bool
    before: float
    expected: float
    after: float
    length: int


def with_pose(made: Simulated, columns: Mapping[str, Floats], wanted: Wanted,
              rng: np.random.Generator) -> dict[str, Floats]:
    """Return the columns of the pose table with one more pose of the same sensor."""
    setup = made.setup
    sigma = setup.noise_mg * 1e-3 * setup.shaking ** rng.uniform(size=(1, 3))
    shaking = rng.normal(size=(1, 3, setup.samples)) * sigma[:, :, np.newaxis]
    temperature = np.array([wanted.temperature])
    around = Around(wanted.up[np.newaxis], np.array([wanted.elapsed]), temperature, temperature,
                    np.zeros(1), np.array([_SUPPLY]), rng.normal(size=(1, 3)) * 0.002, shaking,
                    sigma)
    reading = plain_reading(around, made.traits)
    for name, values in made.values.items():
        reading = reading + basis_of(name, around, made.traits) @ values
    step = setup.step_mg * 1e-3
    output = np.round((reading[:, :, np.newaxis] + shaking) / step) * step * STANDARD_GRAVITY
    mean, std = np.mean(output, axis=2)[0], np.std(output, axis=2, ddof=1)[0]
    one = {'time': around.elapsed[0], 'count': float(setup.samples),
           'temperature': wanted.temperature, 'supply_voltage': _SUPPLY,
           **dict(zip(('ax', 'ay', 'az'), mean)), **dict(zip(('std_x', 'std_y', 'std_z'), std)),
           **dict(zip(('gx', 'gy', 'gz'), around.rate[0]))}
    return {name: np.append(values, one[name]) for name, values in columns.items()}


def refined(made: Simulated, columns: Mapping[str, Floats]) -> Refinement:
    """Return the refinement of the poses of a table."""
    count = len(columns['time'])
    table_ = Simulated(columns, made.truth, {}, made.noise, made.around, made.traits,
                       made.values, Setup(poses=count))
    return refine(poses_of(table_), units_of('m/s2'), base='10')


def step_of(found: Refinement, twins: Sequence[str]) -> Step | None:
    """Return the step that names one of the twins, or None."""
    return next((step for step in found.steps if step.effect in twins), None)


def as_planned(pose: PlannedPose, columns: Mapping[str, Floats]) -> Wanted:
    """Return a planned pose; what the plan leaves open is as usual."""
    wait = max(pose.context.get('time', 0.0), INTERVAL)
    temperature = pose.context.get('temperature', float(columns['temperature'][-1]))
    return Wanted(np.array(pose.up), temperature, float(columns['time'][-1]) + wait)


def at_random(columns: Mapping[str, Floats], known: Floats, rng: np.random.Generator) -> Wanted:
    """Return a random direction, at a random temperature within the range of the first poses."""
    return Wanted(unit(rng.normal(size=(1, 3)))[0],
                  float(rng.uniform(np.min(known), np.max(known))),
                  float(columns['time'][-1]) + INTERVAL)


def until_certain(made: Simulated, twins: Sequence[str], rng: np.random.Generator, *,
                  by_plan: bool) -> tuple[float, bool]:
    """Return the number of poses until one of the twins is certain, and whether it is right."""
    columns, known = dict(made.columns), made.columns['temperature']
    for count in range(MOST + 1):
        found = refined(made, columns)
        step = step_of(found, twins)
        if step is not None and step.data_probabilities[step.effect] >= CERTAIN:
            return count, step.effect in made.truth
        wanted = at_random(columns, known, rng)
        if by_plan and found.plan.poses:
            wanted = as_planned(found.plan.poses[0], columns)
        columns = with_pose(made, columns, wanted, rng)
    return np.inf, False


def after_plan(made: Simulated, found: Refinement, twins: Sequence[str],
               rng: np.random.Generator) -> float:
    """Return the probability of the hidden effect with all poses of a plan."""
    columns, waited = dict(made.columns), 0.0
    for pose in found.plan.poses:
        wanted = as_planned(pose, columns)
        more = max(pose.context.get('time', 0.0) - waited, INTERVAL)
        waited += more
        columns = with_pose(made, columns, Wanted(
            wanted.up, wanted.temperature, float(columns['time'][-1]) + more), rng)
    step = step_of(refined(made, columns), twins)
    return 0.0 if step is None else step.data_probabilities.get(next(iter(made.truth)), 0.0)


def run(case: tuple[tuple[str, str, float, str], tuple[int, ...]]) -> Outcome | None:
    """Return the outcome of one set, or None if the twins are no rivals in it."""
    (first, second, size, course), seed = case
    hidden = (first, second)[seed[-1] % 2]
    made = simulate(np.random.default_rng(seed), {hidden: size},
                    Setup(poses=24, rates='small', temperature=course))
    found = refined(made, made.columns)
    step = step_of(found, (first, second))
    if step is None or not {first, second} <= {step.effect, *step.rivals} or (
            max(step.data_probabilities.values()) >= CERTAIN or not found.plan.poses):
        return None
    planned = until_certain(made, (first, second), np.random.default_rng((*seed, 1)), by_plan=True)
    random = until_certain(made, (first, second), np.random.default_rng((*seed, 2)), by_plan=False)
    return Outcome(planned[0], random[0], planned[1], random[1], step.data_probabilities[hidden],
                   found.plan.poses[-1].expected,
                   after_plan(made, found, (first, second), np.random.default_rng((*seed, 3))),
                   len(found.plan.poses))


def outcomes_of(index: int, sets: int, seed: int, jobs: int) -> list[Outcome]:
    """Return the outcomes of the first sets in which the twins are rivals."""
    cases = [(TWINS[index], (seed, index, number)) for number in range(TRIES)]
    if jobs == 1:
        return list(islice(filter(None, map(run, cases)), sets))
    with multiprocessing.get_context('spawn').Pool(jobs) as pool:
        return list(islice(filter(None, pool.imap(run, cases)), sets))


def median_words(counts: Sequence[float]) -> str:
    """Return the median number of poses as text."""
    median = float(np.median(counts))
    return f'{median:.3g}' if np.isfinite(median) else f'over {MOST}'


def lines_of(name: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of one pair of twins."""
    sets = len(outcomes)
    planned, random = [o.planned for o in outcomes], [o.random for o in outcomes]
    right = [sum(o.planned_right for o in outcomes), sum(o.random_right for o in outcomes)]
    ended = [sum(np.isfinite(each)) for each in (planned, random)]
    before, expected, after = (np.mean([getattr(o, key) for o in outcomes])
                               for key in ('before', 'expected', 'after'))
    error = np.std([o.after for o in outcomes]) / np.sqrt(sets)
    return [Line(f'{name}: poses until one is certain, planned instead of random (median)',
                 f'{median_words(planned)} instead of {median_words(random)}', 'fewer', sets,
                 bool(np.median(planned) < np.median(random))),
            Line(f'{name}: the certain one is the hidden one, planned; random',
                 f'{right[0]}/{ended[0]}; {right[1]}/{ended[1]}', '', sets, None),
            Line(f'{name}: mean probability of the hidden one, before the first plan '
                 f'({np.mean([o.length for o in outcomes]):.1f} poses); expected after it; found '
                 'after it', f'{before:.2f}; {expected:.2f}; {after:.2f} ± {error:.2f}', '', sets,
                 None)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1, jobs=1)
    options.add_argument('--sets', type=int, default=12, help='sets for each pair of twins')
    given = options.parse_args(arguments)
    lines = []
    for index, (first, second, *_) in enumerate(TWINS):
        outcomes = outcomes_of(index, given.sets, given.seed, given.jobs)
        print(f'{first}: {len(outcomes)} sets', file=sys.stderr, flush=True)
        lines += lines_of(f'{first} and {second}', outcomes) if outcomes else []
    publish(f'# Figures of the plans\n\n{__doc__.strip()}\n\nMade by `python benchmarks/plans.py '
            f'--sets {given.sets} --seed {given.seed} --markdown FILE`.\n\n{table(lines)}\n',
            given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
