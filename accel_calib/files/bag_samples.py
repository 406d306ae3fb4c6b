# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The samples of an Imu topic of a bag, block by block, with the temperature beside them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .bag import Bag, TEMPERATURE
from .serialized import doubles_at, frame_id_of, layout_of, stamps_of
from ..errors import InputError
from ..imu import ACCELERATION, ANGULAR_VELOCITY, FIELDS
from ..table import Floats, Recording

_ROWS = 65536  # of a block, about
_TEMPERATURE_FIELDS = 2  # temperature and its variance


@dataclass(frozen=True)
class Track:
    """Temperatures [°C] at times [s], which rise."""

    time: Floats
    temperature: Floats

    def at(self, time: Floats) -> Floats:
        """Give the temperature at these times, (n,)."""
        return np.interp(time, self.time, self.temperature)


def imu_blocks(bag: Bag, topic: str) -> Iterator[Recording]:
    """
    Read the samples of an Imu topic in blocks.

    Raises
    ------
    InputError
        If a message is damaged or holds NaN.

    """
    track = temperature_track(bag)
    parts: list[Recording] = []
    before = 0
    for messages in bag.messages(topic):
        layout = layout_of(messages, FIELDS, f'{bag.path}, {topic}', before)
        columns = {'time': stamps_of(messages, layout),
                   'reading': doubles_at(messages, layout, ACCELERATION),
                   'rate': doubles_at(messages, layout, ANGULAR_VELOCITY)}
        if track is not None:
            columns['temperature'] = track.at(columns['time'])
        _check_finite(bag, columns['reading'], before)
        parts.append(Recording(columns, np.arange(before, before + len(messages)) + 1))
        before += len(messages)
        if sum(map(len, parts)) >= _ROWS:
            yield together(parts)
            parts = []
    if parts:
        yield together(parts)


def together(parts: Sequence[Recording]) -> Recording:
    """Put recordings, one at least, behind each other."""
    if len(parts) == 1:
        return parts[0]
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0].columns}
    return Recording(columns, np.concatenate([part.row for part in parts]))


def _check_finite(bag: Bag, reading: Floats, before: int) -> None:
    """Refuse messages whose acceleration is not a number."""
    if not np.isfinite(reading).all():
        first = int(np.argmin(np.isfinite(reading).all(axis=1)))
        raise InputError(f'{bag.path}: Imu message {before + first + 1} holds NaN or infinity',
                         'mend the driver, or record again')


def first_frame_id(bag: Bag, topic: str) -> str:
    """
    Give the frame_id of the first message of an Imu topic.

    Raises
    ------
    InputError
        If there is no message, or it is damaged.

    """
    block = next(bag.messages(topic), None)
    if block is None:
        raise InputError(f'{bag.path} has no message on {topic}',
                         'record while the sensor publishes')
    first = block.take(slice(1))
    return frame_id_of(first, layout_of(first, FIELDS, f'{bag.path}, {topic}'))


def temperature_track(bag: Bag) -> Track | None:
    """Read all Temperature topics of a bag, where it has any."""
    times: list[Floats] = []
    values: list[Floats] = []
    for topic in bag.of_type(TEMPERATURE):
        before = 0
        for messages in bag.messages(topic, TEMPERATURE):
            layout = layout_of(messages, _TEMPERATURE_FIELDS, f'{bag.path}, {topic}', before)
            times.append(stamps_of(messages, layout))
            values.append(doubles_at(messages, layout, slice(0, 1))[:, 0])
            before += len(messages)
    if not times:
        return None
    order = np.argsort(np.concatenate(times), kind='stable')
    return Track(np.concatenate(times)[order], np.concatenate(values)[order])
