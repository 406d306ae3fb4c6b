# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of single serialized Imu messages.

The result is the same as that of `accel_calib.messages.correction`, but computed with Python
floats (`accel_calib.one_reading`); a test compares both. Covariances rarely change from message to
message, so each covariance is transformed only once.

"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np

from .correction import is_known, transformed
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
from ..calibrate import Calibration
from ..errors import InputError
from ..one_reading import AtReading, OneReading, Triple
from ..table import Floats

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
