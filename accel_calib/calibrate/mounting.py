# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Mounting: the rotation ΔR from one flat pose (NXP AN5286, section 7).

ΔR takes a vector in the levelled frame to the axes of the sensor. Lying flat, the sensor's
calibrated reading G is ΔR times up:

=========  =====================================  ============  ======================
frame      axes                                   flat reading  third column of ΔR
=========  =====================================  ============  ======================
`ros`      x forward, y left, z up (REP-103)      +1 g on z     G over its size
`ned`      x north, y east, z down                +1 g on z     G over its size
`android`  x right, y up the screen, z out of it  +1 g on z     G over its size
`win8`     as android                             -1 g on z     -G over its size
=========  =====================================  ============  ======================

(NED as AN5286 has it: the reading is positive along gravity, so that flat again reads +1 g on z.)
One flat pose leaves the heading open. It is set to zero in the sense of the frame's own angles:
for `ros`, `ned` and `android` the sensor is rolled and pitched but not yawed,

    x column = (√(y²+z²), -xy/√(y²+z²), -xz/√(y²+z²)) / |G|

singular where x is vertical (90° pitch); for `win8` in the sensor's x-z plane, singular where y is
vertical (90° roll). There the limit of level y, or level x, is taken. A second pose of known
direction fixes the heading (TRIAD, Black 1964).

"""

from __future__ import annotations

from typing import get_args, Literal

import numpy as np

from ..errors import InputError
from ..table import Floats

FrameName = Literal['ros', 'ned', 'android', 'win8']
FRAMES: tuple[str, ...] = get_args(FrameName)

_VERTICAL = 1e-9
_LEAST_HEADING_ANGLE = np.radians(10.0)


def flat_direction(frame: str) -> Floats:
    """Give the (3,) unit reading of a sensor that lies flat in this frame."""
    return np.array([0.0, 0.0, -1.0 if frame == 'win8' else 1.0])


def mounting(flat: Floats, frame: str = 'ros') -> Floats:
    """
    Find ΔR from one flat pose.

    Parameters
    ----------
    flat : (3,) array
        Calibrated reading of the flat pose, in the axes of the sensor; any length.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.

    Returns
    -------
    (3, 3) array
        ΔR, a proper rotation.

    Raises
    ------
    InputError
        If the reading is zero or not finite.

    """
    length = np.linalg.norm(flat)
    if not (np.isfinite(length) and length > 0.0):
        raise InputError(f'the flat pose has a force of {flat}, expected about 1 g',
                         'take it again with the sensor at rest')
    column_z = flat / length * flat_direction(frame)[2]
    column_x = _x_of_win8(column_z) if frame == 'win8' else _x_without_yaw(column_z)
    return np.column_stack([column_x, np.cross(column_z, column_x), column_z])


def _x_without_yaw(up: Floats) -> Floats:
    """Give the x column of ned, android and ros: yaw zero, y level."""
    x, y, z = up
    root = np.hypot(y, z)
    if root < _VERTICAL:
        return np.array([0.0, 0.0, -np.sign(x)])
    return np.array([root, -x * y / root, -x * z / root])


def _x_of_win8(up: Floats) -> Floats:
    """Give the x column of win8: no y component, and x never turned back."""
    x, _, z = up
    root = np.hypot(x, z)
    if root < _VERTICAL:
        return np.array([1.0, 0.0, 0.0])
    sign = -1.0 if z < 0.0 else 1.0
    return np.array([z, 0.0, -x]) * sign / root


def mounting_with_heading(flat: Floats, second: Floats, second_direction: Floats,
                          frame: str = 'ros') -> Floats:
    """
    Find ΔR from a flat pose and a second one of known direction.

    Parameters
    ----------
    flat, second : (3,) array
        Calibrated readings in the axes of the sensor.
    second_direction : (3,) array
        Specific force of the second pose in the levelled frame: nose straight down is
        (-1, 0, 0) in `ros`.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.

    Returns
    -------
    (3, 3) array
        ΔR, a proper rotation: the flat pose is met exactly, the second in heading.

    Raises
    ------
    InputError
        If the second pose is nearly the flat one, or its opposite.

    """
    sensor = _triad(flat, second)
    levelled = _triad(flat_direction(frame), second_direction)
    return sensor @ levelled.T


def _triad(first: Floats, second: Floats) -> Floats:
    """Give the (3, 3) matrix whose columns are the axes spanned by two directions."""
    unit = first / np.linalg.norm(first)
    normal = np.cross(unit, second / np.linalg.norm(second))
    if not np.linalg.norm(normal) >= np.sin(_LEAST_HEADING_ANGLE):
        raise InputError('the second pose is within 10° of the flat one or of its opposite',
                         'tilt the robot further, nose straight down for instance')
    normal = normal / np.linalg.norm(normal)
    return np.column_stack([np.cross(normal, unit), normal, unit])
