# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Measure the stillness detector on simulated recordings and on real ones.

A pose belongs to the rest that it overlaps most, if that is more than half of it; otherwise it is
false. Its error is its mean less the true specific force of that rest, less the norm error where
only |a| counts. The normalised error is error / stated noise, and has a standard deviation of 1
where the statement is right.

"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
import sys
from typing import NamedTuple

from accel_calib.table import Floats
from figures import Line, publish, table
import numpy as np
from stillness_case import Case, case_of, KINDS
from stillness_real import table_of_real
import stillness_rules as rules

DATA = Path(__file__).parents[2] / 'shared' / 'data'

RULES: dict[str, Callable[[Case], list[rules.Pose]]] = {
    'ours': lambda case: rules.ours(case, gyro=False),
    'ours, gyro': lambda case: rules.ours(case, gyro=True),
    'variance': rules.variance,
    'gyro': rules.gyro}

WHAT = {'plain': 'hand-turned only', 'tremor': 'and held in the hand, tremor of 1 to 10 mg',
        'turning': 'and turned at 0.5 to 5 °/s', 'footsteps': 'steps of 2 to 20 mg beside it',
        'motor': 'a motor of 2 to 32 mg idles'}

ABOUT = """# Figures of the stillness detector

Made by `python benchmarks/stillness.py {command} --markdown FILE`.
Each recording has ten rests of 2.5 to 8 s, 50 to 1000 Hz, noise that is white or has a
correlation time of 20 or 200 ms, and a gyro with 2 mrad/s of noise and a bias. *variance* (three
times the standard deviation of the first two seconds, as imu_tk and others do) and *gyro* (mean
rate within 0.5 °/s of that of the first two seconds) are told that the recording begins with a
rest; ours is not. A false pose lies for its greater part where the sensor moved. A normalised
error is that of a pose mean over its stated noise std/√count, and should have a standard
deviation of 1; the largest 1 % are left out of it, and show under *largest*. For false poses it
is that against the true force in their middle: a tremor below the noise of the sensor harms no
mean. Footsteps and an idling motor are rests too, for their means are right."""

NOT_REACHED = """\
Not reached, or less than others: beside an idling motor the stated noise is too large, for
vibration averages out faster than the noise it is taken for. With 50 mg a turn that goes on
slower than the noise wanders (correlation 200 ms) is not always told from it; most rests of a few
seconds are refused there unless a gyro tells, for they cannot show that they were not turned.
Steps that stand far out of a quiet sensor's noise cost rests that a threshold learned among them
keeps. A tremor below some twice the noise passes as
rest; held against the true force, such poses are as good as their stated noise."""

ABOUT_REAL = """\
A fit of 10 parameters to the poses, every pose kept; nobody knows the truth of these. The gyro of
the Xsens recording is in counts, which no threshold in °/s fits."""


class Score(NamedTuple):
    """
    What a rule made of a recording.

    Parameters
    ----------
    moving, taken : int
        Samples while moving, and those of them in poses.
    resting, used : int
        Samples at rest, and those of them in poses.
    false : (m, 3) array
        Normalised errors of poses that are no rests.
    errors, norms, scores : (m, 3), (m,), (m, 3) arrays
        Errors of pose means, errors of their norms [g], and normalised errors.
    rests, missed : int
        Rests, and those without a pose.

    """

    moving: int
    taken: int
    resting: int
    used: int
    false: Floats
    errors: Floats
    norms: Floats
    scores: Floats
    rests: int
    missed: int


def score(case: Case, poses: Sequence[rules.Pose]) -> Score:
    """Hold poses against the truth."""
    inside = np.zeros(len(case.time), dtype=bool)
    errors, norms, scores, false = [], [], [], []
    hit: set[int] = set()
    for pose in poses:
        first, last = np.searchsorted(case.time, [pose.start - 1e-9, pose.end + 1e-9])
        inside[first:last] = True
        common = np.minimum(case.rests[:, 1], last) - np.maximum(case.rests[:, 0], first)
        best = int(np.argmax(common))
        if common[best] <= 0.5 * (last - first):
            false.append((pose.mean - case.force[(first + last) // 2]) / pose.noise)
            continue
        error = pose.mean - case.force[case.rests[best, 0]]
        hit.add(best)
        errors.append(error)
        norms.append(np.linalg.norm(pose.mean) - 1.0)
        scores.append(error / pose.noise)
    still = ~case.moving
    return Score(int(case.moving.sum()), int((inside & case.moving).sum()), int(still.sum()),
                 int((inside & still).sum()), np.array(false).reshape(-1, 3),
                 np.array(errors).reshape(-1, 3),
                 np.array(norms), np.array(scores).reshape(-1, 3), len(case.rests),
                 len(case.rests) - len(hit))


class Sum(NamedTuple):
    """Scores of many recordings: shares, false poses, errors [mg], normalised errors."""

    taken: float
    used: float
    false: int
    missed: float
    error: float
    worst: float
    norm: float
    normalised: float
    of_false: float


def summed(scores: Sequence[Score]) -> Sum:
    """Sum up the scores of many recordings."""
    errors = 1e3 * np.concatenate([each.errors for each in scores])
    norms = 1e3 * np.concatenate([each.norms for each in scores])
    return Sum(sum(x.taken for x in scores) / max(sum(x.moving for x in scores), 1),
               sum(x.used for x in scores) / sum(x.resting for x in scores),
               sum(len(x.false) for x in scores),
               sum(x.missed for x in scores) / sum(x.rests for x in scores),
               float(np.median(np.abs(errors))) if len(errors) else np.nan,
               float(np.max(np.abs(errors), initial=0.0)), _rms(norms, 1.0),
               _rms(np.concatenate([each.scores for each in scores]), 0.99),
               _rms(np.concatenate([each.false for each in scores]), 0.99))


def _rms(values: Floats, share: float) -> float:
    """Give the root mean square of this share of the values, the largest left out."""
    squares = np.sort(np.square(values), axis=None)
    kept = squares[:int(np.ceil(share * len(squares)))]
    return float(np.sqrt(np.mean(kept))) if len(kept) else np.nan


def measured(sets: int, seed: int, noisy: bool) -> dict[tuple[str, str], Sum]:
    """Run all rules on recordings of all kinds."""
    found: dict[tuple[str, str], list[Score]] = {}
    for kind in KINDS:
        for number in range(sets):
            case = case_of(kind, seed, number, noisy)
            for name, rule in RULES.items():
                found.setdefault((kind, name), []).append(score(case, rule(case)))
        print(f'{kind}: {sets} recordings', file=sys.stderr, flush=True)
    return {key: summed(scores) for key, scores in found.items()}


def compared(found: dict[tuple[str, str], Sum]) -> str:
    """Give the table of all rules on all kinds, as Markdown."""
    heads = ('recordings', 'rule', 'moving samples in poses', 'rest used', 'rests missed',
             'false poses',
             'median error of a mean, mg', 'largest, mg',
             'RMS error of its norm, mg', 'normalised error', 'the same of false poses')
    rows = [f'| {" | ".join(heads)} |', '|---' * len(heads) + '|']
    for (kind, rule), x in found.items():
        rows.append(f'| {WHAT[kind]} | {rule} | {x.taken:.2%} | {x.used:.1%} | {x.missed:.1%} '
                    f'| {x.false} | {x.error:.3f} | {x.worst:.1f} | {x.norm:.3f} '
                    f'| {x.normalised:.2f} | {_figure(x.of_false)} |')
    return '\n'.join(rows)


def _figure(value: float) -> str:
    return f'{value:.2f}' if np.isfinite(value) else ''


def lines_of(found: dict[tuple[str, str], Sum], noise: str, sets: int) -> list[Line]:
    """Give what is asked of the detector beside what was measured."""
    lines = []
    for rule in ('ours', 'ours, gyro'):
        turning = found['turning', rule]
        lines.append(Line(f'{noise}, {rule}: poses taken while turning slowly',
                          str(turning.false), '0', sets, turning.false == 0))
        for kind in KINDS:
            x = found[kind, rule]
            lines.append(Line(f'{noise}, {rule}, {WHAT[kind]}: normalised error of pose means',
                              f'{x.normalised:.2f}', '0.85 to 1.15', sets,
                              0.85 <= x.normalised <= 1.15))
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').strip().splitlines()[0])
    parser.add_argument('--sets', type=int, default=60, help='recordings of each kind')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--data', type=Path, default=DATA, help='folder of the real recordings')
    parser.add_argument('--markdown', type=Path, help='write the tables to this file')
    given = parser.parse_args(arguments)
    usual = measured(given.sets, given.seed, noisy=False)
    noisy = measured(given.sets, given.seed, noisy=True)
    lines = lines_of(usual, 'noise 0.3 to 5 mg', given.sets)
    lines += lines_of(noisy, 'noise 50 mg', given.sets)
    parts = [ABOUT.format(command=f'--sets {given.sets} --seed {given.seed}'), table(lines),
             NOT_REACHED, '## Noise 0.3 to 5 mg', compared(usual), '## Noise 50 mg',
             compared(noisy)]
    if given.data.is_dir():
        parts += ['## Real recordings', ABOUT_REAL, table_of_real(given.data, RULES)]
    text = '\n\n'.join(parts) + '\n'
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
