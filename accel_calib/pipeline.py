# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From poses to a rated calibration: fit, refine, level, rate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from .calibrate import (
    Calibration,
    fit_poses,
    fit_with_fleet,
    FleetPrior,
    FrameName,
    level_by_rows,
)
from .effects import PROCESSES
from .errors import RefusedFitError
from .findings import rate, Rating
from .refine import refine, refine_with_fleet, Refinement
from .table import Poses
from .text import now, short
from .units import Units

Flat = int | Literal['first', 'last'] | None
"""Row of the flat pose, 1-based, or the first or last pose; None: the mounting stays open."""


@dataclass(frozen=True)
class Outcome:
    """
    A calibration with its rating.

    Parameters
    ----------
    calibration : Calibration
        The fitted or refined calibration.
    rating : Rating
        Whether it is good.
    refinement : Refinement or None
        The search for effects; None if it was not asked for, or not possible.
    line : str
        What was done beyond the fit, and why.

    """

    calibration: Calibration
    rating: Rating
    refinement: Refinement | None = field(repr=False)
    line: str


def calibrated(poses: Poses, units: Units, *, flat: Flat = None,
               nose_down: int | None = None, frame: FrameName = 'ros', sensor: str = '',
               refined: bool = True, fleet: FleetPrior | None = None) -> Outcome:
    """
    Fit, refine if the poses can carry it, level and rate.

    Parameters
    ----------
    poses : Poses
        The poses.
    units : Units
        Unit of the readings.
    flat : int, 'first', 'last' or None
        Pose with the robot level.
    nose_down : int, optional
        Row of a pose with the nose of the robot tilted down.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    sensor : str
        Name of the sensor; by default the name in the poses.
    refined : bool
        Look for effects that the calibration lacks, and add them.
    fleet : FleetPrior, optional
        Typical values of sensors of the same model, for few poses.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit, or a row does not exist.

    """
    date = now()
    calibration = (fit_poses(poses, units, sensor=sensor, date=date) if fleet is None
                   else fit_with_fleet(poses, units, fleet, sensor=sensor, date=date))
    refinement, line = None, 'not refined, as asked'
    if refined:
        refinement, line = _refinement(poses, units, sensor, date, fleet)
    if refinement is not None and refinement.steps and not refinement.refusal:
        calibration = refinement.calibration
    calibration = level_by_rows(calibration, poses, frame, _row(poses, flat), nose_down)
    return Outcome(calibration, rate(calibration, refinement=refinement), refinement, line)


def _row(poses: Poses, flat: Flat) -> int | None:
    """Return the row of the flat pose."""
    if isinstance(flat, str):
        return int(poses.row[0 if flat == 'first' else -1])
    return flat


def _refinement(poses: Poses, units: Units, sensor: str, date: str,
                fleet: FleetPrior | None) -> tuple[Refinement | None, str]:
    """Return the search for effects, and a line about it; None if the poses are too few."""
    try:
        found = (refine(poses, units, sensor=sensor, date=date) if fleet is None
                 else refine_with_fleet(poses, units, fleet, sensor=sensor, date=date))
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
