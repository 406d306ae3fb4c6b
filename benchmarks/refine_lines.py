# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The lines of the refinement benchmark: what is measured in each row, and what is asked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math

from figures import Line
import numpy as np
from refine_case import CARRIER, Outcome, SHOWS
from refine_rows import ALONE, GROUPS, LOOK_ALIKE, LOST, NOTHING
from scipy.stats import binomtest

WORSE = 1.05
"""Ratio of fresh errors, refined over base, above which the refinement does harm."""

Check = tuple[str, Callable[[Outcome], bool], float | None, float | None]
"""What is counted, the condition, and the smallest and the largest share that are asked."""


def share(outcomes: Sequence[Outcome], good: Callable[[Outcome], bool]) -> tuple[float, str]:
    """Return the share of good outcomes, and as text with the count and its interval [%]."""
    count = sum(map(good, outcomes))
    if not outcomes:
        return float('nan'), 'no set'
    part, limits = count / len(outcomes), binomtest(count, len(outcomes)).proportion_ci()
    return part, (f'{100.0 * part:.1f} % ({count}/{len(outcomes)}; {100.0 * limits.low:.1f} to '
                  f'{100.0 * limits.high:.1f})')


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
    lines = []
    for index, group in enumerate(GROUPS[row]):
        chosen = [o for o in outcomes if o.case.group == group.what]
        what = ', '.join(filter(None, (_TITLES.get(row, ''), group.what)))
        lines += [line(f'{what}: {words}', chosen, good, least, most)
                  for words, good, least, most in _checks(row, index)]
        if row in OUTSIDE_ROWS:
            lines += _located(what, chosen) + _by_kind(what, chosen)
        if row == 'lag' or row in OUTSIDE_ROWS:
            lines += fresh_lines(what, chosen, 1.2 if row == 'lag' and index % 2 == 0 else None,
                                 harmless=row != 'lag')
        lines.append(_seconds(what, chosen))
    return lines


def right(outcome: Outcome) -> bool:
    """Return whether all hidden effects are named, or named as rivals, and nothing else is."""
    return outcome.judgement in ('exact', 'rival')


def _wrong(outcome: Outcome) -> bool:
    return outcome.judgement == 'wrong'


def _exact(outcome: Outcome) -> bool:
    return outcome.judgement == 'exact'


def _a_name(outcome: Outcome) -> bool:
    return bool(outcome.named)


def _no_gap(outcome: Outcome) -> bool:
    return outcome.verdict == 'no_gap'


def _described(outcome: Outcome) -> bool:
    return outcome.verdict in ('described', 'drifts')


def _another_name(outcome: Outcome) -> bool:
    return bool(set(outcome.names) - {'offset_wander'})


def honest(outcome: Outcome) -> bool:
    """
    Return whether an effect that cannot be named is reported as not understood.

    A name is right only beside a rest that is not understood, and only if its carrier and variable
    are those of the hidden effect. A random walk of the offset is right alone if the hidden effect
    changes the offset with time, or if its column is missing. If std and count are missing, the
    noise is unknown, and any verdict without a name is right.

    """
    if outcome.verdict == 'error':
        return False
    if 'count' in outcome.case.setup.dropped and not outcome.named:
        return True
    truths = {pair for name in outcome.case.hidden for pair in CARRIER[name]}
    if outcome.names == ('offset_wander',):
        return ('offset', 'time') in truths or bool(set(LOST) & set(outcome.case.hidden))
    if _described(outcome) and not truths and not outcome.case.setup.dropped:
        return False
    return ((_described(outcome) or outcome.verdict == 'unexplained')
            and all(truths & set(CARRIER.get(name, ())) for name in outcome.names))


def found(outcome: Outcome) -> bool:
    """Return whether all knocked poses that show are left out."""
    return all(row in outcome.disturbed for row, size in outcome.knocked.items() if size > SHOWS)


def clean(outcome: Outcome) -> bool:
    """Return whether only knocked poses are left out."""
    return outcome.disturbed <= set(outcome.knocked) and outcome.verdict != 'error'


def _knocks_named(outcome: Outcome) -> bool:
    return found(outcome) and clean(outcome) and not outcome.named


OUTSIDE_ROWS = ('outside', 'outside60', 'outside200')

_TITLES = {
    **dict.fromkeys(NOTHING, 'nothing hidden'), 'two': 'two effects',
    **dict.fromkeys(OUTSIDE_ROWS, 'outside the catalogue'),
    'rising': 'temperature rises with time', 'missing': 'column missing',
    'knocked': 'three knocked in 60', 'small': 'too small to be seen', 'faint': 'one effect',
    'few': 'one effect', 'three': 'three effects',
    'knocked_and_one': 'one effect of size 5', 'lag': 'temperature with a lag of 30 to 300 s',
    'curved': 'offset linear and quadratic in temperature, size 5',
    'chamber': 'offset and gain over temperature, and warm-up, size 5',
    'sign': 'hysteresis by the sign of the motion, size 3', 'spoiled': 'nothing hidden',
    'flicker': '1/f noise of the offset', 'large': 'two effects',
    'columns': 'one effect of an unknown column', 'noise_columns': 'nothing hidden'}

_RIGHT = {'faint': (0.88, 0.97), 'few': (0.65, 0.85, None), 'three': (0.9, 0.975, 0.975),
          'knocked_and_one': (0.95, 0.93, 0.9, 0.6), 'curved': (0.95,), 'chamber': (0.9,),
          'sign': (0.95,), 'large': (0.995,), 'two': (0.95,), 'rising': (0.95,),
          'columns': (0.95, 0.95)}
"""Share of sets with the right names that is asked, by group."""

_CHECKS: dict[str, tuple[Check, ...]] = {
    **dict.fromkeys((*NOTHING, 'spoiled', 'noise_columns'), (
        ('a name', _a_name, None, 0.02),
        ('an empirical term', lambda o: bool(o.where), None, 0.02),
        ('verdict no_gap', _no_gap, None, None))),
    'missing': (('reported as not understood', honest, None, None),
                ('another name', _another_name, None, 0.0)),
    'knocked': (('all found, no clean one, no name', _knocks_named, 0.95, None),
                ('all that show found', found, None, None),
                ('no clean pose left out', clean, None, None),
                ('no effect named', lambda o: not o.named, None, None)),
    'small': (('no_gap', _no_gap, 0.95, None), ('a wrong name', _wrong, None, None)),
    'flicker': (('a wrong name', _another_name, None, 0.05),
                ('verdict described', _described, None, None)),
    **dict.fromkeys(OUTSIDE_ROWS, (
        ('reported as not understood', honest, 0.95, None),
        ('verdict described', _described, None, None)))}


def _checks(row: str, index: int) -> tuple[Check, ...]:
    """Return what is counted in a group of a row."""
    if row == 'lag':
        asked = 0.95 if index % 2 == 0 else None
        return (('offset_temperature named, lag within 10 %',
                 lambda o: o.names == ('offset_temperature',) and o.lag_found, asked, None),
                ('offset_temperature and no other name',
                 lambda o: o.names == ('offset_temperature',), None, None))
    if row not in _RIGHT:
        return _CHECKS[row]
    wrong = 0.01 if row == 'faint' else 0.05 if (row, index) == ('knocked_and_one', 3) else None
    checks: tuple[Check, ...] = (('right or rival', right, _RIGHT[row][index], None),
                                 ('exact', _exact, None, None),
                                 ('a wrong name', _wrong, None, wrong))
    if row == 'knocked_and_one':
        checks += (('all that show found', found, None, None),
                   ('no clean pose left out', clean, None, None))
    return checks


def _located(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return how often the empirical term has the right carrier and variable."""
    chosen = [o for o in outcomes if any(CARRIER[name] for name in o.case.hidden)]
    with_term = [o for o in chosen if o.where]
    return [line(f'{what}: carrier and variable right', chosen, lambda o: o.located),
            line(f'{what}: carrier and variable right, of those with an empirical term',
                 with_term, lambda o: o.located)]


def _by_kind(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return one line per hidden effect."""
    kinds = sorted({name for o in outcomes for name in o.case.hidden})
    return [line(f'{what}, {kind}: reported as not understood',
                 [o for o in outcomes if kind in o.case.hidden], honest, 0.95) for kind in kinds]


def fresh_lines(what: str, outcomes: Sequence[Outcome], most: float | None = None, *,
                harmless: bool = True) -> list[Line]:
    """
    Return the lines of the errors of fresh poses.

    Parameters
    ----------
    what : str
        The sets.
    outcomes : sequence of Outcome
        Their outcomes.
    most : float or None
        Largest ratio to the noise that is asked.
    harmless : bool
        Whether no set may be worse than the base.

    """
    each = np.array([(o.fresh.base_mg, o.fresh.refined_mg, o.fresh.noise_mg)
                     for o in outcomes if o.fresh is not None]).reshape(-1, 3)
    if not len(each):
        return []
    base, refined, noise = each.T
    worst = float(np.max(refined / base))
    over = float(np.sqrt(np.mean((refined / noise) ** 2)))
    start = float(np.sqrt(np.mean((base / noise) ** 2)))
    return [
        Line(f'{what}: largest fresh error over that of the base',
             f'{worst:.3f}, above {WORSE} in {np.sum(refined > WORSE * base)}',
             f'≤ {WORSE}' if harmless else '', len(each), worst <= WORSE if harmless else None),
        Line(f'{what}: fresh error over the noise of a pose',
             f'{start:.2f} → {over:.2f} (95 % of sets below '
             f'{np.percentile(refined / noise, 95.0):.2f})',
             '' if most is None else f'≤ {most:g}', len(each),
             None if most is None else over <= most)]


def said_lines(outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines about what steps say, of all rows."""
    lines = []
    for place, what in enumerate(('the named effect is the most probable of its list',
                                  'the held-out residual falls',
                                  'the instant in words is that of the values')):
        good = [each[place] for o in outcomes for each in o.said]
        lines.append(Line(f'steps: {what}', f'{sum(good)} of {len(good)}', '100 %', len(good),
                          all(good)))
    off = np.abs([value for o in outcomes if right(o) for value in o.deviations])
    inside = 100.0 * float(np.mean(off < 1.96)) if len(off) else math.nan
    lines.append(Line('values of right names: 95 % intervals hold the truth',
                      f'{inside:.1f} % of {len(off)}', '93 to 97 %', len(off),
                      93.0 <= inside <= 97.0))
    for poses in (12, 24, 60):
        lines += fresh_lines(f'{poses} poses, all rows', [
            o for o in outcomes if o.case.setup.poses == poses])[:1]
    return lines


def _seconds(what: str, outcomes: Sequence[Outcome], most: float | None = None) -> Line:
    seconds = np.array([o.seconds for o in outcomes] or [np.nan])
    middle = float(np.median(seconds))
    return Line(f'{what}: CPU seconds per set', f'{middle:.2f}, longest {np.max(seconds):.2f}',
                '' if most is None else f'< {most:g}', len(outcomes),
                None if most is None else middle < most)


def _lines_alone(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of one hidden effect."""
    families = set().union(*LOOK_ALIKE[:2])
    alike = [o for o in outcomes if families & set(o.case.hidden)]
    clear = [o for o in outcomes if not families & set(o.case.hidden)]
    lines = [
        line(f'{what}: exact', outcomes, _exact),
        line(f'{what}: exact, without look-alikes', clear, _exact, least=0.97),
        line(f'{what}: look-alikes right or rival', alike, right, least=0.98),
        line(f'{what}: look-alikes exact', alike, _exact),
        line(f'{what}: wrong and no rival', outcomes, _wrong, most=0.01),
        line(f'{what}: missed', outcomes, lambda o: o.judgement == 'missed'),
        line(f'{what}: right and verdict explained', outcomes,
             lambda o: right(o) and o.verdict == 'explained')]
    return [*lines, *_numbers(what, outcomes), _seconds(what, outcomes, 1.0)]


def _numbers(what: str, outcomes: Sequence[Outcome]) -> list[Line]:
    """Return the lines of held-out residuals and parameters."""
    every = np.array([o.held_out for o in outcomes if o.held_out]).reshape(-1, 2)
    named = np.array([o.held_out for o in outcomes if o.held_out and right(o)]).reshape(-1, 2)
    off = np.abs([value for o in outcomes for value in o.deviations])
    lines = []
    for group, pairs in (('all', every), ('where the name is right', named)):
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
    return lines
