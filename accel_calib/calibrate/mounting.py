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
vertical (90° roll). There the limit of level y, or level x, is taken. A second pose, with
the nose of the robot tilted straight down, fixes the heading (TRIAD, Black 1964).

"""

from __future__ import annotations

from typing import get_args, Literal

import numpy as np

from ..errors import InputError
from ..table import Floats

FrameName = Literal['ros', 'ned', 'android', 'win8']
FRAMES: tuple[str, ...] = get_args(FrameName)

_NOSE_DOWN = {'ros': np.array([-1.0, 0.0, 0.0]), 'ned': np.array([1.0, 0.0, 0.0]),
              'android': np.array([0.0, -1.0, 0.0]), 'win8': np.array([0.0, 1.0, 0.0])}
"""Reading of a sensor whose nose points straight down in each frame [g]."""

_VERTICAL = 1e-9
_LEAST_HEADING_ANGLE = np.radians(10.0)


def flat_direction(frame: str) -> Floats:
    """Return the (3,) unit reading of a sensor that lies flat in this frame."""
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
    """Return the x column of ned, android and ros: yaw zero, y level."""
    x, y, z = up
    root = np.hypot(y, z)
    if root < _VERTICAL:
        return np.array([0.0, 0.0, -np.sign(x)])
    return np.array([root, -x * y / root, -x * z / root])


def _x_of_win8(up: Floats) -> Floats:
    """Return the x column of win8: no y component, and x never turned back."""
    x, _, z = up
    root = np.hypot(x, z)
    if root < _VERTICAL:
        return np.array([1.0, 0.0, 0.0])
    sign = -1.0 if z < 0.0 else 1.0
    return np.array([z, 0.0, -x]) * sign / root


def with_heading(rotation: Floats, nose_down: Floats, frame: str = 'ros') -> Floats:
    """
    Find the heading of a levelled mounting from a pose with the nose of the robot down.

    Parameters
    ----------
    rotation : (3, 3) array
        ΔR of any heading, such as `mounting` returns it.
    nose_down : (3,) array
        Calibrated reading with the nose (forward; the top of a screen) tilted straight down, by
        10° to 170°, in the axes of the sensor; any length.
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
    flat = flat_direction(frame)
    return _triad(rotation @ flat, nose_down) @ _triad(flat, _NOSE_DOWN[frame]).T


def with_heading_of(before: Floats, rotation: Floats) -> Floats:
    """
    Return a levelled mounting with the heading that it had before.

    Parameters
    ----------
    before : (3, 3) array
        ΔR as it was.
    rotation : (3, 3) array
        ΔR of a new flat pose, of any heading.

    Returns
    -------
    (3, 3) array
        ΔR whose x axis is the earlier one, turned into the new level; `rotation` itself if the
        earlier x axis is within 10° of vertical now.

    """
    up, x = rotation[:, 2], before[:, 0]
    level_x = x - up * (up @ x)
    length = np.linalg.norm(level_x)
    if length < np.sin(_LEAST_HEADING_ANGLE):
        return rotation
    level_x = level_x / length
    return np.column_stack([level_x, np.cross(up, level_x), up])


def _triad(first: Floats, second: Floats) -> Floats:
    """Return the (3, 3) matrix whose columns are the axes spanned by two directions."""
    unit = first / np.linalg.norm(first)
    normal = np.cross(unit, second / np.linalg.norm(second))
    if not np.linalg.norm(normal) >= np.sin(_LEAST_HEADING_ANGLE):
        raise InputError('the second pose is within 10° of the flat one or of its opposite',
                         'tilt the nose of the robot further down')
    normal = normal / np.linalg.norm(normal)
    return np.column_stack([np.cross(normal, unit), normal, unit])
