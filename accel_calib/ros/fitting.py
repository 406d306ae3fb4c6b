# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What the node asks of the calibration beyond one call, and how it tells of it."""

from __future__ import annotations

from datetime import datetime, timezone
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from ..calibrate import directions_of, fit_poses, level, next_pose
from ..calibrate.geometry import pose_noise
from ..calibrate.mounting import flat_direction
from ..errors import RefusedFitError
from ..refine import refine

if TYPE_CHECKING:
    from .settings import CalibratorSettings
    from ..calibrate import Calibration, NextPose
    from ..effects import Context
    from ..refine import Refinement
    from ..table import Floats, Poses
    from ..units import Units

_FIT_NEEDS = ('scipy.optimize', 'scipy.special')

_FEWEST_NATIVE = 4
"""Poses from which the centre of native readings can be told."""


def fitted(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
           before: Calibration | None, context: Context) -> Calibration:
    """
    Fit, and level the mounting as it was levelled before.

    Parameters
    ----------
    poses : Poses
        All poses.
    units : Units
        Unit of the readings.
    settings : CalibratorSettings
        Model and method.
    sensor : str
        Name of the sensor.
    before : Calibration or None
        The calibration so far: what it takes for flat stays flat.
    context : mapping of str to array
        What its effects need, one row.

    Raises
    ------
    RefusedFitError
        If the poses cannot carry the fit; says which way to turn the sensor next.
    InputError
        If the readings are plainly in another unit.

    """
    date = _now()
    calibration = fit_poses(poses, units, model=settings.model, method=settings.method,
                            sensor=sensor, date=date)
    if before is None or np.array_equal(before.model.rotation, np.eye(3)):
        return calibration
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    return level(calibration, reading, before.frame, context)


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None) -> Refinement:
    """
    Find what a calibration lacks.

    Parameters
    ----------
    poses : Poses
        All poses.
    units : Units
        Unit of the readings.
    sensor : str
        Name of the sensor.
    before : Calibration or None
        The calibration in use; without one, what a fit would take.

    Raises
    ------
    RefusedFitError
        If there are too few poses.
    InputError
        If the readings are plainly in another unit.

    """
    return refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                  date=_now())


def story(refinement: Refinement) -> str:
    """Say in a line what a refinement came to."""
    words = {'no_gap': 'nothing is missing', 'explained': 'what was missing is named',
             'unexplained': 'a gap remains that no known effect explains'}
    lines = [f'{words[refinement.verdict]}: {refinement.gap_mg:.3f} mg before, '
             f'{refinement.remaining_gap_mg:.3f} mg after']
    for step in refinement.steps:
        rivals = f' (or {", ".join(step.rivals)})' if step.rivals else ''
        lines.append(f'{step.effect}{rivals} {step.gap_before_mg:.3f} to '
                     f'{step.gap_after_mg:.3f} mg, {step.where}')
    if refinement.disturbed_poses:
        rows = ', '.join(str(row) for row in refinement.disturbed_poses)
        lines.append(f'disturbed poses: {rows}')
    return '; '.join([*lines, *refinement.advice])


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def poses_up(poses: Poses, units: Units) -> Floats:
    """
    Give the directions that point up, as far as they are known before a fit.

    Returns
    -------
    (n, 3) array
        Unit vectors; none where native readings do not tell where their centre is.

    """
    if units.name == 'native' and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))


def asked_for(poses: Poses, units: Units, model: str) -> NextPose:
    """Give the pose that would help most next, or that none does."""
    up = poses_up(poses, units)
    noise = pose_noise(poses.noise, up)
    noise_g = None
    if noise is not None and units.name != 'native':
        noise_g = float(np.median(units.to_g(noise)))
    return next_pose(up, '10' if model == 'auto' else model, noise, noise_g=noise_g)


def then(asked: NextPose) -> str:
    """Say what to do next."""
    if asked.direction is None:
        return f'{asked.words}; call ~/fit'
    return asked.words if np.isinf(asked.error) else f'{asked.words}, or call ~/fit'


def warm_up() -> None:
    """Import what the first fit needs, so that it takes no longer than the next."""
    for name in _FIT_NEEDS:
        import_module(name)


def summary(calibration: Calibration) -> str:
    """Say in a line how a fit went."""
    quality = calibration.quality
    used = len(calibration.poses) - len(calibration.rejected)
    floor = ('' if quality.noise_floor_mg is None
             else f', noise alone {quality.noise_floor_mg:.3f} mg')
    words = [f'model {calibration.name} from {used} of {len(calibration.poses)} poses: '
             f'{quality.rms_before_mg:.2f} mg off 1 g before, {quality.rms_after_mg:.3f} mg '
             f'after{floor}']
    words += [f'pose {rejected.row} left out, {rejected.reason}'
              for rejected in calibration.rejected]
    return '; '.join([*words, *calibration.warnings])


def title(calibration: Calibration | None) -> str:
    """Name a calibration in a few words; empty where there is none."""
    if calibration is None:
        return ''
    levelled = not np.array_equal(calibration.model.rotation, np.eye(3))
    return (f'model {calibration.name} of {calibration.date or "unknown date"}, '
            f'{calibration.quality.rms_after_mg:.3f} mg, '
            f'{"levelled" if levelled else "not levelled"}')
