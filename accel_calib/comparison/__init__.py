# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Whether a sensor has changed: comparison of repeated calibrations, and of rests with a calibration.

`comparison` compares calibrations, given their uncertainties, also in order of their dates.
`agreement` prepares them: it checks that they can be compared, computes parameters that do not
depend on the axes, converts their covariances to one scale, and contains the test. A run is one of
the calibrations. `drift` compares every rest with the calibration in use.

"""

from .agreement import LEVEL, NAMES, rotation_free
from .comparison import compare, Comparison, History, history_of, Parameter
from .drift import compared, Drift, rest_errors, status
