# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Messages to plain numbers and back.

What a calibration changes in an Imu is said in `accel_calib.imu`, for messages from bags and from
topics alike; what goes out is in m/s², whatever came in. ``orientation`` is what the driver's own
filter says of the driver's own frame, and stays.

"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from geometry_msgs.msg import Vector3
import numpy as np
from sensor_msgs.msg import Imu
from std_msgs.msg import Header

from .. import imu

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..effects import Context
    from ..table import Floats

Triple = tuple[float, float, float]


def seconds(header: Header) -> float:
    """Give the stamp of a header [s]."""
    return float(header.stamp.sec) + header.stamp.nanosec * 1e-9


def reading_of(message: Imu) -> Triple:
    """Give the acceleration as the sensor gave it."""
    vector = message.linear_acceleration
    return vector.x, vector.y, vector.z


def rate_of(message: Imu) -> Triple | None:
    """Give the angular rate [rad/s], or None where the sensor has none."""
    vector = message.angular_velocity
    rate = vector.x, vector.y, vector.z
    absent = message.angular_velocity_covariance[0] == -1.0 or not is_finite(rate)
    return None if absent else rate


def is_finite(numbers: Triple) -> bool:
    """Say whether none of three numbers is NaN or infinite; a sum of them tells, and fast."""
    return math.isfinite(numbers[0] + numbers[1] + numbers[2])


def vector3(numbers: Floats) -> Vector3:
    """Make a vector message of a (3,) array."""
    return Vector3(x=float(numbers[0]), y=float(numbers[1]), z=float(numbers[2]))


def renamed(header: Header, frame_id: str) -> Header:
    """Give the header with another frame, or itself where that is empty."""
    return Header(stamp=header.stamp, frame_id=frame_id) if frame_id else header


def corrected_message(message: Imu, calibration: Calibration, scale: float, context: Context,
                      frame_id: str) -> Imu:
    """
    Make the corrected message.

    Parameters
    ----------
    message : Imu
        As the sensor gave it.
    calibration : Calibration
        In the unit of the readings.
    scale : float
        m/s² in one unit of its corrected force.
    context : mapping of str to array
        What the effects need, one row.
    frame_id : str
        New name of the frame; empty: keep it.

    Raises
    ------
    InputError
        If the model needs context that is not there.

    """
    fields = imu.corrected(calibration, fields_of(message), context)[0]
    force = fields[imu.ACCELERATION] * scale
    spread = fields[imu.ACCELERATION_COVARIANCE]
    known = spread[0] != -1.0
    return Imu(
        header=renamed(message.header, frame_id),
        orientation=message.orientation,
        orientation_covariance=message.orientation_covariance,
        angular_velocity=vector3(fields[imu.ANGULAR_VELOCITY]),
        angular_velocity_covariance=fields[imu.ANGULAR_VELOCITY_COVARIANCE],
        linear_acceleration=vector3(force),
        linear_acceleration_covariance=spread * scale ** 2 if known else spread)


def fields_of(message: Imu) -> Floats:
    """Give the (1, 37) numbers of a message, in the order of `accel_calib.imu`."""
    attitude, rate = message.orientation, message.angular_velocity
    reading = message.linear_acceleration
    return np.concatenate((
        (attitude.x, attitude.y, attitude.z, attitude.w), message.orientation_covariance,
        (rate.x, rate.y, rate.z), message.angular_velocity_covariance,
        (reading.x, reading.y, reading.z), message.linear_acceleration_covariance,
    ))[np.newaxis]
