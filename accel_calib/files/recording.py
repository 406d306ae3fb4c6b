# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Readers of recordings, from CSV tables and bags: block by block, or as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .bag import first_frame_id, imu_samples, imu_topic, is_bag, open_bag, together
from .table_csv import read_samples
from ..table import Recording
from ..units import UnitName


@dataclass(frozen=True)
class OpenRecording:
    """
    An open recording that is read block by block; `open_recording` makes it.

    Parameters
    ----------
    blocks : iterator of Recording
        The samples, in order. The size of a block does not depend on that of the recording.
    samples : int
        Number of samples, according to the index of the file.
    units : {'m/s2', 'g', 'native', ''}
        Unit of the readings, m/s² for Imu messages; empty if the file does not state it.
    sensor : str
        frame_id of the messages; empty if the file does not state it.

    """

    blocks: Iterator[Recording]
    samples: int
    units: UnitName | str
    sensor: str


@contextmanager
def open_recording(path: Path, topic: str = '', sensor: str = '') -> Iterator[OpenRecording]:
    """
    Open a recording: a CSV table, a rosbag2 (folder, mcap, db3) or a ROS 1 bag.

    Parameters
    ----------
    path : Path
        The file or folder.
    topic : str
        Imu topic, for a bag with several Imu topics.
    sensor : str
        frame_id of the messages to read, for a topic with several sensors.

    Raises
    ------
    InputError
        If the format does not match the file name, or the file contains no samples or samples of
        several sensors; also while it is read.
    OSError
        If the file cannot be read.

    """
    if not is_bag(path):
        table = read_samples(path)
        yield OpenRecording(iter((table,)), len(table), table.units, table.sensor)
        return
    with open_bag(path) as bag:
        name = imu_topic(bag, topic)
        of = sensor or first_frame_id(bag, name)
        yield OpenRecording(imu_samples(bag, name, of, chosen=bool(sensor)), bag.count(name),
                            'm/s2', of)


def read_recording(path: Path, topic: str = '', sensor: str = '') -> Recording:
    """Return a whole recording; parameters and errors as in `open_recording`."""
    with open_recording(path, topic, sensor) as recording:
        return together(list(recording.blocks))
