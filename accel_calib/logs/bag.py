# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of the samples in bags without ROS: rosbag2 (folder, mcap, db3) and ROS 1.

Serialized messages are joined to blocks of arrays (`accel_calib.logs.serialized`), so the memory
needed does not depend on the length of the bag.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .bag_context import context_of, ContextTopic, ContextTopics, Track
from .bag_reader import Bag, BLOCK, IMU, is_bag, open_bag, Received, SUFFIXES
from .serialized import frame_ids, Messages, samples_of
from ..errors import InputError
from ..table import Floats, Recording

__all__ = ['Bag', 'OpenSamples', 'SUFFIXES', 'first_frame_id', 'imu_samples', 'imu_topic',
           'is_bag', 'lost', 'of_sensor', 'open_bag', 'open_samples', 'plausible_samples',
           'together']

_ROWS = 65536
"""Smallest number of samples in a block of a recording."""

LARGEST = 1e6
"""Larger accelerations [m/s²] and rates [rad/s] are those of damaged bytes."""

_HELD_BACK = 8
"""Largest number of blocks that wait for a later temperature."""


@dataclass(frozen=True)
class OpenSamples:
    """
    The samples of an open bag; `open_samples` makes it.

    Parameters
    ----------
    blocks : iterator of Recording
        The samples, in order. The size of a block does not depend on that of the bag.
    samples : int
        Number of samples, according to the index of the bag.
    topic, sensor : str
        Imu topic, and frame_id of its messages.
    found : list of str
        Notes; the last block can add some.

    """

    blocks: Iterator[Recording]
    samples: int
    topic: str
    sensor: str
    found: list[str]

    @property
    def notes(self) -> tuple[str, ...]:
        """Return notes about topics and lost messages; complete after the last block."""
        return tuple(self.found)


@contextmanager
def open_samples(path: Path, topic: str = '', sensor: str = '', *, temperature_topic: str = '',
                 supply_topic: str = '') -> Iterator[OpenSamples]:
    """
    Open the samples of a bag.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``.
    topic : str
        Imu topic, for a bag with several Imu topics.
    sensor : str
        frame_id of the messages to read, for a topic with several sensors.
    temperature_topic, supply_topic : str
        As in `accel_calib.logs.bag_context.context_of`.

    Raises
    ------
    InputError
        If the bag is damaged, or a topic is missing or ambiguous; also while it is read.
    OSError
        If the file cannot be read.

    """
    with open_bag(path) as bag:
        name = imu_topic(bag, topic)
        of = sensor or first_frame_id(bag, name)
        context = context_of(bag, name, of, temperature_topic, supply_topic)
        found = [*bag.notes, *context.notes]
        blocks = imu_samples(bag, name, of, chosen=bool(sensor), context=context, notes=found)
        yield OpenSamples(blocks, bag.count(name), name, of, found)


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


def imu_samples(bag: Bag, topic: str, sensor: str, *, chosen: bool,
                context: ContextTopics | None = None, notes: list[str] | None = None
                ) -> Iterator[Recording]:
    """
    Yield the samples of an Imu topic in blocks.

    Parameters
    ----------
    bag, topic, sensor, chosen
        As in `of_sensor`.
    context : ContextTopics, optional
        Topics of temperature and supply voltage; by default that of `context_of`.
    notes : list of str, optional
        List to which a note about lost messages is added at the end.

    Raises
    ------
    InputError
        If a message is damaged, contains NaN, or is from another sensor.

    """
    used = (context or context_of(bag, topic, sensor)).used
    tracks = {each.quantity.key: Track(np.zeros(0), np.zeros(0)) for each in used}
    waiting: deque[Recording] = deque()
    parts: list[Recording] = []
    before = 0
    for imus, others in _blocks(bag, topic, used):
        for each, block in zip(used, others, strict=True):
            if block:
                tracks[each.quantity.key] = tracks[each.quantity.key].plus(*each.values(block))
        if imus:
            waiting.append(_samples(bag, topic, imus, before, sensor, chosen=chosen))
            before += len(imus)
        parts += _ready(waiting, tracks)
        if sum(map(len, parts)) >= _ROWS:
            yield together(parts)
            parts = []
    parts += [_with_context(part, tracks) for part in waiting]
    if parts:
        yield together(parts)
    if notes is not None:
        notes += lost(bag, topic, before)


def _ready(waiting: deque[Recording], tracks: dict[str, Track]) -> list[Recording]:
    """Return the blocks whose context is known, and discard context that is too old for others."""
    parts = []
    while waiting and (len(waiting) > _HELD_BACK
                       or all(track.covers(waiting[0]) for track in tracks.values())):
        parts.append(_with_context(waiting.popleft(), tracks))
    if waiting:
        for key, track in tracks.items():
            tracks[key] = track.since(waiting[0]['time'][0])
    return parts


def _blocks(bag: Bag, topic: str, used: Sequence[ContextTopic]
            ) -> Iterator[tuple[list[bytes], list[list[Received]]]]:
    """Yield blocks of serialized Imu messages and of the other topics, in one pass."""
    own = [{id(connection) for connection in each.connections} for each in used]
    imu = {id(connection) for connection in bag.connections(topic)}
    wanted = [each for each in bag.reader.connections if id(each) in imu.union(*own)]
    for block in bag.blocks(wanted, BLOCK):
        yield ([raw for connection, _, raw in block if id(connection) in imu],
               [[each for each in block if id(each[0]) in ids] for ids in own])


def lost(bag: Bag, topic: str, found: int) -> list[str]:
    """Return a note if fewer messages of a topic were found than the bag states."""
    stated = bag.count(topic)
    return [f'{stated - found} of {stated} messages on {topic} are lost: the index of {bag.path} '
            'states them, but they are not in the bag'] if found < stated else []


def _samples(bag: Bag, topic: str, raws: list[bytes], before: int, sensor: str, *, chosen: bool
             ) -> Recording:
    """Return Imu messages as samples; parameters as in `of_sensor`."""
    messages = bag.joined(raws, topic, before)
    which = of_sensor(bag, topic, messages, before, sensor, chosen=chosen)
    columns = plausible_samples(bag, messages, before)
    row = np.arange(before, before + len(raws)) + 1
    samples = Recording(columns, row, 'm/s2', sensor)
    return samples if np.all(which) else samples.take(which)


def _with_context(samples: Recording, tracks: dict[str, Track]) -> Recording:
    columns = {key: track.at(samples['time']) for key, track in tracks.items()}
    return samples.with_columns(**columns) if columns else samples


def together(parts: Sequence[Recording]) -> Recording:
    """Concatenate one or more recordings."""
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0].columns}
    return replace(parts[0], columns=columns, row=np.concatenate([part.row for part in parts]))


def plausible_samples(bag: Bag, messages: Messages, before: int) -> dict[str, Floats]:
    """
    Return Imu messages as columns of `accel_calib.table`; `before` counts the earlier messages.

    Raises
    ------
    InputError
        If an acceleration is not finite, or a number is beyond any sensor.

    """
    columns = samples_of(messages)
    _check_plausible(bag, columns['reading'], before, 'acceleration')
    _check_plausible(bag, np.nan_to_num(columns['rate']), before, 'angular velocity')
    return columns


def _check_plausible(bag: Bag, values: Floats, before: int, what: str) -> None:
    """Check that accelerations or rates are finite, and not those of damaged bytes."""
    sound = np.all(np.abs(values) < LARGEST, axis=1)
    if not np.all(sound):
        first = int(np.argmin(sound))
        found = ('contains NaN or infinity' if not np.all(np.isfinite(values[first])) else
                 f'has the {what} {np.max(np.abs(values[first])):.3g}')
        raise InputError(f'{bag.path}: Imu message {before + first + 1} {found}, expected finite '
                         f'numbers below {LARGEST:g}', 'fix the driver, or record again')
