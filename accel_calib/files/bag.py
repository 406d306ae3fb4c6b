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
Recordings as bags: rosbag2 (folder, mcap, db3) and ROS 1, through `rosbags`, without ROS.

An Imu is taken from its serialized bytes: header stamp at the start, and behind the header the 37
doubles of `accel_calib.imu`. So millions of messages are read and corrected as arrays.

"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any, TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..imu import ACCELERATION, ANGULAR_VELOCITY, FIELDS
from ..table import Floats, numbered, Recording

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
SUFFIXES = ('.bag', '.mcap', '.db3')

_TAIL = FIELDS * 8
_TEMPERATURE_TAIL = 16  # temperature and its variance
_NANO = 1e-9


@dataclass(frozen=True)
class BagRecording:
    """
    An Imu topic of a bag.

    Parameters
    ----------
    recording : Recording
        Samples in m/s² and rad/s, with temperature where the bag has it.
    topic : str
        Name of the Imu topic.
    frame_id : str
        Of its messages.

    """

    recording: Recording
    topic: str
    frame_id: str


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
        If it is not a whole bag.
    FileNotFoundError
        If it is missing.

    """
    from rosbags.highlevel import AnyReader, AnyReaderError
    from rosbags.typesys import get_typestore, Stores

    if not path.exists():
        raise FileNotFoundError(2, 'No such file or directory', str(path))
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            yield reader
    except (AnyReaderError, FileNotFoundError, AssertionError, struct.error) as err:
        raise InputError(f'{path} is not a whole bag ({err})',
                         'give a rosbag2 folder, .mcap, .db3 or .bag; ros2 bag reindex may mend '
                         'it') from err


def imu_connections(reader: AnyReader, path: Path, topic: str = '') -> list[Connection]:
    """
    Find the connections of the one Imu topic of an open bag, or of the one asked for.

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
    return [c for c in reader.connections if c.topic == (topic or topics[0]) and c.msgtype == IMU]


def read_bag(path: Path, topic: str = '') -> BagRecording:
    """
    Read the samples of an Imu topic.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``.
    topic : str
        Which, where there are several.

    Raises
    ------
    InputError
        If it is not a bag or has no Imu.
    OSError
        If it cannot be read.

    """
    with open_bag(path) as reader:
        connections = imu_connections(reader, path, topic)
        stamps: list[float] = []
        tails: list[bytes] = []
        first: Any = None
        for connection, _, raw in reader.messages(connections):
            first = first or reader.deserialize(raw, connection.msgtype)
            stamps.append(stamp_of(raw, ros2=reader.is2))
            tails.append(tail_of(raw, path, ros2=reader.is2))
        if first is None:
            raise InputError(f'{path} has no message on {connections[0].topic}',
                             'record while the sensor publishes')
        fields = np.frombuffer(b''.join(tails), '<f8').reshape(-1, FIELDS)
        columns = {'time': np.array(stamps), 'reading': fields[:, ACCELERATION],
                   'rate': fields[:, ANGULAR_VELOCITY]}
        temperature = temperature_at(reader, columns['time'])
        if temperature is not None:
            columns['temperature'] = temperature
    _check_finite(path, columns['reading'])
    return BagRecording(Recording(columns, numbered(columns)), connections[0].topic,
                        first.header.frame_id)


def _check_finite(path: Path, reading: Floats) -> None:
    """Refuse messages whose acceleration is not a number."""
    faulty = np.flatnonzero(~np.all(np.isfinite(reading), axis=1))
    if len(faulty):
        raise InputError(f'{path}: {len(faulty)} of {len(reading)} Imu messages hold NaN or '
                         f'infinity, the first is message {faulty[0] + 1}',
                         'mend the driver, or record again')


def stamp_of(raw: bytes | memoryview, *, ros2: bool) -> float:
    """Read the header stamp [s] of a serialized message."""
    if not ros2:
        seconds, nanoseconds = struct.unpack_from('<II', raw, 4)
    else:
        order = '<' if raw[1] & 1 else '>'
        seconds, nanoseconds = struct.unpack_from(f'{order}iI', raw, 4)
    return float(seconds + nanoseconds * _NANO)


def tail_of(raw: bytes | memoryview, path: Path, *, ros2: bool) -> bytes:
    """
    Give the 37 doubles of a serialized Imu, as bytes.

    Raises
    ------
    InputError
        If the message is too short or not little endian.

    """
    if len(raw) < _TAIL + 12 or (ros2 and not raw[1] & 1):
        raise InputError(f'{path} holds an Imu message of {len(raw)} bytes that is not '
                         'little-endian CDR', 'record it again')
    return bytes(raw[-_TAIL:])


def temperature_at(reader: AnyReader, time: Floats) -> Floats | None:
    """Give the temperature [°C] at these times, where the bag has a Temperature topic."""
    connections = [c for c in reader.connections if c.msgtype == TEMPERATURE]
    stamps: list[float] = []
    values: list[float] = []
    for _, _, raw in reader.messages(connections) if connections else ():
        stamps.append(stamp_of(raw, ros2=reader.is2))
        values.append(struct.unpack_from('<d', raw, len(raw) - _TEMPERATURE_TAIL)[0])
    if not values:
        return None
    order = np.argsort(stamps, kind='stable')
    return np.interp(time, np.array(stamps)[order], np.array(values)[order])
