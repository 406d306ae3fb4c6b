# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of sensor_msgs/Imu messages, from bags and from topics.

`correction` corrects many serialized messages or single ones, these by `one_reading`, and `bags`
writes corrected copies of bags.

"""

from .bags import correct_bag
from .correction import corrected, motion_of, output_frame, output_scale, Rewriter

__all__ = ['Rewriter', 'correct_bag', 'corrected', 'motion_of', 'output_frame', 'output_scale']
