# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses to calibration.

`fit` is the way in, to `unknown_orientation` and `known_orientation`; `refusal` says what poses
cannot determine and `pose_planning` which ones to take; `mounting` levels; `checks` looks for
wrong units and wiring; `gate` keeps implausible results out. `calibration` is the record,
`quality` its figures.

"""

from .calibration import Calibration, level, of_samples, Quality, Rejected, set_heading
from .checks import check_units, FLAT
from .fit import fit_poses, level_by_rows, MODEL_NAMES
from .gate import gated
from .mounting import FrameName, FRAMES, mounting
from .pose_planning import next_pose, NextPose, Outlook, outlook
from .quality import in_g, Verification, verify
from .unknown_orientation import directions_of, Method, METHODS

__all__ = ['FLAT', 'FRAMES', 'METHODS', 'MODEL_NAMES', 'Calibration', 'FrameName', 'Method',
           'NextPose', 'Outlook', 'Quality', 'Rejected', 'Verification', 'check_units',
           'directions_of', 'fit_poses', 'gated', 'in_g', 'level', 'level_by_rows',
           'mounting', 'next_pose', 'of_samples', 'outlook', 'set_heading', 'verify']
