# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether a sensor has changed: comparison of repeated calibrations, and of rests with a calibration.

`comparison` compares calibrations, given their uncertainties; it first checks that they can be
compared. `parameters` computes parameters that do not depend on the axes, converts their
covariances to one scale, and contains the test. A run is one of the calibrations. `history` sorts
calibrations by date and compares each with the one before. `drift` compares every rest with the
calibration in use.

"""

from .comparison import compare, Comparison, Parameter
from .drift import compared, Drift, monitor, rests_of, status
from .history import Change, History, history_of, Moment
from .parameters import LEVEL, NAMES, rotation_free

__all__ = ['LEVEL', 'NAMES', 'Change', 'Comparison', 'Drift', 'History', 'Moment', 'Parameter',
           'compare', 'compared', 'history_of', 'monitor', 'rests_of', 'rotation_free', 'status']
