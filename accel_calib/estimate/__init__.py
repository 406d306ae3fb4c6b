# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses and defines the weight of their measured noise.
`fit` minimises the residuals and computes the covariance. `outliers` finds outliers, also those
that would distort a fit. `closed_form` computes start values. `geometry` computes what poses
determine before any fit.

"""

from .closed_form import (
    closed_form,
    faces,
    fit_12,
    fit_sphere,
    lower_triangular,
    sensing_axes,
    TIES,
)
from .equations import Equations, kinds, noise_of, variance_factor
from .fit import by_pose, estimate, Fit, judge, Prior
from .geometry import (
    Combination,
    coverage,
    dilution,
    distinct,
    error_left_in,
    free_parameters,
    Identifiability,
    identifiability,
    information_of,
    LARGEST_DILUTION,
    left_out,
    NORM_MODELS,
    over_the_sphere,
    pose_noise,
    poses_needed,
    relative_weights,
    rows_of,
    uncovered,
    WEAK_DILUTION,
)
from .least_squares import NotConvergedError, Point, solve
from .mistakes import covariance_with, Rival, rivals, unseen_mistakes
from .outliers import fit_norm, LARGEST_SHARE, originals, outliers, outliers_among, start_of

__all__ = ['LARGEST_DILUTION', 'LARGEST_SHARE', 'NORM_MODELS', 'TIES', 'WEAK_DILUTION',
           'Combination', 'Equations', 'Fit', 'Identifiability', 'NotConvergedError', 'Point',
           'Prior', 'Rival', 'by_pose', 'closed_form', 'covariance_with', 'coverage', 'dilution',
           'distinct', 'error_left_in', 'estimate', 'faces', 'fit_12', 'fit_norm', 'fit_sphere',
           'free_parameters', 'identifiability', 'information_of', 'judge', 'kinds', 'left_out',
           'lower_triangular', 'noise_of', 'originals', 'outliers', 'outliers_among',
           'over_the_sphere', 'pose_noise', 'poses_needed', 'relative_weights', 'rivals',
           'rows_of', 'sensing_axes', 'solve', 'start_of', 'uncovered', 'unseen_mistakes',
           'variance_factor']
