# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized Imu messages, corrected without being taken apart.

What becomes of the numbers is said in `accel_calib.imu` and `conversion`; here the same is done
in plain floats, and a test compares the two field by field. What drivers send again and again, the
covariances, is turned once.

"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING

import numpy as np

from .serialized import layout_with, LITTLE_ENDIAN, NAME_AT, NINE, STAMP, THREE
from .. import imu
from ..model import check_context
from ..plain import linear, plain_correct
from ..plain_spread import plain_spread

if TYPE_CHECKING:
    from .serialized import Layout
    from ..calibrate import Calibration
    from ..plain_effects import PlainContext, Triple
    from ..table import Floats

_FORCE, _MOTION, _ALL = (struct.Struct(each) for each in ('<12d', '<3d72s3d', '<3d72s12d'))
_ABSENT = struct.pack('<d', -1.0)
_NONE: Triple = (0.0, 0.0, 0.0)
_NO_CONTEXT: PlainContext = {}


class Rewriter:
    """
    Correct messages of one layout; see `conversion.corrected_message`.

    Parameters
    ----------
    layout : Layout
        Of the messages.
    calibration : Calibration
        In the unit of the readings.
    scale : float
        m/s² in one unit of its corrected force.
    frame_id : str
        New name of the frame; empty: keep it.

    """

    def __init__(self, layout: Layout, calibration: Calibration, scale: float, frame_id: str
                 ) -> None:
        model = calibration.model
        self._rotation = model.rotation
        self._turns = not np.array_equal(model.rotation, np.eye(3))
        self._turn = linear(model.rotation.T, np.zeros(3))
        self._model, self._needs = model, model.needs
        self._inverse = model.rotation.T @ np.linalg.inv(calibration.gain) * scale
        self._correct = plain_correct(calibration, scale)
        self._uncertainty = plain_spread(calibration, scale)
        self._begin = layout.begin
        self._rate = layout.begin + 8 * imu.ANGULAR_VELOCITY.start
        self._rate_spread = layout.begin + 8 * imu.ANGULAR_VELOCITY_COVARIANCE.start
        self._force = layout.begin + 8 * imu.ACCELERATION.start
        self._force_spread = layout.begin + 8 * imu.ACCELERATION_COVARIANCE.start
        self.layout = layout_with(frame_id) if frame_id else layout
        padding = self.layout.begin - self.layout.name_end
        self._name = self.layout.name + bytes(padding) if frame_id else b''
        self._seen_force = self._seen_rate = self._turned_rate = b''
        self._own: list[float] | None = None
        self._warm, self._warm_context = math.nan, _NO_CONTEXT

    def __call__(self, data: bytes, temperature: float) -> bytes | None:
        """
        Give a corrected message.

        Parameters
        ----------
        data : bytes
            A message of the layout.
        temperature : float
            The last one [°C]; NaN: none came.

        Returns
        -------
        bytes or None
            In the layout ``self.layout``; None where the reading is not finite.

        Raises
        ------
        InputError
            If the model needs context that is not there.

        """
        if self._turns:
            return self._turned(data, temperature)
        x, y, z = THREE.unpack_from(data, self._force)
        if not math.isfinite(x + y + z):
            return None
        context = self._context(data, temperature) if self._needs else _NO_CONTEXT
        force = self._correct(x, y, z, context)
        spread = data[self._force_spread:]
        if spread != self._seen_force:
            self._see_force(spread)
        front = self._renamed(data) + data[self._begin:self._force] if self._name else (
            data[:self._force])
        if self._own is None:
            return front + THREE.pack(*force) + spread
        return front + _FORCE.pack(*force, *self._uncertainty(force, context, self._own))

    def _turned(self, data: bytes, temperature: float) -> bytes | None:
        """Give a corrected message in the levelled frame."""
        p, q, r, spread, x, y, z = _MOTION.unpack_from(data, self._rate)
        if not math.isfinite(x + y + z):
            return None
        if spread != self._seen_rate:
            self._see_rate(spread)
        context = self._context(data, temperature) if self._needs else _NO_CONTEXT
        force = self._correct(x, y, z, context)
        p, q, r = self._turn(p, q, r, context)
        spread = data[self._force_spread:]
        if spread != self._seen_force:
            self._see_force(spread)
        front = self._renamed(data) + data[self._begin:self._rate] if self._name else (
            data[:self._rate])
        if self._own is None:
            return front + _MOTION.pack(p, q, r, self._turned_rate, *force) + spread
        return front + _ALL.pack(p, q, r, self._turned_rate, *force,
                                 *self._uncertainty(force, context, self._own))

    def _renamed(self, data: bytes) -> bytes:
        """Give the message up to the 37 doubles, renamed."""
        return LITTLE_ENDIAN + data[4:NAME_AT] + self._name

    def _context(self, data: bytes, temperature: float) -> PlainContext:
        """Give what `context.context_of_message` gives, in plain floats."""
        if temperature == self._warm:
            return self._warm_context
        seconds, nanoseconds = STAMP.unpack_from(data, 4)
        rate: Triple = THREE.unpack_from(data, self._rate)
        absent = data[self._rate_spread:self._rate_spread + 8] == _ABSENT
        known = {'time': seconds + nanoseconds * 1e-9, 'std': _NONE, 'approach': _NONE,
                 'rate': _NONE if absent or not math.isfinite(sum(rate)) else rate}
        if not math.isnan(temperature):
            known['temperature'] = temperature
        for key in self._needs:
            if key not in known:
                check_context(self._model, known)
        if self._needs == ('temperature',):  # which changes less often than there are messages
            self._warm, self._warm_context = temperature, known
        return known

    def _see_force(self, spread: bytes) -> None:
        """Learn how sure the messages say that the acceleration is."""
        self._seen_force = spread
        self._own = _turned(self._inverse, spread)

    def _see_rate(self, spread: bytes) -> None:
        """Learn how sure the messages say that the angular velocity is."""
        self._seen_rate = spread
        turned = _turned(self._rotation.T, spread)
        self._turned_rate = spread if turned is None else NINE.pack(*turned)


def _turned(matrix: Floats, spread: bytes) -> list[float] | None:
    """Give A C Aᵀ of a covariance that is known; None where it is absent or unknown."""
    covariance = np.frombuffer(spread, '<f8')
    if covariance[0] == -1.0 or not np.any(covariance):
        return None
    turned: list[float] = (matrix @ covariance.reshape(3, 3) @ matrix.T).ravel().tolist()
    return turned
