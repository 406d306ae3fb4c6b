# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of a bag: a copy with the Imu topic corrected and all other messages byte for byte.

The copy is written by `rosbags`, with the storage of the original. What it does not keep is said
in the documentation of the files (attachments of MCAP, the division into several files, …).

"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
import shutil
from typing import Any, TYPE_CHECKING

from .bag import (
    Bag,
    first_frame_id,
    imu_topic,
    of_sensor,
    open_bag,
    TEMPERATURE,
    temperature_track,
)
from .calibration_yaml import check_sensor
from ..calibrate import Calibration
from ..errors import InputError
from ..messages.arrays import doubles_at, Messages, put_doubles, samples_of
from ..messages.correction import corrected
from ..messages.layout import IMU_DOUBLES

if TYPE_CHECKING:
    from collections.abc import Iterator

Progress = Callable[[int, int], object]
"""Called with the number of messages done, and of all."""

_NO_HASH = 'RIHS01_' + 64 * '0'
"""Hash of a type whose definition neither the bag nor Jazzy has."""


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
        The copy; must not exist. A rosbag2 becomes a folder, or a file if `out` has the suffix
        of its storage; a ROS 1 bag becomes a ROS 1 bag.
    topic : str
        Imu topic, for a bag with several.
    progress : callable
        Called after each block of messages.

    Returns
    -------
    int
        Imu messages corrected.

    Raises
    ------
    InputError
        If the bag is not whole, has no Imu or Imu messages of several sensors, or `out` exists.
    StoredCalibrationError
        If the calibration is of another sensor.
    OSError
        If a file cannot be read or written; `out` then does not exist.

    """
    if out.exists():
        raise InputError(f'{out} exists', 'give a new name')
    if calibration.units.name != 'm/s2':
        raise InputError(f'the calibration is for readings in {calibration.units.name}, Imu '
                         'messages are in m/s2', 'fit it to poses in m/s2')
    with open_bag(path) as bag:
        name = imu_topic(bag, topic)
        sensor = first_frame_id(bag, name)
        check_sensor(calibration, sensor)
        with _new(out) as folder:
            return _copy(bag, folder, out, _Correction(calibration, bag, name, sensor), progress)


@contextmanager
def _new(out: Path) -> Iterator[Path]:
    """Yield a folder beside the target to write into, and remove it at the end."""
    folder = out.with_name(f'.{out.name}.partial')
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


class _Correction:
    """The correction of the messages of one topic."""

    def __init__(self, calibration: Calibration, bag: Bag, topic: str, sensor: str) -> None:
        self._calibration, self._bag, self._sensor = calibration, bag, sensor
        needed = 'temperature' in calibration.model.needs and bag.topics(TEMPERATURE)
        self._track = temperature_track(bag) if needed else None
        self.topic, self.done = topic, 0

    def __call__(self, raws: list[bytes]) -> Messages:
        """Return messages corrected, in a new buffer."""
        messages = self._bag.joined(raws, self.topic, self.done)
        of_sensor(self._bag, self.topic, messages, self.done, self._sensor, chosen=False)
        context = samples_of(messages)
        if self._track is not None:
            context['temperature'] = self._track.at(context['time'])
        doubles = doubles_at(messages, slice(0, IMU_DOUBLES))
        put_doubles(messages, corrected(self._calibration, doubles, context))
        self.done += len(messages)
        return messages


def _copy(bag: Bag, folder: Path, out: Path, correction: _Correction, progress: Progress) -> int:
    """Copy all messages, those of the Imu corrected."""
    target = folder / (out.stem if out.suffix in ('.mcap', '.db3') else out.name)
    count = bag.count(correction.topic)
    imu = {id(connection) for connection in bag.connections(correction.topic)}
    writer = _writer(bag, target)
    with writer:
        outputs = _added(bag, writer)
        for block in bag.blocks():
            which = [k for k, (connection, _, _) in enumerate(block) if id(connection) in imu]
            changed: dict[int, memoryview] = {}
            if which:
                new = correction([block[k][2] for k in which])
                changed = dict(zip(which, new.each(), strict=True))
            for k, (connection, stamp, raw) in enumerate(block):
                writer.write(outputs[id(connection)], stamp, changed.get(k, raw))
            progress(correction.done, count)
    (target if target.name == out.name else next(target.glob(f'*{out.suffix}'))).rename(out)
    return correction.done


def _writer(bag: Bag, target: Path) -> Any:
    """Return a writer of the kind of the bag that is read."""
    if not bag.ros2:
        from rosbags.rosbag1 import Writer as Writer1

        return Writer1(target)
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    mcap = bag.path.suffix == '.mcap' or any(bag.path.glob('*.mcap*'))
    writer = Writer2(target, version=9, storage_plugin=StoragePlugin.MCAP if mcap
                     else StoragePlugin.SQLITE3)
    mode = bag.reader.compression_mode if isinstance(bag.reader, Reader) else None
    if mode:
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    return writer


def _added(bag: Bag, writer: Any) -> dict[int, Any]:
    """Add the connections of a bag to a writer; return the new ones by the id of the old."""
    made: dict[tuple[Any, ...], Any] = {}
    outputs = {}
    for each in bag.reader.connections:
        key = (each.topic, each.msgtype, each.msgdef.data, str(each.ext))
        if key not in made:
            made[key] = (_added_to_2 if bag.ros2 else _added_to_1)(writer, each)
        outputs[id(each)] = made[key]
    return outputs


def _added_to_1(writer: Any, each: Any) -> Any:
    return writer.add_connection(each.topic, each.msgtype, msgdef=each.msgdef.data,
                                 md5sum=each.digest, callerid=each.ext.callerid,
                                 latching=each.ext.latching)


def _added_to_2(writer: Any, each: Any) -> Any:
    from rosbags.typesys import get_typestore, Stores

    msgdef, digest, known = each.msgdef.data, each.digest, get_typestore(Stores.ROS2_JAZZY)
    if each.msgtype in known.types:
        msgdef = msgdef or known.generate_msgdef(each.msgtype, ros_version=2)[0]
        digest = digest or known.hash_rihs01(each.msgtype)
    return writer.add_connection(
        each.topic, each.msgtype, msgdef=msgdef, rihs01=digest or _NO_HASH,
        serialization_format=each.ext.serialization_format,
        offered_qos_profiles=each.ext.offered_qos_profiles)
