# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Advice after a refinement: the poses or conditions that would show more."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..effects import CHANGES, effect_named, TO_SEPARATE
from ..errors import counted
from ..model import parameter_names

if TYPE_CHECKING:
    from .records import Step
    from .search import Found
    from .state import State

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
    if verdict == 'unexplained':
        nearest = f'; {", ".join(found.taken_back)} would explain only a part' if (
            found.taken_back) else ''
        lines.append('a gap remains that no effect testable with these data explains'
                     f'{nearest}: check what differs between the poses, and repeat some of them')
        columns = sorted({needs for effect, needs in untestable if effect_named(effect).needs})
        if columns:
            lines.append(f'record {"; ".join(columns)}: their effects cannot be tested yet')
    return tuple(lines)


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
    families = {effect_named(name).family for name in (step.effect, *step.rivals)}
    family = families.pop() if len(families) == 1 else ''
    return (f'{step.effect} cannot be distinguished from {", ".join(step.rivals)} here: '
            f'{TO_SEPARATE[family]}')


def _remarks(step: Step) -> list[str]:
    """Return a remark on values that are far larger than in common parts."""
    effect = effect_named(step.effect)
    largest = max((abs(step.parameters.get(name, 0.0)) for name in effect.parameters),
                  default=0.0)
    if largest <= _FAR * effect.typical:
        return []
    return [f'{step.effect} is {largest:.2g} {effect.unit}, typical parts have about '
            f'{effect.typical:.2g}: check that the sensor causes it, and not the setup']
