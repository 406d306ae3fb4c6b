# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Text about a refinement: its verdict, its advice, and where the gap is.

**Not testable.** Effects that the poses cannot show, and the data to record for them.

**Where.** Description of where simulation and measurement disagree: directions, ranges or poses.

"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .linear import linearised
from .state import State
from ..effects import (
    CHANGES,
    effect_named,
    EFFECTS,
    EMPIRICAL,
    empirical_parts,
    parameter_names,
    PROCESSES,
    TO_SEPARATE,
    value_unit,
    VARIABLES,
    WANDER,
)
from ..estimate import kinds
from ..table import COLUMNS, Floats, Poses
from ..text import counted, short
from ..units import MG

if TYPE_CHECKING:
    from .records import Refinement, Step
    from .search import Found

_LEAST_VISIBLE = 0.1
"""Smallest visible change of the residuals by an effect of typical size, relative to the noise."""


def not_testable(poses_g: Poses, testable: Mapping[str, float], present: tuple[str, ...]
                 ) -> list[tuple[str, str]]:
    """
    Return the effects that these poses cannot show, with the data to record.

    Parameters
    ----------
    poses_g : Poses
        Poses in g.
    testable : mapping of str to float
        Effects that the poses distinguish from the model, and how visible they are.
    present : tuple of str
        Effects of the model and their rivals.

    """
    missing = []
    known = kinds(poses_g)[0]
    for name, effect in {**EFFECTS, **PROCESSES}.items():
        if name in present or effect.output is not None:
            continue
        if name in testable and (effect.needs or testable[name] > _LEAST_VISIBLE):
            continue
        if name in ('gain', 'axis_gain') and {'gain', 'axis_gain'} & set(present):
            continue
        lacking = [', '.join(COLUMNS[key].names) for key in effect.needs if key not in poses_g]
        if lacking:
            missing.append((name, ' and '.join(lacking)))
        elif name == 'misalignment' and not len(known):
            missing.append((name, 'ref_x, ref_y, ref_z (known orientation)'))
        elif name in PROCESSES:
            continue
        elif effect.needs:
            missing.append((name, 'poses with a larger change of this quantity: '
                            f'{COLUMNS[effect.needs[0]].meaning}'))
        else:
            missing.append((name, 'more poses in more directions'))
    return missing


_NEAREST = 2
"""Number of known effects that are named as the nearest to a curve."""


def curve_words(name: str, before: State, after: State) -> str:
    """Return a description of an empirical curve, and of the known effects nearest to it."""
    carrier, variable, _ = empirical_parts(name)
    share = before.fit.equations.of_poses(before.fit.residual - after.fit.residual) * MG
    whole, _, part = carrier.partition('.')
    what = 'size of the force' if whole == 'force' else whole.replace('_', '-')
    of = f' of {part}' if part else ''
    lines = [f'the {what}{of} changes with {VARIABLES[variable]} by up to '
             f'{np.max(np.abs(share)):.2g} mg{_steepest(variable, before, share)}']
    left = _left_by_known(before)
    if left:
        lines.append('no known effect has this form, the nearest are ' + ', '.join(
            f'{effect} (leaves {gap:.2g} mg)' for effect, gap in left))
    return '; '.join(lines)


def _steepest(variable: str, before: State, share: Floats) -> str:
    """Return where a curve is steepest, for a variable of one number."""
    if variable in ('force', 'std'):
        return ''
    values = before.poses_g[variable]
    order = np.argsort(values, kind='stable')
    parts = np.array_split(order, 5)
    middle = [float(np.mean(values[part])) for part in parts]
    size = [float(np.sqrt(np.mean(share[part] ** 2))) for part in parts]
    at = int(np.argmax(np.abs(np.diff(size))))
    unit = COLUMNS[variable].unit
    return f', most between {middle[at]:.4g} and {middle[at + 1]:.4g} {unit}'


def _left_by_known(before: State) -> list[tuple[str, float]]:
    """Return the known effects that leave least of the residual, and what they leave [mg]."""
    names = tuple(name for name in EFFECTS if name not in before.model.values)
    linear = linearised(before.fit, before.model.effects, names)
    nothing = linear.made()
    gain, rank = linear.gains(nothing)
    found: dict[str, float] = {}
    for number in np.argsort(-gain):
        if rank[number] and linear.blocks[number].effect not in found and len(found) < _NEAREST:
            left = linear.made((int(number),)).residual
            found[linear.blocks[number].effect] = before.gap_mg(left)
    return list(found.items())


_LARGEST = 3
_NEAR = np.cos(np.radians(30.0))


def where(effect: str, before: State, after: Floats) -> str:
    """
    Return a description of where an effect explains the disagreement.

    Parameters
    ----------
    effect : str
        The effect.
    before : State
        State without the effect.
    after : (m,) array
        Residuals of the equations with the effect.

    """
    share = (before.fit.equations.of_poses(before.fit.residual - after)) * MG
    if effect == 'offset_step':
        return _instant(before, share)
    needs = effect_named(effect).needs
    column = next((key for key in needs if key in before.poses_g and key != 'new'), None)
    if column is None:
        return _directions(before.fit.equations.force, share)
    return _range(column, before, share)


def _instant(before: State, share: Floats) -> str:
    """Return a text about the instant of the largest change between successive poses."""
    time = before.poses_g['time']
    order = np.argsort(time, kind='stable')[:int(np.sum(np.isfinite(time)))]
    time, moved = time[order], share[order]
    count = np.arange(1, len(moved))
    sums = np.cumsum(moved ** 2)[:-1]
    at = int(np.argmax(np.abs(sums / count - (np.sum(moved ** 2) - sums) / (len(moved) - count))))
    rows = before.poses_g.row[order]
    return f'between {time[at]:.6g} and {time[at + 1]:.6g} s (rows {rows[at]} and {rows[at + 1]})'


def _range(column: str, before: State, share: Floats) -> str:
    """Return a text about the range of a quantity and the disagreement at both ends."""
    known = np.isfinite(before.poses_g[column].reshape(len(share), -1)).all(axis=1)
    values, share = before.poses_g[column][known], share[known]
    if values.ndim > 1:
        values = np.linalg.norm(values, axis=1)
    order = np.argsort(values, kind='stable')
    ends = max(1, len(order) // 5)
    low, high = (np.sqrt(np.mean(share[part] ** 2)) for part in (order[:ends], order[-ends:]))
    name = column.replace('_', ' ')
    unit = COLUMNS[column].unit if column != 'std' else 'g'
    return (f'over {name} {values[order[0]]:.4g} to {values[order[-1]]:.4g} {unit}: '
            f'{low:.2g} mg RMS in the lowest fifth of the poses, {high:.2g} mg in the highest')


def _directions(force: Floats, share: Floats) -> str:
    """Return a text about the directions with the largest disagreement."""
    signs = np.array([(i, j, k) for i in (0, 1, -1) for j in (0, 1, -1) for k in (0, 1, -1)
                      if i or j or k], float)
    units = signs / np.linalg.norm(signs, axis=1, keepdims=True)
    near = units @ force.T >= _NEAR
    counts = np.sum(near, axis=1)
    means = np.where(counts > 0, near @ share / np.maximum(counts, 1), 0.0)
    largest = [k for k in np.argsort(-np.abs(means))[:_LARGEST] if counts[k]]
    return 'with ' + ', '.join(
        f'{_name(signs[k])} up ({means[k]:+.2g} mg over {counts[k]} of {len(share)} poses)'
        for k in largest)


def _name(signs: Floats) -> str:
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)


_FAR = 10.0
"""Ratio to the typical size above which there is a remark."""

_FEW = 10
"""Degrees of freedom below which most effects cannot be detected."""

_OTHER_SENSOR = 'this is probably another sensor'


def advice_for(verdict: str, found: Found, steps: tuple[Step, ...],
               untestable: tuple[tuple[str, str], ...], left_out: int) -> tuple[str, ...]:
    """
    Return advice for the user, one line each.

    Parameters
    ----------
    verdict : str
        Verdict of the refinement.
    found : Found
        The result of the search.
    steps : tuple of Step
        The added effects.
    untestable : tuple of (str, str)
        Effects that the data cannot show, and the data to record for them.
    left_out : int
        Number of poses that were left out.

    """
    lines = _other_sensor(found)
    lines += [_separating(step) for step in steps if step.rivals]
    lines += [line for step in steps for line in _remarks(step)]
    if left_out:
        poses = '1 pose was' if left_out == 1 else f'{left_out} poses were'
        lines.append(f'{poses} left out; take {"it" if left_out == 1 else "them"} again')
    if found.base.dof < _FEW:
        lines.append(f'{counted(len(found.base.poses_g), "pose")} leave '
                     f'{counted(found.base.dof, "degree")} of freedom, which is too few to detect '
                     'most effects: take 24 poses or more')
    if verdict == 'unexplained' and _has_no_structure(found):
        lines.append(_poor_repeatability(found))
    elif verdict == 'unexplained':
        nearest = f'; {", ".join(found.taken_back)} would explain only a part' if (
            found.taken_back) else ''
        lines.append('a gap remains that no effect testable with these data explains'
                     f'{nearest}: check what differs between the poses, and repeat some of them')
        columns = sorted({needs for effect, needs in untestable if effect_named(effect).needs})
        if columns:
            lines.append(f'record {"; ".join(columns)}: their effects cannot be tested yet')
    return tuple(lines)


def _has_no_structure(found: Found) -> bool:
    """Return whether nothing in the scatter of the poses has a form."""
    return not found.taken_back and found.curve is None and WANDER not in found.added


def _poor_repeatability(found: Found) -> str:
    """Return how much more the poses scatter than their samples say, and what to do."""
    final = found.final
    return (f'poses repeat {np.sqrt(final.rss / final.dof):.1f} times worse than their samples, '
            'and the scatter has no structure: clamp the sensor, let it settle longer')


def _other_sensor(found: Found) -> list[str]:
    """Return a line if the changes are too large for one sensor."""
    for name, values in found.final.model.values.items():
        if name in CHANGES and np.max(np.abs(values)) > CHANGES[name].repeatable_g:
            return [f'{_OTHER_SENSOR}: its {name.removesuffix("_change")} differs from the stored '
                    f'one by {np.max(np.abs(values)):.2g} {CHANGES[name].unit}, which is too much '
                    'for one sensor; fit a new calibration from its own poses']
    return []


def change_words(name: str, state: State, date: str) -> str:
    """Return a text about the change of a value since a stored calibration, with uncertainty."""
    effect, model = effect_named(name), state.model
    which = [parameter_names(model.effects).index(f'{name}.{part}') for part in effect.parameters]
    deviation = float(np.sqrt(np.mean(np.diag(state.fit.covariance)[which])))
    in_percent = name != 'offset_change'
    scale, unit = (100.0, '%') if in_percent else (1e3, 'mg')
    digits = max(0, -int(np.floor(np.log10(max(deviation * scale, 1e-6)))))
    values = ', '.join(f'{value * scale:+.{digits}f}' for value in model.values[name])
    since = f' since {date[:10]}' if date else ''
    own = effect_named(name.removesuffix('_change')).words
    return f'the {own} has changed by ({values}) ± {deviation * scale:.{digits}f} {unit}{since}'


def _separating(step: Step) -> str:
    """Return advice on how to separate an effect from its rivals."""
    families = {effect_named(name).family for name in (step.effect, *step.rivals)
                if name != EMPIRICAL}
    family = families.pop() if len(families) == 1 else ''
    return (f'{step.effect} cannot be distinguished from {", ".join(step.rivals)} here: '
            f'{TO_SEPARATE[family]}')


def _remarks(step: Step) -> list[str]:
    """Return a remark on values that are far larger than in common parts."""
    if step.effect == EMPIRICAL:
        return []
    effect = effect_named(step.effect)
    largest = max((abs(step.parameters.get(name, 0.0)) for name in effect.parameters),
                  default=0.0)
    if largest <= _FAR * effect.typical:
        return []
    return [f'{step.effect} is {largest:.2g} {effect.unit}, typical parts have about '
            f'{effect.typical:.2g}: check that the sensor causes it, and not the setup']


_LEAST_P = 1e-16

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond an empirical '
                 'curve, but no known effect has its form.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    words = _VERDICTS[result.verdict]
    if result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


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


def values_of(step: Step) -> list[tuple[str, str]]:
    """Return name and text of each value of a step; values in g are given in mg."""
    effect = effect_named(step.name)
    values = []
    for name, value in step.parameters.items():
        unit, scale = value_unit(step.name, name)
        words = (f'{value * scale:+.3g} {unit}'.replace('-', '−') if name in effect.parameters
                 else f'{value:.5g} {unit}'.rstrip())
        values.append((name, words))
    return values
