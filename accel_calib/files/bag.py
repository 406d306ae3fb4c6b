# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of bags without ROS: rosbag2 (folder, mcap, db3) and ROS 1.

`rosbags` reads the serialized messages. They are joined to blocks of arrays
(`accel_calib.messages.layout`), so the memory needed does not depend on the length of the bag.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..messages.layout import (
    doubles_at,
    frame_ids,
    IMU_DOUBLES,
    joined,
    Messages,
    samples_of,
    stamps_of,
)
from ..table import Floats, Recording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

IMU = 'sensor_msgs/msg/Imu'
TEMPERATURE = 'sensor_msgs/msg/Temperature'
SUFFIXES = ('.bag', '.mcap', '.db3')
BLOCK = 4096
"""Number of messages per block; a block fits in the cache of the processor."""

_ROWS = 65536
"""Smallest number of samples in a block of a recording."""

_TEMPERATURE_DOUBLES = 2
"""Number of doubles of a Temperature: temperature and variance."""

_HELD_BACK = 8
"""Largest number of blocks that wait for a later temperature."""

_AROUND = 10
"""Number of temperatures that are kept before a block."""


def is_bag(path: Path) -> bool:
    """Return whether a path names a bag rather than a table."""
    return path.is_dir() or path.suffix in SUFFIXES


@dataclass(frozen=True)
class Bag:
    """
    An open bag; `open_bag` makes it.

    Parameters
    ----------
    path : Path
        File or folder.
    reader : Reader
        The reader of `rosbags`.
    ros2 : bool
        Whether it is a rosbag2; otherwise it is a ROS 1 bag.

    """

    path: Path
    reader: Reader1 | Reader2
    ros2: bool

    def topics(self, msgtype: str) -> list[str]:
        """Return the topics of a type, sorted."""
        return sorted({c.topic for c in self.reader.connections if c.msgtype == msgtype})

    def connections(self, topic: str, msgtype: str = IMU) -> list[Connection]:
        """Return the connections of a topic; a topic can have several."""
        return [c for c in self.reader.connections if (c.topic, c.msgtype) == (topic, msgtype)]

    def count(self, topic: str) -> int:
        """Return the number of Imu messages of a topic, according to the index of the bag."""
        return sum(connection.msgcount for connection in self.connections(topic))

    def blocks(self, connections: Sequence[Connection] = (), size: int = BLOCK
               ) -> Iterator[list[tuple[Connection, int, bytes]]]:
        """
        Yield blocks of messages, in order of receipt.

        Parameters
        ----------
        connections : sequence of Connection
            Connections to read; by default all.
        size : int
            Largest number of messages in a block.

        Yields
        ------
        list of (Connection, int, bytes)
            Connection, time of receipt [ns] and serialized message.

        """
        messages = self.reader.messages(connections)
        while True:
            with _rosbags_errors(self.path):
                block = list(islice(messages, size))
            if not block:
                return
            yield block

    def joined(self, raws: Sequence[bytes], topic: str, before: int, doubles: int = IMU_DOUBLES
               ) -> Messages:
        """
        Return messages of a topic as arrays; `before` is the number of earlier messages.

        Raises
        ------
        InputError
            If a message is damaged.

        """
        return joined(raws, doubles, f'{self.path}, {topic}', ros2=self.ros2, before=before)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading.

    Raises
    ------
    InputError
        If the bag is damaged; also later, while it is read.
    FileNotFoundError
        If the file is missing.

    """
    from rosbags import rosbag1, rosbag2

    if not path.exists():
        raise FileNotFoundError(2, 'No such file or directory', str(path))
    ros2 = path.suffix != '.bag'
    with _rosbags_errors(path):
        reader = (rosbag2.Reader if ros2 else rosbag1.Reader)(path)
        reader.open()
    try:
        yield Bag(path, reader, ros2)
    finally:
        reader.close()


@contextmanager
def _rosbags_errors(path: Path) -> Iterator[None]:
    """Convert errors of `rosbags` to InputError; only calls of `rosbags` belong inside."""
    try:
        yield
    except OSError as err:
        if err.errno is not None:
            raise
        raise _not_whole(path, err) from err
    except Exception as err:  # damaged bytes cause many kinds of errors
        raise _not_whole(path, err) from err


def _not_whole(path: Path, err: Exception) -> InputError:
    what = ' '.join(str(err).split()) or type(err).__name__
    return InputError(f'{path} is damaged or not a bag ({what}), expected a rosbag2 folder, '
                      '.mcap, .db3 or .bag', 'use another file; ros2 bag reindex may repair this '
                      'one')


def imu_topic(bag: Bag, topic: str = '') -> str:
    """
    Return the Imu topic of an open bag, or check the given topic.

    Raises
    ------
    InputError
        If there is no such topic, or there are several and none is given.

    """
    topics = bag.topics(IMU)
    if not topics:
        others = ', '.join(sorted(f'{c.topic} ({c.msgtype})' for c in bag.reader.connections))
        raise InputError(f'{bag.path} has {others or "no topics"}, expected a topic of type {IMU}',
                         'record the Imu topic')
    if topic and topic not in topics:
        raise InputError(f'{bag.path} has the Imu topics {", ".join(topics)}, expected {topic}',
                         'choose one of them with --topic')
    if not topic and len(topics) > 1:
        raise InputError(f'{bag.path} has {len(topics)} Imu topics, expected one: '
                         f'{", ".join(topics)}', 'choose one of them with --topic')
    return topic or topics[0]


def first_frame_id(bag: Bag, topic: str) -> str:
    """
    Return the frame_id of the first message of an Imu topic.

    Raises
    ------
    InputError
        If there is no message, or the message is damaged.

    """
    block = next(bag.blocks(bag.connections(topic), 1), None)
    if block is None:
        raise InputError(f'{bag.path} has no message on {topic}, expected Imu messages',
                         'record while the sensor publishes')
    return frame_ids(bag.joined([block[0][2]], topic, 0))[0]


def of_sensor(bag: Bag, topic: str, messages: Messages, before: int, sensor: str, *,
              chosen: bool) -> NDArray[np.bool_]:
    """
    Return a mask of the messages of a sensor.

    Parameters
    ----------
    bag, topic
        Source of the messages.
    messages : Messages
        A block of messages of the topic.
    before : int
        Number of earlier messages.
    sensor : str
        frame_id of the sensor.
    chosen : bool
        Whether the user chose the sensor; otherwise messages of another sensor are refused.

    Raises
    ------
    InputError
        If a message is from another sensor, and the user did not choose a sensor.

    """
    names = frame_ids(messages)
    same = np.array([name == sensor for name in names])
    if not chosen and not np.all(same):
        first = int(np.argmin(same))
        raise InputError(f'{bag.path}, {topic}: message {before + first + 1} is from the sensor '
                         f'{names[first]!r}, expected {sensor!r} as before',
                         'capture and refine choose one with --sensor; apply needs a topic for '
                         'each sensor')
    return np.broadcast_to(same, len(messages))


def imu_samples(bag: Bag, topic: str, sensor: str, *, chosen: bool) -> Iterator[Recording]:
    """
    Yield the samples of an Imu topic in blocks; parameters as in `of_sensor`.

    Raises
    ------
    InputError
        If a message is damaged, contains NaN, or is from another sensor.

    """
    waiting: deque[Recording] = deque()
    parts: list[Recording] = []
    before, track = 0, Track(np.zeros(0), np.zeros(0)) if bag.topics(TEMPERATURE) else None
    for imus, temperatures in _raw_messages(bag, topic):
        if track is not None and temperatures:
            track = track.plus(bag.joined(temperatures, 'temperature', 0, _TEMPERATURE_DOUBLES))
        if imus:
            waiting.append(_samples(bag, topic, imus, before, sensor, chosen=chosen))
            before += len(imus)
        while waiting and (track is None or len(waiting) > _HELD_BACK or track.covers(waiting[0])):
            parts.append(_with_temperature(waiting.popleft(), track))
        if track is not None and waiting:
            track = track.since(waiting[0]['time'][0])
        if sum(map(len, parts)) >= _ROWS:
            yield together(parts)
            parts = []
    parts += [_with_temperature(part, track) for part in waiting]
    if parts:
        yield together(parts)


def _raw_messages(bag: Bag, topic: str) -> Iterator[tuple[list[bytes], list[bytes]]]:
    """Yield blocks of serialized Imu and Temperature messages, in one pass over the bag."""
    warm = [c for name in bag.topics(TEMPERATURE) for c in bag.connections(name, TEMPERATURE)]
    are_warm = {id(connection) for connection in warm}
    messages = bag.reader.messages([*bag.connections(topic), *warm])
    while True:
        imus: list[bytes] = []
        temperatures: list[bytes] = []
        with _rosbags_errors(bag.path):
            for connection, _, raw in islice(messages, BLOCK):
                (temperatures if id(connection) in are_warm else imus).append(raw)
        if not imus and not temperatures:
            return
        yield imus, temperatures


def _samples(bag: Bag, topic: str, raws: list[bytes], before: int, sensor: str, *, chosen: bool
             ) -> Recording:
    """Return Imu messages as samples; parameters as in `of_sensor`."""
    messages = bag.joined(raws, topic, before)
    which = of_sensor(bag, topic, messages, before, sensor, chosen=chosen)
    columns = samples_of(messages)
    _check_finite(bag, columns['reading'], before)
    row = np.arange(before, before + len(raws)) + 1
    samples = Recording(columns, row, 'm/s2', sensor)
    return samples if np.all(which) else samples.take(which)


def _with_temperature(samples: Recording, track: Track | None) -> Recording:
    if track is None:
        return samples
    return samples.with_columns(temperature=track.at(samples['time']))


def together(parts: Sequence[Recording]) -> Recording:
    """Concatenate one or more recordings."""
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0].columns}
    return replace(parts[0], columns=columns, row=np.concatenate([part.row for part in parts]))


def _check_finite(bag: Bag, reading: Floats, before: int) -> None:
    """Check that the accelerations are finite."""
    if not np.isfinite(reading).all():
        first = int(np.argmin(np.isfinite(reading).all(axis=1)))
        raise InputError(f'{bag.path}: Imu message {before + first + 1} contains NaN or infinity, '
                         'expected finite numbers', 'fix the driver, or record again')


@dataclass(frozen=True)
class Track:
    """Temperatures [°C] at increasing times [s]."""

    time: Floats
    temperature: Floats

    def at(self, time: Floats) -> Floats:
        """Return the (n,) interpolated temperature; NaN if the track is empty."""
        if not len(self.time):
            return np.full(len(time), np.nan)
        return np.interp(time, self.time, self.temperature)

    def plus(self, messages: Messages) -> Track:
        """Return the track with Temperature messages added."""
        temperature = doubles_at(messages, slice(0, 1))[:, 0]
        known = np.isfinite(temperature)
        time = np.concatenate([self.time, stamps_of(messages)[known]])
        order = np.argsort(time, kind='stable')
        return Track(time[order], np.concatenate([self.temperature, temperature[known]])[order])

    def covers(self, samples: Recording) -> bool:
        """Return whether the track reaches the end of these samples."""
        return bool(len(self.time) and samples['time'][-1] <= self.time[-1])

    def since(self, time: float) -> Track:
        """Return the track without temperatures long before a time."""
        first = max(0, int(np.searchsorted(self.time, time)) - _AROUND)
        return Track(self.time[first:], self.temperature[first:])


def temperature_track(bag: Bag) -> Track:
    """Return all temperatures of a bag."""
    track = Track(np.zeros(0), np.zeros(0))
    for topic in bag.topics(TEMPERATURE):
        for block in bag.blocks(bag.connections(topic, TEMPERATURE)):
            raws = [raw for _, _, raw in block]
            track = track.plus(bag.joined(raws, topic, 0, _TEMPERATURE_DOUBLES))
    return track
