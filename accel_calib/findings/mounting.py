# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The figures and the words of a mounting."""

import math
from typing import Any

from ..geometry import quaternion_of, rpy_of
from ..table import Floats

_DIGITS = 9


def mounting_figures(rotation: Floats, sensor: str, base: str = '') -> dict[str, Any]:
    """
    Return a mounting as numbers and as the lines for the URDF and for TF.

    The numbers are ``roll``, ``pitch`` and ``yaw`` [rad] of the sensor in the levelled frame, and
    ``quaternion`` (x, y, z, w). The lines are for the frame_id `sensor` (if empty ``imu_link``)
    and the frame `base` (if empty ``base_link``).

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
    quaternion = ', '.join(f'{part:.6f}' for part in found['quaternion'])
    return (f'mounting of the sensor: {angle_words(rotation)}; quaternion ({quaternion}); URDF '
            f'{found["urdf"]}; or {found["static_transform_publisher"]}')


def angle_words(rotation: Floats) -> str:
    """Return roll, pitch and yaw of the sensor in words."""
    found = mounting_figures(rotation, '')
    return ', '.join(f'{name} {math.degrees(found[name]):.2f}°' for name in (
        'roll', 'pitch', 'yaw'))
