# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A calibration with a mounting: from a flat pose, from a pose with the nose down, or given.

`mounting` computes ΔR; here it becomes part of a calibration, with the warnings about it.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .calibration import Calibration
from .checks import FLAT, flat_warnings
from .mounting import (
    FrameName,
    heading_is_arbitrary,
    mounting,
    with_heading,
    with_heading_of,
)
from ..effects import Context, Model, sensor_force
from ..table import Floats

_SAME_TILT = np.cos(np.radians(10.0))

_HEADING = 'the heading of the mounting'

ARBITRARY_HEADING = (
    f'{_HEADING} is arbitrary, because an axis of the sensor that defines it is within 10° of the '
    'vertical: take a second pose with the nose of the robot down (~/set_heading or --nose-down), '
    'or give the mounting (mounting_rpy or base_frame)')
"""Warning of a levelled calibration without a known heading near the singular direction."""


def level(calibration: Calibration, reading: Floats, frame: FrameName,
          context: Context | None = None) -> Calibration:
    """
    Return a calibration with the mounting from one flat pose.

    Parameters
    ----------
    calibration : Calibration
        The calibration, with any ΔR. The heading of an existing mounting is kept.
    reading : (3,) array
        Mean reading of the flat pose, in the unit of the readings.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    context : mapping of str to array, optional
        Columns that the effects need, one row.

    Returns
    -------
    Calibration
        The calibration with ΔR of this pose, and a warning if the wiring may be wrong.

    """
    rotation = mounting(_in_sensor_axes(calibration, reading, context), frame)
    kept = calibration.is_levelled and frame == calibration.frame
    arbitrary = not kept and heading_is_arbitrary(rotation, frame)
    if kept:
        rotation = with_heading_of(calibration.rotation, rotation)
    others = [warning for warning in calibration.warnings
              if not warning.startswith((FLAT, _HEADING))]
    return replace(calibration, model=Model(calibration.model.values, rotation), frame=frame,
                   warnings=(*others, *flat_warnings(rotation, frame),
                             *((ARBITRARY_HEADING,) if arbitrary else ())))


def set_heading(calibration: Calibration, reading: Floats, context: Context | None = None
                ) -> Calibration:
    """
    Return a calibration with the heading from one pose with the nose of the robot down.

    Parameters
    ----------
    calibration : Calibration
        The calibration, already levelled.
    reading : (3,) array
        Mean reading of the pose, in the unit of the readings.
    context : mapping of str to array, optional
        Columns that the effects need, one row.

    Returns
    -------
    Calibration
        The calibration with this heading.

    Raises
    ------
    InputError
        If the nose is tilted down by less than 10°.

    """
    nose_down = _in_sensor_axes(calibration, reading, context)
    rotation = with_heading(calibration.rotation, nose_down, calibration.frame)
    return with_mounting(calibration, rotation)


def with_mounting(calibration: Calibration, rotation: Floats) -> Calibration:
    """Return a calibration with another ΔR, whose heading is known."""
    return replace(calibration, model=Model(calibration.model.values, rotation), warnings=tuple(
        line for line in calibration.warnings if not line.startswith(_HEADING)))


def with_given_mounting(calibration: Calibration, rotation: Floats) -> Calibration:
    """
    Return a calibration with a mounting that is known from elsewhere, such as a URDF.

    A calibration that is levelled to within 10° of the given mounting keeps its tilt, which a flat
    pose measured, and takes only the heading.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    rotation : (3, 3) array
        The given ΔR.

    """
    if calibration.is_levelled and calibration.rotation[:, 2] @ rotation[:, 2] > _SAME_TILT:
        rotation = with_heading_of(rotation, calibration.rotation)
    return with_mounting(calibration, rotation)


def _in_sensor_axes(calibration: Calibration, reading: Floats, context: Context | None) -> Floats:
    """Return the specific force of one reading in the axes of the sensor [g]."""
    reading_g = calibration.units.to_g(np.asarray(reading, float))[np.newaxis]
    return sensor_force(calibration.model, reading_g, calibration.held_context(context))[0]
