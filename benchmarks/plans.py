# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Number of poses until an effect is named beside its twin: planned poses against random ones.

More poses of the same sensor are taken by the plan: its first pose, and then the first pose of the
next plan; or at random. A set ends when one twin is certain, or after `MOST` poses.

"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from accel_calib.calibration import PlannedPose
from accel_calib.refinement import refine, Refinement, Step
from accel_calib.table import Floats
from figures import Frame, Line, table
from generator import Around, measure, Setup, simulate, Simulated
import numpy as np
from sensors import simulated_poses
from shared import MPS2, random_directions

TWINS = (('quadratic', 'gain_asymmetry', 3.0, 'wandering'),
         ('cubic', 'odd_quadratic', 3.0, 'wandering'),
         ('offset_temperature', 'offset_drift', 2.0, 'rising'))
"""Twins, the size of the hidden one, and the course of the temperature."""

CERTAIN = 0.95
MOST = 40
TRIES = 400
INTERVAL = 35.0
"""Usual time between poses [s]."""

SUPPLY = 3.3


@dataclass(frozen=True)
class Outcome:
    """The result of one set."""

    planned: float  # poses until a name is certain; infinite: more than `MOST`
    planned_right: bool  # whether that name is the hidden effect
    random: float  # the same with poses at random
    random_right: bool
    before: float  # probability of the hidden effect before the plan,
    expected: float  # that of the right one that the plan states,
    after: float  # and that of the hidden effect with all poses of the plan
    length: int  # poses of the first plan


def add_pose(made: Simulated, up: Floats, temperature: float, wait: float,
             rng: np.random.Generator) -> Simulated:
    """
    Return the poses of a sensor and one more in the pose table.

    `up` is the direction that points up, and `wait` the time since the last pose [s].

    """
    setup = replace(made.setup, poses=1)
    sigma = setup.noise_mg * 1e-3 * setup.shaking ** rng.uniform(size=(1, 3))
    shaking = rng.normal(size=(1, 3, setup.samples)) * sigma[:, :, np.newaxis]
    elapsed, warm = made.columns['time'][-1:] + wait, np.array([temperature])
    around = Around(up[np.newaxis], elapsed, warm, warm, np.zeros(1), np.array([SUPPLY]),
                    rng.normal(size=(1, 3)) * 0.002, shaking, sigma)
    one = measure(rng, setup, around, made.traits, made.values)
    return replace(made, columns={name: np.append(values, one.columns[name])
                                  for name, values in made.columns.items()})


def add_planned(made: Simulated, pose: PlannedPose, wait: float, rng: np.random.Generator
                ) -> Simulated:
    """Add a planned pose; what the plan leaves open is as usual."""
    temperature = pose.context.get('temperature', float(made.columns['temperature'][-1]))
    return add_pose(made, np.array(pose.up), temperature, max(wait, INTERVAL), rng)


def refine_set(made: Simulated, twins: Sequence[str]) -> tuple[Refinement, Step | None]:
    """Return the refinement of the poses, and its step that names one of the twins."""
    found = refine(simulated_poses(made), MPS2, base='10')
    return found, next((step for step in found.steps if step.effect in twins), None)


def take_poses(made: Simulated, twins: Sequence[str], rng: np.random.Generator, *, by_plan: bool
               ) -> tuple[float, bool]:
    """Return the number of poses until one of the twins is certain, and whether it is right."""
    known = made.columns['temperature']
    for count in range(MOST + 1):
        found, step = refine_set(made, twins)
        if step is not None and step.data_probabilities[step.effect] >= CERTAIN:
            return count, step.effect in made.truth
        up, warm = random_directions(1, rng)[0], float(rng.uniform(np.min(known), np.max(known)))
        if by_plan and found.plan.poses:
            first = found.plan.poses[0]
            made = add_planned(made, first, first.context.get('time', 0.0), rng)
        else:
            made = add_pose(made, up, warm, INTERVAL, rng)
    return np.inf, False


def run_set(index: int, seed: int, number: int) -> Outcome | None:
    """Return the outcome of one set, or None if the twins are no rivals in it."""
    first, second, size, course = TWINS[index]
    hidden, twins = (first, second)[number % 2], (first, second)
    made = simulate(np.random.default_rng((seed, index, number)), {hidden: size},
                    Setup(poses=24, rates='small', temperature=course))
    found, step = refine_set(made, twins)
    if step is None or not {*twins} <= {step.effect, *step.rivals} or (
            max(step.data_probabilities.values()) >= CERTAIN or not found.plan.poses):
        return None
    rngs = [np.random.default_rng((seed, index, number, k)) for k in (1, 2, 3)]
    planned = take_poses(made, twins, rngs[0], by_plan=True)
    random = take_poses(made, twins, rngs[1], by_plan=False)
    waited = 0.0
    for pose in found.plan.poses:
        wait = max(pose.context.get('time', 0.0) - waited, INTERVAL)
        waited += wait
        made = add_planned(made, pose, wait, rngs[2])
    after = refine_set(made, twins)[1]
    return Outcome(*planned, *random, step.data_probabilities[hidden],
                   found.plan.poses[-1].expected,
                   after.data_probabilities.get(hidden, 0.0) if after else 0.0,
                   len(found.plan.poses))


def lines_of(name: str, outcomes: Sequence[Outcome]) -> Iterator[Line]:
    sets = len(outcomes)
    planned, random = (float(np.median(each)) for each in zip(*(
        (o.planned, o.random) for o in outcomes)))
    words = [f'{each:.3g}' if np.isfinite(each) else f'over {MOST}' for each in (planned, random)]
    yield Line(f'{name}: poses until one is certain, planned instead of random (median)',
               ' instead of '.join(words), sets, 'fewer', planned < random)
    yield Line(f'{name}: the certain one is the hidden one, planned; random', '; '.join(
        f'{sum(getattr(o, f"{way}_right") for o in outcomes)}/'
        f'{sum(np.isfinite(getattr(o, way)) for o in outcomes)}' for way in ('planned', 'random')),
        sets)
    before, expected, after, length = np.mean([
        (o.before, o.expected, o.after, o.length) for o in outcomes], axis=0)
    error = np.std([o.after for o in outcomes]) / np.sqrt(sets)
    yield Line(f'{name}: mean probability of the hidden one, before the first plan ({length:.1f} '
               'poses); expected after it; found after it',
               f'{before:.2f}; {expected:.2f}; {after:.2f} ± {error:.2f}', sets)


def plans(frame: Frame, sets: int = 12, seed: int = 1) -> Iterator[str]:
    """Yield the table; `sets` is the number for each pair of twins."""
    lines: list[Line] = []
    for index, (first, second, *_) in enumerate(TWINS):
        outcomes: list[Outcome] = []
        for start in range(0, TRIES, sets):
            outcomes += filter(None, frame.run_sets(run_set, sets, index, seed, first=start))
            if len(outcomes) >= sets:
                break
        lines += lines_of(f'{first} and {second}', outcomes[:sets]) if outcomes else []
    yield table(lines)
