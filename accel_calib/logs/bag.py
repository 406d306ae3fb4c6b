# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Open bags without ROS: rosbag2 (folder, mcap, db3) and ROS 1.

Damaged bytes cause many kinds of errors in `rosbags`, also long after the bag is open, and can
take much memory and time. `accel_calib.logs.child` limits and converts them.

A recorder that was killed leaves the last messages of a db3 file in a second file, the journal of
SQLite (``-wal`` or ``-journal``). `rosbags` ignores it. SQLite joins both files, in a copy.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .serialized import frame_ids, IMU_DOUBLES, joined, Messages, samples_of
from ..disk import check_regular
from ..errors import InputError
from ..table import Floats
from ..text import listed, some

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, MessageDefinition
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
_DOUBLES = {IMU: IMU_DOUBLES, TEMPERATURE: 2}
"""Number of doubles of a message; those of a Temperature are temperature and variance."""

BLOCK = 4096
"""Number of messages per block; a block fits in the cache of the processor."""

LARGEST = 1e6
"""Larger accelerations [m/s²] and rates [rad/s] are those of damaged bytes."""

_BLOCK_BYTES = 1 << 24
"""Number of bytes above which a block ends."""

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

        A block has at most `size` messages; large messages make it shorter.

        """
        block: list[Received] = []
        left = _BLOCK_BYTES
        for message in self.reader.messages(connections):
            block.append(message)
            left -= len(message[2])
            if left < 0 or len(block) == size:
                yield block
                block, left = [], _BLOCK_BYTES
        if block:
            yield block

    def first(self, topic: str, msgtype: str = IMU, size: int = 1) -> list[Received]:
        return next(self.blocks(self.connections(topic, msgtype), size), [])

    def joined(self, block: Sequence[Received], topic: str, msgtype: str = IMU, before: int = 0
               ) -> Messages:
        """Return messages of a topic as arrays; `before` is the number of earlier messages."""
        return joined([raw for _, _, raw in block], _DOUBLES[msgtype], f'{self.path}, {topic}',
                      ros2=self.ros2, before=before)

    def frame_id(self, topic: str, msgtype: str = IMU) -> str:
        """Return the frame_id of the first message of a topic; of an Imu there must be one."""
        block = self.first(topic, msgtype)
        if not block and msgtype == IMU:
            raise InputError(f'{self.path} has no message on {topic}, expected Imu messages',
                             'record while the sensor publishes')
        return frame_ids(self.joined(block, topic, msgtype))[0] if block else ''

    def numbers(self, connection: Connection) -> tuple[str, ...]:
        """Return the paths of the single numbers of a message, without headers and times."""
        from rosbags.interfaces import Nodetype

        types = types_of(connection.msgdef, connection.msgtype, self.ros2).fielddefs

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
            every = some(sorted({f'{c.topic} ({c.msgtype})' for c in self.reader.connections}))
            raise InputError(f'{self.path} has {every or "no topics"}, expected a topic of type '
                             f'{IMU}', 'record the Imu topic')
        if topic not in topics and (topic or len(topics) > 1):
            found = (f'has the Imu topics {some(topics)}, expected {topic}' if topic else
                     f'has {len(topics)} Imu topics, expected one: {some(topics)}')
            raise InputError(f'{self.path} {found}', 'choose one of them with --topic')
        return topic or topics[0]

    def lost(self, topic: str, found: int) -> list[str]:
        """Return a note if fewer messages of a topic were found than the bag states."""
        stated = self.count(topic)
        return [f'{stated - found} of {stated} messages on {topic} are lost: the index of '
                f'{self.path} states them, but they are not in the bag'
                ] if found < stated else []


def imus_of(messages: Messages, name: str, before: int, sensor: str, *, chosen: bool = False
            ) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """
    Return Imu messages as columns of a recording, and which are of a sensor.

    For errors, `name` is the bag and the topic, and `before` the number of earlier messages.
    Messages of another sensor are an InputError unless the user chose the sensor. So are an
    acceleration that is not finite, and a number beyond any sensor.

    """
    names = frame_ids(messages)
    same = np.array([each == sensor for each in names])
    if not chosen and not np.all(same):
        first = int(np.argmin(same))
        raise InputError(f'{name}: message {before + first + 1} is from the sensor '
                         f'{names[first]!r}, expected {sensor!r} as before',
                         'capture and refine choose one with --sensor; apply needs a topic for '
                         'each sensor')
    columns = samples_of(messages)
    for key, what in (('reading', 'acceleration'), ('rate', 'angular velocity')):
        values = columns[key] if key == 'reading' else np.nan_to_num(columns[key])
        sound = np.all(np.abs(values) < LARGEST, axis=1)
        if not np.all(sound):
            first = int(np.argmin(sound))
            found = ('contains NaN or infinity' if not np.all(np.isfinite(values[first])) else
                     f'has the {what} {np.max(np.abs(values[first])):.3g}')
            raise InputError(f'{name}: Imu message {before + first + 1} {found}, expected finite '
                             f'numbers below {LARGEST:g}', 'fix the driver, or record again')
    return columns, np.broadcast_to(same, len(messages))


@cache
def types_of(definition: MessageDefinition, msgtype: str, ros2: bool) -> Typestore:
    """Return the types that the bag defines for a type of messages, or else the usual ones."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

    text = definition.data
    if not text:
        return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
    store = get_typestore(Stores.EMPTY)
    if definition.format.name == 'MSG':
        store.register(get_types_from_msg(text, msgtype))
        return store
    types, parts = {}, text.split(80 * '=' + '\n')  # a line before each type, in IDL
    for part in [part.partition('\n')[2] for part in parts[1:]] or parts:
        types.update(get_types_from_idl(part))
    store.register(types)
    return store


# ----------------------------------------------------------------------------- files of a bag

@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading; for a bag of somebody else, in a child process.

    It is read in a copy if SQLite cannot read it as it is. Damage raises errors of any class, also
    later, while the bag is read.

    """
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    source, stored, notes = path, [path], list[str]()
    if path.is_dir():
        for each in path.iterdir():
            if each.exists() and not each.is_dir():  # `rosbags` would wait for a pipe
                check_regular(each)
        stored = sorted(each for each in path.iterdir() if each.suffix in ('.mcap', '.db3'))
        metadata = path / 'metadata.yaml'
        if metadata.exists():
            text = metadata.read_text(encoding='utf-8', errors='replace')
            lost = [each.name for each in stored if each.name not in text]
            if 0 < len(lost) < len(stored):
                notes = [f'metadata.yaml of {path} does not list {listed("file", lost)}: the '
                         'messages there are not read; ros2 bag reindex lists all files']
        elif not stored:
            raise InputError(f'{path} is a folder without a bag, expected a rosbag2 folder or a '
                             'file', 'choose a file in it')
        elif len(stored) == 1:
            notes = [f'{path} has no metadata.yaml, as after a recorder was killed; '
                     f'{stored[0].name} is read without it']
            source, = stored
    databases = [each for each in stored if each.suffix == '.db3']
    journals = [journal for each in databases for suffix in ('-wal', '-journal')
                if (journal := each.with_name(each.name + suffix)).is_file()
                and journal.stat().st_size]
    if journals:
        notes.append('the recorder was killed; its last messages are read from '
                     f'{", ".join(each.name for each in journals)}')
    with ExitStack() as stack:
        if databases:
            source = _copied(source, databases, journals, stack)
        ros2 = path.suffix != '.bag'
        reader: Any = stack.enter_context((Reader2 if ros2 else Reader1)(source))
        yield Bag(path, reader, ros2, tuple(notes))


def _copied(path: Path, databases: Sequence[Path], journals: Sequence[Path], stack: ExitStack
            ) -> Path:
    """
    Return a bag in a temporary folder: databases joined with their journals, and links.

    The name of a db3 file there has no letters that `rosbags` would have to escape in a URI.

    """
    made = Path(stack.enter_context(TemporaryDirectory(prefix='accel_calib_'))) / 'bag.db3'
    if path.is_dir():
        made.mkdir()
    for each in path.iterdir() if path.is_dir() else [path, *journals]:
        copy = Path(f'{made}{str(each).removeprefix(str(path))}')
        if journals and each in (*databases, *journals):
            shutil.copyfile(each, copy)
        elif not each.name.endswith('-shm'):
            copy.symlink_to(each.absolute())
    for each in databases if journals else ():
        with closing(sqlite3.connect(f'{made}{str(each).removeprefix(str(path))}')) as database:
            database.execute('PRAGMA journal_mode = DELETE').fetchone()
    return made
