# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Refinement: how often it names the hidden effect.

The sets come from `test/generator.py`, which shares no code with the package::

    python benchmarks/refine.py --sets 60 --jobs 2 --markdown docs/figures/refine.md

"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
import multiprocessing
import os
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]
os.environ.update(OMP_NUM_THREADS='1', OPENBLAS_NUM_THREADS='1')  # each process has one core

from figures import Line, publish, table  # noqa: E402
from generator import EFFECTS, ON_OUTPUT, OUTSIDE, Setup  # noqa: E402
import numpy as np  # noqa: E402
from refine_case import Case, Outcome, run, SHOWS  # noqa: E402

CATALOGUE = tuple(name for name in EFFECTS if name not in OUTSIDE)
LOOK_ALIKE = ({'quadratic', 'gain_asymmetry', 'cross_coupling'}, {'cubic', 'odd_quadratic'},
              {'offset_drift', 'warm_up', 'offset_step'})
PAIRED = tuple(name for name in CATALOGUE if name not in (*ON_OUTPUT, 'offset_wander'))
IN_TIME = ('temperature_rate', 'periodic_offset')
RISING = ('offset_temperature', 'offset_drift', 'warm_up')
LOST = {'offset_temperature': ('temperature',), 'gain_temperature': ('temperature',),
        'supply_ratio': ('supply_voltage',), 'offset_drift': ('time',), 'warm_up': ('time',),
        'offset_step': ('time',), 'lever_arm': ('gx', 'gy', 'gz'),
        'vibration_rectification': ('std_x', 'std_y', 'std_z', 'count')}
ALONE = {'alone60': (60, 3.0), 'alone200': (200, 2.0), 'alone24': (24, 6.0)}
SMALL = 0.3
NOTHING = {'nothing24': 24, 'nothing60': 60, 'nothing200': 200}
ROWS = (*ALONE, *NOTHING, 'two', 'outside', 'rising', 'missing', 'knocked', 'small')

_ABOUT = """\
Made by `{command} --markdown FILE`, on sets of an independent generator
(`test/generator.py`). The size of an effect is the RMS of its part in |a| that the base cannot
absorb, over the noise of a pose mean. Look-alikes are quadratic, gain_asymmetry and
cross_coupling; also cubic and odd_quadratic."""

Kind = tuple[dict[str, float], Setup]


def cases_of(row: str, sets: int, seed: int) -> Iterator[Case]:
    """
    Yield the cases of a row.

    Parameters
    ----------
    row : str
        Of `ROWS`.
    sets : int
        Number of sets per effect; five times as many if no effect or two are hidden.
    seed : int
        Seed of the random numbers.

    """
    place = (seed, ROWS.index(row))
    for number in range(sets):
        kinds = _kinds(row, np.random.default_rng((*place, number)))
        for kind, (hidden, setup) in enumerate(kinds):
            yield Case(row, hidden, setup, (*place, kind, number), row in ALONE)


def _kinds(row: str, rng: np.random.Generator) -> list[Kind]:
    """Return what is hidden in the sets of a row."""
    if row in ALONE:
        poses, size = ALONE[row]
        return [({name: size}, Setup(poses=poses)) for name in CATALOGUE]
    if row in NOTHING:
        return [({}, Setup(poses=NOTHING[row]))] * 5
    if row == 'two':
        return [({one: 5.0, two: 5.0}, Setup()) for one, two in _pairs(rng, 5)]
    one_by_one: dict[str, list[Kind]] = {
        'outside': [({name: 3.0}, Setup()) for name in OUTSIDE],
        'rising': [({name: 3.0}, Setup(temperature='rising')) for name in RISING],
        'missing': [({name: 3.0}, Setup(dropped=lost)) for name, lost in LOST.items()],
        'knocked': [({}, Setup(knocked=3))] * 3,
        'small': [({name: SMALL}, Setup()) for name in CATALOGUE if name not in ON_OUTPUT]}
    return one_by_one[row]


def _pairs(rng: np.random.Generator, count: int) -> list[tuple[str, str]]:
    """Draw pairs of effects that do not look alike."""
    pairs: list[tuple[str, str]] = []
    while len(pairs) < count:
        one, two = rng.choice(PAIRED, 2, replace=False).tolist()
        if not any({one, two} <= family for family in LOOK_ALIKE):
            pairs.append((one, two))
    return pairs


def share(outcomes: Sequence[Outcome], good: Callable[[Outcome], bool]) -> tuple[float, str]:
    """Return the share of good outcomes, and the share as text with the count."""
    count = sum(map(good, outcomes))
    part = count / len(outcomes) if outcomes else float('nan')
    return part, f'{100.0 * part:.1f} % ({count}/{len(outcomes)})'


def line(what: str, outcomes: Sequence[Outcome], good: Callable[[Outcome], bool],
         least: float | None = None, most: float | None = None) -> Line:
    """Return a line with the share of good outcomes."""
    part, text = share(outcomes, good)
    if least is not None:
        return Line(what, text, f'≥ {100.0 * least:g} %', len(outcomes), part >= least)
    if most is not None:
        return Line(what, text, f'≤ {100.0 * most:g} %', len(outcomes), part <= most)
    return Line(what, text, '', len(outcomes), None)


def lines_of(row: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of a row."""
    if row in ALONE:
        poses, size = ALONE[row]
        return _lines_alone(f'one effect, {poses} poses, size {size:g}', outcomes)
    if row in NOTHING:
        what = f'nothing hidden, {NOTHING[row]} poses'
        return [line(f'{what}: a name', outcomes, lambda o: bool(o.named), most=0.02),
                line(f'{what}: verdict no_gap', outcomes, lambda o: o.verdict == 'no_gap')]
    if row == 'two':
        what = 'two effects, 60 poses, size 5'
        return [line(f'{what}: both right', outcomes, _right, least=0.95),
                line(f'{what}: both exact', outcomes, lambda o: o.judgement == 'exact'),
                line(f'{what}: a wrong name', outcomes, lambda o: o.judgement == 'wrong')]
    if row == 'rising':
        what = 'temperature rises with time'
        return [line(f'{what}: right or rival', outcomes, _right, least=0.95),
                line(f'{what}: exact', outcomes, lambda o: o.judgement == 'exact')]
    return _lines_without_name(row, outcomes)


def _right(outcome: Outcome) -> bool:
    return outcome.judgement in ('exact', 'rival')


def _lines_alone(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of one hidden effect."""
    families = set().union(*LOOK_ALIKE[:2])
    alike = [o for o in outcomes if families & set(o.case.hidden)]
    clear = [o for o in outcomes if not families & set(o.case.hidden)]
    lines = [
        line(f'{what}: exact', outcomes, lambda o: o.judgement == 'exact'),
        line(f'{what}: exact, without look-alikes', clear, lambda o: o.judgement == 'exact',
             least=0.97),
        line(f'{what}: look-alikes right or rival', alike, _right, least=0.98),
        line(f'{what}: look-alikes exact', alike, lambda o: o.judgement == 'exact'),
        line(f'{what}: wrong and no rival', outcomes, lambda o: o.judgement == 'wrong',
             most=0.01),
        line(f'{what}: missed', outcomes, lambda o: o.judgement == 'missed'),
        line(f'{what}: right and verdict explained', outcomes,
             lambda o: _right(o) and o.verdict == 'explained')]
    return [*lines, *_numbers(what, outcomes)]


def _numbers(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of held-out residuals, parameters and time."""
    every = np.array([o.held_out for o in outcomes if o.held_out]).reshape(-1, 2)
    right = np.array([o.held_out for o in outcomes if o.held_out and _right(o)]).reshape(-1, 2)
    off = np.abs([value for o in outcomes for value in o.deviations])
    seconds = np.array([o.seconds for o in outcomes])
    lines = []
    for group, pairs in (('all', every), ('where the name is right', right)):
        if len(pairs):
            pooled = float(np.sqrt(np.mean(pairs[:, 0] ** 2) / np.mean(pairs[:, 1] ** 2)))
            worst = float(np.percentile(pairs[:, 0] / pairs[:, 1], 95.0))
            lines.append(Line(f'{what}: held-out residual over that of the true form, {group}',
                              f'{pooled:.3f} (95 % of sets below {worst:.3f})', '≤ 1.05',
                              len(pairs), pooled <= 1.05))
    if len(off):
        inside = float(np.mean(off < 3.0))
        lines.append(Line(f'{what}: parameters inside 3 standard deviations',
                          f'{100.0 * inside:.1f} % of {len(off)}', '≥ 99 %', len(outcomes),
                          inside >= 0.99))
    return [*lines, Line(f'{what}: seconds per set',
                         f'{np.median(seconds):.2f}, longest {np.max(seconds):.2f}', '< 1',
                         len(outcomes), bool(np.median(seconds) < 1.0))]


def _lines_without_name(row: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of rows in which no effect of the catalogue is to be named."""
    if row == 'outside':
        groups = {name: [o for o in outcomes if name in o.case.hidden] for name in OUTSIDE}
        return [line('outside the catalogue: unexplained, or offset_wander in time', outcomes,
                     _honest, least=0.95),
                *(line(f'outside the catalogue, {name}', group, _honest, least=0.95)
                  for name, group in groups.items() if group)]
    if row == 'missing':
        return [line('column missing: unexplained or offset_wander', outcomes, _honest),
                line('column missing: another name', outcomes,
                     lambda o: bool(set(o.names) - {'offset_wander'}), most=0.0)]
    if row == 'knocked':
        return [line('three knocked in 60: all found, no clean one, no name', outcomes,
                     lambda o: _found(o) and _clean(o) and not o.named, least=0.95),
                line('three knocked in 60: all that show found', outcomes, _found),
                line('three knocked in 60: no clean pose left out', outcomes, _clean),
                line('three knocked in 60: no effect named', outcomes, lambda o: not o.named)]
    return [line(f'too small to be seen (size {SMALL:g}): no_gap', outcomes,
                 lambda o: o.verdict == 'no_gap', least=0.95),
            line(f'too small to be seen (size {SMALL:g}): a wrong name', outcomes,
                 lambda o: o.judgement == 'wrong')]


def _honest(outcome: Outcome) -> bool:
    """
    Return whether an effect that cannot be named is reported without a name.

    If std and count are missing, the noise is unknown, and any verdict without a name is right.

    """
    if 'count' in outcome.case.setup.dropped and not outcome.named:
        return outcome.verdict != 'error'
    in_time = bool({*IN_TIME, *LOST} & set(outcome.case.hidden))
    if outcome.names == ('offset_wander',):
        return in_time
    return not outcome.named and outcome.verdict == 'unexplained'


def _found(outcome: Outcome) -> bool:
    return all(row in outcome.disturbed for row, size in outcome.knocked.items() if size > SHOWS)


def _clean(outcome: Outcome) -> bool:
    return outcome.disturbed <= set(outcome.knocked) and outcome.verdict != 'error'


def by_effect(outcomes: Sequence[Outcome]) -> str:
    """Return a Markdown table of the outcomes by hidden effect, with what is named instead."""
    heads = ('row', 'hidden', 'sets', 'exact', 'rival', 'wrong', 'missed', 'error',
             'clean poses left out', 'parameters inside 3 sd', 'held-out residual over true form',
             'instead')
    rows = [f'| {" | ".join(heads)} |', '|---' * len(heads) + '|']
    kinds = sorted({(o.case.row, _hidden(o)) for o in outcomes},
                   key=lambda kind: (ROWS.index(kind[0]), kind[1]))
    for row, hidden in kinds:
        group = [o for o in outcomes if (o.case.row, _hidden(o)) == (row, hidden)]
        counts = Counter(o.judgement for o in group)
        left_out = sum(len(o.disturbed - set(o.knocked)) for o in group) / len(group)
        instead = Counter(f'{" + ".join(o.names) or "-"} ({o.verdict})' for o in group
                          if o.judgement != 'exact' or o.verdict not in ('explained', 'no_gap'))
        rows.append(f'| {row} | {hidden} | {len(group)} | ' + ' | '.join(
            str(counts[word]) for word in ('exact', 'rival', 'wrong', 'missed', 'error'))
            + f' | {left_out:.1f} | {_inside(group)} | {_over_true_form(group)} | '
            + ', '.join(f'{count} {word}' for word, count in instead.most_common(5)) + ' |')
    return '\n'.join(rows)


def _inside(outcomes: Sequence[Outcome]) -> str:
    off = np.abs([value for o in outcomes for value in o.deviations])
    return f'{np.sum(off < 3.0)}/{len(off)}' if len(off) else ''


def _over_true_form(outcomes: Sequence[Outcome]) -> str:
    each = np.array([o.held_out for o in outcomes if o.held_out])
    return f'{np.sqrt(np.divide(*np.mean(each ** 2, axis=0))):.2f}' if len(each) else ''


def _hidden(outcome: Outcome) -> str:
    return ' + '.join(sorted(outcome.case.hidden)) or 'nothing'


def measured(cases: Sequence[Case], jobs: int) -> list[Outcome]:
    """Run the cases in `jobs` processes."""
    if jobs == 1:
        return [run(case) for case in cases]
    with multiprocessing.get_context('spawn').Pool(jobs) as pool:
        return list(pool.imap_unordered(run, cases, chunksize=4))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--sets', type=int, default=20, help='sets of each kind in each row')
    parser.add_argument('--jobs', type=int, default=2, help='processes')
    parser.add_argument('--only', action='append', choices=ROWS, help='only this row; repeatable')
    parser.add_argument('--hidden', help='only sets in which this effect hides')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--markdown', type=Path, help='write the tables to this file')
    given = parser.parse_args(arguments)
    lines, everything = [], []
    for row in given.only or ROWS:
        cases = [case for case in cases_of(row, given.sets, given.seed)
                 if given.hidden is None or given.hidden in case.hidden]
        outcomes = measured(cases, given.jobs)
        everything += outcomes
        if outcomes:
            lines += lines_of(row, outcomes)
            print(f'{row}: {len(outcomes)} sets', file=sys.stderr, flush=True)
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
