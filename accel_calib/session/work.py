# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The computations of a session, and texts about their results."""

from __future__ import annotations

from dataclasses import replace

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
from ..errors import counted, listed, RefusedFitError
from ..estimate.geometry import pose_noise
from ..model import Model
from ..refine import refine, Refinement
from ..table import Floats, Poses
from ..units import Units
from ..words import now, residual_words, verdict_words

_FEWEST_NATIVE = 4
"""Smallest number of poses to estimate the centre of native readings."""


def fitted(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
           before: Calibration | None, context: Context) -> Calibration:
    """
    Return a fit with the mounting of the previous calibration.

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
        The previous calibration; its levelled frame is kept.
    context : mapping of str to array
        Columns that its effects need, one row.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model; the advice is how to turn the sensor next.
    InputError
        If the readings are clearly in another unit.

    """
    calibration = fit_poses(poses, units, model=settings.model, method=settings.method,
                            sensor=sensor, date=now())
    if before is None or not before.is_levelled:
        return calibration
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                     frame=before.frame)
    return level(headed, reading, before.frame, context)


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None) -> Refinement:
    """
    Return the refinement of a calibration.

    Parameters
    ----------
    poses : Poses
        All poses.
    units : Units
        Unit of the readings.
    sensor : str
        Name of the sensor.
    before : Calibration or None
        The calibration in use; None: the model that a fit would select.

    Raises
    ------
    RefusedFitError
        If there are too few poses.
    InputError
        If the readings are clearly in another unit.

    """
    return refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                  date=now())


def poses_up(poses: Poses, units: Units) -> Floats:
    """
    Return the approximate direction of up in each pose, before a fit.

    Returns
    -------
    (n, 3) array
        Unit vectors; n = 0 if the centre of native readings is not known.

    """
    if units.name == 'native' and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))


def asked_for(poses: Poses, units: Units, model: str) -> NextPose:
    """Return the next pose, or that more poses no longer help."""
    up = poses_up(poses, units)
    noise = pose_noise(poses.noise, up)
    noise_g = None
    if noise is not None and units.name != 'native':
        noise_g = float(np.median(units.to_g(noise)))
    return next_pose(up, '10' if model == 'auto' else model, noise, noise_g=noise_g)


def next_action(asked: NextPose) -> str:
    """Return a text about the next action of the user."""
    if asked.direction is None:
        return f'{asked.words}; call ~/fit'
    return asked.words if np.isinf(asked.error) else f'{asked.words}, or call ~/fit'


def summary(calibration: Calibration) -> str:
    """Return the quality of a fit as one line."""
    quality = calibration.quality
    floor = ('' if quality.noise_floor_mg is None
             else f', noise floor {quality.noise_floor_mg:.3f} mg')
    words = [f'model {calibration.name} from {len(calibration.used_poses)} of '
             f'{counted(len(calibration.poses), "pose")}: residual {quality.rms_before_mg:.2f} mg '
             f'before, {quality.rms_after_mg:.3f} mg after{floor}']
    words += [f'pose {rejected.row} left out: {rejected.reason}'
              for rejected in calibration.rejected]
    return '; '.join([*words, *calibration.warnings])


def story(refinement: Refinement) -> str:
    """Return the result of a refinement as one line."""
    lines = [f'{verdict_words(refinement).rstrip(".")}; {residual_words(refinement)}']
    for step in refinement.steps:
        rivals = f' (or {", ".join(step.rivals)})' if step.rivals else ''
        lines.append(f'{step.effect}{rivals} {step.gap_before_mg:.3f} to '
                     f'{step.gap_after_mg:.3f} mg, {step.where}')
    if refinement.disturbed_poses:
        lines.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    return '; '.join([*lines, *refinement.calibration.warnings, *refinement.advice])


def title(calibration: Calibration) -> str:
    """Return a short description of a calibration."""
    return (f'model {calibration.name} of {calibration.date or "unknown date"}, '
            f'{calibration.quality.rms_after_mg:.3f} mg, '
            f'{"levelled" if calibration.is_levelled else "not levelled"}')
