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

"""Recordings of any kind, by their name: CSV tables and bags."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .bag import is_bag, read_bag
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


def read_recording(path: Path, topic: str = '') -> Source:
    """
    Read a recording: a CSV table, a rosbag2 (folder, mcap, db3) or a ROS 1 bag.

    Parameters
    ----------
    path : Path
        The file or folder.
    topic : str
        Imu topic, where a bag has several.

    Raises
    ------
    InputError
        If it is not what its name says, or holds no samples.
    OSError
        If it cannot be read.

    """
    if is_bag(path):
        bag = read_bag(path, topic)
        return Source(bag.recording, 'm/s2', bag.frame_id)
    return Source(read_samples(path), None, '')
