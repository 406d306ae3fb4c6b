# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses and defines the weight of their measured noise.
`fit` minimises the residuals and computes the covariance. `outliers` finds outliers, also those
that would distort a fit. `closed_form` computes start values. `geometry` computes what poses
determine before any fit.

"""
