# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The next pose for the person who turns the sensor, and one line per pose.

The next pose is chosen again only when a pose is added or removed. While a rest lasts, the advice
therefore stays the same, although the average of its pose still changes.

"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import math

import numpy as np

from ..calibrate import directions_of, next_pose, NextPose
from ..errors import RefusedFitError
from ..estimate import fit_sphere, pose_noise
from ..geometry import coverage
from ..refine import PlannedPose
from ..table import Floats, Poses
from ..units import MG, Units

_TAKEN = math.cos(math.radians(17.0))
"""A pose within 17° of a planned one counts as taken, as for the next pose of a fit."""

_FEWEST_NATIVE = 4
"""Smallest number of poses to estimate the centre of native readings."""

_WITHOUT_NEW = 60.0
"""Time without a new pose after which the robot probably cannot be turned further [s]."""


@dataclass(frozen=True)
class Plan:
    """
    The next pose, or that more poses no longer help, and the poses for which it was chosen.

    `up` are the (n, 3) approximate directions of up in the sensor axes, unit vectors; n = 0 if
    they are not known. `noise_g` is the median noise of the poses [g], NaN if not known.
    `coverage` is the share of the sphere within 45° of a pose. `zero` is the approximate zero of
    native readings before a fit; empty if it is not known.

    """

    asked: NextPose
    poses: int
    up: Floats
    noise_g: float
    coverage: float
    zero: tuple[float, ...] = ()


def plan_for(poses: Poses, units: Units, model: str) -> Plan:
    """
    Return the next pose for a fit of this model, or that more poses no longer help.

    As long as the directions of native readings are not known, the poses are taken for those that
    were asked for. Otherwise the same pose would be asked for again.

    """
    up: Floats = np.zeros((0, 3))
    if not units.is_native or len(poses) >= _FEWEST_NATIVE:
        with suppress(RefusedFitError):
            up = directions_of(poses, units)
    noise, noise_g = pose_noise(poses.noise, up), None
    if noise is not None and len(noise) and not units.is_native:
        noise_g = float(np.median(units.to_g(noise)))
    fitted_model = '10' if model == 'auto' else model
    asked = next_pose(up, fitted_model, noise, noise_g=noise_g)
    supposed = up
    while len(supposed) < len(poses) and asked.direction is not None:
        supposed = np.vstack([supposed, asked.direction])
        asked = next_pose(supposed, fitted_model)
    # The zero of readings in other units than native ones is known.
    zero = fit_sphere(poses.reading)[1].tolist() if units.is_native and len(up) else ()
    return Plan(asked, len(poses), up, math.nan if noise_g is None else noise_g,
                coverage(up) if len(up) else 0.0, tuple(zero))


@dataclass(frozen=True)
class Action:
    """The next step: one of `accel_calib.finding.STEPS`, its words, and its service or ''."""

    kind: str
    words: str
    command: str = ''


NOT_KNOWN = Action('', '')

_SERVICES = {'fit': 'fit', 'refine': 'refine', 'level': 'set_level', 'save': 'save'}
"""Service for each kind of step that has one."""


def calling(kind: str, text: str) -> Action:
    """Return a step with the call of its service."""
    command = _SERVICES.get(kind, '')
    return Action(kind, f'{text}; call ~/{command}' if command else text, command)


class Guide:
    """
    The next pose, and the lines about captured poses.

    `planned` are the poses of a refinement that are still asked for, () once all are taken; None:
    the poses are for a fit.

    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self.planned: tuple[PlannedPose, ...] | None = None
        self._begun = 0
        self._count = 0
        self._new_at = math.inf
        self._refused = 0, ''
        self._rest = -math.inf

    @property
    def plan(self) -> Plan | None:
        """Return the next pose, or that of a followed refinement; None before the first choice."""
        if self._plan is None or not self.planned:
            return self._plan
        first, plan = self.planned[0], self._plan
        where = f' {first.conditions}' if first.conditions else ''
        return replace(plan, asked=NextPose(
            np.array(first.up), f'hold {first.words}{where}, {first.purpose}', plan.asked.error,
            plan.poses + len(self.planned), fits=False))

    @plan.setter
    def plan(self, plan: Plan | None) -> None:
        self._plan = plan
        if plan is None or plan.poses < self._begun:
            self.planned = None
        elif self.planned:
            new = plan.up[self._begun:]
            self.planned = tuple(
                each for each in self.planned if not np.any(new @ each.up >= _TAKEN))

    def follow(self, planned: Sequence[PlannedPose]) -> None:
        """Ask for these poses of a refinement next; for none, ask for poses for a fit."""
        self.planned, self._begun = tuple(planned) or None, self.poses

    @property
    def action(self) -> Action:
        """Return what to do next with the poses; `NOT_KNOWN` before the first choice."""
        if self.planned == ():
            return calling('refine', 'all poses of the plan are taken')
        plan = self.plan
        if plan is None:
            return NOT_KNOWN
        asked = plan.asked
        if asked.direction is None:
            return calling('fit', asked.words)
        return (Action('poses', f'{asked.words}, or call ~/fit', 'fit') if asked.fits
                else Action('poses', asked.words))

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

    def refuse(self, poses: int, advice: str) -> None:
        """Note that a fit to this number of poses is refused, and what to do."""
        self._refused = poses, advice

    @property
    def refused_advice(self) -> str:
        """Return what to do after a refused fit to the present poses; empty otherwise."""
        poses, advice = self._refused
        return advice if poses == self.poses else ''

    def is_stuck(self, stamp: float) -> bool:
        """Return whether a fit is refused, or no pose has been new for a minute."""
        return bool(self.refused_advice) or stamp - self._new_at >= _WITHOUT_NEW

    def is_new_rest(self, start: float) -> bool:
        """Return whether a captured rest with this start has no line yet, and note it."""
        new = start > self._rest
        self._rest = max(start, self._rest)
        return new

    def line(self, poses: Poses, units: Units, action: Action, *, added: bool) -> str:
        """Return the line about a rest that `added` a pose or repeats one; empty if no news."""
        if self.plan is None or action is NOT_KNOWN:
            return ''
        more, total = action.kind == 'poses', self.plan.asked.total
        if not added:
            return f'this rest repeats an earlier pose; next: {action.words}' if more else ''
        count = f'{len(poses)} of about {total}' if more else f'{len(poses)}'
        noise = ''
        if poses.noise is not None and not units.is_native:
            latest = poses.noise[int(np.argmax(poses['time']))]
            noise = f', {float(np.mean(units.to_g(latest))) * MG:.2f} mg'
        then = '' if action.kind == 'done' else f', next: {action.words}'
        return f'pose {count}{noise}{then}'
