# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses to calibration: closed forms, maximum likelihood, mounting, and the record of it."""

from .agreement import LEVEL
from .calibration import Calibration, level, Quality, Rejected
from .comparison import compare, Comparison
from .fit import fit_poses, MODEL_NAMES
from .geometry import coverage
from .identifiability import Identifiability, identifiability
from .many import fit_many, Fleet
from .mounting import FrameName, FRAMES, mounting, mounting_with_heading
from .next_pose import next_pose, NextPose
from .outlook import Outlook, outlook
from .quality import in_g, Verification, verify
from .sensing_axes import sensing_axes, SensingAxes
from .unit_check import check_units
from .unknown import directions_of, METHODS
from .wiring import FLAT

__all__ = [
           'FLAT',
           'FRAMES',
           'LEVEL',
           'METHODS',
           'MODEL_NAMES',
           'Calibration',
           'Comparison',
           'Fleet',
           'FrameName',
           'Identifiability',
           'NextPose',
           'Outlook',
           'Quality',
           'Rejected',
           'SensingAxes',
           'Verification',
           'check_units',
           'compare',
           'coverage',
           'directions_of',
           'fit_many',
           'fit_poses',
           'identifiability',
           'in_g',
           'level',
           'mounting',
           'mounting_with_heading',
           'next_pose',
           'outlook',
           'sensing_axes',
           'verify',
]
