# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Correction of a bag: a copy with a corrected Imu topic; all other messages are unchanged.

`rosbags` writes the copy, with the storage of the original. The copy does not contain everything
(not the attachments of MCAP, and not the division into several files); see docs/files.md.

"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
import errno
import glob
import os
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
import time
from typing import Any

import numpy as np

from .correction import corrected, output_frame, output_scale
from ..calibration import Calibration, on_topics
from ..disk import check_regular
from ..errors import InputError
from ..logs import (
    BAG, IMU_DOUBLES, imus_of, joined, LogOptions, messages_of, open_bag, parts_of, Progress)
from ..pipeline import Correction
from ..table import check_units, Recording
from ..units import Units, units_of

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
    ros2 = path.suffix != '.bag'
    if (out.suffix == '.bag') is ros2:
        kind, names = (2, '.mcap or .db3, or the name of a folder') if ros2 else (1, '.bag')
        raise InputError(f'{path} is a ROS {kind} bag, but {out} is not the name of one',
                         f'choose a name that ends in {names}')
    if not path.is_dir():
        check_regular(path)
    with parts_of(BAG.file(path), messages_of, options, calibration.model.needs,
                  in_child=options.in_child) as parts:
        known = next(parts)
        units = units_of(options.units or 'm/s2', options.gravity)
        correction = Correction(on_topics(calibration, calibration.frame), units.name,
                                known['sensor'])
        imus = _Imus(path=path, ros2=ros2, known=known, correction=correction, units=units,
                     scale=output_scale(correction.calibration, options.gravity))
        with _new(out) as folder:
            notes = _copy(imus, parts, folder, out, progress)
    for line in (*notes, *correction.notes):
        note(line)
    return imus.done


@contextmanager
def _new(out: Path) -> Iterator[Path]:
    """
    Yield a new folder next to the target, and remove it and old leftovers of others.

    An OSError has the name of the target; SQLite has an error of its own for a full disk.

    """
    out.parent.mkdir(parents=True, exist_ok=True)
    for each in out.parent.glob(f'.{glob.escape(out.name)}.*{_PARTIAL}'):
        if not each.is_symlink() and time.time() - each.stat().st_mtime > _STALE_S:
            shutil.rmtree(each)
    try:
        with TemporaryDirectory(_PARTIAL, f'.{out.name}.', out.parent) as folder:
            yield Path(folder)
    except sqlite3.OperationalError as err:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(out)) from err
    except OSError as err:
        err.filename = str(out)
        raise


@dataclass
class _Imus:
    """The messages of an Imu topic: what `messages_of` says first, and the units recorded."""

    path: Path
    ros2: bool
    known: Mapping[str, Any]
    correction: Correction
    units: Units
    scale: float
    done: int = 0

    def corrected(self, raws: Sequence[memoryview]) -> Iterator[bytes]:
        """Return the corrected messages."""
        own, sensor = self.correction.calibration, self.known['sensor']
        name = f'{self.path}, {self.known["topic"]}'
        messages = joined(raws, IMU_DOUBLES, name, ros2=self.ros2, before=self.done)
        columns, _ = imus_of(messages, name, self.done, sensor)
        samples = Recording(columns, np.arange(len(messages)))
        if not self.done:
            check_units(samples, self.units, str(self.path))
        known = self.correction.context(samples.with_columns(**{
            key: np.interp(columns['time'], *track)
            for key, track in self.known['tracks'].items()}))
        doubles = messages.doubles(slice(0, IMU_DOUBLES))
        with np.errstate(over='ignore', invalid='ignore'):  # damaged numbers become infinite
            new = corrected(own, doubles, known, scale=self.scale)
        self.done += len(messages)
        return messages.rewrite(new, output_frame(own, sensor) if own.is_levelled else None)


def _copy(imus: _Imus, parts: Iterator[Any], folder: Path, out: Path, progress: Progress
          ) -> list[str]:
    """Copy all messages, correct those of the Imu topic, and return the notes about the bag."""
    target = folder / (out.stem if out.suffix in ('.mcap', '.db3') else out.name)
    imu, written, notes = {*imus.known['imu']}, 0, list[str]()
    with _writer(imus, target, out.suffix) as writer:
        with BAG.file(imus.path).refused():
            outputs = _added(imus, writer)
        for block in parts:
            if isinstance(block, list):
                notes = block
                continue
            ends = np.cumsum(block['size']).tolist()
            raws = [block['data'].data[start:end] for start, end in zip([0, *ends], ends)]
            connections = block['connection'].tolist()
            which = [k for k, connection in enumerate(connections) if connection in imu]
            new = imus.corrected([raws[k] for k in which]) if which else ()
            changed = dict(zip(which, new, strict=True))
            for k, (connection, stamp) in enumerate(zip(connections, block['stamp'].tolist())):
                writer.write(outputs[connection], stamp, changed.get(k, raws[k]))
            written += len(raws)
            progress(imus.done, imus.known['count'])
    try:  # it can be read back, and its files hold all messages
        with BAG.file(target).refused(), open_bag(target) as copy:
            stored = copy.stored
    except InputError as err:
        what = err.message.removeprefix(f'{target} ')
        raise InputError(f'{imus.path} cannot be copied: the copy {what}', 'use a bag whose '
                         'topics have valid names, types and formats') from err
    if stored != written:
        raise InputError(f'{imus.path}: the copy holds {stored} of {written} messages, expected '
                         'all', 'check the disk, and try again')
    (target if target.name == out.name else next(target.glob(f'*{out.suffix}'))).rename(out)
    return notes


def _writer(imus: _Imus, target: Path, suffix: str) -> Any:
    """Return a writer for the kind of bag that the suffix names, otherwise for the same kind."""
    if not imus.ros2:
        from rosbags.rosbag1 import Writer as Writer1

        return Writer1(target)
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    mcap = suffix == '.mcap' or (suffix != '.db3' and (
        imus.path.suffix == '.mcap' or any(imus.path.glob('*.mcap*'))))
    writer = Writer(target, version=9, storage_plugin=StoragePlugin.MCAP if mcap
                    else StoragePlugin.SQLITE3)
    mode = imus.known['compression']
    if mode and suffix not in ('.mcap', '.db3'):  # a lone file has no metadata to tell it
        writer.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    return writer


def _added(imus: _Imus, writer: Any) -> list[Any]:
    """Add the connections of a bag to a writer, and return the new ones."""
    made: dict[str, Any] = {}
    outputs = []
    for each in imus.known['connections']:
        topic, msgtype, msgdef, digest, ext = (each[name] for name in (
            'topic', 'msgtype', 'msgdef', 'digest', 'ext'))
        key = str([topic, msgtype, msgdef, ext])
        if key not in made and imus.ros2:
            from rosbags.rosbag2.metadata import parse_qos
            from rosbags.typesys import get_typestore, Stores

            known = get_typestore(Stores.ROS2_JAZZY)
            if msgtype in known.types:
                msgdef = msgdef or known.generate_msgdef(msgtype, ros_version=2)[0]
                digest = digest or known.hash_rihs01(msgtype)
            made[key] = writer.add_connection(
                topic, msgtype, msgdef=msgdef, rihs01=digest or _NO_HASH,
                serialization_format=ext[0], offered_qos_profiles=parse_qos(ext[1]))
        elif key not in made:
            made[key] = writer.add_connection(topic, msgtype, msgdef=msgdef, md5sum=digest,
                                              **dict(zip(('callerid', 'latching'), ext)))
        outputs.append(made[key])
    return outputs
