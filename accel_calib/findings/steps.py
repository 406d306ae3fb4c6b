# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The words of a refinement: of its verdict, of its steps, and its advice."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TYPE_CHECKING

import numpy as np

from .poses import percent, plan_advice
from ..effects import CHANGES, entry_of, TO_SEPARATE, unit_of, value_unit, variable_words
from ..geometry import axes_of_signs
from ..text import counted, listed, with_minus, with_sd

if TYPE_CHECKING:
    from ..refinement import Refinement, Step

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond an empirical '
                 'curve, but its cause is not known.',
    'drifts': 'The offset drifts: only noise remains beside a slow change of the offset, which no '
              'calibration corrects.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}

_APART = 0.05
"""Difference of two probabilities above which both are stated."""

_LEAST_P = 1e-16


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    words = _VERDICTS[result.verdict]
    if result.undecided:
        words = ('Not enough poses: they cannot tell what explains the gap, because '
                 f'{_why_undecided(result)}.')
    elif result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


def _why_undecided(result: Refinement) -> str:
    if result.refusal:
        return result.refusal[0]
    if result.one_curve:
        one, other = result.one_curve
        if other not in {step.effect for step in result.steps}:
            return (f'beside {one}, {other} shows in the same proportion on each axis, as parts '
                    'of one curve do')
        return (f'{one} and {other} are in the same proportion on each axis, as parts of one '
                'curve are')
    most = max(result.steps, key=lambda step: len(step.rivals))
    return f'{len(most.rivals)} others explain it about as well as {most.effect}'


def base_words(result: Refinement) -> str:
    """Return the name of the base."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def chance_words(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def value_words(step: Step) -> list[tuple[str, str]]:
    """
    Return name and text of each value of a step, ± its deviation; values in g are in mg.

    A curve that has a formula is stated by that.

    """
    if step.formula:
        return [('', step.formula)]
    parameters, values = entry_of(step.name).parameters, []
    for name, value in step.parameters.items():
        unit_name, scale = value_unit(step.name, name)
        sd = step.parameters_sd.get(name, 0.0)
        words = with_sd(value * scale, sd * scale) if sd else f'{value * scale:.5g}'
        sign = '+' if name in parameters and value >= 0.0 else ''
        values.append((name, with_minus(f'{sign}{words} {unit_name}'.rstrip())))
    return values


def odds_words(step: Step) -> dict[str, str]:
    """Return the probability of each rival, and that by the data alone if it differs much."""
    found = {}
    for rival in step.rivals:
        whole, alone = step.odds(rival)
        by_data = f', by the data alone {percent(alone)}' if abs(alone - whole) > _APART else ''
        found[rival] = f'{percent(whole)}{by_data}'
    return found


def rival_words(step: Step) -> list[str]:
    """Return the rivals with their probabilities, such as ``quadratic (11 %)``."""
    return [f'{name} ({odds})' for name, odds in odds_words(step).items()]


# ----------------------------------------------------------------------------- where

def place_words(step: Step) -> str:
    """Return where an effect acts; for a change of a stored calibration, also the change."""
    figures = step.place.figures
    words = _PLACES[step.place.kind](figures)
    if 'change' not in figures:
        return words
    effect = entry_of(step.name)
    scale, unit_name = (1e3, 'mg') if effect.is_offset else (100.0, '%')
    shown = ', '.join(f'{"+" if value > 0.0 else ""}{with_sd(value * scale, sd * scale)}'
                      for value, sd in figures['change'])
    since = f' since {figures["date"][:10]}' if figures['date'] else ''
    return f'the {effect.words} has changed by ({shown}) {unit_name}{since}; {words}'


def _curve_words(figures: Mapping[str, Any]) -> str:
    carrier, part, variable = (figures[key] for key in ('carrier', 'part', 'variable'))
    what = 'size of the force' if carrier == 'force' else carrier.replace('_', '-')
    words = (f'the {what}{f" of {part}" if part else ""} changes with '
             f'{variable_words(variable)} by up to {figures["most_mg"]:.2g} mg')
    if figures['between']:
        low, high = figures['between']
        words += f', most between {low:.4g} and {high:.4g} {unit_of(variable)}'.rstrip()
    nearest = [f'{effect} (leaves {left:.2g} mg)' for effect, left in figures['nearest'].items()]
    return words + (f'; no known effect has this form, the nearest are {", ".join(nearest)}'
                    if nearest else '')


def _range_words(figures: Mapping[str, Any]) -> str:
    column, (low, high) = figures['column'], figures['range']
    low_mg, high_mg = figures['ends_mg']
    span = f'{low:.4g} to {high:.4g} {unit_of(column)}'.rstrip()
    return (f'over {column.replace("_", " ")} {span}: {low_mg:.2g} mg RMS in the lowest fifth of '
            f'the poses, {high_mg:.2g} mg in the highest')


def _instant_words(figures: Mapping[str, Any]) -> str:
    (last, first), (row_before, row_after) = figures['times'], figures['rows']
    return f'between {last:.6g} and {first:.6g} s (rows {row_before} and {row_after})'


def _direction_words(figures: Mapping[str, Any]) -> str:
    return 'with ' + ', '.join(
        f'{axes_of_signs(signs)} up ({mean:+.2g} mg over {count} of {figures["poses"]} poses)'
        for signs, mean, count in figures['directions'])


_PLACES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    'curve': _curve_words, 'range': _range_words, 'instant': _instant_words,
    'directions': _direction_words,
    'limit': lambda of: (f'in {listed("row", of["rows"])}: an axis reads {of["limit_g"]:.4g} g '
                         'and its samples hardly scatter'),
    'grid': lambda of: (f'pose means are multiples of {of["step_mg"]:.3g} mg, which causes '
                        f'{of["step_mg"] / np.sqrt(12.0):.2g} mg RMS per axis')}
"""Texts by kind of a place."""


# ----------------------------------------------------------------------------- advice

def advice_lines(result: Refinement) -> tuple[str, ...]:
    """Return advice for the user, one line each."""
    return (*(_REMARKS[each.kind](each.figures) for each in result.remarks),
            *plan_advice(result.plan))


def _other_sensor_words(figures: Mapping[str, Any]) -> str:
    change = CHANGES[figures['effect']]
    return (f'this is probably another sensor: its {change.base} differs from the stored one by '
            f'{figures["change"]:.2g} {change.unit}, which is too much for one sensor; fit a new '
            'calibration from its own poses')


def _left_out_words(figures: Mapping[str, Any]) -> str:
    were, them = ('was', 'it') if figures['poses'] == 1 else ('were', 'them')
    return f'{counted(figures["poses"], "pose")} {were} left out; take {them} again'


def _gap_words(figures: Mapping[str, Any]) -> str:
    names = ', '.join(figures['taken_back'])
    nearest = f'; {names} would explain only a part' if names else ''
    return (f'a gap remains that no effect testable with these data explains{nearest}: check what '
            'differs between the poses, and repeat some of them')


_REMARKS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    'other_sensor': _other_sensor_words, 'left_out': _left_out_words, 'gap': _gap_words,
    'mount_not_seen': lambda of: (
        'a mount that has turned since the calibration cannot show: only |force| = 1 g is known; '
        'take poses of known orientation (ref_x, ref_y, ref_z) with both'),
    'rivals': lambda of: (
        f'{of["effect"]} cannot be distinguished from {", ".join(of["rivals"])} here: '
        f'{TO_SEPARATE[of["family"]]}'),
    'at_bound': lambda of: (
        f'{of["effect"]} is not used, because its constant {of["constant"]} ends at its bound '
        f'{of["value"]:.4g}: widen the bounds in its definition, or use another function'),
    'unusual': lambda of: (
        f'{of["effect"]} is {of["size"]:.2g} {of["unit"]}, typical parts have about '
        f'{of["typical"]:.2g}: check that the sensor causes it, and not the setup'),
    'one_curve': lambda of: (
        f'{" and ".join(of["effects"])} may be parts of one curve: take more poses in all '
        'directions, which show its form'),
    'few': lambda of: (
        f'{counted(of["poses"], "pose")} leave {counted(of["dof"], "degree")} of freedom, which '
        'is too few to detect most effects: take 24 poses or more'),
    'scatter': lambda of: (
        f'poses repeat {of["ratio"]:.1f} times worse than their samples, and the scatter has no '
        'structure: clamp the sensor, let it settle longer'),
    'record': lambda of: (
        f'record {"; ".join(of["columns"])}: their effects cannot be tested yet'),
    'not_searched': lambda of: (
        f'no effects were searched: {of["message"]}; the result is the fit with the fleet'),
    'refusal': lambda of: str(of['advice'])}
"""Texts by kind of a remark."""
