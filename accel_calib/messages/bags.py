# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of a bag: a copy with a corrected Imu topic; all other messages are unchanged.

`rosbags` writes the copy, with the storage of the original. The copy does not contain everything
(not the attachments of MCAP, and not the division into several files); see docs/files.md.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import errno
import glob
import os
from pathlib import Path
import shutil
import sqlite3
from tempfile import mkdtemp
import time
from typing import Any, TYPE_CHECKING

import numpy as np

from .correction import corrected, output_frame, output_scale
from ..calibrate import Calibration, on_topics
from ..errors import InputError
from ..logs import (
    Bag, context_of, damage_as_input_error, doubles_at, IMU_DOUBLES, LogOptions, Messages,
    open_bag, Progress, put_doubles, renamed)
from ..pipeline import Correction
from ..table import check_units, Recording
from ..units import Units, units_of

if TYPE_CHECKING:
    from collections.abc import Iterator

_PARTIAL = '.partial'
_STALE_S = 86400.0
"""Age of an unfinished copy that no process writes any more [s]."""

_NO_HASH = 'RIHS01_' + 64 * '0'
"""Hash of a type whose definition is neither in the bag nor in Jazzy."""


def correct_bag(path: Path, calibration: Calibration, out: Path,
                options: LogOptions = LogOptions(),
                progress: Progress = lambda done, count: None,
                note: Callable[[str], object] = lambda line: None) -> int:
    """
    Write a corrected copy of a bag, and return the number of corrected Imu messages.

    Parameters
    ----------
    path : Path
        A rosbag2 folder, ``.mcap``, ``.db3`` or ROS 1 ``.bag``.
    calibration : Calibration
        The calibration. One in g is converted to m/s², and one in m/s² to g.
    out : Path
        The copy, a bag of the same kind. A copy of a rosbag2 is a folder, or a file if `out` has
        the suffix of the storage.
    options : LogOptions
        How to read the bag: its topics, unit and gravity. The corrected accelerations are in
        m/s², the unit of Imu messages.
    progress, note : callable
        Functions that are called after each block of messages, and with each note about topics,
        lost messages, and what the messages lack or left the range of the calibration.

    Raises
    ------
    InputError
        If the bag is damaged, has no Imu messages or those of several sensors, or lacks a topic
        that the calibration needs; if the readings are clearly in another unit; if only one of
        calibration and messages is in native units; if the mounting is in the frame win8; or if
        `out` exists.
    StoredCalibrationError
        If the calibration belongs to another sensor.
    OSError
        If a file cannot be read or written. `out` then does not exist.

    """
    if out.exists():
        raise InputError(f'{out} exists, expected a new file', 'choose another name')
    with open_bag(path) as bag:
        _check_kind(bag, out)
        name = bag.imu_topic(options.topic)
        sensor = bag.first_frame_id(name)
        units = units_of(options.units or 'm/s2', options.gravity)
        correction = Correction(on_topics(calibration, calibration.frame), units.name, sensor)
        context = context_of(bag, name, sensor, options).needed(bag, calibration.model.needs)
        with _new(out) as folder:
            imus = _Topic(bag, name, sensor, context.tracks(), correction, units,
                          output_scale(correction.calibration, options.gravity))
            count = _copy(bag, folder, out, imus, progress)
        for line in (*bag.notes, *context.notes, *bag.lost(name, count), *correction.notes):
            note(line)
        return count


def _check_kind(bag: Bag, out: Path) -> None:
    """Check that the name of the copy is that of a bag of the same kind."""
    if (out.suffix == '.bag') is bag.ros2:
        kind, names = ((2, '.mcap or .db3, or the name of a folder') if bag.ros2 else (1, '.bag'))
        raise InputError(f'{bag.path} is a ROS {kind} bag, but {out} is not the name of one',
                         f'choose a name that ends in {names}')


@contextmanager
def _new(out: Path) -> Iterator[Path]:
    """Yield a new folder next to the target, and remove it and old leftovers of others."""
    out.parent.mkdir(parents=True, exist_ok=True)
    for each in out.parent.glob(f'.{glob.escape(out.name)}.*{_PARTIAL}'):
        if not each.is_symlink() and time.time() - each.stat().st_mtime > _STALE_S:
            shutil.rmtree(each)
    folder = Path(mkdtemp(_PARTIAL, f'.{out.name}.', out.parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


@dataclass
class _Topic:
    """The messages of one Imu topic, with the context over time; `units` are those recorded."""

    bag: Bag
    name: str
    sensor: str
    tracks: Mapping[str, Any]
    correction: Correction
    units: Units
    scale: float
    done: int = 0

    def corrected(self, raws: list[bytes]) -> Messages:
        """Return corrected messages in a new buffer."""
        own = self.correction.calibration
        messages, columns, _ = self.bag.imus(raws, self.name, self.done, self.sensor)
        samples = Recording(columns, np.arange(len(messages)))
        if not self.done:
            check_units(samples, self.units, str(self.bag.path))
        known = self.correction.context(samples.with_columns(
            **{key: track.at(columns['time']) for key, track in self.tracks.items()}))
        doubles = doubles_at(messages, slice(0, IMU_DOUBLES))
        with np.errstate(over='ignore', invalid='ignore'):  # damaged numbers become infinite
            put_doubles(messages, corrected(own, doubles, known, scale=self.scale))
        self.done += len(messages)
        return renamed(messages, output_frame(own, self.sensor)) if own.is_levelled else messages


def _copy(bag: Bag, folder: Path, out: Path, imus: _Topic, progress: Progress) -> int:
    """Copy all messages, and correct those of the Imu topic."""
    target = folder / (out.stem if out.suffix in ('.mcap', '.db3') else out.name)
    count = bag.count(imus.name)
    imu = {id(connection) for connection in bag.connections(imus.name)}
    written = 0
    writer = _writer(bag, target, out.suffix)
    with _full_disk(out), writer:
        with damage_as_input_error(bag.path):
            outputs = _added(bag, writer)
        for block in bag.blocks():
            which = [k for k, (connection, _, _) in enumerate(block) if id(connection) in imu]
            new = imus.corrected([block[k][2] for k in which]).each() if which else ()
            changed = dict(zip(which, new, strict=True))
            with damage_as_input_error(bag.path), _full_disk(out):  # a stamp can be out of range
                for k, (connection, stamp, raw) in enumerate(block):
                    writer.write(outputs[id(connection)], stamp, changed.get(k, raw))
            written += len(block)
            progress(imus.done, count)
    _check_copy(bag, target, written)
    (target if target.name == out.name else next(target.glob(f'*{out.suffix}'))).rename(out)
    return imus.done


@contextmanager
def _full_disk(out: Path) -> Iterator[None]:
    """Raise OSError with the name of the copy; SQLite has an error of its own for a full disk."""
    try:
        yield
    except sqlite3.OperationalError as err:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out)) from err
    except OSError as err:
        err.filename = str(out)
        raise


def _check_copy(bag: Bag, target: Path, written: int) -> None:
    """Check that a copy can be read back, and that its files hold all messages."""
    try:
        with open_bag(target) as copy:
            found = copy.stored
    except InputError as err:
        what = err.message.removeprefix(f'{target} ')
        raise InputError(f'{bag.path} cannot be copied: the copy {what}', 'use a bag whose topics '
                         'have valid names, types and formats') from err
    if found != written:
        raise InputError(f'{bag.path}: the copy holds {found} of {written} messages, expected '
                         'all', 'check the disk, and try again')


def _writer(bag: Bag, target: Path, suffix: str) -> Any:
    """Return a writer for the kind of bag that the suffix names, otherwise for the same kind."""
    if not bag.ros2:
        from rosbags.rosbag1 import Writer as Writer1

        return Writer1(target)
    from rosbags.rosbag2 import (
        CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer as Writer2)

    mcap = suffix == '.mcap' or (suffix != '.db3' and (
        bag.path.suffix == '.mcap' or any(bag.path.glob('*.mcap*'))))
    writer = Writer2(target, version=9, storage_plugin=StoragePlugin.MCAP if mcap
                     else StoragePlugin.SQLITE3)
    mode = bag.reader.compression_mode if isinstance(bag.reader, Reader) else None
    if mode and suffix not in ('.mcap', '.db3'):  # a lone file has no metadata to tell it
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    return writer


def _added(bag: Bag, writer: Any) -> dict[int, Any]:
    """Add the connections of a bag to a writer; return the new ones by the id of the old ones."""
    about = _about_in_2 if bag.ros2 else _about_in_1
    made: dict[tuple[Any, ...], Any] = {}
    outputs = {}
    for each in bag.reader.connections:
        key = (each.topic, each.msgtype, each.msgdef.data, str(each.ext))
        if key not in made:
            made[key] = writer.add_connection(each.topic, each.msgtype, **about(each))
        outputs[id(each)] = made[key]
    return outputs


def _about_in_1(connection: Any) -> dict[str, Any]:
    return {'msgdef': connection.msgdef.data, 'md5sum': connection.digest,
            'callerid': connection.ext.callerid, 'latching': connection.ext.latching}


def _about_in_2(connection: Any) -> dict[str, Any]:
    from rosbags.typesys import get_typestore, Stores

    msgdef, digest, msgtype = connection.msgdef.data, connection.digest, connection.msgtype
    known = get_typestore(Stores.ROS2_JAZZY)
    if msgtype in known.types:
        msgdef = msgdef or known.generate_msgdef(msgtype, ros_version=2)[0]
        digest = digest or known.hash_rihs01(msgtype)
    return {'msgdef': msgdef, 'rihs01': digest or _NO_HASH,
            'serialization_format': connection.ext.serialization_format,
            'offered_qos_profiles': connection.ext.offered_qos_profiles}
