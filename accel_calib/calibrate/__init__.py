# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses to a calibration.

`fit` is the entry point; it calls `unknown_orientation` or `known_orientation`. `partial` is for a
sensor that cannot be turned over. `pose_planning` explains what poses do not determine and plans
the next pose. `mounting` computes the mounting. `checks` detects wrong units and wiring faults,
and `gate` rejects implausible results. `calibration` is the record, `quality` computes its
figures, and `rest_noise` those of the gyro and of the samples. `outside` compares samples with the
range of a calibration.

"""

from .calibration import (
    Calibration,
    check_sensor,
    converted,
    Quality,
    Rejected,
    RejectedKind,
)
from .context import joined_ranges, of_samples, Outside, outside, thermal_stream, USES_LIMIT
from .fit import (
    fit_poses,
    level,
    level_by_rows,
    MODEL_NAMES,
    set_heading,
    with_given_mounting,
)
from .fleet_prior import fit_with_fleet, FleetPrior
from .gate import gated
from .mounting import flat_direction, FrameName, FRAMES
from .partial import carried_words, fit_partial, mounting_only
from .pose_planning import lies_in_cone, next_pose, NextPose, Outlook, outlook
from .quality import in_g, Verification, verify, with_history
from .rest_noise import (
    gyro_bias_of,
    GyroBias,
    sample_noise_of,
    SampleNoise,
    with_rest_noise,
)
from .unknown_orientation import directions_of, Method, METHODS, PRIOR, STORED_METHODS
from ..table import check_units

__all__ = ['FRAMES', 'METHODS', 'MODEL_NAMES', 'PRIOR', 'STORED_METHODS', 'USES_LIMIT',
           'Calibration', 'FleetPrior', 'FrameName', 'GyroBias', 'Method', 'NextPose', 'Outlook',
           'Outside', 'Quality', 'Rejected', 'RejectedKind', 'SampleNoise', 'Verification',
           'carried_words', 'check_sensor', 'check_units', 'converted', 'directions_of',
           'fit_partial', 'fit_poses', 'fit_with_fleet', 'flat_direction', 'gated',
           'gyro_bias_of', 'in_g', 'joined_ranges', 'level', 'level_by_rows', 'lies_in_cone',
           'mounting_only', 'next_pose', 'of_samples', 'outlook', 'outside', 'sample_noise_of',
           'set_heading', 'thermal_stream', 'verify', 'with_given_mounting', 'with_history',
           'with_rest_noise']
