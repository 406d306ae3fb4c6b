# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The files of a sensor: calibration and poses, and the lock for one node at a time.

Each sensor has its own files (`store_of`). Stored data are never lost: files that cannot be used,
or that belong to another sensor, are renamed and never overwritten. So are folders with such a
name, pipes, sockets and links to nothing. Devices, and folders without a suffix in their name, are
left where they are: the node then works without storing.

Calibrations are formatted and parsed apart from writing, so that another process can do it
(`Store.load_calibration`, `Store.prepared`). Files are written in the process that holds the lock.
It is held until it is released or the process ends.

"""

from __future__ import annotations

from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
import errno
import fcntl
import glob
import hashlib
import itertools
import os
from pathlib import Path
import re
import stat

import numpy as np

from .settings import CalibratorSettings
from ..calibration import Calibration, check_sensor
from ..disk import check_regular, copy_atomically, remove_leftovers, write_atomically
from ..effects import OwnEffect
from ..errors import (
    AccelCalibError, crash_words, DamagedCalibrationError, FREE_SPACE, InputError, is_full,
    StoredCalibrationError)
from ..logs import read_poses, write_table
from ..stored import calibration_bytes, read_calibration
from ..table import LARGEST, Poses
from ..text import LONGEST_NAME, one_line
from ..units import UnitName

ANOTHER_FILE = 'start again with another calibration_file (live: another -o)'
"""What to do if a file cannot be used: the parameter of the node, and the option of ``live``."""

_UNSAFE = re.compile(r'[^A-Za-z0-9_-]+')
_UNSAFE_NAMED = re.compile(r'^\.+|[^A-Za-z0-9._-]+')
_NAMELESS = 'imu'
_LONGEST = 120
_NUMBER = re.compile('[1-9][0-9]{0,17}')

MOST_STEPS = 100
"""Number of earlier calibrations that are kept for ~/undo; older ones are removed."""

_OTHER_PLACE = (errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP)
"""Errors of a path that no file can have."""

_UNREADABLE = (errno.EACCES, errno.EPERM, errno.ENOENT, errno.ELOOP)
"""Errors of a file that later attempts cannot read either; it is renamed before writing."""

_LARGEST_TABLE = 32 * 2**20
"""Largest pose table of a store: 100,000 poses have half of it [bytes]."""


def _safe(name: str, unsafe: re.Pattern[str] = _UNSAFE) -> str:
    """Return a file name; it ends with a hash if characters were replaced."""
    safe = unsafe.sub('_', name)[:_LONGEST] or _NAMELESS
    if safe == name:
        return safe
    return f'{safe.strip("_") or _NAMELESS}-{hashlib.sha256(name.encode()).hexdigest()[:8]}'


def ros_home() -> Path:
    """Return ``$ROS_HOME``, or ``~/.ros``."""
    return Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')


@dataclass(frozen=True)
class Store:
    """
    The files of a sensor, for readings in one unit, and the effects of the user.

    The poses are in ``<stem of the calibration>_poses.csv`` in the same folder. All methods raise
    OSError if a file cannot be read or written.

    """

    calibration: Path
    sensor: str
    topic: str
    units: UnitName
    own: tuple[OwnEffect, ...] = ()

    @property
    def poses(self) -> Path:
        """Path of the pose table."""
        return self.calibration.with_name(f'{self.calibration.stem}_poses.csv')

    def load_calibration(self) -> Calibration | None:
        """Return the stored calibration as `read` does, or None if there is none."""
        return self.read(self.calibration) if _exists(self.calibration) else None

    def read(self, path: Path) -> Calibration:
        """
        Return a calibration of this sensor in the unit of the readings.

        StoredCalibrationError if it is damaged, of another version, for another sensor, or in
        a unit that cannot be converted. InputError if it is not a regular file.

        """
        calibration = read_calibration(path, self.own)
        check_sensor(calibration, self.sensor)
        try:
            return calibration.in_units(self.units)
        except InputError as err:
            raise StoredCalibrationError(f'{path} is for readings in {calibration.units.name}, '
                                         f'but the parameter units is {self.units}',
                                         'start again with the units of the calibration'
                                         ) from err

    def load_poses(self) -> Poses | None:
        """
        Return the stored poses, or None if there are none.

        InputError if the table is damaged, too large, or not a regular file.
        StoredCalibrationError if it is for another sensor or unit.

        """
        if not _exists(self.poses):
            return None
        check_regular(self.poses)
        size = self.poses.stat().st_size
        if size > _LARGEST_TABLE:
            raise InputError(f'{self.poses} has {size} bytes, expected at most {_LARGEST_TABLE}',
                             'new poses start a new table')
        poses = read_poses(self.poses, partial=True)
        if 'count' in poses and np.any(poses['count'] < 1.0 / LARGEST):
            row = int(np.argmin(poses['count'])) + 1
            raise InputError(f'{self.poses}: row {row} has an impossible count, expected at least '
                             f'{1.0 / LARGEST:g}', 'new poses start a new table')
        for what, found, expected in (('sensor', poses.sensor, self.sensor),
                                      ('units', poses.units, self.units)):
            if found and found != expected and expected:
                raise StoredCalibrationError(f'{self.poses} has {what} {found!r}, expected '
                                             f'{expected!r}', 'new poses start a new table')
        return poses

    def prepared(self, calibration: Calibration) -> tuple[bytes, bool]:
        """Return the content of the file of a calibration, and whether the present `is_good`."""
        named = replace(calibration, sensor=self.sensor, stream=self.topic)
        return calibration_bytes(named), self.is_good()

    def is_good(self) -> bool:
        """Return whether the present file can be used, or does not exist."""
        try:
            self.load_calibration()
        except AccelCalibError:
            return False
        except OSError as error:
            if error.errno not in _UNREADABLE:
                raise
            return False
        return True

    def write(self, prepared: tuple[bytes, bool]) -> None:
        """Write what `prepared` returned, and keep the file before as a step."""
        data, is_good = prepared
        self.calibration.parent.mkdir(parents=True, exist_ok=True)
        step = self._keep_step(is_good)
        try:
            write_atomically(self.calibration, lambda file: file.buffer.write(data))
        except OSError:
            step.unlink(missing_ok=True)
            raise
        if step.read_bytes() == data:
            step.unlink()

    def _keep_step(self, is_good: bool) -> Path:
        """Return a copy of a good file for `step_back`, or an empty step if there is none."""
        if not is_good:
            aside(self.calibration, 'other')
        kept, used = [*self.steps().values()], [number for number, _ in self._named_as_steps()]
        step = self.calibration.with_name(
            f'{self.calibration.name}.before{1 + max(used, default=0)}')
        if _exists(self.calibration):
            copy_atomically(self.calibration, step)
        else:
            step.touch()
        for old in kept[:max(len(kept) + 1 - MOST_STEPS, 0)]:
            old.unlink(missing_ok=True)
        return step

    def steps(self) -> dict[int, Path]:
        """Return the kept steps by number, the oldest first."""
        return {number: path for number, path in self._named_as_steps() if path.is_file()}

    def _named_as_steps(self) -> list[tuple[int, Path]]:
        """Return what has the name of a step, also what is not a file, with its number."""
        start = f'{self.calibration.name}.before'
        found = ((path.name.removeprefix(start), path)
                 for path in self.calibration.parent.glob(f'{glob.escape(start)}*'))
        return sorted((int(number), path) for number, path in found if _NUMBER.fullmatch(number))

    def step_back(self) -> Calibration | None:
        """
        Return to the calibration before the last stored one; None if there was none.

        The last stored file is kept as ``<name>.undone<k>``. InputError if there is no earlier
        step, StoredCalibrationError if the earlier calibration cannot be used.

        """
        now = b''
        if _exists(self.calibration):
            check_regular(self.calibration)
            now = self.calibration.read_bytes()
        # The last step that differs from the file; equal ones come from failed writes.
        for step in reversed(self.steps().values()):
            if step.read_bytes() != now:
                break
            step.unlink()
        else:
            raise InputError('there is no earlier calibration', 'nothing can be undone')
        try:
            before = self.read(step) if step.stat().st_size else None
        except DamagedCalibrationError as error:
            raise StoredCalibrationError(f'{error.message}; it is kept as '
                                         f'{aside(step, "damaged")}', 'try again for the '
                                         'calibration before it') from error
        if _exists(self.calibration):
            copy_atomically(self.calibration, free_name(self.calibration, 'undone'))
        if before is not None:
            step.replace(self.calibration)
            return before
        self.calibration.unlink(missing_ok=True)
        step.unlink()
        return None

    def save_poses(self, poses: Poses) -> None:
        """Write the poses, or remove the file if there are none."""
        if len(poses) == 0:
            self.poses.unlink(missing_ok=True)
            return
        self.poses.parent.mkdir(parents=True, exist_ok=True)
        write_table(self.poses, replace(poses, sensor=self.sensor, units=self.units))

    def set_aside(self, is_good: bool) -> list[Path]:
        """Rename both files, and return the new paths."""
        if _exists(self.calibration):
            self._keep_step(is_good)
        return [aside(path, 'reset') for path in (self.calibration, self.poses) if _exists(path)]

    def is_writable(self) -> bool:
        """Return whether the files can be written, or their folder created."""
        folder = self.calibration.parent
        while not os.path.lexists(folder):
            folder = folder.parent
        rights = os.W_OK | os.X_OK
        return folder.is_dir() and os.access(folder, rights, effective_ids=True)


def _exists(path: Path) -> bool:
    """Return whether something has this path, also a link to nothing; OSError if not known."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def store_of(settings: CalibratorSettings, name: str, topic: str,
             own: tuple[OwnEffect, ...] = ()) -> Store:
    """
    Return the store of a sensor, by default in `ros_home`; InputError if there is no home.

    The name of the file has that of the sensor if the user has set it, otherwise also the topic.

    """
    sensor, units = one_line(name).strip()[:LONGEST_NAME], settings.units
    if settings.calibration_file:
        try:
            path = Path(settings.calibration_file).expanduser()
        except RuntimeError as error:
            raise InputError(f'calibration_file is {settings.calibration_file}, but this user has '
                             'no home folder', 'state the whole path') from error
        return Store(path.absolute(), sensor, topic, units, own)
    file_name = _safe(sensor, _UNSAFE_NAMED) if settings.sensor else (
        f'{".".join(map(_safe, topic.strip("/").split("/")))}@{_safe(sensor)}')
    return Store(ros_home() / 'accel_calib' / f'{file_name}.yaml', sensor, topic, units, own)


def aside(path: Path, word: str) -> Path:
    """Rename to the `free_name`, and return it; OSError for devices and folders without suffix."""
    mode = path.lstat().st_mode
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode) or (stat.S_ISDIR(mode) and not path.suffix):
        kind = 'folder' if stat.S_ISDIR(mode) else 'device'
        raise OSError(errno.EEXIST, f'there is a {kind} in place of the file', str(path))
    free = free_name(path, word)
    path.replace(free)
    return free


def free_name(path: Path, word: str) -> Path:
    """Return ``<name>.<word><k>`` with the first free k."""
    names = (path.with_name(f'{path.name}.{word}{k}') for k in itertools.count(1))
    return next(name for name in names if not _exists(name))


def writing_advice(error: OSError) -> str:
    """Return what to do about a file that cannot be written."""
    if is_full(error):
        return FREE_SPACE
    if error.errno == errno.EROFS:
        return f'mount the file system for writing, or {ANOTHER_FILE}'
    return ANOTHER_FILE if error.errno in _OTHER_PLACE else (
        f'correct the permissions, or {ANOTHER_FILE}')


_TO_LOCK = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""A link is not followed, because the lock would empty its target; a pipe does not block."""


@dataclass(frozen=True)
class SensorFiles:
    """
    The store of a sensor, None until the sensor is known, and its `lock`, None without it.

    `problem` is why another node has the lock; empty if none has it. Where files cannot be locked,
    the lock is empty.

    """

    store: Store | None = None
    lock: ExitStack | None = None
    problem: str = ''

    @property
    def path(self) -> str:
        """Path of the calibration; empty until the sensor is known."""
        return '' if self.store is None else str(self.store.calibration)

    def take(self) -> SensorFiles:
        """Return the files, locked until `release` unless another process has locked them."""
        if self.store is None or self.lock is not None:
            return self
        path, mine = self.store.calibration, replace(self, lock=ExitStack(), problem='')
        with ExitStack() as lock:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                handle = os.open(path.with_name(f'{path.stem}.lock'), _TO_LOCK, 0o644)
            except OSError:
                return mine  # the folder cannot be written, so there is nothing to protect
            lock.callback(os.close, handle)
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                return mine
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.read(handle, 32).decode(errors='replace').strip() or 'unknown'
                return replace(self, problem=str(InputError(
                    f'{path} is used by the node with process id {holder}', 'stop that node, or '
                    f'{ANOTHER_FILE}, or another sensor')))
            except OSError:
                return mine  # this file system has no locks
            with suppress(OSError):  # without space on the disk, the lock does not name its holder
                os.ftruncate(handle, 0)
                os.pwrite(handle, f'{os.getpid()}\n'.encode(), 0)
            return replace(mine, lock=lock.pop_all())

    def usable(self) -> Store:
        """Return the locked store; InputError if the sensor is not known, or it is not locked."""
        if self.store is None:
            raise InputError('the name of the sensor is not known, because there is no Imu '
                             'message yet', 'start the driver, or set the parameter sensor')
        if self.lock is None:
            raise InputError(self.problem, 'this node stores nothing')
        return self.store

    def release(self) -> None:
        """Unlock the files."""
        if self.lock is not None:
            self.lock.close()


def tidied(store: Store) -> list[str]:
    """Remove leftovers of writing; return log lines about what fails."""
    try:
        failed = [error for path in (store.calibration, store.poses)
                  for error in remove_leftovers(path)]
    except OSError as error:
        return [f'the folder {store.calibration.parent} could not be tidied: {error}; '
                f'{writing_advice(error)}']
    return [f'the temporary file {error.filename} could not be removed: {error.strerror}; '
            'remove it by hand' for error in failed]


def unusable(path: Path, error: Exception, is_table: bool = False) -> str:
    """Return a line about a file that cannot be used; a damaged one and a table are renamed."""
    words = str(error) if isinstance(error, AccelCalibError | OSError) else crash_words(error)
    sound = isinstance(error, OSError | StoredCalibrationError)
    if sound and not is_table and not isinstance(error, DamagedCalibrationError):
        return f'{words}; it is renamed when the next calibration is stored'
    try:
        return f'{words}; kept as {aside(path, "damaged")}'
    except OSError as err:
        return f'{words}; it could not be renamed ({err})'
