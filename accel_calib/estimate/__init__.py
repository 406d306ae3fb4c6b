# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses and a list of effects to values: the one estimator, used by `calibrate` and `refine`.

`equations` sets up what poses say of a model, `solve` minimises, `fit` puts both together with the
covariance, where `noise` says how far the measured noise is believed. `outliers` finds disturbed
poses, `robust` begins where they would spoil the fit, `closed_form` and `quadric` give starts.
`geometry` and `identifiability` say what poses determine before any fit.

"""
