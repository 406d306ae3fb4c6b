# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses, with the weight of the measured noise. `fit`
minimises the residuals and computes the covariance. `outliers` fits without outliers, or beside
the scatter by which poses repeat worse than their samples, and finds mistakes that the poses do
not locate or show. `closed_form` computes start values.

"""

from .closed_form import closed_form, faces, fit_12, fit_sphere, sensing_axes, start_of, TIES
from .equations import believable, kinds, originals, pose_noise, variance_factor
from .fit import (
    by_pose, estimate, Fit, judge, left_out, NotConvergedError, Point, Prior, solve, stated)
from .outliers import (
    beside_scatter, covariance_with, fit_robust, LARGEST_SHARE, outliers, outliers_among, Rival,
    rivals, scatter_of, unseen_mistakes, with_scatter_of)
