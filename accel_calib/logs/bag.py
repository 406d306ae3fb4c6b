# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Open bags without ROS: rosbag2 (folder, mcap, db3) and ROS 1.

Damaged bytes cause many kinds of errors in `rosbags`, also long after the bag is open.
`damage_as_input_error` is the only place that converts them.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, TYPE_CHECKING
import warnings

import numpy as np
from numpy.typing import NDArray

from .containers import damage_refused
from .serialized import frame_ids, IMU_DOUBLES, joined, Messages, samples_of
from ..disk import check_regular
from ..errors import InputError
from ..table import Floats
from ..text import some

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

IMU = 'sensor_msgs/msg/Imu'
BLOCK = 4096
"""Number of messages per block; a block fits in the cache of the processor."""

LARGEST = 1e6
"""Larger accelerations [m/s²] and rates [rad/s] are those of damaged bytes."""

_BLOCK_BYTES = 1 << 24
_AT_ONCE = 64
"""Number of bytes above which a block ends, and of messages after which they are counted."""

NUMBERS = ('float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64',
           'uint64')
_TIMES = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')

Received = tuple['Connection', int, bytes]
"""Connection, time of receipt [ns] and serialized message."""


@dataclass(frozen=True)
class Bag:
    """
    An open bag; `open_bag` makes it.

    Notes state which parts of the bag are not read or were recovered.

    """

    path: Path
    reader: Reader1 | Reader2
    ros2: bool
    notes: tuple[str, ...] = ()

    def topics(self, msgtype: str) -> list[str]:
        return sorted({c.topic for c in self.reader.connections if c.msgtype == msgtype})

    def connections(self, topic: str, msgtype: str = IMU) -> list[Connection]:
        """Return the connections of a topic; a topic can have several."""
        return [c for c in self.reader.connections if (c.topic, c.msgtype) == (topic, msgtype)]

    def count(self, topic: str) -> int:
        """Return the number of Imu messages of a topic, according to the index of the bag."""
        return sum(connection.msgcount for connection in self.connections(topic))

    @property
    def stored(self) -> int:
        """Return the number of all messages, according to the files rather than metadata.yaml."""
        storage = getattr(self.reader, 'storage', self.reader)
        return sum(connection.msgcount for file in getattr(storage, 'storages', [storage])
                   for connection in file.connections)

    def blocks(self, connections: Sequence[Connection] = (), size: int = BLOCK
               ) -> Iterator[list[Received]]:
        """
        Yield blocks of messages, in order of receipt; by default those of all connections.

        A block has at most `size` messages; large messages make it shorter. A damaged bag is an
        InputError.

        """
        sound = damage_as_input_error(self.path)
        messages = sound(self.reader.messages)(connections)
        yield from iter(sound(partial(_next_block, messages, size)), [])

    def first(self, topic: str, msgtype: str = IMU, size: int = 1) -> list[Received]:
        return next(self.blocks(self.connections(topic, msgtype), size), [])

    def joined(self, raws: Sequence[bytes], topic: str, before: int, doubles: int = IMU_DOUBLES
               ) -> Messages:
        """Return messages of a topic as arrays; `before` is the number of earlier messages."""
        return joined(raws, doubles, f'{self.path}, {topic}', ros2=self.ros2, before=before)

    def fields(self, msgtype: str, field: str, block: Sequence[Received]) -> list[tuple[Any, Any]]:
        """Return stamp of the header (or None) and value of a field such as ``status.voltage``."""
        with damage_as_input_error(self.path):
            store = _types(block[0][0], ros2=self.ros2)
            read = store.deserialize_cdr if self.ros2 else store.deserialize_ros1
            rows = []
            for _, _, raw in block:
                value: Any = read(raw, msgtype)
                stamp = getattr(getattr(value, 'header', None), 'stamp', None)
                for name in field.split('.'):
                    value = getattr(value, name)
                rows.append((stamp, value))
            return rows

    def numbers(self, connection: Connection) -> tuple[str, ...]:
        """Return the paths of the single numbers of a message, without headers and times."""
        from rosbags.interfaces import Nodetype

        with damage_as_input_error(self.path):
            types = _types(connection, ros2=self.ros2).fielddefs

            def below(msgtype: str, path: tuple[str, ...]) -> Iterator[str]:
                for name, (kind, about) in types[msgtype][1]:
                    if kind == Nodetype.BASE and str(about[0]) in NUMBERS:
                        yield '.'.join((*path, name))
                    elif kind == Nodetype.NAME and str(about) not in _TIMES:
                        yield from below(str(about), (*path, name))

            known = connection.msgtype in types
            return tuple(below(connection.msgtype, ())) if known else ()

    # -------------------------------------------------------------------------- Imu messages

    def imu_topic(self, topic: str = '') -> str:
        """Return the Imu topic, or check the given one; it must be one that the bag has."""
        topics = self.topics(IMU)
        if not topics:
            others = sorted(f'{c.topic} ({c.msgtype})' for c in self.reader.connections)
            raise InputError(f'{self.path} has {some(others) or "no topics"}, expected a topic of '
                             f'type {IMU}', 'record the Imu topic')
        if topic not in topics and (topic or len(topics) > 1):
            found = (f'has the Imu topics {some(topics)}, expected {topic}' if topic else
                     f'has {len(topics)} Imu topics, expected one: {some(topics)}')
            raise InputError(f'{self.path} {found}', 'choose one of them with --topic')
        return topic or topics[0]

    def first_frame_id(self, topic: str) -> str:
        """Return the frame_id of the first message of an Imu topic; there must be one."""
        block = self.first(topic)
        if not block:
            raise InputError(f'{self.path} has no message on {topic}, expected Imu messages',
                             'record while the sensor publishes')
        return frame_ids(self.joined([block[0][2]], topic, 0))[0]

    def imus(self, raws: Sequence[bytes], topic: str, before: int, sensor: str, *,
             chosen: bool = False) -> tuple[Messages, dict[str, Floats], NDArray[np.bool_]]:
        """
        Return Imu messages as arrays and as columns of a recording, and which are of a sensor.

        Messages of another sensor are an InputError unless the user chose the sensor. So are an
        acceleration that is not finite, and a number beyond any sensor.

        """
        messages = self.joined(raws, topic, before)
        names = frame_ids(messages)
        same = np.array([name == sensor for name in names])
        if not chosen and not np.all(same):
            first = int(np.argmin(same))
            raise InputError(f'{self.path}, {topic}: message {before + first + 1} is from the '
                             f'sensor {names[first]!r}, expected {sensor!r} as before',
                             'capture and refine choose one with --sensor; apply needs a topic '
                             'for each sensor')
        columns = samples_of(messages)
        self._check_plausible(columns['reading'], 'acceleration', before)
        self._check_plausible(np.nan_to_num(columns['rate']), 'angular velocity', before)
        return messages, columns, np.broadcast_to(same, len(messages))

    def _check_plausible(self, values: Floats, what: str, before: int) -> None:
        sound = np.all(np.abs(values) < LARGEST, axis=1)
        if not np.all(sound):
            first = int(np.argmin(sound))
            found = ('contains NaN or infinity' if not np.all(np.isfinite(values[first])) else
                     f'has the {what} {np.max(np.abs(values[first])):.3g}')
            raise InputError(f'{self.path}: Imu message {before + first + 1} {found}, expected '
                             f'finite numbers below {LARGEST:g}',
                             'fix the driver, or record again')

    def lost(self, topic: str, found: int) -> list[str]:
        """Return a note if fewer messages of a topic were found than the bag states."""
        stated = self.count(topic)
        return [f'{stated - found} of {stated} messages on {topic} are lost: the index of '
                f'{self.path} states them, but they are not in the bag'
                ] if found < stated else []


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading.

    Raises
    ------
    InputError
        If the bag is damaged; also later, while it is read.

    """
    from .bounded_bags import readable, Reader1, Reader2

    if not path.is_dir():
        check_regular(path)
    ros2 = path.suffix != '.bag'
    with ExitStack() as stack:
        with damage_as_input_error(path):
            source, notes = readable(path, stack)
            with warnings.catch_warnings():
                warnings.simplefilter('ignore')  # of the YAML of damaged metadata
                reader = (Reader2 if ros2 else Reader1)(source)
                reader.open()
            stack.callback(damage_as_input_error(path)(reader.close))
            _check(reader)
        yield Bag(path, reader, ros2, tuple(notes))


@contextmanager
def damage_as_input_error(path: Path) -> Iterator[None]:
    """Convert errors of `rosbags` to InputError; only calls of `rosbags` belong inside."""
    inside = ' or the .mcap or .db3 file inside it' if path.is_dir() else ''
    with damage_refused(f'{path} is damaged or not a bag', 'a rosbag2 folder, .mcap, .db3 or .bag',
                        f'use another file{inside}; ros2 bag reindex may repair this one'):
        yield


def _check(reader: Any) -> None:
    """Check the types of what `rosbags` reads from YAML or SQLite as stored."""
    files = getattr(getattr(reader, 'storage', None), 'files', [])
    if not isinstance(files, list):  # `rosbags` clears this list when it closes the bag
        raise ValueError(f'files in metadata.yaml is {files!r}')
    for connection in reader.connections:
        topic, msgtype, count = connection.topic, connection.msgtype, connection.msgcount
        if not (isinstance(topic, str) and isinstance(msgtype, str)):
            raise ValueError(f'a topic has the name {topic!r} and the type {msgtype!r}')
        if not isinstance(count, int) or count < 0:
            raise ValueError(f'topic {topic} has {count!r} messages')


def _next_block(messages: Iterator[Received], size: int) -> list[Received]:
    """Return the next messages: at most `size`, and not many more bytes than `_BLOCK_BYTES`."""
    block: list[Received] = []
    left = _BLOCK_BYTES
    while left > 0 and len(block) < size:
        part = list(islice(messages, min(_AT_ONCE, size - len(block))))
        _check_messages(part)
        if not part:
            break
        block += part
        left -= sum(len(raw) for _, _, raw in part)
    return block


def _check_messages(block: Sequence[tuple[Any, Any, Any]]) -> None:
    """Check the types of messages, which SQLite returns as stored."""
    for kinds, position, what in (((int,), 1, 'time of receipt'),
                                  ((bytes, memoryview, bytearray), 2, 'content')):
        if not {type(message[position]) for message in block} <= {*kinds}:
            bad = next(message for message in block if type(message[position]) not in kinds)
            cell = bad[position]
            raise ValueError(f'a message on {bad[0].topic} has the {what} '
                             f'{cell[:20] if isinstance(cell, (str, bytes)) else cell!r}')


def _types(connection: Connection, *, ros2: bool) -> Typestore:
    """Return the types of a connection: those that the bag defines, otherwise the usual ones."""
    from rosbags.typesys import get_typestore, Stores

    definition = connection.msgdef
    if definition.data:
        return _defined(definition.format.name, definition.data, connection.msgtype)
    return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)


@cache
def _defined(kind: str, text: str, msgtype: str) -> Typestore:
    """Return the types in a definition; an IDL definition has a line before each type."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

    store = get_typestore(Stores.EMPTY)
    if kind == 'MSG':
        store.register(get_types_from_msg(text, msgtype))
        return store
    types, parts = {}, text.split(80 * '=' + '\n')
    for part in [part.partition('\n')[2] for part in parts[1:]] or parts:
        types.update(get_types_from_idl(part))
    store.register(types)
    return store
