# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Rests of a calibrated sensor against its calibration: `drift`, decided by `change_detection`."""

from .change_detection import Change
from .drift import compared, Drift, monitor, rests_of, status

__all__ = ['Change', 'Drift', 'compared', 'monitor', 'rests_of', 'status']
