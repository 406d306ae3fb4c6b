# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Bags of every kind: rosbag2 (folder, mcap, db3) and ROS 1, without ROS.

`rosbags` opens a bag and says what is in it. The messages of a topic then come in blocks, as they
are serialized: by chunks from MCAP files, by rows from SQLite files, and one by one through
`rosbags` from ROS 1 bags, compressed rosbag2 and MCAP files of unusual make.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
import sqlite3
import struct
from typing import TYPE_CHECKING

import yaml

from . import db3, mcap
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


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """
    Open a bag for reading.

    Raises
    ------
    InputError
        If it is not a whole bag, also where that shows only when its messages are read.
    FileNotFoundError
        If it is missing.

    """
    from rosbags import rosbag1, rosbag2
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import get_typestore, Stores

    if not path.exists():
        raise FileNotFoundError(2, 'No such file or directory', str(path))
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except (AnyReaderError, FileNotFoundError, AssertionError, struct.error) as err:
        raise _not_whole(path, err) from err
    try:
        yield reader
    except (AnyReaderError, rosbag1.ReaderError, rosbag2.ReaderError, sqlite3.Error) as err:
        raise _not_whole(path, err) from err
    finally:
        reader.close()


def _not_whole(path: Path, err: Exception) -> InputError:
    return InputError(f'{path} is not a whole bag ({err})',
                      'give a rosbag2 folder, .mcap, .db3 or .bag; ros2 bag reindex may mend it')


def imu_topic(reader: AnyReader, path: Path, topic: str = '') -> str:
    """
    Find the one Imu topic of an open bag, or the one asked for.

    Raises
    ------
    InputError
        If there is none, or more than one to choose from.

    """
    topics = sorted({c.topic for c in reader.connections if c.msgtype == IMU})
    if not topics:
        others = sorted({f'{c.topic} ({c.msgtype})' for c in reader.connections})
        raise InputError(f'{path} has no topic of type {IMU}, only {", ".join(others) or "none"}',
                         'record the Imu topic')
    if topic and topic not in topics:
        raise InputError(f'{path} has no Imu topic {topic}, only {", ".join(topics)}',
                         'choose one with --topic')
    if not topic and len(topics) > 1:
        raise InputError(f'{path} has {len(topics)} Imu topics: {", ".join(topics)}',
                         'choose one with --topic')
    return topic or topics[0]


def connections_of(reader: AnyReader, topic: str, msgtype: str = IMU) -> list[Connection]:
    """Give the connections of a topic; a bag may have several."""
    return [c for c in reader.connections if (c.topic, c.msgtype) == (topic, msgtype)]


def count_of(reader: AnyReader, topic: str, msgtype: str = IMU) -> int:
    """Give the number of messages of a topic, by the index of the bag."""
    return sum(c.msgcount for c in connections_of(reader, topic, msgtype))


def storage_files(path: Path) -> list[Path]:
    """Give the files of a rosbag2 that hold its messages as they are; none of another bag."""
    if not path.is_dir():
        return [path] if path.suffix in ('.mcap', '.db3') else []
    text = (path / 'metadata.yaml').read_text(encoding='utf-8')
    about = yaml.safe_load(text)['rosbag2_bagfile_information']
    if (about.get('compression_mode') or 'none').lower() != 'none':
        return []
    return [path / Path(name).name for name in about['relative_file_paths']]


def messages_of(reader: AnyReader, path: Path, topic: str, msgtype: str = IMU
                ) -> Iterator[Messages]:
    """Give the messages of a topic in the order in which they were received, in blocks."""
    sources = [(mcap if file.suffix == '.mcap' else db3).topic_messages(file, topic, msgtype)
               for file in storage_files(path)]
    if sources and None not in sources:
        for source in sources:
            yield from source or ()
        return
    messages = reader.messages(connections_of(reader, topic, msgtype))
    while block := [raw for _, _, raw in islice(messages, BLOCK)]:
        yield joined(block, ros2=reader.is2)
