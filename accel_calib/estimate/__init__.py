# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses, with the weight of the measured noise. `fit`
minimises the residuals and computes the covariance. `outliers` fits without outliers, and finds
mistakes that the poses do not locate or show. `closed_form` computes start values. `geometry`
computes what poses determine before any fit.

"""

from .closed_form import (
    closed_form, faces, fit_12, fit_sphere, lower_triangular, sensing_axes, start_of, TIES)
from .equations import believable, Equations, kinds, originals, variance_factor
from .fit import by_pose, estimate, Fit, judge, NotConvergedError, Point, Prior, solve
from .geometry import (
    Combination, dilution, error_left_in, free_parameters, Identifiability, identifiability,
    information_of, LARGEST_DILUTION, largest_error, left_out, NORM_MODELS, pose_noise,
    poses_needed, rows_of, WEAK_DILUTION)
from .outliers import (
    covariance_with, fit_norm, LARGEST_SHARE, outliers, outliers_among, Rival, rivals,
    unseen_mistakes)

__all__ = ['LARGEST_DILUTION', 'LARGEST_SHARE', 'NORM_MODELS', 'TIES', 'WEAK_DILUTION',
           'Combination', 'Equations', 'Fit', 'Identifiability', 'NotConvergedError', 'Point',
           'Prior', 'Rival', 'believable', 'by_pose', 'closed_form', 'covariance_with', 'dilution',
           'error_left_in', 'estimate', 'faces', 'fit_12', 'fit_norm', 'fit_sphere',
           'free_parameters', 'identifiability', 'information_of', 'judge', 'kinds',
           'largest_error', 'left_out', 'lower_triangular', 'originals', 'outliers',
           'outliers_among', 'pose_noise', 'poses_needed', 'rivals', 'rows_of', 'sensing_axes',
           'solve', 'start_of', 'unseen_mistakes', 'variance_factor']
