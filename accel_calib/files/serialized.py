# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized messages as arrays: many in one buffer, none of them deserialized by itself.

Both in CDR (ROS 2) and in the serialization of ROS 1 a message with a header begins with four
32-bit words, which are the encapsulation (CDR) or seq (ROS 1), the two of the stamp, and the
length of frame_id; frame_id follows. Then come the doubles: 37 of an Imu, as in `accel_calib.imu`,
two of a Temperature. CDR aligns them to 8 bytes, counted from behind the encapsulation, whose
second byte is 1 where the message is little endian. ROS 1 aligns nothing and is little endian.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..errors import InputError
from ..table import Floats

Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

_WORDS = 4
_HEAD = 4 * _WORDS
_ENCAPSULATION = 4
_TRAILING = 3  # bytes of padding that a CDR message may end with
_NANO = 1e-9


@dataclass(frozen=True)
class Messages:
    """
    Serialized messages of one type, in one buffer.

    Parameters
    ----------
    data : (m,) array of bytes
        The buffer.
    start, stop : (n,) array
        Where each message begins and ends, in any order.
    ros2 : bool
        CDR, otherwise the serialization of ROS 1.

    """

    data: Bytes
    start: Indices
    stop: Indices
    ros2: bool

    def __len__(self) -> int:
        return len(self.start)

    def take(self, which: slice | Indices) -> Messages:
        """Give some of the messages, in the same buffer."""
        return Messages(self.data, self.start[which], self.stop[which], self.ros2)

    def each(self) -> Iterator[memoryview]:
        """Give the messages one by one."""
        data = self.data.data
        for start, stop in zip(self.start.tolist(), self.stop.tolist(), strict=True):
            yield data[start:stop]


@dataclass(frozen=True)
class Layout:
    """
    Where things are in messages.

    Parameters
    ----------
    head : (n, 4) array of uint32
        The first four words.
    place : (n,) array
        Where the doubles begin in the buffer.
    swapped : (n,) array of bool
        True where the message is big endian.

    """

    head: NDArray[np.uint32]
    place: Indices
    swapped: NDArray[np.bool_]


def joined(raws: Sequence[bytes | memoryview], *, ros2: bool) -> Messages:
    """Put messages into one buffer, which can be written to."""
    stop = np.cumsum(np.fromiter(map(len, raws), np.int64, len(raws)))
    start = np.concatenate([np.zeros(1, np.int64), stop])[:-1]
    return Messages(np.frombuffer(bytearray().join(raws), np.uint8), start, stop, ros2)


def merged(first: Messages, second: Messages) -> Messages:
    """Put the messages of two buffers into one."""
    shift = len(first.data)
    return Messages(np.concatenate([first.data, second.data]),
                    np.concatenate([first.start, second.start + shift]),
                    np.concatenate([first.stop, second.stop + shift]), first.ros2)


def layout_of(messages: Messages, doubles: int, name: str, before: int = 0) -> Layout:
    """
    Find the header and the doubles of messages.

    Parameters
    ----------
    messages : Messages
        Of a type with a header and so many doubles.
    doubles : int
        How many.
    name : str
        What to call the topic where a message is broken.
    before : int
        Messages of the topic that came before these.

    Raises
    ------
    InputError
        If a message is shorter or longer than its header says, or is not plain CDR.

    """
    size = messages.stop - messages.start
    _check(size >= _HEAD + 8 * doubles, size, name, before)
    head = rows_at(messages.data, messages.start, _HEAD).view('<u4')
    swapped = np.zeros(len(messages), dtype=bool)
    if messages.ros2:
        swapped = head[:, 0] & 0xffff == 0
        _check(swapped | (head[:, 0] & 0xffff == 0x100), size, name, before)
        if np.any(swapped):
            head[swapped] = head[swapped].byteswap()
    offset = head[:, 3].astype(np.int64) + _HEAD
    if messages.ros2:
        offset = (offset - _ENCAPSULATION + 7) // 8 * 8 + _ENCAPSULATION
    extra = size - offset - 8 * doubles
    _check((extra >= 0) & (extra <= (_TRAILING if messages.ros2 else 0)), size, name, before)
    return Layout(head, messages.start + offset, swapped)


def _check(sound: NDArray[np.bool_], size: Indices, name: str, before: int) -> None:
    """Refuse messages that are not sound, and name the first."""
    if not np.all(sound):
        first = int(np.argmin(sound))
        raise InputError(f'{name}: message {before + first + 1}, of {size[first]} bytes, is not '
                         'whole', 'take it out of the bag, or record again')


def stamps_of(messages: Messages, layout: Layout) -> Floats:
    """Give the header stamps [s]."""
    seconds = layout.head[:, 1]
    signed = seconds.view(np.int32) if messages.ros2 else seconds
    return signed + layout.head[:, 2] * _NANO


def frame_id_of(messages: Messages, layout: Layout) -> str:
    """Give the frame_id of the first message."""
    begin = int(messages.start[0]) + _HEAD
    text = messages.data[begin:begin + int(layout.head[0, 3])].tobytes()
    return text.rstrip(b'\0').decode(errors='replace')


def doubles_at(messages: Messages, layout: Layout, which: slice) -> Floats:
    """Give these of the doubles, (n, k)."""
    width = 8 * (which.stop - which.start)
    values = rows_at(messages.data, layout.place + 8 * which.start, width).view('<f8')
    if np.any(layout.swapped):
        values[layout.swapped] = values[layout.swapped].byteswap()
    return values


def put_doubles(messages: Messages, layout: Layout, values: Floats) -> None:
    """Write all doubles, (n, k), into the buffer of the messages."""
    stored = np.ascontiguousarray(values, '<f8')
    if np.any(layout.swapped):
        stored = np.where(layout.swapped[:, np.newaxis], stored.byteswap(), stored)
    rows = stored.view(np.uint8)
    sliding_window_view(messages.data, rows.shape[1], writeable=True)[layout.place] = rows


def rows_at(data: Bytes, place: Indices, width: int) -> Bytes:
    """Give so many bytes from each place on, (n, width)."""
    if not len(place):
        return np.empty((0, width), np.uint8)
    return sliding_window_view(data, width)[place]
