# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Repeat runs of one sensor: how often they are reported to agree, and how often a change is found.

Each set draws a sensor. The poses are spread evenly in a random attitude, with 0.3 mg of noise per
pose mean and axis. The change is 1 mg of offset on one axis in one run::

    python benchmarks/compare.py --sets 200 --markdown docs/figures/compare.md

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import os
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')

from accel_calib.calibration import Calibration, fit_poses  # noqa: E402
from accel_calib.comparison import compare, Comparison  # noqa: E402
from accel_calib.effects import Model, model_with, simulate_poses  # noqa: E402
from accel_calib.geometry import rotation_from_rpy, spread_directions  # noqa: E402
from accel_calib.table import Poses  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from shared import sensor  # noqa: E402

_ABOUT = """\
Repeat runs of one simulated sensor, with 0.3 mg of noise per pose mean and axis, compared as they
are and with 1 mg of offset added on one axis in one run. Two runs of 12 poses leave six residuals
to estimate the noise from, and 1 mg is four to five standard deviations of an offset there.
Measured noise is not fully believed.

12 poses determine a cross-axis gain to about 0.3 mg/g. Where a sensor has so little, `auto`
chooses model 10 if the noise makes it look larger, and otherwise model 7, which sets it to zero.
The comparison of 20 runs detects this difference; with `--model 10` there is none. Where the noise
is really twice that of the samples, 1 mg is half as large beside it.
"""

_MORE = {'twice': np.sqrt(3.0), 'scatter': 5.0}
"""Standard deviation of what is added to the poses, over their noise."""

CHANGE_G = 1e-3
MOST_FALSE = 0.05


@dataclass(frozen=True)
class Case:
    """
    The runs of one set.

    Parameters
    ----------
    runs, poses : int
        Number of runs, and of poses per run.
    model : str
        The model that is fitted.
    noise : {'known', 'unknown', 'twice', 'scatter'}
        Whether the poses state their noise. For 'twice', it is really twice what they state. For
        'scatter', it differs up to ten times, and they scatter by five times the largest.
    cross_axis : float
        Factor on the cross-axis gain of a common sensor. Where the result is as small as the
        noise, ``auto`` chooses sometimes model 7, sometimes 10.

    """

    runs: int
    poses: int = 12
    model: str = '10'
    noise: str = 'known'
    cross_axis: float = 1.0

    @property
    def words(self) -> str:
        """Return the case in words, for the table."""
        noise = {'known': '', 'unknown': ', noise not given',
                 'twice': ', noise really twice that of the samples',
                 'scatter': ', scatter of 5 to 50 times the noise'}[self.noise]
        small = '' if self.cross_axis == 1.0 else f' (cross-axis {self.cross_axis * 10:.1f} mg/g)'
        return f'{self.runs} runs of {self.poses} poses, model {self.model}{small}{noise}'


CASES = (*(Case(runs) for runs in (2, 5, 20)), Case(2, 24), Case(5, 24),
         *(Case(runs, model='auto', cross_axis=0.03) for runs in (2, 5, 20)),
         *(Case(runs, noise='unknown') for runs in (2, 5, 20)),
         *(Case(runs, noise='twice') for runs in (2, 5, 20)),
         *(Case(2, poses, noise='scatter') for poses in (12, 24, 60)))


def fitted(model: Model, case: Case, rng: np.random.Generator) -> Calibration:
    """Simulate a run and fit it."""
    attitude = rotation_from_rpy(*rng.uniform(-np.pi, np.pi, 3))
    poses = simulate_poses(model, spread_directions(case.poses) @ attitude.T, rng)
    if case.noise == 'unknown':
        poses = Poses({'reading': poses.reading}, poses.row)
    if case.noise in _MORE:
        more = _MORE[case.noise] * rng.normal(size=poses.reading.shape) * np.asarray(poses.noise)
        poses = poses.with_columns(reading=poses.reading + more)
    if case.noise == 'scatter':
        poses = poses.with_columns(std=poses['std'] * rng.uniform(0.1, 1.0, (case.poses, 1)))
    return fit_poses(poses, units_of('g'), model=case.model)


def measured(case: Case, sets: int, seed: int) -> list[tuple[Comparison, Comparison, int]]:
    """Compare the runs unchanged and with one changed; return both, and which one changed."""
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
    """Return the lines of a case."""
    count = len(found)
    false = sum(not same.agree for same, _, _ in found)
    seen = sum(not changed.agree for _, changed, _ in found)
    named = sum(changed.outlier == which for _, changed, which in found)
    ratio = np.median([one.ratio for same, _, _ in found for one in same.parameters if one.ratio])
    asked = case.noise in ('known', 'unknown')
    lines = [Line(f'{case.words}: equal runs reported to differ', _share(false, count),
                  '≤ 5 %' if asked else '', count, false <= MOST_FALSE * count if asked else None),
             Line(f'{case.words}: 1 mg in one run detected', _share(seen, count), '', count, None)]
    if case.runs > 2:
        lines.append(Line(f'{case.words}: the changed run named', _share(named, count), '', count,
                          None))
    if case.runs > 5:
        lines.append(Line(f'{case.words}: spread of a parameter over its stated deviation, median',
                          f'{ratio:.2f}', '', count, None))
    return lines


def _share(count: int, total: int) -> str:
    return f'{100.0 * count / total:.1f} % ({count}/{total})'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=1)
    options.add_argument('--sets', type=int, default=200,
                         help='sets of each case, half of 20 runs')
    given = options.parse_args(arguments)
    lines = []
    for case in CASES:
        sets = max(given.sets // 2 if case.runs > 5 else given.sets, 1)
        lines += lines_of(case, measured(case, sets, given.seed))
        print(case.words, file=sys.stderr, flush=True)
    command = f'python benchmarks/compare.py --sets {given.sets} --seed {given.seed}'
    publish(f'# Figures of compare\n\nMade by `{command} --markdown FILE`.\n\n{_ABOUT}\n'
            f'{table(lines)}\n', given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
