# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What to do after a refinement: which poses or conditions would tell more."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..effects import EFFECTS

if TYPE_CHECKING:
    from .records import Step
    from .search import Found

_BY_FORCE = {'quadratic', 'cubic', 'odd_quadratic', 'gain_asymmetry', 'cross_coupling'}
_BY_TIME = {'offset_drift', 'warm_up', 'offset_step', 'offset_wander', 'offset_temperature',
            'gain_temperature'}
_FAR = 10.0


def advice_for(verdict: str, found: Found, steps: tuple[Step, ...],
               untestable: tuple[tuple[str, str], ...]) -> tuple[str, ...]:
    """
    Say what to do.

    Parameters
    ----------
    verdict : str
        Of the refinement.
    found : Found
        What the search came to.
    steps : tuple of Step
        What was added.
    untestable : tuple of (str, str)
        Effects that cannot be seen, and what they need.

    """
    lines = [_parting(step) for step in steps if step.rivals]
    lines += [line for step in steps for line in _remarks(step)]
    if len(found.knocked):
        lines.append(f'{len(found.knocked)} poses were disturbed; take them again')
    if verdict == 'unexplained':
        nearest = f'; {", ".join(found.taken_back)} would explain a part alone' if (
            found.taken_back) else ''
        lines.append('a gap remains that no effect that these data can show accounts for'
                     f'{nearest}: see what differs between the poses, and repeat some of them')
        columns = sorted({needs for effect, needs in untestable
                          if EFFECTS.get(effect) is not None and EFFECTS[effect].needs})
        if columns:
            lines.append(f'record {"; ".join(columns)}: effects of these cannot be seen yet')
    return tuple(lines)


def _parting(step: Step) -> str:
    """Say what would part an effect from its rivals."""
    names = {step.effect, *step.rivals}
    alike = f'{step.effect} and {", ".join(step.rivals)} look alike here'
    if names <= _BY_FORCE:
        return (f'{alike}: on the 1 g sphere they overlap by up to 98 %; more poses between the '
                'faces would part them, or forces other than 1 g (a centrifuge)')
    if names <= _BY_TIME:
        return (f'{alike}: let the temperature fall as well as rise, and visit the same '
                'orientations again at other times')
    return f'{alike}: vary the one while the other stays as it is'


def _remarks(step: Step) -> list[str]:
    """Remark on values far outside what common parts have."""
    if step.effect not in EFFECTS:
        return []
    effect = EFFECTS[step.effect]
    largest = max((abs(step.parameters.get(name, 0.0)) for name in effect.parameters),
                  default=0.0)
    if largest <= _FAR * effect.typical:
        return []
    return [f'{step.effect} is {largest:.2g} {effect.unit}, common parts have about '
            f'{effect.typical:.2g}: make sure that it is the sensor and not the set-up']
