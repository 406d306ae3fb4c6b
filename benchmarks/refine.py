# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement: how often it names the hidden effect.

The sets come from `test/generator.py`, which shares no code with the package::

    python benchmarks/refine.py --sets 60 --jobs 2 --seed 2028 --markdown docs/figures/refine.md
    python benchmarks/refine.py --sets 1 --only lag

Settings of the package are tuned with ``--seed 1``. Published figures are measured with seed 2028
or above, on sets that nothing was tuned with. All rows take an hour or two: with ``--keep FOLDER``
the rows that are done are kept there, and a second run goes on with the others.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import multiprocessing
import os
from pathlib import Path
import pickle
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')  # each process has one core

from figures import commit, markdown, parser, publish, table  # noqa: E402
import numpy as np  # noqa: E402
from refine_case import CARRIER, Case, Outcome, run  # noqa: E402
from refine_lines import lines_of, said_lines  # noqa: E402
from refine_rows import cases_of, ROWS  # noqa: E402

_ABOUT = """\
Made by `{command} --markdown FILE`, on sets of an independent generator
(`test/generator.py`). The size of an effect is the RMS of its part in |a| that the base cannot
absorb, over the noise of a pose mean. Look-alikes are quadratic, gain_asymmetry and
cross_coupling; also cubic and odd_quadratic. Fresh errors are those of other poses of the same
sensor. Shares have their exact interval for 95 % (Clopper and Pearson)."""


def by_effect(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table of the outcomes by hidden effect, with what is named instead."""
    heads = ('row', 'hidden', 'sets', 'exact', 'rival', 'wrong', 'missed', 'error',
             'clean poses left out', 'parameters inside 3 sd', 'held-out residual over true form',
             'located', 'fresh over base', 'fresh over noise', 'instead')
    rows = []
    for kind in sorted({_kind(o) for o in outcomes}, key=lambda kind: (ROWS.index(kind[0]), kind)):
        group = [o for o in outcomes if _kind(o) == kind]
        counts = Counter(o.judgement for o in group)
        left_out = sum(len(o.disturbed - set(o.knocked)) for o in group) / len(group)
        rows.append((', '.join(filter(None, kind[:2])), kind[2], len(group),
                     *(counts[word] for word in ('exact', 'rival', 'wrong', 'missed', 'error')),
                     f'{left_out:.1f}', _inside(group), _over_true_form(group), _located(group),
                     *_fresh_ratios(group), _instead(group)))
    return markdown(heads, rows)


def _kind(outcome: Outcome) -> tuple[str, str, str]:
    """Return row, group and hidden effects."""
    case = outcome.case
    names = 'random' if case.drawn else ' + '.join(sorted(case.hidden)) or 'nothing'
    return case.row, case.group, names


def _instead(outcomes: Sequence[Outcome]) -> str:
    """Return the most frequent other results; of random effects those that lack or are added."""
    other = [o for o in outcomes
             if o.judgement != 'exact' or o.verdict not in ('explained', 'no_gap')]
    if any(o.case.drawn for o in other):
        words = [f'{sign}{name}' for o in other
                 for sign, names in (('-', set(o.case.hidden) - set(o.names)),
                                     ('+', set(o.names) - set(o.case.hidden)))
                 for name in sorted(names)]
    else:
        words = [f'{" + ".join(o.names) or "-"} ({o.verdict})' for o in other]
    return ', '.join(f'{count} {word}' for word, count in Counter(words).most_common(5))


def _inside(outcomes: Sequence[Outcome]) -> str:
    off = np.abs([value for o in outcomes for value in o.deviations])
    return f'{np.sum(off < 3.0)}/{len(off)}' if len(off) else ''


def _over_true_form(outcomes: Sequence[Outcome]) -> str:
    each = np.array([o.held_out for o in outcomes if o.held_out])
    return f'{np.sqrt(np.divide(*np.mean(each ** 2, axis=0))):.2f}' if len(each) else ''


def _located(outcomes: Sequence[Outcome]) -> str:
    """Return how many empirical terms have the right carrier and variable."""
    terms = [o for o in outcomes if o.where]
    known = any(CARRIER[name] for o in terms for name in o.case.hidden)
    return f'{sum(o.located for o in terms)}/{len(terms)}' if known else str(len(terms) or '')


def _fresh_ratios(outcomes: Sequence[Outcome]) -> tuple[str, str]:
    """Return the RMS of fresh errors over base and noise."""
    each = np.array([(o.fresh.refined_mg / o.fresh.base_mg, o.fresh.refined_mg / o.fresh.noise_mg)
                     for o in outcomes if o.fresh is not None])
    if not len(each):
        return '', ''
    base, noise = np.sqrt(np.mean(each ** 2, axis=0))
    return f'{base:.2f}', f'{noise:.2f}'


def measured(cases: Sequence[Case], jobs: int, kept: Path | None) -> list[Outcome]:
    """Run the cases in `jobs` processes, unless their outcomes are `kept` in a file."""
    if kept is not None:
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_bytes(pickle.dumps(measured(cases, jobs, None)))
        return pickle.loads(kept.read_bytes())
    if jobs == 1:
        return [run(case) for case in cases]
    with multiprocessing.get_context('spawn').Pool(jobs) as pool:
        return list(pool.imap_unordered(run, cases, chunksize=4))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    options = parser(__doc__, jobs=2, seed=1)
    options.add_argument('--sets', type=int, default=20, help='sets of each kind in each row')
    options.add_argument('--only', action='append', choices=ROWS, help='only this row; repeatable')
    options.add_argument('--hidden', help='only sets in which this effect hides')
    options.add_argument('--keep', type=Path, help='folder for the outcomes of rows, by commit')
    given = options.parse_args(arguments)
    about = f'{commit()}-{given.sets}-{given.seed}-{given.hidden or "all"}'
    lines, everything = [], []
    for row in given.only or ROWS:
        cases = [case for case in cases_of(row, given.sets, given.seed)
                 if given.hidden is None or given.hidden in case.hidden]
        outcomes = measured(cases, given.jobs, given.keep and given.keep / about / f'{row}.pickle')
        everything += outcomes
        if outcomes:
            lines += lines_of(row, outcomes)
            print(f'{row}: {len(outcomes)} sets', file=sys.stderr, flush=True)
    lines += said_lines(everything)
    command = (f'python benchmarks/refine.py --sets {given.sets} --jobs {given.jobs} --seed '
               f'{given.seed}' + ''.join(f' --only {row}' for row in given.only or ())
               + (f' --hidden {given.hidden}' if given.hidden else ''))
    text = (f'# Figures of refine\n\n{_ABOUT.format(command=command)}\n\n'
            f'{table([x for x in lines if x.sets])}\n\n{by_effect(everything)}\n')
    for error, count in Counter(o.error for o in everything if o.error).most_common(5):
        print(f'{count} times:\n{error}', file=sys.stderr)
    publish(text, given.markdown)
    return 0


if __name__ == '__main__':
    sys.exit(main())
