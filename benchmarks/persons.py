# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Persons who do what the guide says, as far as they can: how each of them ends, and when.

The persons are those of ``test/test_persons.py``, in each set with another sensor and hand. A
calibration must hold in the directions that the person can reach: the error of |a| there is
compared with its stated uncertainty::

    python benchmarks/persons.py --sets 40 --markdown docs/figures/persons.md

"""

from __future__ import annotations

import os
from pathlib import Path
import sys
from tempfile import TemporaryDirectory
from unittest.mock import patch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from accel_calib.geometry import ATTITUDES, spread_directions, unit  # noqa: E402
from accel_calib.session import COMMANDS, conditions  # noqa: E402
from driven import Driver, GRAVITY, Person  # noqa: E402
from figures import machine, markdown, parser, publish  # noqa: E402
import numpy as np  # noqa: E402
import test_persons as persons  # noqa: E402

_PAGE = """\
# Persons who cannot follow the guide

Made by `python benchmarks/persons.py {command}` on
{machine}.
Each set is another sensor (offsets of 30 mg, gains of 1.5 %) and another hand, which does what the
next step says as far as this person can, with 2 to 4 s for each rest. *In time*: the end is
reached, or what is in the way is named, within the limit. *Held*: the RMS error of |a| over the
directions within reach is at most 1.96 times the stated one.

{table}

Of {orders} who turn a sound sensor in an own order of sides, of sides and edges, or of any
directions, {told} were told that its axes are swapped or inverted.
"""


def main() -> None:
    given = parser(__doc__, sets=40, seed=1)
    args = given.parse_args()
    rows = [row_of(name, args.sets, args.seed) for name in persons.PERSONS]
    told = [is_told(kind, np.random.default_rng([args.seed, k, kind]))
            for kind in range(3) for k in range(3 * args.sets)]
    heads = ('person', 'ends', 'as expected', 'limit [s]', 'in time', 'median [s]', 'held')
    publish(_PAGE.format(command=' '.join(sys.argv[1:]), machine=machine(),
                         table=markdown(heads, rows), orders=len(told), told=sum(told)),
            args.markdown)


def row_of(name: str, sets: int, seed: int) -> tuple[object, ...]:
    """Return a row of the table."""
    case = persons.PERSONS[name]
    found = [run(case, np.random.default_rng([seed, k, len(name)])) for k in range(sets)]
    ended, seconds, held = (np.array(each, float) for each in zip(*found, strict=True))
    known = held[np.isfinite(held)]
    words = case.ends if case.ends == 'done' else f'{case.ends}: {case.named or "refused"}'
    return (name, words, f'{np.sum(ended):.0f} of {sets}', f'{case.seconds:.0f}',
            f'{np.sum(seconds <= case.seconds):.0f}', f'{np.median(seconds):.0f}',
            f'{np.sum(known):.0f} of {len(known)}' if len(known) else '')


def run(case: persons.Case, rng: np.random.Generator) -> tuple[bool, float, float]:
    """Return whether a person ends as expected, when [s], and whether the error holds."""
    persons.OFFSET = 0.03 * rng.uniform(-1.0, 1.0, 3)
    persons.GAIN = np.eye(3) + 0.015 * np.diag(rng.uniform(-1.0, 1.0, 3))
    with TemporaryDirectory() as home:
        os.environ['ROS_HOME'] = home
        driver = Driver()
        case.change(driver)
        person = Person(driver, case.sensor, **case.about)
        person._rng = rng
        with patch.dict(COMMANDS, dict.fromkeys(case.refuses, persons.refused)):
            ended = person.follow(seconds=400.0 if case.ends in ('done', 'fit') else 40.0)
        seconds = person.times[person.steps.index(ended)]
        named = not case.named or case.named in [
            each.kind for each in conditions(driver.session.state)]
        held = np.nan
        if driver.calibration is not None:
            reach = case.about.get('can_reach', lambda up: True)
            up = np.array([(0.0, 0.0, 1.0), *filter(reach, spread_directions(2000))])
            readings = np.array([case.sensor(each, 25.0) for each in up]) * GRAVITY
            force = driver.calibration.correct(readings)
            error = np.linalg.norm(force, axis=1) - GRAVITY
            along = force / np.linalg.norm(force, axis=1)[:, np.newaxis]
            variance = np.einsum('ni,nij,nj->n', along,
                                 driver.calibration.force_covariance(force), along)
            held = float(np.sqrt(np.mean(error ** 2)) <= 1.96 * np.sqrt(np.mean(variance)))
        driver.session.close()
    return ended == case.ends and named, seconds, held


def is_told(kind: int, rng: np.random.Generator) -> bool:
    """Return whether axes are named though the person only turns in an own order."""
    sides, edges = rng.permutation(ATTITUDES[:6]), rng.permutation(ATTITUDES[6:18])[:6]
    order = (sides, np.vstack([sides, edges]), unit(rng.normal(size=(10, 3))))[kind]
    with TemporaryDirectory() as home:
        os.environ['ROS_HOME'] = home
        driver, told = Driver(), False
        person = Person(driver, persons.reading())
        person._rng = rng
        for up in order:
            person.rest(up, 1.4)
            told |= bool(driver.session.sensor.guide.axes_words)
        driver.session.close()
    return told


if __name__ == '__main__':
    main()
