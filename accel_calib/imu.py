# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The numbers of a sensor_msgs/Imu, and how a calibration changes them.

The fields behind the header are 37 doubles, in this order both in CDR (ROS 2) and in the
serialization of ROS 1, where they are the last 296 bytes of a message. Arrays here hold a message
a row, so that bags, typed messages and serialized ones go through the same code.

A corrected message keeps stamp, orientation and everything else; acceleration is corrected. Where
ΔR turns the frame, angular velocity and the covariances turn with it. The covariance of the
acceleration keeps its conventions (first element -1: no data; all zero: unknown); a known one is
transformed by A = ΔRᵀ W⁻¹, and the uncertainty of the calibration is added.

"""

from __future__ import annotations

import numpy as np

from .calibrate import Calibration
from .effects import Context
from .table import Floats

ORIENTATION = slice(0, 4)
ORIENTATION_COVARIANCE = slice(4, 13)
ANGULAR_VELOCITY = slice(13, 16)
ANGULAR_VELOCITY_COVARIANCE = slice(16, 25)
ACCELERATION = slice(25, 28)
ACCELERATION_COVARIANCE = slice(28, 37)
FIELDS = 37


def corrected(calibration: Calibration, fields: Floats, context: Context | None = None) -> Floats:
    """
    Correct the numbers of Imu messages.

    Parameters
    ----------
    calibration : Calibration
        In the unit of the messages.
    fields : (n, 37) array
        A message a row.
    context : mapping of str to array, optional
        What the effects need, n rows each.

    Returns
    -------
    (n, 37) array
        The corrected messages.

    """
    rotation = calibration.model.rotation
    result = fields.copy()
    force = calibration.correct(fields[:, ACCELERATION], context)
    result[:, ACCELERATION] = force
    if not np.array_equal(rotation, np.eye(3)):
        result[:, ANGULAR_VELOCITY] = fields[:, ANGULAR_VELOCITY] @ rotation
        rate_covariance = fields[:, ANGULAR_VELOCITY_COVARIANCE]
        known = _known(rate_covariance)
        result[known, ANGULAR_VELOCITY_COVARIANCE] = _transformed(
            rotation.T, rate_covariance[known])
    force_covariance = fields[:, ACCELERATION_COVARIANCE]
    known = _known(force_covariance)
    if np.any(known):
        inverse = rotation.T @ np.linalg.inv(calibration.gain)
        own = _transformed(inverse, force_covariance[known])
        rows = {key: values[known] for key, values in (context or {}).items()}
        added = calibration.force_covariance(force[known], rows)
        result[known, ACCELERATION_COVARIANCE] = own + added.reshape(-1, 9)
    return result


def _known(covariance: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Tell which (n, 9) covariances are neither -1 (no data) nor all zero (unknown)."""
    return (covariance[:, 0] != -1.0) & np.any(covariance != 0.0, axis=1)


def _transformed(matrix: Floats, covariance: Floats) -> Floats:
    """Give A C Aᵀ for (n, 9) covariances C."""
    return (matrix @ covariance.reshape(-1, 3, 3) @ matrix.T).reshape(-1, 9)
