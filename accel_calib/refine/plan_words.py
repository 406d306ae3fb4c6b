# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The record of a plan of poses, and its words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math

import numpy as np

from ..calibrate.pose_planning import words_of
from ..geometry import unit
from ..table import Floats

ENOUGH = 0.95
"""Expected probability of the right effect at which a plan ends."""

_NEAR = math.cos(math.radians(8.0))
"""A direction within 8° of a face, edge or corner has its name."""

VARIED = ('temperature', 'supply_voltage', 'time', 'std')
"""Context that a plan can vary, by column."""

NOTHING = (f'there is nothing to separate: no named effect has a rival that leaves it a '
           f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""


@dataclass(frozen=True)
class PlannedPose:
    """
    One pose of a plan.

    Parameters
    ----------
    up : tuple of float
        Direction to point up, a unit vector in the sensor axes.
    words : str
        The same in words.
    context : mapping of str to float
        What else to set, by column of `accel_calib.table.COLUMNS`: ``temperature`` [°C],
        ``supply_voltage`` [V], ``std`` [g], and ``time`` as the wait after the last pose [s].
    separates : tuple of str
        The named effect and its rivals.
    expected : float
        Expected probability of the right one of them after this pose and those before it.

    """

    up: tuple[float, float, float]
    words: str
    context: Mapping[str, float]
    separates: tuple[str, ...]
    expected: float

    @property
    def purpose(self) -> str:
        """Return what the pose is for."""
        return f'to separate {_versus(self.separates)}'

    @property
    def conditions(self) -> str:
        """Return the context in words; empty if the pose can be taken at once."""
        parts = []
        if 'temperature' in self.context:
            parts.append(f'at {self.context["temperature"]:.0f} °C')
        if 'supply_voltage' in self.context:
            parts.append(f'at {self.context["supply_voltage"]:.2f} V')
        if 'std' in self.context:
            parts.append(f'with {1e3 * self.context["std"]:.2g} mg of vibration')
        if self.context.get('time', 0.0) > 0.0:
            parts.append(f'{_duration(self.context["time"])} after the last pose')
        return ' '.join(parts)


@dataclass(frozen=True)
class PosePlan:
    """
    Poses that separate named effects from their rivals soonest.

    Parameters
    ----------
    poses : tuple of PlannedPose
        The poses in the order to take them; empty if there are no rivals, or no pose separates
        them.
    lines : tuple of str
        The plan in words.

    """

    poses: tuple[PlannedPose, ...] = ()
    lines: tuple[str, ...] = (NOTHING,)

    @property
    def advice(self) -> tuple[str, ...]:
        """Return a line about the first pose; empty without poses."""
        if not self.poses:
            return ()
        first, last = self.poses[0], self.poses[-1]
        where = f', {first.conditions}' if first.conditions else ''
        return (f'next pose to separate {_versus(first.separates)}: {first.words}{where} (1 of '
                f'{len(self.poses)} poses, with which the expected probability of the right one '
                f'is {percent(last.expected)})',)


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


def attitudes() -> Floats:
    """Return the faces, edges and corners as (26, 3) unit vectors, the faces first."""
    signs = np.array([s for s in product((0, 1, -1), repeat=3) if any(s)], float)
    return unit(signs[np.argsort(np.sum(np.abs(signs), axis=1), kind='stable')])


def plan_lines(weights: Mapping[str, float], poses: Sequence[PlannedPose], expected: float
               ) -> Iterator[str]:
    """
    Yield the lines about one contest.

    Parameters
    ----------
    weights : mapping of str to float
        Probability of the named effect, then of its rivals.
    poses : sequence of PlannedPose
        The poses that separate them.
    expected : float
        Expected probability of the right one after all poses of the plan.

    """
    odds = ', '.join(percent(weight) for weight in weights.values())
    names = tuple(weights)
    end = f'the expected probability of the right one is then {percent(expected)}'
    if not poses and expected >= ENOUGH:
        yield f'to separate {_versus(names)} ({odds}), the same poses are enough: {end}'
    elif not poses:
        yield (f'to separate {_versus(names)} ({odds}), poses at 1 g do not help; apply '
               'other forces (a centrifuge)')
    else:
        yield f'to separate {_versus(names)} ({odds}), take these poses:'
        yield from _held(poses)
        yield end


def _held(poses: Sequence[PlannedPose]) -> Iterator[str]:
    """Yield one line for each condition; conditions with the same directions share a line."""
    directions: dict[str, list[str]] = {}
    for pose in poses:
        directions.setdefault(pose.conditions, []).append(pose.words)
    shared: dict[tuple[str, ...], list[str]] = {}
    for where, held in directions.items():
        shared.setdefault(tuple(_counted(held)), []).append(where)
    for texts, places in shared.items():
        where = ' and '.join(filter(None, places))
        yield f'{where + ": " if where else ""}hold {"; ".join(texts)}'


def _counted(words: Sequence[str]) -> Iterator[str]:
    """Yield each text once, with the number of times if there are several."""
    for each in dict.fromkeys(words):
        times = list(words).count(each)
        yield each if times == 1 else f'{each} ({times} poses)'


def _versus(names: Sequence[str]) -> str:
    """Return the words of an effect and its rivals."""
    first, *others = (name.removesuffix('_change') for name in names)
    return f'{first} from {", ".join(others)}'


def _duration(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 120.0:
        return f'{seconds:.0f} s'
    return f'{seconds / 60.0:.0f} min' if seconds < 7200.0 else f'{seconds / 3600.0:.1f} h'


def attitude_words(up: Floats) -> str:
    """Return a direction that points up in words: a face, edge or corner, or a tilted face."""
    known = attitudes()
    near = int(np.argmax(known @ up))
    if known[near] @ up >= _NEAR:
        return f'{words_of(np.sign(known[near]))} up ({_axes(known[near])})'
    axis = int(np.argmax(np.abs(up)))
    face = np.sign(up) * (np.arange(3) == axis)
    flat = unit((up - up[axis] * np.eye(3)[axis])[np.newaxis])[0]
    edges = known[known[:, axis] == 0.0]
    raised = edges[int(np.argmax(edges @ flat))]
    tilt = math.degrees(math.acos(min(abs(float(up[axis])), 1.0)))
    return (f'{words_of(face)} up ({_axes(face)}), tilted by {tilt:.0f}° so that '
            f'{words_of(np.sign(raised))} ({_axes(raised)}) rises')


def _axes(signs: Floats) -> str:
    """Return the axes of these signs, such as ``+x -y``."""
    return ' '.join(f'{"+" if sign > 0 else "-"}{axis}'
                    for axis, sign in zip('xyz', signs, strict=True) if sign)
