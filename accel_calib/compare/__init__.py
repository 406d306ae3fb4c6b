# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Repeated calibrations of one sensor: whether they agree within their uncertainties.

`comparability` checks that they can be compared, `rotation_free` takes their axes out,
`common_scale` puts their covariances on one scale, `agreement` tests, `comparison` is the way in.

"""

from .agreement import LEVEL
from .comparison import compare, Comparison

__all__ = ['LEVEL', 'Comparison', 'compare']
