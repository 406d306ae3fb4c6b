# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Sentences about a refinement and about a plan of poses, from their figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..effects import (
    CHANGES, COVARIATES, effect_named, EMPIRICAL, empirical_parts, is_effect, kind_of, TO_SEPARATE,
    unit_of, value_unit, variable_of, variable_words, WANDER)
from ..geometry import axes_of_signs
from ..table import column_of, Floats, is_quantity
from ..text import counted, short, with_sd

if TYPE_CHECKING:
    from .result import Refinement, Step
    from .search import Found

_FAR = 10.0
"""Ratio to the typical size above which there is a remark."""

_FEW = 10
"""Degrees of freedom below which most effects cannot be detected."""

_LEAST_P = 1e-16

_OTHER_SENSOR = 'this is probably another sensor'

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond {}, but its '
                 'cause is not known.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    walks = any(step.effect == WANDER for step in result.steps)
    words = _VERDICTS[result.verdict].format(
        'a slow change of the offset' if walks else 'an empirical curve')
    if result.undecided:
        words = _undecided(result)
    elif result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


def _undecided(result: Refinement) -> str:
    """Return why it is not known what explains a gap."""
    if result.refusal:
        why = result.refusal[0]
    else:
        most = max(result.steps, key=lambda step: len(step.rivals))
        why = f'{len(most.rivals)} others explain it about as well as {most.effect}'
    return f'Not enough poses: they cannot tell what explains the gap, because {why}.'


def residual_words(result: Refinement) -> str:
    """Return the residual of the base and of the refined model, and the noise floor."""
    floor = ('not known' if result.noise_floor_mg is None
             else f'{short(result.noise_floor_mg)} mg')
    residual = f'{short(result.gap_mg)} mg'
    if result.steps:
        residual = f'{short(result.gap_mg)} -> {short(result.remaining_gap_mg)} mg'
    poses = result.poses_g
    count = int(np.sum(poses['new'] > 0.0)) if 'new' in poses else len(poses)
    return f'residual {residual} over {counted(count, "pose")}, noise floor {floor}'


def base_words(result: Refinement) -> str:
    """Return the name of the base model."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def chance(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


def values_of(step: Step) -> list[tuple[str, str]]:
    """Return name and text of each value of a step; values in g are given in mg."""
    effect = effect_named(step.name)
    values = []
    for name, value in step.parameters.items():
        unit_name, scale = value_unit(step.name, name)
        words = (f'{value * scale:+.3g} {unit_name}'.replace('-', '−')
                 if name in effect.parameters else f'{value:.5g} {unit_name}'.rstrip())
        values.append((name, words))
    return values


def sample_words(used: int, total: int) -> str:
    """Return a warning about a sample of a long table."""
    return (f'the refinement uses {used} of {total} poses, spread evenly over the table, to bound '
            'its time and memory; it does not look for disturbed poses among the others; choose '
            'rows to use others')


def limit_words(rows: str, limit_g: float) -> str:
    """Return where readings are clipped."""
    return f'in {rows}: an axis reads {limit_g:.4g} g and its samples hardly scatter'


def grid_words(step_mg: float) -> str:
    """Return the step of a grid and the error that it causes."""
    return (f'pose means are multiples of {step_mg:.3g} mg, which causes '
            f'{step_mg / np.sqrt(12.0):.2g} mg RMS per axis')


def curve_words(name: str, largest_mg: float, steepest: tuple[float, float] | None,
                nearest: Mapping[str, float]) -> str:
    """
    Return a description of an empirical curve, with its largest contribution to a pose.

    It changes most between two values of its variable. `nearest` is what the most similar known
    effects leave of the residual [mg].

    """
    carrier, variable, _ = empirical_parts(name)
    whole, _, part = carrier.partition('.')
    what = 'size of the force' if whole == 'force' else whole.replace('_', '-')
    of = f' of {part}' if part else ''
    words = f'the {what}{of} changes with {variable_words(variable)} by up to {largest_mg:.2g} mg'
    if steepest is not None:
        low, high = steepest
        words += f', most between {low:.4g} and {high:.4g} {column_of(variable).unit}'.rstrip()
    if nearest:
        words += '; no known effect has this form, the nearest are ' + ', '.join(
            f'{effect} (leaves {left:.2g} mg)' for effect, left in nearest.items())
    return words


def instant_words(times: tuple[float, float], rows: tuple[int, int]) -> str:
    """Return the poses before and after an instant, by their times [s] and rows."""
    return (f'between {times[0]:.6g} and {times[1]:.6g} s (rows {rows[0]} and {rows[1]})')


def range_words(column: str, ends: tuple[float, float], rms_mg: tuple[float, float]) -> str:
    """Return the range of a column, and the disagreement at both ends of it [mg]."""
    span = f'{ends[0]:.4g} to {ends[1]:.4g} {unit_of(column)}'.rstrip()
    return (f'over {column.replace("_", " ")} {span}: '
            f'{rms_mg[0]:.2g} mg RMS in the lowest fifth of the poses, {rms_mg[1]:.2g} mg in the '
            'highest')


def direction_words(means: Sequence[tuple[Floats, float, int]], total: int) -> str:
    """Return the mean disagreement around directions, from (signs, mean [mg], poses) of each."""
    return 'with ' + ', '.join(
        f'{axes_of_signs(signs)} up ({mean:+.2g} mg over {count} of {total} poses)'
        for signs, mean, count in means)


def change_words(name: str, values: Floats, deviations: Sequence[float], date: str) -> str:
    """Return the change of values since a stored calibration of a date, with uncertainties."""
    effect = effect_named(CHANGES[name].base)
    scale, unit_name = (1e3, 'mg') if effect.is_offset else (100.0, '%')
    shown = ', '.join(f'{"+" if value > 0.0 else ""}{with_sd(value * scale, sd * scale)}'
                      for value, sd in zip(values.tolist(), deviations, strict=True))
    since = f' since {date[:10]}' if date else ''
    return f'the {effect.words} has changed by ({shown}) {unit_name}{since}'


def plain_name(name: str) -> str:
    """Return the name of an effect, for a change that of the effect that has changed."""
    return CHANGES[name].base if name in CHANGES else name


def shown_name(name: str) -> str:
    """Return the name of an effect among rivals; a covariate keeps its quantity."""
    if kind_of(name) in COVARIATES:
        return f'{kind_of(name)}-{variable_of(name)}'
    return plain_name(kind_of(name))


def advice_for(found: Found, steps: tuple[Step, ...], untestable: tuple[tuple[str, str], ...],
               left_out: int, *, unexplained: bool = False) -> tuple[str, ...]:
    """
    Return advice for the user, one line each.

    `untestable` are the effects that the data cannot show, and the data to record for them;
    `left_out` is the number of poses that were left out; `unexplained`: a gap remains.

    """
    lines = [*_other_sensor(found), *_unseen_turn(found)]
    lines += [_separating(step) for step in steps if step.rivals]
    lines += [line for step in steps for line in _remarks(step)]
    if left_out:
        were, them = ('was', 'it') if left_out == 1 else ('were', 'them')
        lines.append(f'{counted(left_out, "pose")} {were} left out; take {them} again')
    if found.base.dof < _FEW:
        lines.append(f'{counted(len(found.base.poses_g), "pose")} leave '
                     f'{counted(found.base.dof, "degree")} of freedom, which is too few to detect '
                     'most effects: take 24 poses or more')
    if unexplained:
        lines += _unexplained(found, untestable)
    return tuple(lines)


def _unexplained(found: Found, untestable: tuple[tuple[str, str], ...]) -> list[str]:
    final, nearest = found.final, ''
    if not found.taken_back and found.curve is None and WANDER not in found.added:
        return [f'poses repeat {np.sqrt(final.rss / final.dof):.1f} times worse than their '
                'samples, and the scatter has no structure: clamp the sensor, let it settle '
                'longer']
    if found.taken_back:
        nearest = f'; {", ".join(found.taken_back)} would explain only a part'
    lines = [f'a gap remains that no effect testable with these data explains{nearest}: check '
             'what differs between the poses, and repeat some of them']
    columns = sorted({needs for effect, needs in untestable if effect_named(effect).needs})
    if columns:
        lines.append(f'record {"; ".join(columns)}: their effects cannot be tested yet')
    return lines


def _other_sensor(found: Found) -> list[str]:
    """Return a line if the changes are too large for one sensor."""
    for name, values in found.final.model.values.items():
        if name in CHANGES and np.max(np.abs(values)) > CHANGES[name].repeatable_g:
            return [f'{_OTHER_SENSOR}: its {CHANGES[name].base} differs from the stored one by '
                    f'{np.max(np.abs(values)):.2g} {CHANGES[name].unit}, which is too much for '
                    'one sensor; fit a new calibration from its own poses']
    return []


def _unseen_turn(found: Found) -> list[str]:
    """Return a line if the sensor may have turned since the stored calibration, unseen."""
    poses_g = found.base.poses_g
    if 'new' not in poses_g or 'reference' in poses_g:
        return []
    return ['a mount that has turned since the calibration cannot show: only |force| = 1 g is '
            'known; take poses of known orientation (ref_x, ref_y, ref_z) with both']


def _separating(step: Step) -> str:
    families = {effect_named(name).family for name in (step.name, *step.rivals)
                if is_effect(name)}
    family = families.pop() if len(families) == 1 else ''
    return (f'{step.effect} cannot be distinguished from {", ".join(step.rivals)} here: '
            f'{TO_SEPARATE[family]}')


def times_typical(step: Step) -> float:
    """Return the largest value of an effect relative to that of typical parts; 0: not known."""
    if step.effect == EMPIRICAL:
        return 0.0
    effect = effect_named(step.name)
    return max((abs(step.parameters.get(name, 0.0)) for name in effect.parameters),
               default=0.0) / effect.typical


def _remarks(step: Step) -> list[str]:
    """Return a remark on values that are far larger than in common parts."""
    times = times_typical(step)
    if times <= _FAR:
        return []
    effect = effect_named(step.name)
    return [f'{step.effect} is {times * effect.typical:.2g} {effect.unit}, typical parts have '
            f'about {effect.typical:.2g}: check that the sensor causes it, and not the setup']


def plan_lines(weights: Mapping[str, float], poses: Sequence[tuple[str, str]], expected: float, *,
               enough: bool) -> list[str]:
    """
    Return the lines about one contest, with the direction and the conditions of each pose.

    `weights` are the probabilities of the named effect and of its rivals. After all poses of the
    plan, the right one has the probability `expected`; `enough`: more poses are not needed.

    """
    odds = ', '.join(percent(weight) for weight in weights.values())
    what = f'to separate {versus(tuple(weights))} ({odds})'
    end = f'the expected probability of the right one is then {percent(expected)}'
    if poses:
        return [f'{what}, take these poses:', *_held(poses), end]
    if enough:
        return [f'{what}, the same poses are enough: {end}']
    return [f'{what}, poses at 1 g do not help; apply other forces (a centrifuge)']


def _held(poses: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Yield one line for each condition; conditions with the same directions share a line."""
    directions: dict[str, list[str]] = {}
    for direction, where in poses:
        directions.setdefault(where, []).append(direction)
    shared: dict[tuple[str, ...], list[str]] = {}
    for where, held in directions.items():
        shared.setdefault(tuple(_counted(held)), []).append(where)
    for texts, places in shared.items():
        where = ' and '.join(filter(None, places))
        yield f'{where + ": " if where else ""}hold {"; ".join(texts)}'


def _counted(texts: list[str]) -> list[str]:
    """Return each text once, with the number of times if there are several."""
    times = {text: texts.count(text) for text in texts}
    return [text if count == 1 else f'{text} ({count} poses)' for text, count in times.items()]


def versus(names: Sequence[str]) -> str:
    """Return the words of an effect and its rivals."""
    first, *others = (shown_name(name) for name in names)
    return f'{first} from {", ".join(others)}'


def condition_words(context: Mapping[str, float]) -> str:
    """Return the context of a planned pose in words; empty if the pose can be taken at once."""
    parts = []
    if 'temperature' in context:
        parts.append(f'at {context["temperature"]:.0f} °C')
    if 'supply_voltage' in context:
        parts.append(f'at {context["supply_voltage"]:.2f} V')
    if 'std' in context:
        parts.append(f'with {1e3 * context["std"]:.2g} mg of vibration')
    parts += [f'at {key} {value:.4g}' for key, value in context.items() if is_quantity(key)]
    if context.get('time', 0.0) > 0.0:
        parts.append(f'{_duration(context["time"])} after the last pose')
    return ' '.join(parts)


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'
