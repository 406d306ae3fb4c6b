# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of sensor_msgs/Imu messages by a calibration.

One rule holds for the node and for recordings. A corrected message has offset, gain and the
mounting ΔR applied. If ΔR is a rotation of the frame, everything in the message is turned into the
levelled frame, and the message has the frame_id of that frame:

==================  ======================================================================
acceleration        ΔRᵀ W⁻¹ (reading - V), and the other effects of the calibration
angular velocity    ΔRᵀ rate
orientation         q ⊗ q(ΔR), the attitude of the levelled frame in the same world
covariances         A C Aᵀ with A = ΔRᵀ, for the acceleration ΔRᵀ W⁻¹; all three are stated
                    about the x, y and z axes of the message (sensor_msgs/Imu)
frame_id            `output_frame`
==================  ======================================================================

A calibration without a mounting (`Calibration.in_sensor_frame`) leaves the frame unchanged. Then
only the acceleration and its covariance differ from the raw message, and a covariance that is not
finite. The stamp never changes.

The conventions for covariances are kept: a first element of -1 means no data, and all zero means
unknown. A covariance that is not finite becomes unknown. The covariance of the calibration is
added to a known covariance of the acceleration.

**Single messages.** `Rewriter` has the result of `corrected`, but computes with Python floats
(`one_reading`). Covariances rarely change from message to message, so that each is transformed
only once.

"""

from __future__ import annotations

from collections.abc import Mapping
import math
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .one_reading import AtReading, OneReading, Triple
from ..calibration import Calibration, SampleNoise
from ..effects import context_of_samples, thermal_stream, ThermalStream
from ..errors import InputError
from ..geometry import quaternion_of
from ..logs import (
    ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE, Layout,
    layout_with, LITTLE_ENDIAN, NAME_AT, NINE, ORIENTATION, ORIENTATION_COVARIANCE, STAMP,
    STAMP_AT, THREE)
from ..table import Floats


def output_scale(calibration: Calibration, gravity: float) -> float:
    """Return m/s² per unit of corrected force; `gravity` is the local gravity [m/s²]."""
    return 1.0 if calibration.units.is_si else gravity / calibration.force_per_g


def corrected(calibration: Calibration, doubles: Floats, context: Mapping[str, NDArray[Any]] = {},
              scale: float = 1.0) -> Floats:
    """
    Return the corrected doubles of Imu messages, (n, 37).

    Parameters
    ----------
    calibration : Calibration
        The calibration, in the unit of the messages.
    doubles : (n, 37) array
        One row per message; see `accel_calib.logs.serialized`.
    context : mapping of str to array, optional
        Columns that the effects need, n rows each.
    scale : float
        Factor on the corrected force.

    """
    known = context_of_samples(context, len(doubles), calibration.model)
    rotation = calibration.model.rotation
    result = doubles.copy()
    force = calibration.correct(doubles[:, ACCELERATION], known)
    result[:, ACCELERATION] = scale * force
    if calibration.is_levelled:
        result[:, ANGULAR_VELOCITY] = doubles[:, ANGULAR_VELOCITY] @ rotation
        present = doubles[:, ORIENTATION_COVARIANCE.start] != -1.0
        x, y, z, w = doubles[present, ORIENTATION].T
        result[present, ORIENTATION] = np.array(_product(x, y, z, w, *quaternion_of(rotation))).T
    turn = rotation.T if calibration.is_levelled else np.eye(3)
    for part, matrix in ((ANGULAR_VELOCITY_COVARIANCE, turn), (ORIENTATION_COVARIANCE, turn), (
            ACCELERATION_COVARIANCE, scale * rotation.T @ np.linalg.inv(calibration.gain))):
        result[:, part], stated = _transformed(matrix, doubles[:, part])
    if np.any(stated):
        rows = {key: values[stated] for key, values in known.items()}
        added = calibration.force_covariance(force[stated], rows)
        result[stated, ACCELERATION_COVARIANCE] += scale ** 2 * added.reshape(-1, 9)
    return result


def output_frame(calibration: Calibration, frame_id: str, chosen: str = '') -> str:
    """Return the frame_id of corrected messages; `chosen` is that of the levelled frame."""
    return (chosen or f'{frame_id}_levelled') if calibration.is_levelled else frame_id


def _transformed(matrix: Floats, covariance: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """
    Return A C Aᵀ for (n, 9) covariances C, and which of them are known.

    An unknown covariance becomes zero, and one without data (-1) is unchanged.

    """
    absent = covariance[:, 0] == -1.0
    known = ~absent & np.any(covariance != 0.0, axis=1) & np.all(np.isfinite(covariance), axis=1)
    found = np.where(absent[:, np.newaxis], covariance, 0.0)
    found[known] = (matrix @ covariance[known].reshape(-1, 3, 3) @ matrix.T).reshape(-1, 9)
    return found, known


def _product(x: Any, y: Any, z: Any, w: Any, p: float, q: float, r: float, s: float
             ) -> tuple[Any, Any, Any, Any]:
    """Return the product of two quaternions (x, y, z, w); the first can have arrays."""
    return (w * p + x * s + y * r - z * q, w * q - x * r + y * s + z * p,
            w * r + x * q - y * p + z * s, w * s - x * p - y * q - z * r)


LARGEST_G = 100.0
"""Larger corrected forces are not published [g]. The range of common accelerometers is 16 to 40 g;
shock sensors cannot be calibrated by gravity."""

_FORCE, _FRONT, _WHOLE = (struct.Struct(each) for each in ('<12d', '<4d72s3d72s', '<4d72s3d72s3d'))
_ABSENT = struct.pack('<d', -1.0)
_UNKNOWN = bytes(72)
_NONE: Triple = (0.0, 0.0, 0.0)


class _Seen(NamedTuple):
    """
    A covariance as given, whether its quantity is in the message, and the corrected one.

    `turned` has the numbers of the corrected one; None if it is not known.

    """

    given: bytes
    present: bool
    new: bytes
    turned: list[float] | None


class Rewriter:
    """
    Correct messages of one layout.

    Parameters
    ----------
    layout, calibration
        Layout of the messages, and the calibration in the unit of the readings.
    gravity : float
        Local gravity [m/s²].
    frame_id : str
        frame_id of the corrected messages.
    noise : SampleNoise, optional
        Noise of the samples, stated in messages whose covariance is unknown.
    thermal : ThermalStream, optional
        Lag and rate of the temperature before the messages; by default they start in equilibrium.

    Attributes
    ----------
    layout : Layout
        Layout of the corrected messages.
    bias : (float, float, float)
        Bias that is subtracted from the angular velocity [rad/s].

    """

    def __init__(self, layout: Layout, calibration: Calibration, gravity: float, frame_id: str,
                 noise: SampleNoise | None = None, thermal: ThermalStream | None = None) -> None:
        scale = output_scale(calibration, gravity)
        self.bias: Triple = _NONE
        self._turns = calibration.is_levelled
        self._turn = tuple(calibration.rotation.T.ravel().tolist())
        self._quaternion = quaternion_of(calibration.rotation)
        self._inverse = calibration.rotation.T @ np.linalg.inv(calibration.gain) * scale
        self._calibration = OneReading(calibration, scale)
        self._needs, self._neutral = calibration.model.needs, calibration.model.neutral
        self._thermal = thermal if thermal is not None else thermal_stream(calibration.model)
        self._per_message = bool({'time', 'rate'}.intersection(self._needs))
        self._at = None if self._needs else self._calibration.at({})
        self._context: Mapping[str, float] | None = None
        self._around: list[float | None] = []
        self._largest = LARGEST_G * gravity
        self._given, self.layout = layout, layout_with(frame_id)
        self._force, self._force_spread, self._rate, self._rate_spread = map(layout.place, (
            ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE))
        self._renamed = self.layout.name != layout.name
        self._name = self.layout.name + bytes(self.layout.begin - self.layout.name_end)
        stated = [np.full(3, np.nan)] * 2 if noise is None else [noise.force, noise.rate]
        self._fill_force, self._fill_rate = (
            np.diag(np.square(each)).astype('<f8').tobytes() if np.all(np.isfinite(each))
            else _UNKNOWN for each in stated)
        self._seen_force = self._seen_rate = self._seen_orientation = _Seen(b'', True, b'', None)

    def __call__(self, data: bytes, context: Mapping[str, float]) -> bytes | None:
        """
        Return the corrected message; None for a reading that is not finite.

        `context` is another mapping if it has changed. Missing context and a corrected force that
        is not plausible are an InputError.

        """
        given = _WHOLE.unpack_from(data, self._given.begin)
        x, y, z = given[-3:]
        if not math.isfinite(x + y + z):
            return None
        at = self._at
        if at is None or (self._needs and (self._per_message or context is not self._context)):
            at = self._at_context(data, context)
        force = at.correct(x, y, z)
        largest = self._largest
        a, b, c = force
        if not (-largest < a < largest and -largest < b < largest and -largest < c < largest):
            words = ', '.join(f'{part:.3g}' for part in force)
            raise InputError(f'the corrected acceleration is ({words}) m/s², expected less than '
                             f'{LARGEST_G:.0f} g', 'check the calibration and the driver')
        covariance, seen = data[self._force_spread:], self._seen_force
        if covariance != seen.given:
            seen = self._seen_force = _seen(self._inverse, covariance, self._fill_force)
        before = self._before(data, given)
        if seen.turned is None:
            return before + THREE.pack(a, b, c) + seen.new
        return before + _FORCE.pack(a, b, c, *at.with_spread(force, seen.turned))

    def _before(self, data: bytes, given: tuple[Any, ...]) -> bytes:
        """Return the message before the acceleration."""
        attitude, orientation_spread, rate, rate_spread = given[:4], given[4], given[5:8], given[8]
        if rate_spread != self._seen_rate.given:
            self._seen_rate = _seen(self._turn, rate_spread, self._fill_rate)
        if orientation_spread != self._seen_orientation.given:
            self._seen_orientation = _seen(self._turn, orientation_spread, _UNKNOWN)
        _, has_rate, new_rate, _ = self._seen_rate
        _, has_orientation, new_orientation, _ = self._seen_orientation
        u, v, t = self.bias
        begin = self._given.begin
        head = (LITTLE_ENDIAN + data[STAMP_AT:NAME_AT] + self._name if self._renamed
                else data[:begin])
        if not (self._turns or u or v or t or new_rate != rate_spread
                or new_orientation != orientation_spread):
            return head + data[begin:self._force]
        p, q, r = rate
        if has_rate:
            p, q, r = rate = p - u, q - v, r - t
        if self._turns:
            if has_orientation:
                x, y, z, w = attitude
                attitude = _product(x, y, z, w, *self._quaternion)
            d, e, f, g, h, i, j, k, m = self._turn
            rate = d * p + e * q + f * r, g * p + h * q + i * r, j * p + k * q + m * r
        return head + _FRONT.pack(*attitude, new_orientation, *rate, new_rate)

    def _at_context(self, data: bytes, context: Mapping[str, float]) -> AtReading:
        """Return the calibration at the context of a message, and cache it."""
        around = [context.get(key) for key in self._needs]
        same, self._context, self._around = around == self._around, context, around
        if self._at is not None and same and not self._per_message:
            return self._at
        seconds, nanoseconds = STAMP.unpack_from(data, STAMP_AT)
        rate: Triple = THREE.unpack_from(data, self._rate)
        absent = data[self._rate_spread:self._rate_spread + 8] == _ABSENT
        time = seconds + nanoseconds * 1e-9
        known: dict[str, Any] = {
            **self._neutral, **context, 'time': time, 'std': _NONE, 'previous': _NONE,
            'rate': _NONE if absent or not all(map(math.isfinite, rate)) else rate}
        if self._thermal is not None and 'temperature' in context:
            self._thermal.add(time, context['temperature'])
            known.update(self._thermal.value)
        self._at = self._calibration.at(known)
        return self._at


def _seen(matrix: Any, covariance: bytes, fill: bytes) -> _Seen:
    """Return a covariance C with A C Aᵀ, and `fill` in place of an unknown C."""
    if covariance[:8] == _ABSENT:
        return _Seen(covariance, False, covariance, None)
    either = np.frombuffer(covariance + fill, '<f8').reshape(2, 9)
    found, known = _transformed(np.reshape(matrix, (3, 3)), either)
    for turned in found[known].tolist():
        return _Seen(covariance, True, NINE.pack(*turned), turned)
    return _Seen(covariance, True, _UNKNOWN, None)


def motion_of(data: bytes, layout: Layout, gravity: Floats) -> bytes:
    """Return a serialized Vector3Stamped: the acceleration of a message minus gravity [m/s²]."""
    x, y, z = THREE.unpack_from(data, layout.place(ACCELERATION))
    return data[:layout.begin] + THREE.pack(x - gravity[0], y - gravity[1], z - gravity[2])
