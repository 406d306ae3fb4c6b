# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The estimator: from poses and a list of effects to values. `calibrate` and `refine` use it.

`equations` sets up the equations of the poses, and `solve` minimises their residuals. `fit`
combines both and computes the covariance; `noise` defines the weight of the measured noise.
`outliers` finds outliers, and `robust` starts the fit if outliers would distort it. `closed_form`
and `quadric` compute start values. `geometry` and `identifiability` compute what poses determine
before any fit.

"""
