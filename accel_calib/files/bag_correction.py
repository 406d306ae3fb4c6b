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
Correcting a bag: a copy in which the Imu topic is calibrated and all else is as it was.

Messages are copied in their serialized form, in blocks; of an Imu the last 296 bytes change.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

import numpy as np

from .bag import imu_connections, open_bag, stamp_of, tail_of, temperature_at
from .calibration_yaml import check_sensor
from ..calibrate import Calibration
from ..errors import InputError
from ..imu import corrected, FIELDS
from ..table import Floats

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2

_BLOCK = 16384
_Message = tuple[Any, int, bytes]


def correct_bag(path: Path, calibration: Calibration, out: Path, topic: str = '') -> int:
    """
    Write a corrected copy of a bag.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``.
    calibration : Calibration
        In m/s².
    out : Path
        A new rosbag2 folder, or a new ``.bag`` for ROS 1; must not be there yet.
    topic : str
        Imu topic, where the bag has several.

    Returns
    -------
    int
        Imu messages corrected.

    Raises
    ------
    InputError
        If the bag is not whole or has no Imu, or `out` is there already.
    StoredCalibrationError
        If the calibration is of another sensor.
    OSError
        If a file cannot be read or written; `out` is then not there.

    """
    if out.exists():
        raise InputError(f'{out} is there already', 'give a name that is still free')
    if calibration.units.name != 'm/s2':
        raise InputError(f'the calibration is for readings in {calibration.units.name}, Imu '
                         'messages are in m/s2', 'fit it to poses in m/s2')
    partial = out.with_name(f'.{out.name}.partial')
    _remove(partial)
    try:
        with open_bag(path) as reader:
            imu = {id(c) for c in imu_connections(reader, path, topic)}
            with _writer(reader, path, partial) as writer:
                count = _copy(reader, writer, imu, calibration, path)
        partial.rename(out)
    finally:
        _remove(partial)
    return count


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


def _writer(reader: AnyReader, path: Path, out: Path) -> Writer1 | Writer2:
    """Make a writer of the kind of the bag that is read."""
    if not reader.is2:
        from rosbags.rosbag1 import Writer as Rosbag1Writer

        return Rosbag1Writer(out)
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Rosbag2Writer

    mcap = path.suffix == '.mcap' or any(path.glob('*.mcap'))
    return Rosbag2Writer(out, version=9, storage_plugin=StoragePlugin.MCAP if mcap
                         else StoragePlugin.SQLITE3)


def _copy(reader: AnyReader, writer: Writer1 | Writer2, imu: set[int], calibration: Calibration,
          path: Path) -> int:
    """Copy all messages, those of the Imu corrected; return how many these are."""
    add = _adder(reader, writer)
    outputs = {id(connection): add(connection) for connection in reader.connections}
    count = 0
    messages: Iterator[_Message] = reader.messages()
    while block := list(islice(messages, _BLOCK)):
        which = [k for k, (connection, _, _) in enumerate(block) if id(connection) in imu]
        count += len(which)
        changed = dict(zip(which, _corrected(reader, [block[k] for k in which], calibration, path),
                           strict=True))
        for k, (connection, stamp, raw) in enumerate(block):
            writer.write(outputs[id(connection)], stamp, changed.get(k, raw))
    return count


def _adder(reader: AnyReader, writer: Any) -> Callable[[Any], Any]:
    """Give the function that declares a connection of the reader to the writer."""
    def add1(connection: Any) -> Any:
        return writer.add_connection(connection.topic, connection.msgtype,
                                     msgdef=connection.msgdef.data, md5sum=connection.digest,
                                     callerid=connection.ext.callerid,
                                     latching=connection.ext.latching)

    def add2(connection: Any) -> Any:
        return writer.add_connection(
            connection.topic, connection.msgtype, typestore=reader.typestore,
            serialization_format=connection.ext.serialization_format,
            offered_qos_profiles=connection.ext.offered_qos_profiles)

    return add2 if reader.is2 else add1


def _corrected(reader: AnyReader, messages: list[_Message], calibration: Calibration,
               path: Path) -> list[bytes]:
    """Correct the serialized Imu messages of a block."""
    if not messages:
        return []
    raws = [raw for _, _, raw in messages]
    first: Any = reader.deserialize(raws[0], messages[0][0].msgtype)
    check_sensor(calibration, first.header.frame_id)
    tails = b''.join(tail_of(raw, path, ros2=reader.is2) for raw in raws)
    fields: Floats = np.frombuffer(tails, '<f8').reshape(-1, FIELDS)
    context = {}
    if 'temperature' in calibration.model.needs:
        times = np.array([stamp_of(raw, ros2=reader.is2) for raw in raws])
        temperature = temperature_at(reader, times)
        context = {} if temperature is None else {'temperature': temperature}
    result = corrected(calibration, fields, context).astype('<f8')
    size = FIELDS * 8
    return [raw[:-size] + row.tobytes() for raw, row in zip(raws, result, strict=True)]
