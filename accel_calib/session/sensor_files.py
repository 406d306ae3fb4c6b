# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The files of the sensor of a session, which only one node can use at a time."""

from __future__ import annotations

from .settings import CalibratorSettings
from .store import Identity, Lock, Store, store_of, StoreInUseError
from ..errors import InputError


class SensorFiles:
    """
    The store of a sensor, with its lock.

    Parameters
    ----------
    settings : CalibratorSettings
        Parameters for sensor and files.
    topic : str
        Topic of the messages, with namespace.

    Attributes
    ----------
    store : Store or None
        The store; None until the sensor is known.
    problem : str
        Reason why the files cannot be used, or empty.

    """

    def __init__(self, settings: CalibratorSettings, topic: str) -> None:
        self._settings, self._topic = settings, topic
        self._lock: Lock | None = None
        self.store: Store | None = None
        self.problem = ''

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
        """
        Return the locked store.

        Raises
        ------
        InputError
            If the sensor is not known yet, or another node uses the files.

        """
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
