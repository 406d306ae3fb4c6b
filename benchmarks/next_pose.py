# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Number of poses until |a| is known, by the order in which they are taken.

A sensor with offset, gains and cross-axis gains, 0.3 mg of noise per pose mean and axis, is turned
pose by pose: as the node asks, in the order faces, edges, corners, or at random. After each pose
model 10 is fitted, and the RMS error of |a| is measured on fresh directions. A person holds an
attitude 10° off in each of two axes. The result is the number of poses from which on the median
over the sets stays below 0.3 mg.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from accel_calib.calibration import directions_of, fit_poses, next_pose  # noqa: E402
from accel_calib.effects import Model, predict, simulate_poses  # noqa: E402
from accel_calib.errors import RefusedFitError  # noqa: E402
from accel_calib.estimate import pose_noise  # noqa: E402
from accel_calib.geometry import ATTITUDES  # noqa: E402
from accel_calib.table import Floats, Poses  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from directions import held, joined, length_error_mg, random_directions, sensor  # noqa: E402
from figures import Line, markdown, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402

G = units_of('g')
AIM = 0.3
NOISE, SAMPLES = 0.003, 100
FEWEST, MOST = 9, 26
OFF = 10.0
"""How far a person holds an attitude off, in each of two axes [°]."""

SHOWN = (9, 10, 11, 12, 14, 16, 18, 20, 24)

Order = Callable[[Poses | None, int, np.random.Generator], Floats]


def asked(poses: Poses | None, count: int, rng: np.random.Generator) -> Floats:
    """Return the direction that the node asks for; a random attitude once it asks for none."""
    if poses is None:
        found = next_pose(np.zeros((0, 3)))
    else:
        directions = directions_of(poses, G)
        found = next_pose(directions, '10', pose_noise(poses.noise, directions))
    return ATTITUDES[rng.integers(26)] if found.direction is None else found.direction


def in_order(poses: Poses | None, count: int, rng: np.random.Generator) -> Floats:
    """Return the faces, then the edges, then the corners."""
    return ATTITUDES[count % 26]


def at_random(poses: Poses | None, count: int, rng: np.random.Generator) -> Floats:
    """Return a random direction."""
    return random_directions(1, rng)[0]


def of_the_26(poses: Poses | None, count: int, rng: np.random.Generator) -> Floats:
    """Return one of the 26 attitudes."""
    return ATTITUDES[rng.integers(26)]


ORDERS: dict[str, tuple[Order, bool]] = {
    'as asked, held 10° off': (asked, True),
    'as asked, held exactly': (asked, False),
    'faces, edges, corners, held 10° off': (in_order, True),
    'faces, edges, corners, held exactly': (in_order, False),
    'random among the 26, held 10° off': (of_the_26, True),
    'random directions': (at_random, False)}


def error(model: Model, poses: Poses, fresh: Floats) -> float:
    """Return the RMS error of |a| on fresh directions [mg]; infinite if the fit is refused."""
    try:
        fitted = fit_poses(poses, G, model='10')
    except RefusedFitError:
        return np.inf
    return length_error_mg(fitted.correct(predict(model, fresh, {})))


def run(order: Order, by_hand: bool, seed: Sequence[int]) -> tuple[list[float], float]:
    """Return the errors from `FEWEST` poses on, and the number at which the node asks no more."""
    rng = np.random.default_rng(seed)
    model, fresh = sensor(rng), random_directions(500, rng)
    poses: Poses | None = None
    errors, enough = [], np.inf
    for count in range(MOST):
        direction = order(poses, count, rng)[np.newaxis]
        direction = held(direction, OFF, rng) if by_hand else direction
        one = simulate_poses(model, direction, rng, noise_g=NOISE, samples=SAMPLES)
        poses = one if poses is None else joined(poses, one)
        if count + 1 >= FEWEST:
            errors.append(error(model, poses, fresh))
            directions = directions_of(poses, G)
            if next_pose(directions, '10').direction is None:
                enough = min(enough, count + 1)
    return errors, enough


def first_below(medians: Floats) -> int | None:
    """Return the number of poses from which on the median stays below the aim; None: never."""
    above = np.flatnonzero(~(medians <= AIM))
    first = 0 if len(above) == 0 else int(above[-1]) + 1
    return FEWEST + first if first < len(medians) else None


def words_of(count: int | None) -> str:
    """Return a number of poses as text; None: more than were taken."""
    return f'over {MOST}' if count is None else str(count)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    given = parser(__doc__, sets=200, seed=1).parse_args(arguments)
    lines, needed, rows = [], {}, []
    for name, (order, by_hand) in ORDERS.items():
        found = [run(order, by_hand, [given.seed, k]) for k in range(given.sets)]
        medians = np.median([errors for errors, _ in found], axis=0)
        needed[name] = first_below(medians)
        rows.append((name, *(f'{medians[count - FEWEST]:.3f}' for count in SHOWN)))
        lines.append(Line(f'poses to {AIM} mg, {name}', words_of(needed[name]), '', given.sets,
                          None))
        if order is asked:
            enough = np.array([count for _, count in found])
            there = [errors[int(min(count, MOST)) - FEWEST] for errors, count in found]
            lines.append(Line(f'poses when the node asks for no more, {name}',
                              f'{np.median(enough):.0f} ({np.min(enough):.0f} to '
                              f'{np.max(enough):.0f}), {np.median(there):.3f} mg', '',
                              given.sets, None))
    ours = needed['as asked, held 10° off']
    for name in ('random directions', 'random among the 26, held 10° off',
                 'faces, edges, corners, held 10° off'):
        lines.append(Line(f'poses to {AIM} mg: as asked, held 10° off, instead of {name}',
                          f'{words_of(ours)} instead of {words_of(needed[name])}', 'fewer',
                          given.sets, ours is not None and ours < (needed[name] or np.inf)))
    text = (f'# Figures of the next pose\n\n{__doc__.strip()}\n\nMade by `python '
            f'benchmarks/next_pose.py --sets {given.sets} --seed {given.seed} --markdown FILE`.'
            f'\n\n{table(lines)}\n\nMedian error of |a| [mg]:\n\n'
            f'{markdown(("poses", *SHOWN), rows)}\n')
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
