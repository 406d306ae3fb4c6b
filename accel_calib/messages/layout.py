# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The layout of serialized messages.

In both CDR (ROS 2) and the serialization of ROS 1, a message with a header starts with four 32-bit
words: the encapsulation (CDR) or seq (ROS 1), two words of the stamp, and the length of frame_id.
The letters of frame_id follow, and then the doubles: 37 for an Imu, 2 for a Temperature. CDR
aligns the doubles to 8 bytes, counted from the end of the encapsulation, and its length of
frame_id includes a NUL. ROS 1 has no alignment. Padding bytes can have any value.

"""

from __future__ import annotations

from dataclasses import dataclass
import struct
from typing import Any

ORIENTATION = slice(0, 4)
ORIENTATION_COVARIANCE = slice(4, 13)
ANGULAR_VELOCITY = slice(13, 16)
ANGULAR_VELOCITY_COVARIANCE = slice(16, 25)
ACCELERATION = slice(25, 28)
ACCELERATION_COVARIANCE = slice(28, 37)
IMU_DOUBLES = 37
"""Number of doubles of an Imu; the slices above are the places of its fields."""

LITTLE_ENDIAN = b'\x00\x01\x00\x00'
"""Encapsulation of plain little-endian CDR, which all common middlewares send."""

STAMP_AT, NAME_AT, LETTERS_AT = 4, 12, 16
"""Places of the stamp, of the length of frame_id, and of the letters of frame_id."""

THREE, NINE, STAMP = struct.Struct('<3d'), struct.Struct('<9d'), struct.Struct('<iI')


def begin_of(name_length: Any, *, ros2: bool) -> Any:
    """Return the place of the first double for one length of frame_id, or an array of lengths."""
    end = LETTERS_AT + name_length
    return (end - STAMP_AT + 7) // 8 * 8 + STAMP_AT if ros2 else end


@dataclass(frozen=True)
class Layout:
    """
    Layout of the Imu messages with one frame_id, in little-endian CDR.

    Parameters
    ----------
    name : bytes
        Length and letters of frame_id, as in a message.
    begin : int
        Place of the first double.
    size : int
        Length of a message.

    """

    name: bytes
    begin: int
    size: int

    @property
    def name_end(self) -> int:
        """Place after the letters of frame_id."""
        return NAME_AT + len(self.name)

    @property
    def frame_id(self) -> str:
        """Return the frame_id."""
        return self.name[4:-1].decode(errors='replace')

    def place(self, field: slice) -> int:
        """Return the place of a field."""
        return self.begin + 8 * int(field.start)


def layout_with(frame_id: str) -> Layout:
    """Return the layout of messages with this frame_id."""
    letters = frame_id.encode() + b'\x00'
    return _layout_named(len(letters).to_bytes(4, 'little') + letters)


def layout_of(data: bytes) -> Layout | None:
    """Return the layout of a message, or None if it is not a whole Imu in little-endian CDR."""
    length = int.from_bytes(data[NAME_AT:LETTERS_AT], 'little')
    name = data[NAME_AT:LETTERS_AT + length]
    layout = _layout_named(name)
    whole = (data[:4] == LITTLE_ENDIAN and length > 0 and len(name) == 4 + length
             and len(data) == layout.size)
    return layout if whole and name[-1] == 0 else None


def _layout_named(name: bytes) -> Layout:
    begin = begin_of(len(name) - 4, ros2=True)
    return Layout(name, begin, begin + 8 * IMU_DOUBLES)
