# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drift of a calibrated sensor: every rest is compared with the calibration.

`drift` is the entry point; `change_detection` contains the test.

"""

from .drift import compared, Drift, monitor, rests_of, status

__all__ = ['Drift', 'compared', 'monitor', 'rests_of', 'status']
