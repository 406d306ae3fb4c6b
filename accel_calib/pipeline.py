# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From poses to a rated calibration: fit, refine, level, rate; the one way of all surfaces."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TYPE_CHECKING

import numpy as np

from .calibrate import (
    Calibration, directions_of, fit_partial, fit_poses, fit_with_fleet, flat_direction, FleetPrior,
    FrameName, level, level_by_rows, lies_in_cone, Method, PRIOR)
from .effects import LADDER, Model, PROCESSES
from .errors import RefusedFitError
from .findings import rate, Rating
from .table import Poses
from .text import now, short
from .units import Units

if TYPE_CHECKING:
    from .refine import Refinement

Flat = int | Literal['first', 'last'] | None
"""Row of the flat pose, 1-based, or the first or last pose; None: the mounting stays open."""

FEWEST_IN_CONE = 4
"""Fewest poses near one direction that are fitted; fewer are the beginning of more poses."""


@dataclass(frozen=True)
class Plan:
    """
    How poses become a calibration.

    Parameters
    ----------
    model : {'auto', '4', '7', '9', '10', '12'}
        The model to fit.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of the documents.
    rows : slice, optional
        The poses to fit, by default all; the flat pose can be another one.
    refined : bool
        Look for effects that the calibration lacks, and add them.
    fleet : FleetPrior, optional
        Typical values of sensors of the same model, for few poses; then model 10 is fitted.
    flat : int, 'first', 'last' or None
        Pose with the robot level.
    nose_down : int, optional
        Row of a pose with the nose of the robot tilted down.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    sensor : str
        Name of the sensor; by default the name in the poses.
    also : tuple of str
        Names of own effects of the user, which the search tries beside the catalogue.
    before : Calibration, optional
        The calibration in use. Effects that a refinement has added to it are kept, with new
        values, and the search for effects starts from it. Without a `flat` pose, its levelled
        frame and its mounting are kept.
    in_cone : bool
        Fit poses that are all near one direction, too, with typical values of sensors, unless
        `before` is a full fit.

    """

    model: str = 'auto'
    method: Method = 'ml'
    rows: slice | None = None
    refined: bool = True
    fleet: FleetPrior | None = None
    flat: Flat = None
    nose_down: int | None = None
    frame: FrameName = 'ros'
    sensor: str = ''
    also: tuple[str, ...] = ()
    before: Calibration | None = field(default=None, repr=False)
    in_cone: bool = False


@dataclass(frozen=True)
class Outcome:
    """
    A fitted or refined calibration with its rating.

    `refinement` is None if the search for effects was not asked for, or not possible. `line` is
    what was done beyond the fit, and why.

    """

    calibration: Calibration
    refinement: Refinement | None = field(repr=False)
    line: str

    @cached_property
    def rating(self) -> Rating:
        """Return whether the calibration is good, and the next step."""
        return rate(self.calibration, refinement=self.refinement)


def calibrated(poses: Poses, units: Units, plan: Plan = Plan()) -> Outcome:
    """
    Fit, refine if the poses can carry it, and level, as planned.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit, or a row does not exist.

    """
    date, chosen = now(), poses if plan.rows is None else poses.take(plan.rows)
    calibration = _fit(chosen, units, plan, date)
    refinement, line = None, 'not refined, as asked'
    if plan.refined:
        refinement, line = _refinement(chosen, units, plan, date)
    if refinement is not None and refinement.steps and not refinement.refusal:
        calibration = refinement.calibration
    if plan.before is not None and plan.flat is None:
        calibration = _mounted_as(plan.before, calibration)
    else:
        calibration = level_by_rows(calibration, poses, plan.frame, _row(poses, plan.flat),
                                    plan.nose_down)
    return Outcome(calibration, refinement, line)


def _fit(poses: Poses, units: Units, plan: Plan, date: str) -> Calibration:
    before = plan.before
    if plan.fleet is not None:
        return fit_with_fleet(poses, units, plan.fleet, sensor=plan.sensor, date=date)
    if before is not None and is_refined(before):
        from .refine import refitted
        return refitted(before, poses, sensor=plan.sensor, date=date)
    if plan.in_cone and (before is None or is_partial(before)) and _lie_in_cone(poses, units):
        return fit_partial(poses, units, sensor=plan.sensor, date=date)
    return fit_poses(poses, units, model=plan.model, method=plan.method, sensor=plan.sensor,
                     date=date)


def is_refined(calibration: Calibration) -> bool:
    """Return whether a calibration has effects beyond offset and gain."""
    return any(name not in LADDER for name in calibration.model.effects)


def is_partial(calibration: Calibration) -> bool:
    """Return whether a calibration is not a full fit: a mounting alone, or a fit to a cone."""
    return calibration.method == PRIOR or not calibration.model.effects


def _lie_in_cone(poses: Poses, units: Units) -> bool:
    if units.is_native:
        return False
    try:
        up = directions_of(poses, units)
    except RefusedFitError:
        return False
    return len(up) >= FEWEST_IN_CONE and lies_in_cone(up)


def _mounted_as(before: Calibration, calibration: Calibration) -> Calibration:
    """Return a calibration with the levelled frame and the mounting of the one before it."""
    if not before.is_levelled:
        return calibration
    context = before.typical_context(1)
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                     frame=before.frame)
    return level(headed, reading, before.frame, context)


def _row(poses: Poses, flat: Flat) -> int | None:
    if isinstance(flat, str):
        return int(poses.row[0 if flat == 'first' else -1])
    return flat


def _refinement(poses: Poses, units: Units, plan: Plan, date: str
                ) -> tuple[Refinement | None, str]:
    """Return the search for effects, and a line about it; None if the poses are too few."""
    from .refine import refine, refine_with_fleet  # a fit alone does not load the search

    fleet, named = plan.fleet, {'sensor': plan.sensor, 'date': date}
    try:
        found = (refine(poses, units, base='auto' if plan.before is None else plan.before,
                        **named, also=plan.also) if fleet is None
                 else refine_with_fleet(poses, units, fleet, **named, also=plan.also))
    except RefusedFitError as err:
        return None, f'not refined: {err.message}'
    if found.refusal:
        return found, f'not refined: {found.refusal[0]}'
    if not found.steps:
        why = 'these poses show no further effect' if fleet is None else found.advice[0]
        return found, f'not refined: {why}'
    change = f'residual {short(found.gap_mg)} -> {short(found.remaining_gap_mg)} mg'
    added = [step.effect for step in found.steps if step.effect not in PROCESSES]
    only_named = [step.effect for step in found.steps if step.effect in PROCESSES]
    words = [f'refined with {", ".join(added)}' if added else 'not refined']
    if only_named:
        words.append(f'found {", ".join(only_named)}, which no calibration corrects')
    return found, f'{"; ".join(words)}: {change}'
