# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Samples to still poses: streaming for the node, the same rule over arrays for recordings.

The way of the data: `chunks` sums the samples over short stretches of header time, `rule` says
of each whether the sensor is still, `tracker` joins still chunks to dwells, `run` sums a dwell,
`average` says what it comes to, `dwell` judges it, `poses` makes the pose table. `detector` is the
way in; both paths go through it. `sums`, `window`, `sliding` and `noise` are the arithmetic below.

"""

from .chunks import Interruption
from .detector import StillDetector
from .dwell import Dwell
from .poses import capture, Captured, is_new, merged, poses_from, select
from .settings import CaptureSettings, Repeated

__all__ = ['capture', 'Captured', 'CaptureSettings', 'Dwell', 'Interruption', 'is_new', 'merged',
           'poses_from', 'Repeated', 'select', 'StillDetector']
