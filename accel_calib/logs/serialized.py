# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The layout of serialized messages, one by one and as arrays.

In both CDR (ROS 2) and the serialization of ROS 1, a message with a header starts with four 32-bit
words: the encapsulation (CDR) or seq (ROS 1), two words of the stamp, and the length of frame_id.
The letters of frame_id follow, and then the doubles: 37 for an Imu, 2 for a Temperature. CDR
aligns the doubles to 8 bytes, counted from the end of the encapsulation, and its length of
frame_id includes a NUL. ROS 1 has no alignment. Padding bytes can have any value.

The messages of a bag can differ in the length of frame_id and in the byte order. Both are
therefore read from each message. ROS 1 messages are always little endian. CDR messages are little
endian if the second byte of the encapsulation is 1.

"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import struct
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..errors import InputError
from ..table import Floats

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

    `name` is length and letters of frame_id as in a message, `begin` the place of the first
    double, and `size` the length of a message.

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
        return self.name[4:-1].decode(errors='replace')

    def place(self, field: slice) -> int:
        return self.begin + 8 * int(field.start)


def layout_with(frame_id: str) -> Layout:
    """Return the layout of messages with this frame_id."""
    letters = frame_id.encode() + b'\x00'
    begin = begin_of(len(letters), ros2=True)
    return Layout(len(letters).to_bytes(4, 'little') + letters, begin, begin + 8 * IMU_DOUBLES)


def layout_of(data: bytes) -> Layout | None:
    """Return the layout of a message, or None if it is not a whole Imu in little-endian CDR."""
    length = int.from_bytes(data[NAME_AT:LETTERS_AT], 'little')
    name = data[NAME_AT:LETTERS_AT + length]
    begin = begin_of(len(name) - 4, ros2=True)
    layout = Layout(name, begin, begin + 8 * IMU_DOUBLES)
    whole = (data[:4] == LITTLE_ENDIAN and length > 0 and len(name) == 4 + length
             and len(data) == layout.size)
    return layout if whole and name[-1] == 0 else None


Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

NANO = 1e-9


@dataclass(frozen=True)
class Messages:
    """
    Serialized messages with a header and doubles, in one buffer; `joined` makes them.

    `start`, `stop` and `begin` (n,) are the places of the beginning, the end and the first double
    of each message, `head` (n, 4) its first four words, and `swapped` (n,) whether it is big
    endian. Messages of ROS 1 are not CDR.

    """

    data: Bytes
    start: Indices
    stop: Indices
    head: NDArray[np.uint32]
    begin: Indices
    swapped: NDArray[np.bool_]
    ros2: bool

    def __len__(self) -> int:
        return len(self.start)

    def each(self) -> Iterator[memoryview]:
        """Yield the messages one by one."""
        data = self.data.data
        for start, stop in zip(self.start.tolist(), self.stop.tolist(), strict=True):
            yield data[start:stop]


def joined(raws: Sequence[bytes | memoryview], doubles: int, name: str, *, ros2: bool = True,
           before: int = 0) -> Messages:
    """
    Copy messages with a header and this number of doubles into one writable buffer.

    For errors, `name` is the topic, and `before` the number of its earlier messages.

    Raises
    ------
    InputError
        If the length of a message does not match its header, or it is not plain CDR.

    """
    stop = np.cumsum(np.fromiter(map(len, raws), np.int64, len(raws)))
    start = np.concatenate([np.zeros(1, np.int64), stop])[:-1]
    data = np.frombuffer(bytearray().join(raws), np.uint8)
    size = stop - start
    _check(size >= LETTERS_AT + 8 * doubles, size, name, before)
    head = sliding_window_view(data, LETTERS_AT)[start].view('<u4')
    swapped = np.zeros(len(raws), dtype=bool)
    if ros2:
        swapped = head[:, 0] & 0xffff == 0
        _check(swapped | (head[:, 0] & 0xffff == 0x100), size, name, before)
        if np.any(swapped):
            head[swapped] = head[swapped].byteswap()
    begin = begin_of(head[:, 3].astype(np.int64), ros2=ros2)
    extra = size - begin - 8 * doubles
    # A CDR message may end with up to 3 bytes of padding.
    _check((extra >= 0) & (extra <= (3 if ros2 else 0)), size, name, before)
    return Messages(data=data, start=start, stop=stop, head=head, begin=start + begin,
                    swapped=swapped, ros2=ros2)


def _check(sound: NDArray[np.bool_], size: Indices, name: str, before: int) -> None:
    if not np.all(sound):
        first = int(np.argmin(sound))
        raise InputError(f'{name}: message {before + first + 1} of {size[first]} bytes is '
                         'damaged, expected a whole message',
                         'remove it from the bag, or record again')


def stamps_of(messages: Messages) -> Floats:
    """Return the header stamps [s]."""
    seconds = messages.head[:, 1]
    signed = seconds.view(np.int32) if messages.ros2 else seconds
    return signed + messages.head[:, 2] * NANO


def frame_ids(messages: Messages) -> list[str]:
    """Return the frame_id of each message; only one item if all are equal."""
    length, first = messages.head[:, 3].astype(np.int64), messages.start + LETTERS_AT
    if np.all(length == length[0]):
        names = sliding_window_view(messages.data, int(length[0]))[first]
        if np.all(names == names[0]):
            length, first = length[:1], first[:1]
    return [messages.data[place:place + size].tobytes().rstrip(b'\0').decode(errors='replace')
            for place, size in zip(first.tolist(), length.tolist(), strict=True)]


def doubles_at(messages: Messages, which: slice) -> Floats:
    """Return a slice of the doubles of each message, (n, k)."""
    width = 8 * (which.stop - which.start)
    begin = messages.begin + 8 * which.start
    values = sliding_window_view(messages.data, width)[begin].view('<f8')
    if np.any(messages.swapped):
        values[messages.swapped] = values[messages.swapped].byteswap()
    return values


def put_doubles(messages: Messages, values: Floats) -> None:
    """Write all (n, k) doubles into the buffer of the messages."""
    stored = np.ascontiguousarray(values, '<f8')
    if np.any(messages.swapped):
        stored = np.where(messages.swapped[:, np.newaxis], stored.byteswap(), stored)
    rows = stored.view(np.uint8)
    sliding_window_view(messages.data, rows.shape[1], writeable=True)[messages.begin] = rows


def renamed(messages: Messages, frame_id: str) -> Messages:
    """Return Imu messages with another frame_id, in a new buffer."""
    letters = frame_id.encode() + (b'\0' if messages.ros2 else b'')
    begin = int(begin_of(len(letters), ros2=messages.ros2))
    size = begin + 8 * IMU_DOUBLES
    rows = np.zeros((len(messages), size), np.uint8)
    rows[:, :LETTERS_AT] = sliding_window_view(messages.data, LETTERS_AT)[messages.start]
    length = np.where(messages.swapped, np.uint32(len(letters)).byteswap(), len(letters))
    rows[:, NAME_AT:LETTERS_AT] = length.astype('<u4')[:, np.newaxis].view(np.uint8)
    rows[:, LETTERS_AT:LETTERS_AT + len(letters)] = np.frombuffer(letters, np.uint8)
    rows[:, begin:] = sliding_window_view(messages.data, size - begin)[messages.begin]
    start, head = np.arange(len(messages)) * size, messages.head.copy()
    head[:, 3] = len(letters)
    return replace(messages, data=rows.ravel(), start=start, stop=start + size, head=head,
                   begin=start + begin)


def samples_of(messages: Messages) -> dict[str, Floats]:
    """
    Return Imu messages as columns of `accel_calib.table`.

    They are ``time`` (n,) [s], ``reading`` (n, 3) and ``rate`` (n, 3) [rad/s], which is NaN for a
    message without a rate.

    """
    rate = doubles_at(messages, ANGULAR_VELOCITY)
    first = ANGULAR_VELOCITY_COVARIANCE.start
    absent = doubles_at(messages, slice(first, first + 1))[:, 0] == -1.0
    rate[absent | ~np.isfinite(rate).all(axis=1)] = np.nan
    return {'time': stamps_of(messages), 'reading': doubles_at(messages, ACCELERATION),
            'rate': rate}
