# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of sensor_msgs/Imu messages by a calibration.

The acceleration is corrected; stamp and orientation do not change. If ΔR is a rotation of the
frame, angular velocity and covariances are rotated, too. The conventions for the covariance of the
acceleration are kept (first element -1: no data; all zero: unknown). A known covariance is
transformed by A = ΔRᵀ W⁻¹, and the covariance of the calibration is added.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .layout import (
    ACCELERATION,
    ACCELERATION_COVARIANCE,
    ANGULAR_VELOCITY,
    ANGULAR_VELOCITY_COVARIANCE,
)
from ..calibrate import Calibration, of_samples
from ..effects import Context
from ..table import Floats


def corrected(calibration: Calibration, doubles: Floats, context: Context | None = None
              ) -> Floats:
    """
    Return the corrected doubles of Imu messages.

    Parameters
    ----------
    calibration : Calibration
        The calibration, in the unit of the messages.
    doubles : (n, 37) array
        One row per message; see `accel_calib.messages.layout`.
    context : mapping of str to array, optional
        Columns that the effects need, n rows each.

    Returns
    -------
    (n, 37) array
        The corrected messages.

    """
    known = of_samples(context or {}, len(doubles))
    rotation = calibration.model.rotation
    result = doubles.copy()
    force = calibration.correct(doubles[:, ACCELERATION], known)
    result[:, ACCELERATION] = force
    if not np.array_equal(rotation, np.eye(3)):
        result[:, ANGULAR_VELOCITY] = doubles[:, ANGULAR_VELOCITY] @ rotation
        rate_covariance = doubles[:, ANGULAR_VELOCITY_COVARIANCE]
        stated = is_known(rate_covariance)
        result[stated, ANGULAR_VELOCITY_COVARIANCE] = transformed(
            rotation.T, rate_covariance[stated])
    force_covariance = doubles[:, ACCELERATION_COVARIANCE]
    stated = is_known(force_covariance)
    if np.any(stated):
        inverse = rotation.T @ np.linalg.inv(calibration.gain)
        own = transformed(inverse, force_covariance[stated])
        rows = {key: values[stated] for key, values in known.items()}
        added = calibration.force_covariance(force[stated], rows)
        result[stated, ACCELERATION_COVARIANCE] = own + added.reshape(-1, 9)
    return result


def is_known(covariance: Floats) -> NDArray[np.bool_]:
    """Return which (n, 9) covariances are neither -1 (no data) nor all zero (unknown)."""
    return (covariance[:, 0] != -1.0) & np.any(covariance != 0.0, axis=1)


def transformed(matrix: Floats, covariance: Floats) -> Floats:
    """Return A C Aᵀ for (n, 9) covariances C."""
    return (matrix @ covariance.reshape(-1, 3, 3) @ matrix.T).reshape(-1, 9)
