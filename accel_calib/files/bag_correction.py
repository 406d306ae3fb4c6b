# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correcting a bag: a copy in which the Imu topic is calibrated and all else is as it was.

Of a rosbag2 the files are rewritten in their own format: other topics, names, definitions,
compression of chunks, and ``metadata.yaml`` stay byte for byte. A ROS 1 bag, and a rosbag2 whose
messages or files are compressed, go message by message through `rosbags`.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from . import db3, mcap_rewrite
from .bag import Bag, BLOCK, IMU, imu_topic, open_bag
from .bag_metadata import write_metadata
from .bag_samples import first_frame_id, temperature_track
from .calibration_yaml import check_sensor
from .serialized import (
    doubles_at,
    frame_id_of,
    joined,
    layout_of,
    Messages,
    put_doubles,
    stamps_of,
)
from ..calibrate import Calibration
from ..errors import InputError
from ..imu import corrected, FIELDS

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2

Progress = Callable[[int, int], object]
"""Is told how many messages are done, and of how many."""


def correct_bag(path: Path, calibration: Calibration, out: Path, topic: str = '',
                progress: Progress = lambda done, count: None) -> int:
    """
    Write a corrected copy of a bag.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``.
    calibration : Calibration
        In m/s².
    out : Path
        What to write; must not be there yet. A folder becomes a folder and a ROS 1 bag a ROS 1
        bag; a single file of rosbag2 becomes a file where `out` has its suffix, otherwise a
        folder.
    topic : str
        Imu topic, where the bag has several.
    progress : callable
        Told of the messages, block by block.

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
        with open_bag(path) as bag:
            name = imu_topic(bag, topic)
            check_sensor(calibration, first_frame_id(bag, name))
            change = _Correction(calibration, bag, name, progress)
            partial.parent.mkdir(parents=True, exist_ok=True)
            if _can_rewrite(bag):
                _rewrite(bag, partial, out, name, change)
            else:
                with _writer(bag, partial) as writer:
                    _copy(bag, writer, name, change)
        partial.rename(out)
    finally:
        _remove(partial)
    return change.done


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


class _Correction:
    """Correct messages in their buffer, and count them."""

    def __init__(self, calibration: Calibration, bag: Bag, topic: str, progress: Progress
                 ) -> None:
        needed = 'temperature' in calibration.model.needs
        self._calibration = calibration
        self._name = f'{bag.path}, {topic}'
        self._track = temperature_track(bag) if needed else None
        self._count = bag.topics[topic, IMU]
        self._progress = progress
        self.done = 0

    def __call__(self, messages: Messages) -> None:
        """Correct these messages."""
        layout = layout_of(messages, FIELDS, self._name, self.done)
        check_sensor(self._calibration, frame_id_of(messages, layout))
        context = {}
        if self._track is not None:
            context['temperature'] = self._track.at(stamps_of(messages, layout))
        fields = doubles_at(messages, layout, slice(0, FIELDS))
        put_doubles(messages, layout, corrected(self._calibration, fields, context))
        self.done += len(messages)
        self._progress(self.done, self._count)


def _can_rewrite(bag: Bag) -> bool:
    return bool(bag.files) and all(file.suffix == '.db3' or mcap_rewrite.can_rewrite(file)
                                   for file in bag.files)


def _rewrite(bag: Bag, partial: Path, out: Path, topic: str, change: _Correction) -> None:
    """Rewrite the files of a rosbag2 one by one; others in its folder are copied."""
    names = [file.name for file in bag.files]
    targets = [partial / name for name in names]
    if bag.path.is_dir():
        _copy_others(bag.path, partial, names)
    elif out.suffix == bag.path.suffix:
        targets = [partial]
    else:
        partial.mkdir()
        targets = [partial / f'{out.name}{bag.path.suffix}']
        write_metadata(bag.reader, targets[0])
    for file, target in zip(bag.files, targets, strict=True):
        module = db3 if file.suffix == '.db3' else mcap_rewrite
        module.rewrite(file, target, topic, IMU, change)


def _copy_others(folder: Path, target: Path, names: Sequence[str]) -> None:
    """Copy what is in a folder beside the files of these names."""
    others = [item for item in folder.iterdir() if item.name not in names]
    target.mkdir()
    for item in others:
        copy = shutil.copytree if item.is_dir() else shutil.copyfile
        copy(item, target / item.name)


def _writer(bag: Bag, out: Path) -> Writer1 | Writer2:
    """Make a writer of the kind of the bag that is read."""
    if not bag.ros2:
        from rosbags.rosbag1 import Writer as Rosbag1Writer

        return Rosbag1Writer(out)
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Rosbag2Writer

    mcap = bag.path.suffix == '.mcap' or any(bag.path.glob('*.mcap*'))
    return Rosbag2Writer(out, version=9, storage_plugin=StoragePlugin.MCAP if mcap
                         else StoragePlugin.SQLITE3)


def _copy(bag: Bag, writer: Writer1 | Writer2, topic: str, change: _Correction) -> None:
    """Copy all messages, those of the Imu corrected."""
    add = _adder(bag.reader, writer)
    outputs = {id(connection): add(connection) for connection in bag.reader.connections}
    imu = {id(connection) for connection in bag.connections(topic)}
    messages: Iterator[tuple[Any, int, bytes]] = bag.reader.messages()
    while block := list(islice(messages, BLOCK)):
        which = [k for k, (connection, _, _) in enumerate(block) if id(connection) in imu]
        new = joined([block[k][2] for k in which], ros2=bag.ros2)
        if which:
            change(new)
        changed = dict(zip(which, new.each(), strict=True))
        for k, (connection, stamp, raw) in enumerate(block):
            writer.write(outputs[id(connection)], stamp, changed.get(k, raw))


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
