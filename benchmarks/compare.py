# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How often repeat runs of one sensor are said to agree, and a change of it is found.

Poses spread evenly in a random attitude, noise of a pose mean 0.3 mg by axis; a sensor is drawn
for each set. The change is 1 mg of offset on one axis in one run::

    python benchmarks/compare.py --sets 200 --markdown docs/figures/compare.md

"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibrate import Calibration, compare, Comparison, fit_poses  # noqa: E402
from accel_calib.model import Model  # noqa: E402
from accel_calib.simulate import model_with, simulate_poses  # noqa: E402
from accel_calib.sphere import rotation_from_rpy, spread_directions  # noqa: E402
from accel_calib.table import Poses  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from shared import sensor  # noqa: E402

_SAID = """\
Repeat runs of one simulated sensor, noise of a pose mean 0.3 mg by axis; then with 1 mg of offset
added on one axis in one run. Two runs of 12 poses have six residuals to tell their noise by, and
1 mg is there four to five standard deviations of an offset; measured noise is not fully believed.

A cross-axis gain of 0.3 mg/g is as small as what 12 poses leave it known to: `auto` takes model 10
where the noise makes it look larger, and model 7, which says zero, elsewhere. Over 20 runs that
choice shows; with `--model 10` it does not. Where the noise is really twice that of the samples,
some poses look disturbed and are left out, so that the residuals of the rest tell too little.
"""

CHANGE_G = 1e-3
MOST_FALSE = 0.05


@dataclass(frozen=True)
class Case:
    """
    What is repeated.

    Parameters
    ----------
    runs, poses : int
        Number of runs, and of poses of each.
    model : str
        What is fitted.
    noise : {'known', 'unknown', 'twice'}
        Whether the poses state it, or state half of it.
    cross_axis : float
        Cross-axis gain over that of a common sensor: where it is as small as the noise,
        ``auto`` takes now model 7, now 10.

    """

    runs: int
    poses: int = 12
    model: str = '10'
    noise: str = 'known'
    cross_axis: float = 1.0

    @property
    def words(self) -> str:
        """Say so for the table."""
        noise = {'known': '', 'unknown': ', noise not given',
                 'twice': ', noise really twice that of the samples'}[self.noise]
        small = '' if self.cross_axis == 1.0 else f' (cross-axis {self.cross_axis * 10:.1f} mg/g)'
        return f'{self.runs} runs of {self.poses} poses, model {self.model}{small}{noise}'


CASES = (*(Case(runs) for runs in (2, 5, 20)), Case(2, 24), Case(5, 24),
         *(Case(runs, model='auto', cross_axis=0.03) for runs in (2, 5, 20)),
         *(Case(runs, noise='unknown') for runs in (2, 5, 20)),
         *(Case(runs, noise='twice') for runs in (2, 5, 20)))


def fitted(model: Model, case: Case, rng: np.random.Generator) -> Calibration:
    """Take poses and fit them."""
    attitude = rotation_from_rpy(*rng.uniform(-np.pi, np.pi, 3))
    poses = simulate_poses(model, spread_directions(case.poses) @ attitude.T, rng)
    if case.noise == 'unknown':
        poses = Poses({'reading': poses.reading}, poses.row)
    if case.noise == 'twice':
        more = rng.normal(size=poses.reading.shape) * np.sqrt(3.0) * poses.noise
        poses = poses.with_columns(reading=poses.reading + more)
    return fit_poses(poses, units_of('g'), model=case.model)


def measured(case: Case, sets: int, seed: int) -> list[tuple[Comparison, Comparison, int]]:
    """Compare runs as they are, and with one of them changed; and give which."""
    found = []
    for number in range(sets):
        rng = np.random.default_rng([seed, CASES.index(case), number])
        model = sensor(rng)
        model = model_with({**model.values,
                            'cross_axis': model.values['cross_axis'] * case.cross_axis})
        runs = [fitted(model, case, rng) for _ in range(case.runs)]
        offset = model.values['offset'].copy()
        offset[rng.integers(3)] += CHANGE_G * rng.choice([-1.0, 1.0])
        changed, which = list(runs), int(rng.integers(case.runs))
        changed[which] = fitted(model_with({**model.values, 'offset': offset}), case, rng)
        found.append((compare(runs), compare(changed), which))
    return found


def lines_of(case: Case, found: Sequence[tuple[Comparison, Comparison, int]]) -> list[Line]:
    """Give the lines of a case."""
    count = len(found)
    false = sum(not same.agree for same, _, _ in found)
    seen = sum(not changed.agree for _, changed, _ in found)
    named = sum(changed.outlier == which for _, changed, which in found)
    ratio = np.median([one.ratio for same, _, _ in found for one in same.parameters if one.ratio])
    asked = case.noise != 'twice'
    lines = [Line(f'{case.words}: said to differ and do not', _share(false, count),
                  '≤ 5 %' if asked else '', count, false <= MOST_FALSE * count if asked else None),
             Line(f'{case.words}: 1 mg in one run found', _share(seen, count), '', count, None)]
    if case.runs > 2:
        lines.append(Line(f'{case.words}: and the run named', _share(named, count), '', count,
                          None))
    if case.runs > 5:
        lines.append(Line(f'{case.words}: spread of a parameter over the stated deviation, median',
                          f'{ratio:.2f}', '', count, None))
    return lines


def _share(count: int, total: int) -> str:
    return f'{100.0 * count / total:.1f} % ({count}/{total})'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--sets', type=int, default=200, help='sets of each case, half of 20 runs')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--markdown', type=Path, help='write the table to this file')
    given = parser.parse_args(arguments)
    lines = []
    for case in CASES:
        sets = max(given.sets // 2 if case.runs > 5 else given.sets, 1)
        lines += lines_of(case, measured(case, sets, given.seed))
        print(case.words, file=sys.stderr, flush=True)
    command = f'python benchmarks/compare.py --sets {given.sets} --seed {given.seed}'
    publish(f'# Figures of compare\n\nMade by `{command} --markdown FILE`.\n\n{_SAID}\n'
            f'{table(lines)}\n', given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
