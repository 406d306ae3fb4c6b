# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
From samples to still poses. The node and recordings use the same rule.

`chunks` sums the samples over short intervals of header time. `rule` decides whether the sensor is
still in each chunk, from the arithmetic in `trend`. `dwell` joins still chunks to dwells, accepts
or rejects each, and states why. `detector` is the entry point and makes the pose table. `sensor`
checks whether numbers can be those of a sensor. `ramp` makes the stretches of a still board whose
temperature changes.

"""

from .chunks import CaptureSettings, REPEATED, Repeated, settings_from
from .detector import (
    capture, Captured, dwells_of, overlap, poses_from, rest_after, samples_of, select,
    StillDetector, with_temperature)
from .dwell import account_of, Dwell, Rest
from .ramp import cells_of, is_turned_over, LEAST_RANGE, LEAST_RESTS, Ramp, ramp_of, rests_in_cells
from .rule import rounding_left
from .sensor import check_axes, check_measured, is_one_direction
