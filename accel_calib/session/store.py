# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The files of a sensor: its calibration, its poses, and a lock.

A sensor is identified by its topic, with namespace, and the frame_id of its messages, or by the
name that the user gives it; each has files of its own. Nothing stored is lost: files that cannot
be used, or that belong to another sensor, are renamed and never overwritten.

"""

from __future__ import annotations

from dataclasses import dataclass, replace
import fcntl
import hashlib
import itertools
import os
from pathlib import Path
import re

from ..calibrate import Calibration
from ..errors import AccelCalibError, DamagedCalibrationError, StoredCalibrationError
from ..files import check_sensor, read_calibration, read_poses, write_calibration, write_table
from ..table import Poses
from ..units import UnitName

_UNSAFE = re.compile(r'[^A-Za-z0-9_-]+')
_UNSAFE_NAMED = re.compile(r'^\.+|[^A-Za-z0-9._-]+')
_UNSAFE_OF_VERSION_1 = re.compile(r'[^A-Za-z0-9._-]+')
_NAMELESS = 'imu'
_LONGEST = 120


class StoreInUseError(AccelCalibError):
    """Another node uses the files."""


@dataclass(frozen=True)
class Identity:
    """
    Which sensor files belong to.

    Parameters
    ----------
    sensor : str
        frame_id of its messages, or the name that the user gave it.
    topic : str
        Topic of its messages, with namespace.
    named : bool
        Whether the user gave the name; the topic then does not matter.

    """

    sensor: str
    topic: str
    named: bool = False

    @property
    def file_name(self) -> str:
        """Name of the calibration file, different for different sensors."""
        if self.named:
            return f'{_safe(self.sensor, _UNSAFE_NAMED)}.yaml'
        topic = '.'.join(_safe(part) for part in self.topic.strip('/').split('/'))
        return f'{topic}@{_safe(self.sensor)}.yaml'


def _safe(name: str, unsafe: re.Pattern[str] = _UNSAFE) -> str:
    """Return a name for a file; it ends with a hash if characters had to be replaced."""
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
    The files of a sensor.

    Parameters
    ----------
    calibration : Path
        The poses are in ``<stem>_poses.csv`` beside it.
    identity : Identity
        The sensor.
    units : {'m/s2', 'g', 'native'}
        Unit of its readings.

    """

    calibration: Path
    identity: Identity
    units: UnitName

    @property
    def poses(self) -> Path:
        """Path of the pose table."""
        return self.calibration.with_name(f'{self.calibration.stem}_poses.csv')

    def load_calibration(self) -> Calibration | None:
        """
        Read the calibration; None if there is none yet.

        Raises
        ------
        StoredCalibrationError
            If it is damaged, newer, of another sensor, or of readings in another unit.
        OSError
            If it cannot be read.

        """
        if not self.calibration.exists():
            return None
        calibration = read_calibration(self.calibration)
        check_sensor(calibration, self.identity.sensor)
        if calibration.units.name != self.units:
            raise StoredCalibrationError(f'{self.calibration} is for readings in '
                                         f'{calibration.units.name}, the parameter units is '
                                         f'{self.units}', 'set it to the unit of the calibration')
        return calibration

    def load_poses(self) -> Poses | None:
        """
        Read the poses; None if there are none yet.

        Raises
        ------
        InputError
            If the table is damaged.
        StoredCalibrationError
            If it is of another sensor or in another unit.
        OSError
            If it cannot be read.

        """
        if not self.poses.exists():
            return None
        poses = read_poses(self.poses)
        for what, found, expected in (('sensor', poses.sensor, self.identity.sensor),
                                      ('units', poses.units, self.units)):
            if found and found != expected and expected:
                raise StoredCalibrationError(f'{self.poses} has {what} {found!r}, expected '
                                             f'{expected!r}', 'new poses begin a new table')
        return poses

    def save_calibration(self, calibration: Calibration) -> None:
        """Write the calibration; the previous one is kept. Raises OSError."""
        self.calibration.parent.mkdir(parents=True, exist_ok=True)
        if self.calibration.exists():
            try:
                self.load_calibration()
            except AccelCalibError:
                aside(self.calibration, 'other')
        write_calibration(self.calibration, replace(
            calibration, sensor=self.identity.sensor, stream=self.identity.topic))

    def save_poses(self, poses: Poses) -> None:
        """Write the poses; without any there is no file. Raises OSError."""
        if len(poses) == 0:
            self.poses.unlink(missing_ok=True)
            return
        self.poses.parent.mkdir(parents=True, exist_ok=True)
        write_table(self.poses, replace(poses, sensor=self.identity.sensor, units=self.units))

    def set_aside(self) -> list[Path]:
        """Rename both files, so that nothing is lost; return the new names. Raises OSError."""
        return [aside(path, 'reset') for path in (self.calibration, self.poses) if path.exists()]

    def is_writable(self) -> bool:
        """Return whether files can be written there, or the folder made."""
        folder = self.calibration.parent
        while not folder.exists():
            folder = folder.parent
        return os.access(folder, os.W_OK)


class Lock:
    """
    The right to use the files of a store, until it is released or the process ends.

    Parameters
    ----------
    store : Store
        The store.

    Raises
    ------
    StoreInUseError
        If another process has it.

    """

    def __init__(self, store: Store) -> None:
        self._handle = -1
        path = store.calibration.with_name(f'{store.calibration.stem}.lock')
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError:
            return  # nobody can write there, so there is nothing to protect
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(self._handle, 32).decode(errors='replace').strip()
            self.release()
            raise StoreInUseError(
                f'{store.calibration} is in use by the node of process {holder or "unknown"}',
                'end that node, or set calibration_file or sensor for this one') from None
        os.ftruncate(self._handle, 0)
        os.pwrite(self._handle, f'{os.getpid()}\n'.encode(), 0)

    def release(self) -> None:
        """Leave the files to others."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


@dataclass(frozen=True)
class Loaded:
    """
    The content of a store.

    Parameters
    ----------
    calibration, poses
        None if there are none that can be used.
    problem : str
        Why the calibration cannot be used; empty if it can, or if there is none.
    notes : tuple of str
        What else the user should know.

    """

    calibration: Calibration | None
    poses: Poses | None
    problem: str = ''
    notes: tuple[str, ...] = ()


def load(store: Store) -> Loaded:
    """Read a store; files that cannot be used are renamed, or left if they can be used later."""
    notes = take_over(store)
    calibration, poses, problem = None, None, ''
    try:
        calibration = store.load_calibration()
    except (AccelCalibError, OSError) as error:
        problem = str(error)
        if isinstance(error, DamagedCalibrationError):
            problem = f'{problem}; {_renamed(store.calibration)}'
    if calibration is not None and calibration.stream not in ('', store.identity.topic):
        notes.append(f'{store.calibration} was made for {calibration.stream}, and is used for '
                     f'{store.identity.topic}')
    try:
        poses = store.load_poses()
    except (AccelCalibError, OSError) as error:
        notes.append(f'{error}; {_renamed(store.poses)}')
    return Loaded(calibration, poses, problem, tuple(notes))


def _renamed(path: Path) -> str:
    """Rename a file that cannot be used, and return a line about it."""
    try:
        return f'kept as {aside(path, "damaged")}'
    except OSError as error:
        return f'it cannot be renamed ({error})'


def store_of(calibration_file: str, identity: Identity, units: UnitName) -> Store:
    """
    Return the store of a sensor.

    Parameters
    ----------
    calibration_file : str
        File that the user chose, ``~`` for home; empty: in ``accel_calib`` in `ros_home`.
    identity : Identity
        The sensor.
    units : {'m/s2', 'g', 'native'}
        Unit of its readings.

    """
    if calibration_file:
        return Store(Path(calibration_file).expanduser().absolute(), identity, units)
    return Store(ros_home() / 'accel_calib' / identity.file_name, identity, units)


def take_over(store: Store) -> list[str]:
    """
    Rename the files that version 0.1 stored under the frame_id alone; return lines about it.

    Several sensors may have shared such a name. The first that finds it takes it, if the
    calibration is of its frame_id; poses without a calibration only if their name is unambiguous.

    """
    sensor = store.identity.sensor
    name = _UNSAFE_OF_VERSION_1.sub('_', sensor).strip('._') or _NAMELESS
    former = replace(store, calibration=store.calibration.with_name(f'{name}.yaml'))
    own = ros_home() / 'accel_calib' / store.identity.file_name
    if (store.calibration != own or former.calibration == store.calibration
            or store.calibration.exists() or store.poses.exists()):
        return []
    try:
        found = former.load_calibration()
    except (AccelCalibError, OSError):
        return []
    ours = found.sensor == sensor if found is not None else name == sensor
    lines = []
    for old, new in ((former.calibration, store.calibration), (former.poses, store.poses)):
        if ours and old.exists():
            old.rename(new)
            lines.append(f'{old} is now {new}')
    return lines


def aside(path: Path, word: str) -> Path:
    """Rename a file to ``<name>.<word><k>`` with the first free k, and return that name."""
    names = (path.with_name(f'{path.name}.{word}{k}') for k in itertools.count(1))
    free = next(name for name in names if not name.exists())
    path.replace(free)
    return free
