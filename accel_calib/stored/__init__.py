# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Files of this package: calibrations and what a fleet of sensors has in common.

`exports` makes the files of other programs.

"""

from .calibration_yaml import (
    calibration_bytes, calibration_from, OF_FILE, read_calibration, read_prior, write_calibration,
    write_priors)
