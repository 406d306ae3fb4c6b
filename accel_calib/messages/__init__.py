# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized sensor_msgs/Imu messages, from bags and from topics.

`layout` defines the places of the fields in a message and reads many messages at once.
`correction` corrects many messages or single ones.

"""

from .correction import corrected, motion_of, output_frame, output_scale, Rewriter
from .layout import (
    ACCELERATION,
    ACCELERATION_COVARIANCE,
    ANGULAR_VELOCITY,
    ANGULAR_VELOCITY_COVARIANCE,
    doubles_at,
    frame_ids,
    IMU_DOUBLES,
    joined,
    Layout,
    layout_of,
    Messages,
    ORIENTATION,
    ORIENTATION_COVARIANCE,
    renamed,
    samples_of,
    stamps_of,
)

__all__ = ['ACCELERATION', 'ACCELERATION_COVARIANCE', 'ANGULAR_VELOCITY',
           'ANGULAR_VELOCITY_COVARIANCE', 'IMU_DOUBLES', 'ORIENTATION', 'ORIENTATION_COVARIANCE',
           'Layout', 'Messages', 'Rewriter', 'corrected', 'doubles_at', 'frame_ids', 'joined',
           'layout_of', 'motion_of', 'output_frame', 'output_scale', 'renamed', 'samples_of',
           'stamps_of']
