# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Recordings of any kind, by their name: CSV tables and bags; block by block, or whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .bag import IMU, imu_topic, is_bag, open_bag
from .bag_samples import first_frame_id, imu_blocks, together
from .table_csv import read_samples
from ..table import Recording
from ..units import UnitName


@dataclass(frozen=True)
class Source:
    """
    A recording and what its file says of it.

    Parameters
    ----------
    recording : Recording
        The samples.
    units : {'m/s2', 'g', 'native'} or None
        Unit of the readings where the file fixes it: Imu messages are in m/s².
    sensor : str
        frame_id of the messages; empty for a table.

    """

    recording: Recording
    units: UnitName | None
    sensor: str


@dataclass(frozen=True)
class Stream:
    """
    An open recording, to be read block by block.

    Parameters
    ----------
    blocks : iterator of Recording
        The samples, in order; however many there are, they take the memory of a block.
    samples : int
        How many to expect, by the index of the file.
    units, sensor
        As of `Source`.

    """

    blocks: Iterator[Recording]
    samples: int
    units: UnitName | None
    sensor: str


@contextmanager
def open_recording(path: Path, topic: str = '') -> Iterator[Stream]:
    """
    Open a recording: a CSV table, a rosbag2 (folder, mcap, db3) or a ROS 1 bag.

    Parameters
    ----------
    path : Path
        The file or folder.
    topic : str
        Imu topic, where a bag has several.

    Raises
    ------
    InputError
        If it is not what its name says, or holds no samples; also while it is read.
    OSError
        If it cannot be read.

    """
    if not is_bag(path):
        table = read_samples(path)
        yield Stream(iter((table,)), len(table), None, '')
        return
    with open_bag(path) as bag:
        name = imu_topic(bag, topic)
        frame_id = first_frame_id(bag, name)
        yield Stream(imu_blocks(bag, name), bag.topics[name, IMU], 'm/s2', frame_id)


def read_recording(path: Path, topic: str = '') -> Source:
    """Read a recording whole; takes and raises what `open_recording` does."""
    with open_recording(path, topic) as stream:
        return Source(together(list(stream.blocks)), stream.units, stream.sensor)
