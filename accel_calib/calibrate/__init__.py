# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses to a calibration.

`fit` is the entry point and has the gate, which rejects implausible results. It calls
`unknown_orientation` or `known_orientation`, which also detects wiring faults. `partial` is for
few poses, with the typical values of `prior`. `pose_planning` explains what poses do not determine
and plans the next pose. `mounting` computes the mounting. `calibration` is the record, `quality`
makes it and computes its figures, and `rest_noise` those of the gyro and of the samples. `context`
compares samples with the range of a calibration.

"""

from .calibration import (
    BASES, Calibration, check_sensor, converted, FLEET, FrameName, FRAMES, Method, METHODS,
    MODEL_NAMES, PRIOR, Quality, Rejected, RejectedKind, STORED_METHODS)
from .context import (
    of_samples, Outside, outside, SampleContext, thermal_stream, USES_LIMIT, with_history,
    with_previous)
from .fit import (
    deviations_g, fit_poses, gated, LARGEST_OFFSET_G, sound_rows, sure_rows, uncertainty_g)
from .mounting import (
    angle_words, flat_direction, in_frame, level, level_by_rows, mounting_figures, mounting_of,
    mounting_words, on_topics, set_heading, with_given_mounting)
from .partial import fit_partial, fit_with_fleet, mounting_only
from .pose_planning import (
    determines, lies_in_cone, next_pose, NextPose, Outlook, outlook, refuse_if_unfit)
from .prior import FleetPrior, posterior
from .quality import (
    errors_after, errors_before, fit_findings, in_g, OF_A_FIT, quality_of, record_of, Verification,
    verify)
from .rest_noise import gyro_bias_of, GyroBias, sample_noise_of, SampleNoise, with_rest_noise
from .unknown_orientation import directions_of, fit_unknown, only_norm

__all__ = ['BASES', 'FLEET', 'FRAMES', 'LARGEST_OFFSET_G', 'METHODS', 'MODEL_NAMES', 'OF_A_FIT',
           'PRIOR', 'STORED_METHODS', 'USES_LIMIT', 'Calibration', 'FleetPrior', 'FrameName',
           'GyroBias', 'Method', 'NextPose', 'Outlook', 'Outside', 'Quality', 'Rejected',
           'RejectedKind', 'SampleContext', 'SampleNoise', 'Verification', 'angle_words',
           'check_sensor', 'converted', 'determines', 'deviations_g', 'directions_of',
           'errors_after', 'errors_before', 'fit_findings', 'fit_partial', 'fit_poses',
           'fit_unknown', 'fit_with_fleet', 'flat_direction', 'gated', 'gyro_bias_of', 'in_frame',
           'in_g', 'level', 'level_by_rows', 'lies_in_cone', 'mounting_figures', 'mounting_of',
           'mounting_only', 'mounting_words', 'next_pose', 'of_samples', 'on_topics', 'only_norm',
           'outlook', 'outside', 'posterior', 'quality_of', 'record_of', 'refuse_if_unfit',
           'sample_noise_of', 'set_heading', 'sound_rows', 'sure_rows', 'thermal_stream',
           'uncertainty_g', 'verify', 'with_given_mounting', 'with_history', 'with_previous',
           'with_rest_noise']
