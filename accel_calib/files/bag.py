# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags of every kind: rosbag2 (folder, mcap, db3) and ROS 1, without ROS.

The messages of a topic come in blocks, as they are serialized: by chunks from MCAP files and by
rows from SQLite files. ROS 1 bags, rosbag2 whose files or messages are compressed, and MCAP files
of unusual make go message by message through `rosbags`, which also says what is wrong with a bag.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, ExitStack
from itertools import islice
from pathlib import Path
import sqlite3
import struct
from typing import TYPE_CHECKING

from . import db3, mcap_messages
from .bag_index import index_of, Topics
from .serialized import joined, Messages
from ..errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
SUFFIXES = ('.bag', '.mcap', '.db3')
BLOCK = 16384
"""Messages that go together where they come one by one."""


def is_bag(path: Path) -> bool:
    """Tell a bag from a table by its name."""
    return path.is_dir() or path.suffix in SUFFIXES


class Bag:
    """
    An open bag; made by `open_bag`.

    Attributes
    ----------
    path : Path
        File or folder.
    ros2 : bool
        False for a ROS 1 bag.
    files : list of Path
        The files of a rosbag2 that hold its messages as they are; none of another bag.
    topics : mapping of (str, str) to int
        By name and type, how many messages to expect.

    """

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._stack = stack
        self._reader: AnyReader | None = None
        self.path = path
        self.ros2 = path.suffix != '.bag'
        index = index_of(path)
        self.files = [] if index is None else index.files
        self.topics = self._counted() if index is None else index.topics

    @property
    def reader(self) -> AnyReader:
        """Open the bag with `rosbags`, which first goes through all of an SQLite file."""
        if self._reader is None:
            self._reader = _reader(self.path)
            self._stack.callback(self._reader.close)
        return self._reader

    def _counted(self) -> Topics:
        counts: Topics = {}
        for each in self.reader.connections:
            key = each.topic, each.msgtype
            counts[key] = counts.get(key, 0) + each.msgcount
        return counts

    def of_type(self, msgtype: str) -> list[str]:
        """Give the topics of a type, sorted."""
        return sorted(topic for topic, kind in self.topics if kind == msgtype)

    def connections(self, topic: str, msgtype: str = IMU) -> list[Connection]:
        """Give the connections of a topic, as `rosbags` has them; there may be several."""
        return [c for c in self.reader.connections if (c.topic, c.msgtype) == (topic, msgtype)]

    def messages(self, topic: str, msgtype: str = IMU) -> Iterator[Messages]:
        """Give the messages of a topic in the order in which they were received, in blocks."""
        sources = [(db3 if file.suffix == '.db3' else mcap_messages).topic_messages(
            file, topic, msgtype) for file in self.files]
        if sources and None not in sources:
            for source in sources:
                yield from source or ()
            return
        messages = self.reader.messages(self.connections(topic, msgtype))
        while block := [raw for _, _, raw in islice(messages, BLOCK)]:
            yield joined(block, ros2=self.ros2)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading.

    Raises
    ------
    InputError
        If it is not a whole bag, also where that shows only when its messages are read.
    FileNotFoundError
        If it is missing.

    """
    if not path.exists():
        raise FileNotFoundError(2, 'No such file or directory', str(path))
    with ExitStack() as stack:
        try:
            yield Bag(path, stack)
        except _reading_errors() as err:
            raise _not_whole(path, err) from err


def _reader(path: Path) -> AnyReader:
    """Open a bag through `rosbags`."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import get_typestore, Stores

    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except (AnyReaderError, FileNotFoundError, AssertionError, struct.error) as err:
        raise _not_whole(path, err) from err
    return reader


def _reading_errors() -> tuple[type[Exception], ...]:
    from rosbags import rosbag1, rosbag2
    from rosbags.highlevel import AnyReaderError

    return AnyReaderError, rosbag1.ReaderError, rosbag2.ReaderError, sqlite3.Error


def _not_whole(path: Path, err: Exception) -> InputError:
    return InputError(f'{path} is not a whole bag ({err})',
                      'give a rosbag2 folder, .mcap, .db3 or .bag; ros2 bag reindex may mend it')


def imu_topic(bag: Bag, topic: str = '') -> str:
    """
    Find the one Imu topic of an open bag, or the one asked for.

    Raises
    ------
    InputError
        If there is none, or more than one to choose from.

    """
    topics = bag.of_type(IMU)
    if not topics:
        others = ', '.join(f'{name} ({kind})' for name, kind in sorted(bag.topics))
        raise InputError(f'{bag.path} has no topic of type {IMU}, only {others or "none"}',
                         'record the Imu topic')
    if topic and topic not in topics:
        raise InputError(f'{bag.path} has no Imu topic {topic}, only {", ".join(topics)}',
                         'choose one with --topic')
    if not topic and len(topics) > 1:
        raise InputError(f'{bag.path} has {len(topics)} Imu topics: {", ".join(topics)}',
                         'choose one with --topic')
    return topic or topics[0]
