# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Correction of sensor_msgs/Imu messages, from bags and from topics.

`correction` corrects many serialized messages or single ones, and `bags` writes corrected copies
of bags.

"""

from .bags import correct_bag
from .correction import (
    corrected, Known, motion_of, OneReading, output_frame, output_scale, Rewriter, Triple)
