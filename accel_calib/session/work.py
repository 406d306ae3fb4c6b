# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a session computes beside the stream, and the words about it."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from .settings import CalibratorSettings
from ..calibrate import (
    Calibration,
    directions_of,
    fit_poses,
    level,
    next_pose,
    NextPose,
)
from ..calibrate.mounting import flat_direction
from ..effects import Context
from ..errors import RefusedFitError
from ..estimate.geometry import pose_noise
from ..model import Model
from ..refine import refine, Refinement
from ..table import Floats, Poses
from ..units import Units

_FEWEST_NATIVE = 4
"""Poses from which the centre of native readings can be estimated."""

_VERDICTS = {'no_gap': 'nothing is missing', 'explained': 'the missing effects are named',
             'unexplained': 'a gap remains that no known effect explains'}


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
        The previous calibration, of which the levelled frame is kept.
    context : mapping of str to array
        What its effects need, one row.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model; its advice is how to turn the sensor next.
    InputError
        If the readings are clearly in another unit.

    """
    calibration = fit_poses(poses, units, model=settings.model, method=settings.method,
                            sensor=sensor, date=_now())
    if before is None or not before.is_levelled:
        return calibration
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                     frame=before.frame)
    return level(headed, reading, before.frame, context)


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
        The calibration in use; None: what a fit would use.

    Raises
    ------
    RefusedFitError
        If there are too few poses.
    InputError
        If the readings are clearly in another unit.

    """
    return refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                  date=_now())


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def poses_up(poses: Poses, units: Units) -> Floats:
    """
    Return the directions of up, as far as they are known before a fit.

    Returns
    -------
    (n, 3) array
        Unit vectors; none if the centre of native readings is not known.

    """
    if units.name == 'native' and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))


def asked_for(poses: Poses, units: Units, model: str) -> NextPose:
    """Return the pose that helps most next, or that more poses no longer help."""
    up = poses_up(poses, units)
    noise = pose_noise(poses.noise, up)
    noise_g = None
    if noise is not None and units.name != 'native':
        noise_g = float(np.median(units.to_g(noise)))
    return next_pose(up, '10' if model == 'auto' else model, noise, noise_g=noise_g)


def then(asked: NextPose) -> str:
    """Return what to do next."""
    if asked.direction is None:
        return f'{asked.words}; call ~/fit'
    return asked.words if np.isinf(asked.error) else f'{asked.words}, or call ~/fit'


def poses_in_words(count: int) -> str:
    """Return a number of poses in words."""
    return '1 pose' if count == 1 else f'{count} poses'


def summary(calibration: Calibration) -> str:
    """Return the quality of a fit in a line."""
    quality = calibration.quality
    floor = ('' if quality.noise_floor_mg is None
             else f', noise floor {quality.noise_floor_mg:.3f} mg')
    words = [f'model {calibration.name} from {len(calibration.used_poses)} of '
             f'{poses_in_words(len(calibration.poses))}: residual {quality.rms_before_mg:.2f} mg '
             f'before, {quality.rms_after_mg:.3f} mg after{floor}']
    words += [f'pose {rejected.row} left out, {rejected.reason}'
              for rejected in calibration.rejected]
    return '; '.join([*words, *calibration.warnings])


def story(refinement: Refinement) -> str:
    """Return the result of a refinement in a line."""
    lines = [f'{_VERDICTS[refinement.verdict]}: residual {refinement.gap_mg:.3f} mg before, '
             f'{refinement.remaining_gap_mg:.3f} mg after']
    for step in refinement.steps:
        rivals = f' (or {", ".join(step.rivals)})' if step.rivals else ''
        lines.append(f'{step.effect}{rivals} {step.gap_before_mg:.3f} to '
                     f'{step.gap_after_mg:.3f} mg, {step.where}')
    if refinement.disturbed_poses:
        rows = ', '.join(str(row) for row in refinement.disturbed_poses)
        lines.append(f'left out as outliers: poses {rows}')
    return '; '.join([*lines, *refinement.calibration.warnings, *refinement.advice])


def title(calibration: Calibration) -> str:
    """Return the name of a calibration in a few words."""
    return (f'model {calibration.name} of {calibration.date or "unknown date"}, '
            f'{calibration.quality.rms_after_mg:.3f} mg, '
            f'{"levelled" if calibration.is_levelled else "not levelled"}')
