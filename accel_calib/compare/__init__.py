# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of repeated calibrations of one sensor, given their uncertainties.

`comparison` is the entry point; it first checks that the calibrations can be compared.
`parameters` computes parameters that do not depend on the axes, converts their covariances to one
scale, and contains the test. A run is one of the calibrations. `history` sorts calibrations by
date and compares each with the one before.

"""

from .comparison import compare, Comparison
from .history import Change, History, history_of, Moment
from .parameters import LEVEL

__all__ = ['LEVEL', 'Change', 'Comparison', 'History', 'Moment', 'compare', 'history_of']
