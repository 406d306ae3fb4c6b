# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The mounting ΔR of a sensor from one flat pose (NXP AN5286, section 7).

ΔR transforms a vector from the levelled frame to the axes of the sensor. In a flat pose, the
calibrated reading G of the sensor is ΔR times up:

=========  =====================================  ============  ======================
frame      axes                                   flat reading  third column of ΔR
=========  =====================================  ============  ======================
`ros`      x forward, y left, z up (REP-103)      +1 g on z     G over its size
`ned`      x north, y east, z down                +1 g on z     G over its size
`android`  x right, y up the screen, z out of it  +1 g on z     G over its size
`win8`     as android                             -1 g on z     -G over its size
=========  =====================================  ============  ======================

(NED follows AN5286: the reading is positive along gravity, so that a flat pose reads +1 g on z.)
One flat pose does not determine the heading. The heading is zero by the convention of the angles
of each frame. For `ros`, `ned` and `android` the sensor is rolled and pitched but not yawed,

    x column = (√(y²+z²), -xy/√(y²+z²), -xz/√(y²+z²)) / |G|

which is singular if x is vertical (90° pitch). For `win8` the x column is in the x-z plane of the
sensor, which is singular if y is vertical (90° roll). At these singularities the limit of a level
y axis, or a level x axis, is used. A second pose, with the nose of the robot tilted straight down,
determines the heading (TRIAD, Black 1964).

"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any, get_args, Literal

import numpy as np

from ..errors import InputError
from ..geometry import quaternion_of, rotation_from_rpy, rpy_of
from ..table import Floats

FrameName = Literal['ros', 'ned', 'android', 'win8']
FRAMES: tuple[str, ...] = get_args(FrameName)

_NOSE_DOWN = {'ros': np.array([-1.0, 0.0, 0.0]), 'ned': np.array([1.0, 0.0, 0.0]),
              'android': np.array([0.0, -1.0, 0.0]), 'win8': np.array([0.0, 1.0, 0.0])}
"""Reading of a sensor whose nose points straight down, for each frame [g]."""

_VERTICAL = 1e-9
_DIGITS = 9
_LEAST_HEADING_ANGLE = np.radians(10.0)


def flat_direction(frame: str) -> Floats:
    """Return the (3,) unit reading of a sensor that lies flat in this frame."""
    return np.array([0.0, 0.0, -1.0 if frame == 'win8' else 1.0])


def mounting(flat: Floats, frame: str = 'ros') -> Floats:
    """
    Compute ΔR from one flat pose.

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
        raise InputError(f'the flat pose has the force {flat}, expected about 1 g',
                         'repeat the flat pose with the sensor at rest')
    column_z = flat / length * flat_direction(frame)[2]
    column_x = _x_of_win8(column_z) if frame == 'win8' else _x_without_yaw(column_z)
    return np.column_stack([column_x, np.cross(column_z, column_x), column_z])


def _x_without_yaw(up: Floats) -> Floats:
    """Return the x column for ned, android and ros: zero yaw, level y axis."""
    x, y, z = up
    root = np.hypot(y, z)
    if root < _VERTICAL:
        return np.array([0.0, 0.0, -np.sign(x)])
    return np.array([root, -x * y / root, -x * z / root])


def _x_of_win8(up: Floats) -> Floats:
    """Return the x column for win8: no y component, and x component not negative."""
    x, _, z = up
    root = np.hypot(x, z)
    if root < _VERTICAL:
        return np.array([1.0, 0.0, 0.0])
    sign = -1.0 if z < 0.0 else 1.0
    return np.array([z, 0.0, -x]) * sign / root


def with_heading(rotation: Floats, nose_down: Floats, frame: str = 'ros') -> Floats:
    """
    Return a levelled mounting with the heading from a pose with the nose of the robot down.

    Parameters
    ----------
    rotation : (3, 3) array
        ΔR with any heading, as `mounting` returns it.
    nose_down : (3,) array
        Calibrated reading with the nose (front of the robot, top of a screen) tilted straight
        down, by 10° to 170°; in the axes of the sensor, any length.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.

    Returns
    -------
    (3, 3) array
        ΔR, a proper rotation. It matches the flat pose exactly, and the second pose in heading.

    Raises
    ------
    InputError
        If the second pose is nearly the flat pose, or its opposite.

    """
    flat = flat_direction(frame)
    return _triad(rotation @ flat, nose_down) @ _triad(flat, _NOSE_DOWN[frame]).T


def with_heading_of(before: Floats, rotation: Floats) -> Floats:
    """
    Return a levelled mounting with the heading of an earlier mounting.

    Parameters
    ----------
    before : (3, 3) array
        Earlier ΔR.
    rotation : (3, 3) array
        ΔR of a new flat pose, with any heading.

    Returns
    -------
    (3, 3) array
        ΔR with the earlier x axis, rotated into the new horizontal plane; `rotation` itself if the
        earlier x axis is now within 10° of the vertical.

    """
    up, x = rotation[:, 2], before[:, 0]
    level_x = x - up * (up @ x)
    length = np.linalg.norm(level_x)
    if length < np.sin(_LEAST_HEADING_ANGLE):
        return rotation
    level_x = level_x / length
    return np.column_stack([level_x, np.cross(up, level_x), up])


def _triad(first: Floats, second: Floats) -> Floats:
    """Return the (3, 3) matrix of orthonormal axes defined by two directions."""
    unit = first / np.linalg.norm(first)
    normal = np.cross(unit, second / np.linalg.norm(second))
    if not np.linalg.norm(normal) >= np.sin(_LEAST_HEADING_ANGLE):
        raise InputError('the pose with the nose down is within 10° of the flat pose or of its '
                         'opposite, expected a tilt of 10° to 170°',
                         'tilt the nose of the robot further down')
    normal = normal / np.linalg.norm(normal)
    return np.column_stack([np.cross(normal, unit), normal, unit])


def mounting_of(rpy: Sequence[float]) -> Floats:
    """Return ΔR, (3, 3), from roll, pitch and yaw of the sensor on the robot [rad] (URDF)."""
    return rotation_from_rpy(*rpy).T


def mounting_figures(rotation: Floats, sensor: str, base: str = '') -> dict[str, Any]:
    """
    Return a mounting as numbers and as the lines for the URDF and for TF.

    Parameters
    ----------
    rotation : (3, 3) array
        ΔR.
    sensor : str
        frame_id of the sensor; empty: ``imu_link``.
    base : str
        Frame of the robot; empty: ``base_link``.

    Returns
    -------
    dict
        ``roll``, ``pitch`` and ``yaw`` [rad] of the sensor in the levelled frame, ``quaternion``
        (x, y, z, w), ``urdf`` and ``static_transform_publisher``.

    """
    roll, pitch, yaw = (round(angle, _DIGITS) + 0.0 for angle in rpy_of(rotation.T))
    quaternion = [round(part, _DIGITS) + 0.0 for part in quaternion_of(rotation.T)]
    return {'roll': roll, 'pitch': pitch, 'yaw': yaw, 'quaternion': quaternion,
            'urdf': f'<origin xyz="0 0 0" rpy="{roll} {pitch} {yaw}"/>',
            'static_transform_publisher':
                f'ros2 run tf2_ros static_transform_publisher --roll {roll} --pitch {pitch} '
                f'--yaw {yaw} --frame-id {base or "base_link"} --child-frame-id '
                f'{sensor or "imu_link"}'}


def mounting_words(rotation: Floats, sensor: str, base: str = '') -> str:
    """Return `mounting_figures` as one line."""
    found = mounting_figures(rotation, sensor, base)
    angles = ', '.join(f'{name} {math.degrees(found[name]):.2f}°'
                       for name in ('roll', 'pitch', 'yaw'))
    quaternion = ', '.join(f'{part:.6f}' for part in found['quaternion'])
    return (f'mounting of the sensor: {angles}; quaternion ({quaternion}); URDF {found["urdf"]}; '
            f'or {found["static_transform_publisher"]}')


def heading_is_arbitrary(rotation: Floats, frame: str) -> bool:
    """
    Return whether the heading of `mounting` depends on the noise of the flat pose.

    The axis that defines the heading is then within 10° of the vertical: x, for ``win8`` y.

    """
    axis = 1 if frame == 'win8' else 0
    return bool(np.hypot(*np.delete(rotation[:, 2], axis)) < np.sin(_LEAST_HEADING_ANGLE))
