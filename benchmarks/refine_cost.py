# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Time and memory that `refine` needs for many poses.

Each case runs in a process of its own, so that its largest memory is its own::

    python benchmarks/refine_cost.py --markdown docs/figures/refine_cost.md

"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
import multiprocessing
from pathlib import Path
import resource
import sys
import time

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

from accel_calib.refinement import refine  # noqa: E402
from accel_calib.units import units_of  # noqa: E402
from figures import Line, machine, parser, publish, table  # noqa: E402
from generator import Setup, simulate  # noqa: E402
import numpy as np  # noqa: E402
from refine_case import poses_of  # noqa: E402

CASES = ('', 'offset_temperature', 'offset_wander', 'quadratic', 'ripple')
LIMITS = {5_000: 10.0, 50_000: 100.0}
"""Asked: the longest time by the number of poses [s]."""

MOST_MB = 200.0
"""Asked: the largest memory [MB]."""

SIZE = 3.0
SAMPLES = 20


def measured(hidden: str, poses: int, seed: int) -> tuple[float, float, float, str]:
    """Return seconds, memory before and during the refinement [MB], and the result."""
    made = simulate(np.random.default_rng(seed), {hidden: SIZE} if hidden else {},
                    Setup(poses=poses, samples=SAMPLES))
    taken = poses_of(made)
    del made
    before = _memory_mb()
    started = time.perf_counter()
    found = refine(taken, units_of('m/s2'), base='10')
    seconds = time.perf_counter() - started
    names = ' + '.join(step.effect for step in found.steps) or 'nothing'
    return seconds, before, _memory_mb(), f'{names}, {found.verdict}'


def _memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, seed=2028)
    options.add_argument('--poses', type=int, action='append', choices=list(LIMITS),
                         help='number of poses; repeatable')
    given = options.parse_args(arguments)
    before, lines = machine(), []
    for poses in given.poses or LIMITS:
        for hidden in CASES:
            alone = ProcessPoolExecutor(1, multiprocessing.get_context('spawn'))
            with alone:
                seconds, start, memory, result = alone.submit(
                    measured, hidden, poses, given.seed).result()
            what = f'{poses:,} poses, {hidden or "nothing"} hidden'
            lines += [
                Line(f'{what}: seconds ({result})', f'{seconds:.1f}', f'≤ {LIMITS[poses]:g}', 1,
                     seconds <= LIMITS[poses]),
                Line(f'{what}: largest memory [MB] ({start:.0f} before)', f'{memory:.0f}',
                     f'≤ {MOST_MB:g}', 1, memory <= MOST_MB)]
            print(*lines[-2:], sep='\n', file=sys.stderr, flush=True)
    only = ''.join(f' --poses {poses}' for poses in given.poses or ())
    publish(f'# Cost of refine with many poses\n\nMade by `python benchmarks/refine_cost.py{only} '
            f'--markdown FILE` on {before}.\n\n{table(lines)}\n', given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
