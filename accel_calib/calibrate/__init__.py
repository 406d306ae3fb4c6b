# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses to a calibration.

`fit` is the entry point; it calls `unknown_orientation` or `known_orientation`. `pose_planning`
explains what poses do not determine and plans the next pose. `mounting` computes the mounting.
`checks` detects wrong units and wiring faults, and `gate` rejects implausible results.
`calibration` is the record, and `quality` computes its figures.

"""

from .calibration import (
    Calibration,
    check_sensor,
    EDITED,
    level,
    of_samples,
    Quality,
    Rejected,
    set_heading,
)
from .checks import check_units, FLAT
from .fit import fit_poses, level_by_rows, MODEL_NAMES
from .gate import gated
from .mounting import FrameName, FRAMES
from .pose_planning import next_pose, NextPose, Outlook, outlook
from .quality import in_g, Verification, verify
from .unknown_orientation import directions_of, Method, METHODS

__all__ = ['EDITED', 'FLAT', 'FRAMES', 'METHODS', 'MODEL_NAMES', 'Calibration', 'FrameName',
           'Method', 'NextPose', 'Outlook', 'Quality', 'Rejected', 'Verification', 'check_sensor',
           'check_units', 'directions_of', 'fit_poses', 'gated', 'in_g', 'level', 'level_by_rows',
           'next_pose', 'of_samples', 'outlook', 'set_heading', 'verify']
