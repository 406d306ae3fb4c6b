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

from dataclasses import dataclass, field, replace
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

_ANSWERS = 4
"""Number of answers from which the axes are found."""

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


@dataclass(frozen=True, eq=False)
class Guide:
    """
    The next pose, and the lines about captured poses; the methods return the guide after them.

    Parameters
    ----------
    chosen : SessionPlan or None
        The next pose for a fit; None before the first choice.
    planned : tuple of PlannedPose or None
        The poses of a refinement that are still asked for, () once all are taken; None: the poses
        are for a fit.
    begun : int
        Number of poses when they were planned.
    axes : (3, 3) array
        The axes of the readings in those of the sensor, one of the 48 with right angles.
    skipped : tuple of (3,) array
        Directions that are not asked for.
    is_stale : bool
        Whether another pose is to be asked for because of the last rest.
    answers : tuple of (array, array)
        The last requests, and the directions that were read instead.
    missed : int
        Number of the last requests in a row that were not followed.
    count, new_at : int, float
        Number of poses, and the header stamp at which it changed [s].
    rest : float
        Start of the last rest that has a line [s].

    """

    chosen: SessionPlan | None = None
    planned: tuple[PlannedPose, ...] | None = None
    begun: int = 0
    axes: Floats = field(default_factory=lambda: _AXES[0])
    skipped: tuple[Floats, ...] = ()
    is_stale: bool = False
    answers: tuple[tuple[Floats, Floats], ...] = ()
    missed: int = 0
    count: int = 0
    new_at: float = math.inf
    rest: float = -math.inf

    @property
    def plan(self) -> SessionPlan | None:
        """Return the next pose, or that of a followed refinement; None before the first choice."""
        plan = self.chosen
        if plan is None:
            return None
        asked = plan.asked
        if self.planned:
            first = self.planned[0]
            asked = NextPose(self.axes.T @ first.up, asked.error, plan.poses + len(self.planned),
                             fits=False, planned=first)
        elif asked.direction is not None:
            asked = replace(asked, direction=self.axes.T @ asked.direction)
        return replace(plan, asked=asked)

    def choose(self, plan: SessionPlan | None) -> Guide:
        """Ask for another pose; those of a refinement that are taken now are not asked for."""
        planned = self.planned
        if plan is None or plan.poses < self.begun:
            planned = None
        elif planned:
            new = plan.up[self.begun:]
            planned = tuple(each for each in planned if not np.any(new @ each.up >= TAKEN))
        return replace(self, chosen=plan, planned=planned, is_stale=False)

    @property
    def poses(self) -> int:
        """Return the number of poses for which the next pose was chosen."""
        return 0 if self.chosen is None else self.chosen.poses

    def answer(self, mean: Floats, units: Units) -> tuple[Guide, str]:
        """Note the mean reading of a new rest; return also how it is not what was asked for."""
        plan = self.plan
        if plan is None or not plan.poses or plan.asked.direction is None or (
                units.is_native and not plan.zero):
            return self, ''
        asked, read = plan.asked.direction, unit(mean - np.array(plan.zero or (0.0, 0.0, 0.0)))
        noted = replace(self, answers=(*self.answers, (asked, read))[-_ANSWERS:])
        wanted = self.axes @ asked
        if read @ wanted >= _FOLLOWED:
            return replace(noted, missed=0), ''
        skips = all(each @ wanted < TAKEN for each in self.skipped)
        noted = replace(noted, skipped=(*self.skipped, *([wanted] if skips else [])),
                        missed=self.missed + 1, is_stale=True)
        asked_all, read_all = map(np.array, zip(*noted.answers, strict=True))
        # Opposite requests show one axis alone, and a robot that tilts reads the same without end.
        telling = np.min(np.abs(asked_all @ asked_all.T)) < _APART and not lies_in_cone(
            np.vstack([plan.up, read_all]))
        wrong, axes = int(np.sum(np.sum(read_all * asked_all, axis=1) < _FOLLOWED)), _AXES[0]
        if telling and wrong >= _FEWEST_WRONG:
            likely = _AXES if len(asked_all) > _FEWEST_WRONG else _AXES[:_SIMPLE]
            axes = next((each for each in likely if np.all(
                np.sum(read_all * (asked_all @ each.T), axis=1) >= _AGREES)), axes)
        if not np.array_equal(axes, self.axes):
            noted = replace(noted, axes=axes, skipped=(), missed=0)
        return noted, f'asked for {_signs(asked)}, the sensor reads {_signs(read)}'

    @property
    def axes_words(self) -> str:
        """Return how the axes are probably swapped or inverted; empty if they are not."""
        if np.array_equal(self.axes, _AXES[0]):
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
