# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Samples to still poses: streaming for the node, the same rule over arrays for recordings.

`detector` is the way in. `chunks` sums the samples over short stretches of header time, `rule`
judges whether the sensor is still in each, `tracker` joins still chunks to dwells, `ongoing` sums
one, `average` computes its figures, `dwell` judges it, and `poses` makes the pose table. `sums`,
`window`, `sliding` and `noise` are the arithmetic below.

"""

from .chunks import Interruption
from .detector import StillDetector
from .dwell import Dwell
from .poses import capture, Captured, poses_from, select
from .settings import CaptureSettings, REPEATED, Repeated, settings_from

__all__ = ['REPEATED', 'CaptureSettings', 'Captured', 'Dwell', 'Interruption', 'Repeated',
           'StillDetector', 'capture', 'poses_from', 'select', 'settings_from']
