# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The words of poses: of the next one, of a plan, and of what poses do not determine."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from ..calibration import Combination, ENOUGH, NextPose, PlannedPose, PosePlan
from ..effects import EffectKey, shown_name
from ..geometry import attitude_words, axes_of_signs, words_of
from ..table import is_quantity
from ..units import MG

NOTHING_TO_PLAN = (f'there is nothing to separate: no named effect has a rival that leaves it a '
                   f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""


def request_words(asked: NextPose) -> str:
    """Return what to do for the next pose, or that more poses no longer help."""
    up, planned = asked.direction, asked.planned
    if up is None:
        certain = (f'{asked.error * asked.noise_g * MG:.2g} mg' if asked.noise_g is not None
                   else f'{asked.error:.2g} times the noise of a pose')
        return (f'more poses no longer help: {asked.total} poses determine |a| to within '
                f'{certain}')
    if planned is None:
        return f'turn the sensor so that {words_of(up)} points up ({axes_of_signs(up)})'
    where = ' '.join(filter(None, [attitude_words(up), condition_words(planned)]))
    return f'hold {where}, to separate {versus(planned.separates)}'


def combination_words(combination: Combination) -> str:
    """Return a combination of parameters, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
    if len(combination.main) == 1:
        return next(iter(combination.main))
    first, *others = (f'{"-" if weight < 0 else "+"} {abs(weight):.2f} {name}'
                      for name, weight in combination.main.items())
    return ' '.join([first.removeprefix('+ '), *others])


def condition_words(pose: PlannedPose) -> str:
    """Return the context of a planned pose; empty if it can be taken at once."""
    context, parts = pose.context, list[str]()
    if 'temperature' in context:
        parts.append(f'at {context["temperature"]:.0f} °C')
    if 'supply_voltage' in context:
        parts.append(f'at {context["supply_voltage"]:.2f} V')
    if 'std' in context:
        parts.append(f'with {1e3 * context["std"]:.2g} mg of vibration')
    parts += [f'at {key} {value:.4g}' for key, value in context.items() if is_quantity(key)]
    if (wait := context.get('time', 0.0)) > 0.0:
        duration = (f'{wait:.0f} s' if wait < 120.0 else
                    f'{wait / 60.0:.0f} min' if wait < 7200.0 else f'{wait / 3600.0:.1f} h')
        parts.append(f'{duration} after the last pose')
    return ' '.join(parts)


def plan_lines(plan: PosePlan) -> tuple[str, ...]:
    """Return a plan in words."""
    lines: list[str] = []
    for rivalry in plan.rivalries:
        own = [pose for pose in plan.poses if pose.separates == rivalry.names]
        odds = ', '.join(map(percent, rivalry.probabilities))
        what = f'to separate {versus(rivalry.names)} ({odds})'
        end = f'the expected probability of the right one is then {percent(rivalry.expected)}'
        if own:
            lines += f'{what}, take these poses:', *_attitude_lines(own), end
        elif rivalry.expected >= ENOUGH:
            lines.append(f'{what}, the same poses are enough: {end}')
        else:
            lines.append(f'{what}, poses at 1 g do not help; apply other forces (a centrifuge)')
    return tuple(lines) or (NOTHING_TO_PLAN,)


def _attitude_lines(poses: Sequence[PlannedPose]) -> Iterator[str]:
    """Yield one line for each condition; conditions with the same directions share a line."""
    directions: dict[str, list[str]] = {}
    for pose in poses:
        directions.setdefault(condition_words(pose), []).append(attitude_words(np.array(pose.up)))
    shared: dict[tuple[str, ...], list[str]] = {}
    for where, attitudes in directions.items():
        texts = tuple(text if count == 1 else f'{text} ({count} poses)'
                      for text, count in Counter(attitudes).items())
        shared.setdefault(texts, []).append(where)
    for texts, places in shared.items():
        where = ' and '.join(filter(None, places))
        yield f'{where + ": " if where else ""}hold {"; ".join(texts)}'


def plan_advice(plan: PosePlan) -> tuple[str, ...]:
    """Return a line about the first pose of a plan; empty without poses."""
    if not plan.poses:
        return ()
    first, last = plan.poses[0], plan.poses[-1]
    where = ', '.join(filter(None, [attitude_words(np.array(first.up)), condition_words(first)]))
    return (f'next pose to separate {versus(first.separates)}: {where} (1 of {len(plan.poses)} '
            'poses, with which the expected probability of the right one is '
            f'{percent(last.expected)})',)


def versus(names: Sequence[EffectKey]) -> str:
    """Return a named effect and its rivals."""
    first, *others = map(shown_name, names)
    return f'{first} from {", ".join(others)}'


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'
