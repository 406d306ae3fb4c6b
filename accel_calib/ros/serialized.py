# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized Imu messages: what is where in them.

In CDR a sensor_msgs/Imu is 4 bytes that tell the encoding, the stamp, the length of frame_id with
its NUL, frame_id, padding up to a multiple of 8 behind the first four, and the 37 doubles of
`accel_calib.imu`. What a driver sends has the same frame_id each time, so the `Layout` of one
message is that of the next, and to check it is to compare a few bytes. Padding holds garbage.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
import struct
from typing import Any, TYPE_CHECKING

import numpy as np

from .. import imu

if TYPE_CHECKING:
    from ..table import Floats

LITTLE_ENDIAN = b'\x00\x01\x00\x00'
"""Encapsulation header of plain CDR in little endian, the only encoding that is read here."""

NAME_AT = 12
"""Where the length of frame_id is."""

THREE, NINE, STAMP = struct.Struct('<3d'), struct.Struct('<9d'), struct.Struct('<iI')

_FIELDS_SIZE = 8 * imu.FIELDS


@dataclass(frozen=True)
class Layout:
    """
    Where things are in the messages of a driver.

    Parameters
    ----------
    name : bytes
        Length and letters of frame_id, as they are in the message.
    name_end : int
        Where frame_id ends.
    begin : int
        Where the 37 doubles begin.
    size : int
        Length of a message.

    """

    name: bytes
    name_end: int
    begin: int
    size: int

    @property
    def frame_id(self) -> str:
        """Give frame_id."""
        return self.name[4:-1].decode(errors='replace')

    @cached_property
    def kind(self) -> np.dtype[np.void]:
        """Give the message as a type of numpy."""
        return np.dtype({'names': ['sec', 'nanosec', 'fields'],
                         'formats': ['<i4', '<u4', f'<{imu.FIELDS}f8'],
                         'offsets': [4, 8, self.begin], 'itemsize': self.size})


def _layout_named(name: bytes) -> Layout:
    begin = 4 + -(-(NAME_AT - 4 + len(name)) // 8) * 8
    return Layout(name, NAME_AT + len(name), begin, begin + _FIELDS_SIZE)


def layout_with(frame_id: str) -> Layout:
    """Give the layout of messages with this frame_id."""
    letters = frame_id.encode() + b'\x00'
    name = len(letters).to_bytes(4, 'little') + letters
    return _layout_named(name)


def layout_of(data: bytes) -> Layout | None:
    """Give the layout of a message; None where it is not a whole Imu in little-endian CDR."""
    if data[:4] != LITTLE_ENDIAN:
        return None
    length = int.from_bytes(data[NAME_AT:NAME_AT + 4], 'little')
    name = data[NAME_AT:NAME_AT + 4 + length]
    layout = _layout_named(name)
    whole = len(data) == layout.size and length > 0 and len(name) == 4 + length
    return layout if whole and name[-1] == 0 else None


def rows_of(messages: Sequence[bytes], layout: Layout, temperature: Sequence[float]) -> Floats:
    """
    Give messages of one layout as the samples of the capture.

    Parameters
    ----------
    messages : sequence of bytes
        Messages.
    layout : Layout
        Of all of them.
    temperature : sequence of float
        The last one before each message [°C]; NaN: not known.

    Returns
    -------
    (n, 9) array
        Time [s], reading, rate (NaN: none), temperature, supply voltage (NaN).

    """
    found = np.frombuffer(b''.join(messages), layout.kind)
    fields = found['fields']
    rows = np.empty((len(messages), 9))
    rows[:, 0] = found['sec'] + found['nanosec'] * 1e-9
    rows[:, 1:4] = fields[:, imu.ACCELERATION]
    rows[:, 4:7] = fields[:, imu.ANGULAR_VELOCITY]
    absent = fields[:, imu.ANGULAR_VELOCITY_COVARIANCE.start] == -1.0
    rows[absent | ~are_finite(rows[:, 4:7]), 4:7] = np.nan
    rows[:, 7], rows[:, 8] = temperature, np.nan
    return rows


def are_finite(vectors: Floats) -> Any:
    """Say of (n, 3) vectors whether their numbers are finite, as `conversion.is_finite` does."""
    return np.isfinite(vectors[:, 0] + vectors[:, 1] + vectors[:, 2])


def is_finite(data: bytes, layout: Layout) -> bool:
    """Say whether the acceleration of a message is finite."""
    x, y, z = THREE.unpack_from(data, layout.begin + 8 * imu.ACCELERATION.start)
    return math.isfinite(x + y + z)


def motion_of(data: bytes, layout: Layout, gravity: Floats) -> bytes:
    """Give the Vector3Stamped of a corrected message without gravity."""
    x, y, z = THREE.unpack_from(data, layout.begin + 8 * imu.ACCELERATION.start)
    return data[:layout.begin] + THREE.pack(x - gravity[0], y - gravity[1], z - gravity[2])
