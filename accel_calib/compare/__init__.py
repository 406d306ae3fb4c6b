# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of repeated calibrations of one sensor, given their uncertainties.

`comparison` is the entry point. `comparability` checks that the calibrations can be compared,
`rotation_free` computes parameters that do not depend on the axes, `common_scale` converts the
covariances to one scale, and `agreement` contains the test. A run is one of the calibrations.

"""

from .agreement import LEVEL
from .comparison import compare, Comparison

__all__ = ['LEVEL', 'Comparison', 'compare']
