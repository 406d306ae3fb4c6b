# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The files of the sensor of a session: what they contain, and the lock for one node at a time.

A lock on the files is held until it is released or the process ends.

"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import fcntl
import os
from pathlib import Path
import stat

from .settings import CalibratorSettings
from .store import aside, here, Identity, Store, store_of, writing_advice
from ..calibrate import Calibration
from ..disk import remove_leftovers
from ..errors import (
    AccelCalibError, crash_words, DamagedCalibrationError, InputError, StoredCalibrationError)
from ..table import Poses

_TO_LOCK = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
"""A link is not followed, because the lock would empty its target; a pipe does not block."""


class StoreInUseError(AccelCalibError):
    """Another node uses the files."""


class Lock:
    """A lock on the files of a store; StoreInUseError if another process has locked them."""

    def __init__(self, store: Store) -> None:
        self._handle = -1
        path = store.calibration.with_name(f'{store.calibration.stem}.lock')
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(path, _TO_LOCK, 0o644)
        except OSError:
            return  # the folder cannot be written, so there is nothing to protect
        if not stat.S_ISREG(os.fstat(self._handle).st_mode):
            self.release()
            return
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(self._handle, 32).decode(errors='replace').strip()
            self.release()
            raise StoreInUseError(
                f'{store.calibration} is used by the node with process id {holder or "unknown"}',
                'stop that node, or restart this node with another calibration_file or sensor'
            ) from None
        except OSError:
            self.release()  # this file system has no locks
            return
        with suppress(OSError):  # without space on the disk, the lock does not name its holder
            os.ftruncate(self._handle, 0)
            os.pwrite(self._handle, f'{os.getpid()}\n'.encode(), 0)

    def release(self) -> None:
        """Release the lock."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


class SensorFiles:
    """The store of a sensor, None until the sensor is known; and why it cannot be used, or ''."""

    def __init__(self, settings: CalibratorSettings, topic: str) -> None:
        self._settings, self._topic = settings, topic
        self._lock: Lock | None = None
        self.store: Store | None = None
        self.problem = ''

    @property
    def path(self) -> str:
        """Path of the calibration; empty until the sensor is known."""
        return '' if self.store is None else str(self.store.calibration)

    @property
    def locked(self) -> bool:
        """Whether this node has locked the files."""
        return self._lock is not None

    def take(self, sensor: str) -> Store | None:
        """Lock the files of a sensor and return the store; None if another node uses them."""
        identity = Identity(sensor, self._topic, bool(self._settings.sensor))
        before, self.store = self.store, store_of(self._settings.calibration_file, identity,
                                                  self._settings.units)
        if before is None or before.calibration != self.store.calibration:
            self.release()
        return self.store if self.locked else self.try_again()

    def try_again(self) -> Store | None:
        """Lock the files if they have become free; return the store, or otherwise None."""
        if self.store is None or self.locked:
            return None
        try:
            self._lock, self.problem = Lock(self.store), ''
        except StoreInUseError as error:
            self.problem = str(error)
            return None
        return self.store

    def usable(self) -> Store:
        """Return the locked store; InputError if the sensor is not known, or it is not locked."""
        if self.store is None:
            raise InputError('the name of the sensor is not known, because there is no Imu '
                             'message yet', 'start the driver, or set the parameter sensor')
        if not self.locked:
            raise InputError(self.problem, 'this node stores nothing')
        return self.store

    def release(self) -> None:
        """Unlock the files."""
        if self._lock is not None:
            self._lock.release()
        self._lock = None


@dataclass(frozen=True)
class Loaded:
    """What is usable of a store, notes, and `problem`: why the calibration cannot be used."""

    calibration: Calibration | None
    poses: Poses | None
    problem: str = ''
    notes: tuple[str, ...] = ()


def load(store: Store, call: Callable[..., Calibration] = here) -> Loaded:
    """Read a store; damaged files are renamed, and no file keeps the node from starting."""
    notes = _tidied(store)
    calibration, poses, problem = None, None, ''
    try:
        calibration = store.load_calibration(call)
    except Exception as error:  # the node starts in any case
        problem = f'{_words(error)}; {_after(store.calibration, error)}'
    if calibration is not None and calibration.stream not in ('', store.identity.topic):
        notes.append(f'{store.calibration} was made for {calibration.stream}, but it is used for '
                     f'{store.identity.topic}')
    try:
        poses = store.load_poses()
    except Exception as error:
        notes.append(f'{_words(error)}; {_renamed(store.poses)}')
    return Loaded(calibration, poses, problem, tuple(notes))


def _tidied(store: Store) -> list[str]:
    """Remove leftovers of writing; return log lines about what fails."""
    try:
        failed = [error for path in (store.calibration, store.poses)
                  for error in remove_leftovers(path)]
    except OSError as error:
        return [f'the folder {store.calibration.parent} could not be tidied: {error}; '
                f'{writing_advice(error)}']
    return [f'the temporary file {error.filename} could not be removed: {error.strerror}; '
            'remove it by hand' for error in failed]


def _after(path: Path, error: Exception) -> str:
    """Return what happens to a calibration that cannot be used; a damaged one is renamed."""
    sound = isinstance(error, OSError | StoredCalibrationError)
    if sound and not isinstance(error, DamagedCalibrationError):
        return 'it is renamed when the next calibration is stored'
    return _renamed(path)


def _words(error: Exception) -> str:
    """Return one line about an error, also about one that nobody expected."""
    return str(error) if isinstance(error, AccelCalibError | OSError) else crash_words(error)


def _renamed(path: Path) -> str:
    try:
        return f'kept as {aside(path, "damaged")}'
    except OSError as error:
        return f'it could not be renamed ({error})'
