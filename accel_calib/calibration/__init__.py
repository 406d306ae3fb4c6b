# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
From poses to a calibration.

`fit` is the entry point, and `partial` that for few poses, with the typical values of sensors.
`calibration` is the record. `quality` makes it, computes its figures, and has the gate, which
rejects implausible results. `rest_noise` adds the figures of the gyro and of the samples.
`mounting` computes the mounting and detects wiring faults. `directions` computes what poses
determine, and `planning` the next pose. `thermal` is for a still board whose temperature changes.

"""

from .calibration import (
    Calibration, check_sensor, FLEET, ORIENTED, PRIOR, Quality, Rejected, RejectedKind,
    STORED_METHODS)
from .directions import (
    Combination, determines, dilution, directions_in, directions_of, error_left_in,
    free_parameters, Identifiability, identifiability, LARGEST_DILUTION, lies_in_cone,
    lies_in_plane, NORM_MODELS)
from .fit import CLIPPED, fit_poses, fit_unknown, only_norm, rejected_by, sound_rows, sure_rows
from .mounting import (
    flat_direction, in_frame, level, level_by_rows, on_topics, set_heading, with_given_mounting)
from .partial import fit_partial, fit_with_fleet, FleetPrior, mounting_only, posterior
from .planning import (
    ENOUGH, next_pose, NextPose, plan_refinement, plan_session, PlannedPose, PosePlan,
    refuse_if_unfit, SessionPlan)
from .quality import (
    deviations_g, errors_after, errors_before, fit_findings, gated, has_usual_gains, in_g,
    LARGEST_OFFSET_G, OF_A_FIT, Outside, outside, quality_of, record_of, refused,
    stated_uncertainty, uncertainty_g, Verification, verify, with_rest_noise)
from .rest_noise import gyro_bias_of, gyro_bias_of_rest, GyroBias, sample_noise_of, SampleNoise
from .thermal import Curve, curve_of, thermal_alone, with_curve, without_curve
