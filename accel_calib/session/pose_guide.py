# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The next pose for the person who turns the sensor, and one line per pose.

The next pose is chosen again only when a pose is added or removed, or a request was not followed.
While a rest lasts, the advice therefore stays the same, although the average of its pose still
changes.

A rest answers the request before it. An answer in another direction is noted. If the answers agree
with swapped or inverted axes, poses are asked for in the axes that the sensor reads. Otherwise the
request is not repeated.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from ..calibration import lies_in_cone, NextPose, PlannedPose, SessionPlan
from ..geometry import ATTITUDES, axes_of_signs, SIGNED_AXES, TAKEN, unit
from ..table import Floats, Poses
from ..units import MG, Units

_FOLLOWED = math.cos(math.radians(30.0))
"""A rest within 30° of what was asked for has followed; the next orientations are 35° away."""

_APART = math.cos(math.radians(50.0))
"""Requests 50° to 130° apart show two axes."""

_WITHOUT_NEW = 30.0
"""Time without a new pose after which the robot probably cannot be turned further [s]."""

NOT_FOLLOWED = 3
"""Number of requests in a row that are not followed, with the same meaning."""

_FEWEST_WRONG = 2
"""Smallest number of wrong answers that show swapped or inverted axes."""

_AGREES = math.cos(math.radians(25.0))
"""All answers must be within 25° of those with such axes. Whoever turns the sensor in an own order
seldom agrees by chance (`benchmarks/persons.py`)."""


_AXES = sorted(SIGNED_AXES,
               key=lambda axes: np.sum(np.diag(axes) != 1.0) + 0.1 * np.sum(axes < 0.0))
"""The ways in which axes can be swapped and inverted, the most likely first: reading = A up."""

_SIMPLE = 7
"""Number of them with no, or with one axis inverted, or two swapped."""


class Guide:
    """
    The next pose, and the lines about captured poses.

    `planned` are the poses of a refinement that are still asked for, () once all are taken; None:
    the poses are for a fit. `axes` are the axes of the readings in those of the sensor, one of the
    48 with right angles. `missed` counts the last requests in a row that were not followed, and
    `skipped` are directions that are not asked for. `is_stale`: because of the last rest, another
    pose is to be asked for.

    """

    def __init__(self) -> None:
        self._plan: SessionPlan | None = None
        self.planned: tuple[PlannedPose, ...] | None = None
        self.axes: Floats = _AXES[0]
        self.skipped: list[Floats] = []
        self.is_stale = False
        self._answers = deque[tuple[Floats, Floats]](maxlen=4)
        self.missed = 0
        self._begun = 0
        self._count = 0
        self._new_at = math.inf
        self._rest = -math.inf

    @property
    def plan(self) -> SessionPlan | None:
        """Return the next pose, or that of a followed refinement; None before the first choice."""
        plan = self._plan
        if plan is None:
            return None
        asked = plan.asked
        if self.planned:
            first = self.planned[0]
            asked = NextPose(self.axes.T @ first.up, asked.error, plan.poses + len(self.planned),
                             fits=False, planned=first)
        elif asked.direction is not None and not self._is_usual:
            asked = replace(asked, direction=self.axes.T @ asked.direction)
        return replace(plan, asked=asked)

    @plan.setter
    def plan(self, plan: SessionPlan | None) -> None:
        self._plan, self.is_stale = plan, False
        if plan is None or plan.poses < self._begun:
            self.planned = None
        elif self.planned:
            new = plan.up[self._begun:]
            self.planned = tuple(
                each for each in self.planned if not np.any(new @ each.up >= TAKEN))

    @property
    def _is_usual(self) -> bool:
        return np.array_equal(self.axes, _AXES[0])

    def follow(self, planned: Sequence[PlannedPose]) -> None:
        """Ask for these poses of a refinement next; for none, ask for poses for a fit."""
        self.planned, self._begun = tuple(planned) or None, self.poses

    @property
    def poses(self) -> int:
        """Return the number of poses for which the next pose was chosen."""
        return 0 if self._plan is None else self._plan.poses

    def added(self, count: int, stamp: float) -> int:
        """Note the number of poses at a header stamp [s]; return by how many it has changed."""
        change, self._count = count - self._count, count
        if change:
            self._new_at = stamp
        return change

    def is_stuck(self, stamp: float) -> bool:
        """Return whether several requests were not followed, or no pose is new for a time."""
        return self.missed >= NOT_FOLLOWED or stamp - self._new_at >= _WITHOUT_NEW

    def is_new_rest(self, start: float) -> bool:
        """Return whether a captured rest with this start has no line yet, and note it."""
        new = start > self._rest
        self._rest = max(start, self._rest)
        return new

    def rested(self, mean: Floats, units: Units) -> str:
        """Note the mean reading of a new rest; return how it is not what was asked for, or ''."""
        plan = self.plan
        if plan is None or not plan.poses or plan.asked.direction is None or (
                units.is_native and not plan.zero):
            return ''
        asked, read = plan.asked.direction, unit(mean - np.array(plan.zero or (0.0, 0.0, 0.0)))
        self._answers.append((asked, read))
        wanted = self.axes @ asked
        if read @ wanted >= _FOLLOWED:
            self.missed = 0
            return ''
        words = f'asked for {_signs(asked)}, the sensor reads {_signs(read)}'
        if all(each @ wanted < TAKEN for each in self.skipped):
            self.skipped.append(wanted)
        self.missed, self.is_stale = self.missed + 1, True
        axes = self._likely_axes(plan.up)
        if not np.array_equal(axes, self.axes):
            self.axes, self.skipped, self.missed = axes, [], 0
        return words

    def _likely_axes(self, up: Floats) -> Floats:
        """Return the axes in which the last answers follow; `up` are the poses, (n, 3)."""
        asked, read = map(np.array, zip(*self._answers, strict=True))
        # Opposite requests show one axis alone, and a robot that tilts reads the same without end.
        telling = np.min(np.abs(asked @ asked.T)) < _APART and not lies_in_cone(
            np.vstack([up, read]))
        if telling and np.sum(np.sum(read * asked, axis=1) < _FOLLOWED) >= _FEWEST_WRONG:
            likely = _AXES if len(asked) > _FEWEST_WRONG else _AXES[:_SIMPLE]
            for axes in likely:
                if np.all(np.sum(read * (asked @ axes.T), axis=1) >= _AGREES):
                    return axes
        return _AXES[0]

    @property
    def axes_words(self) -> str:
        """Return how the axes are probably swapped or inverted; empty if they are not."""
        if self._is_usual:
            return ''
        reads = {f'+{name}': _signs(read) for name, read in zip('xyz', self.axes.T)}
        wrong = {name: read for name, read in reads.items() if name != read}
        if all(name[1] == read[1] for name, read in wrong.items()):
            what = (f'the {" and the ".join(f"{name[1]} axis" for name in wrong)} of the readings '
                    f'{"is" if len(wrong) == 1 else "are"} probably inverted')
        else:
            what = 'the axes of the readings are probably swapped: ' + ', '.join(
                f'{name} reads {read}' for name, read in wrong.items())
        return (f'{what}; a calibration does not mind, but the mounting does: correct the driver, '
                'and take the poses again')

    def line(self, poses: Poses, units: Units, words: str, *, asks: bool, added: bool) -> str:
        """
        Return the line about a rest that `added` a pose or repeats one; empty if no news.

        `words` are the next step, empty after the last one; `asks`: it is a pose.

        """
        if not added:
            return f'this rest repeats an earlier pose; next: {words}' if asks else ''
        total = 0 if self.plan is None else self.plan.asked.total
        count = f'{len(poses)} of about {total}' if asks and len(poses) < total else len(poses)
        noise = ''
        if poses.noise is not None and not units.is_native:
            latest = poses.noise[int(np.argmax(poses['time']))]
            noise = f', {float(np.mean(units.to_g(latest))) * MG:.2f} mg'
        return f'pose {count}{noise}{f", next: {words}" if words else ""}'


def _signs(up: Floats) -> str:
    """Return the axes of the side, edge or corner nearest to a direction."""
    return axes_of_signs(ATTITUDES[int(np.argmax(ATTITUDES @ up))])
