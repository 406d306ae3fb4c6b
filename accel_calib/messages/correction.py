# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of sensor_msgs/Imu messages by a calibration.

The acceleration is corrected; stamp and orientation do not change. If ΔR is a rotation of the
frame, angular velocity and covariances are rotated, too. The conventions for the covariance of the
acceleration are kept (first element -1: no data; all zero: unknown). A known covariance is
transformed by A = ΔRᵀ W⁻¹, and the covariance of the calibration is added.

**Single messages.** Correction of single serialized Imu messages.

The result is the same as that of `accel_calib.messages.correction`, but computed with Python
floats (`accel_calib.one_reading`); a test compares both. Covariances rarely change from message to
message, so each covariance is transformed only once.

"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import (
    ACCELERATION,
    ACCELERATION_COVARIANCE,
    ANGULAR_VELOCITY,
    ANGULAR_VELOCITY_COVARIANCE,
    Layout,
    layout_with,
    LITTLE_ENDIAN,
    NAME_AT,
    NINE,
    STAMP,
    STAMP_AT,
    THREE,
)
from ..calibrate import Calibration, of_samples
from ..effects import Context
from ..errors import InputError
from ..one_reading import AtReading, OneReading, Triple
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


LARGEST_G = 100.0
"""Larger corrected forces are not published [g]. The range of common accelerometers is 16 to 40 g;
shock sensors cannot be calibrated by gravity."""

_FORCE, _MOTION, _ALL = (struct.Struct(each) for each in ('<12d', '<3d72s3d', '<3d72s12d'))
_ABSENT = struct.pack('<d', -1.0)
_NONE: Triple = (0.0, 0.0, 0.0)
_PER_MESSAGE = {'time', 'rate'}


class Rewriter:
    """
    Correct messages of one layout.

    Parameters
    ----------
    layout : Layout
        Layout of the messages.
    calibration : Calibration
        The calibration, in the unit of the readings.
    scale : float
        m/s² per unit of the corrected force.
    gravity : float
        Local gravity [m/s²].
    frame_id : str
        New frame_id; empty: keep the frame_id.

    Attributes
    ----------
    layout : Layout
        Layout of the corrected messages.

    """

    def __init__(self, layout: Layout, calibration: Calibration, scale: float, gravity: float,
                 frame_id: str) -> None:
        rotation = calibration.model.rotation
        self._rotation = rotation
        self._turns = not np.array_equal(rotation, np.eye(3))
        self._turn = rotation.T.tolist()
        self._inverse = rotation.T @ np.linalg.inv(calibration.gain) * scale
        self._calibration = OneReading(calibration, scale)
        self._needs = calibration.model.needs
        self._per_message = bool(_PER_MESSAGE.intersection(self._needs))
        self._at = None if self._needs else self._calibration.at({})
        self._warm = math.nan
        self._largest = LARGEST_G * gravity
        self._given = layout
        self._rate = layout.place(ANGULAR_VELOCITY)
        self._rate_spread = layout.place(ANGULAR_VELOCITY_COVARIANCE)
        self._force = layout.place(ACCELERATION)
        self._force_spread = layout.place(ACCELERATION_COVARIANCE)
        self.layout = layout_with(frame_id) if frame_id else layout
        padding = self.layout.begin - self.layout.name_end
        self._name = self.layout.name + bytes(padding) if frame_id else b''
        self._seen_force = self._seen_rate = self._turned_rate = b''
        self._own: list[float] | None = None

    def __call__(self, data: bytes, temperature: float) -> bytes | None:
        """
        Return the corrected message.

        Parameters
        ----------
        data : bytes
            A message with the layout.
        temperature : float
            Last temperature [°C]; NaN if there is none.

        Returns
        -------
        bytes or None
            The message with the layout ``self.layout``; None if the reading is not finite.

        Raises
        ------
        InputError
            If context is missing, or the corrected force is not plausible.

        """
        p, q, r, spread, x, y, z = _MOTION.unpack_from(data, self._rate)
        if not math.isfinite(x + y + z):
            return None
        at = self._at
        if at is None or (self._needs and (self._per_message or temperature != self._warm)):
            at = self._at_context(data, temperature)
        force = at.correct(x, y, z)
        largest = self._largest
        a, b, c = force
        if not (-largest < a < largest and -largest < b < largest and -largest < c < largest):
            raise _implausible(force)
        covariance = data[self._force_spread:]
        if covariance != self._seen_force:
            self._see_force(covariance)
        if not self._turns:
            front = self._front(data, self._force)
            if self._own is None:
                return front + THREE.pack(a, b, c) + covariance
            return front + _FORCE.pack(a, b, c, *at.with_spread(force, self._own))
        if spread != self._seen_rate:
            self._see_rate(spread)
        rates = [i * p + j * q + k * r for i, j, k in self._turn]
        front = self._front(data, self._rate)
        if self._own is None:
            return front + _MOTION.pack(*rates, self._turned_rate, a, b, c) + covariance
        return front + _ALL.pack(*rates, self._turned_rate, a, b, c,
                                 *at.with_spread(force, self._own))

    def _front(self, data: bytes, end: int) -> bytes:
        """Return the message up to a place, with the new frame_id if there is one."""
        if not self._name:
            return data[:end]
        return LITTLE_ENDIAN + data[STAMP_AT:NAME_AT] + self._name + data[self._given.begin:end]

    def _at_context(self, data: bytes, temperature: float) -> AtReading:
        """Return the calibration at the context of a message, and cache it."""
        seconds, nanoseconds = STAMP.unpack_from(data, STAMP_AT)
        rate: Triple = THREE.unpack_from(data, self._rate)
        absent = data[self._rate_spread:self._rate_spread + 8] == _ABSENT
        known: dict[str, Any] = {
            'time': seconds + nanoseconds * 1e-9, 'std': _NONE, 'previous': _NONE,
            'rate': _NONE if absent or not math.isfinite(sum(rate)) else rate}
        if not math.isnan(temperature):
            known['temperature'] = temperature
        self._at, self._warm = self._calibration.at(known), temperature
        return self._at

    def _see_force(self, covariance: bytes) -> None:
        """Cache the transformed covariance of the acceleration."""
        self._seen_force = covariance
        self._own = _transformed(self._inverse, covariance)

    def _see_rate(self, covariance: bytes) -> None:
        """Cache the transformed covariance of the angular velocity."""
        self._seen_rate = covariance
        turned = _transformed(self._rotation.T, covariance)
        self._turned_rate = covariance if turned is None else NINE.pack(*turned)


def _implausible(force: Triple) -> InputError:
    words = ', '.join(f'{part:.3g}' for part in force)
    return InputError(f'the corrected acceleration is ({words}) m/s², expected less than '
                      f'{LARGEST_G:.0f} g', 'check the calibration and the driver')


def _transformed(matrix: Floats, covariance: bytes) -> list[float] | None:
    """Return A C Aᵀ of a covariance, or None if the covariance is absent or unknown."""
    numbers = np.frombuffer(covariance, '<f8')[np.newaxis]
    if not is_known(numbers)[0]:
        return None
    found: list[float] = transformed(matrix, numbers)[0].tolist()
    return found


def motion_of(data: bytes, layout: Layout, gravity: Floats) -> bytes:
    """Return a serialized Vector3Stamped: the acceleration of a message minus gravity [m/s²]."""
    x, y, z = THREE.unpack_from(data, layout.place(ACCELERATION))
    return data[:layout.begin] + THREE.pack(x - gravity[0], y - gravity[1], z - gravity[2])
