# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses and defines the weight of their measured noise.
`fit` minimises the residuals and computes the covariance. `outliers` finds outliers, also those
that would distort a fit. `closed_form` computes start values. `geometry` computes what poses
determine before any fit.

"""

from .closed_form import closed_form, faces, fit_12, lower_triangular, sensing_axes
from .equations import variance_factor
from .fit import estimate, Fit, judge, Prior
from .geometry import (
    coverage,
    dilution,
    error_left_in,
    identifiability,
    pose_noise,
    poses_needed,
    rows_of,
)

__all__ = ['Fit', 'Prior', 'closed_form', 'coverage', 'dilution', 'error_left_in', 'estimate',
           'faces', 'fit_12', 'identifiability', 'judge', 'lower_triangular', 'pose_noise',
           'poses_needed', 'rows_of', 'sensing_axes', 'variance_factor']
