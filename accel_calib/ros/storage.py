# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Where the calibration and the poses of a sensor are kept."""

from __future__ import annotations

from dataclasses import dataclass
import itertools
import os
from pathlib import Path
import re
from typing import TYPE_CHECKING

from ..errors import AccelCalibError, StoredCalibrationError
from ..files import check_sensor, read_calibration, read_poses, write_calibration, write_table

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..table import Poses

_UNSAFE = re.compile(r'[^A-Za-z0-9._-]+')
_NAMELESS = 'imu'


def ros_home() -> Path:
    """Give ``$ROS_HOME``, or ``~/.ros``."""
    return Path(os.environ.get('ROS_HOME') or Path.home() / '.ros')


def safe_name(sensor: str) -> str:
    """Give the name of a sensor as a name of a file."""
    return _UNSAFE.sub('_', sensor).strip('._') or _NAMELESS


@dataclass(frozen=True)
class Store:
    """
    Two files: the calibration, and the poses beside it.

    Parameters
    ----------
    calibration : Path
        Poses are in ``<stem>_poses.csv``.

    """

    calibration: Path

    @property
    def poses(self) -> Path:
        """Give the path of the pose table."""
        return self.calibration.with_name(f'{self.calibration.stem}_poses.csv')

    def load_calibration(self, sensor: str, units: str) -> Calibration | None:
        """
        Read the calibration of this sensor; None where there is none yet.

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
        check_sensor(calibration, sensor)
        if calibration.units.name != units:
            raise StoredCalibrationError(f'{self.calibration} is for readings in '
                                         f'{calibration.units.name}, the parameter units is '
                                         f'{units}', 'set it to the unit of the calibration')
        return calibration

    def load_poses(self) -> Poses | None:
        """
        Read the poses; None where there are none yet.

        Raises
        ------
        InputError
            If the table is damaged.
        OSError
            If it cannot be read.

        """
        return read_poses(self.poses) if self.poses.exists() else None

    def save_calibration(self, calibration: Calibration) -> None:
        """Write the calibration; the one before is kept. Raises OSError."""
        self.calibration.parent.mkdir(parents=True, exist_ok=True)
        write_calibration(self.calibration, calibration)

    def save_poses(self, poses: Poses) -> None:
        """Write the poses; without any, there is no file. Raises OSError."""
        if len(poses) == 0:
            self.poses.unlink(missing_ok=True)
            return
        self.poses.parent.mkdir(parents=True, exist_ok=True)
        write_table(self.poses, poses)

    def set_aside(self) -> list[Path]:
        """Rename both files, so that nothing is lost; give their new names. Raises OSError."""
        return [aside(path, 'reset') for path in (self.calibration, self.poses) if path.exists()]

    def is_writable(self) -> bool:
        """Say whether files can be written there, or the folder made."""
        folder = self.calibration.parent
        while not folder.exists():
            folder = folder.parent
        return os.access(folder, os.W_OK)


@dataclass(frozen=True)
class Loaded:
    """
    What was found in a store.

    Parameters
    ----------
    calibration, poses
        None where there are none that can be used.
    problem : str
        Why the calibration cannot be used; empty where it can, or where there is none.
    note : str
        Why the poses cannot be used; empty as well.

    """

    calibration: Calibration | None
    poses: Poses | None
    problem: str = ''
    note: str = ''


def load(store: Store, sensor: str, units: str) -> Loaded:
    """Read what there is; a pose table that cannot be read is set aside, and said so."""
    calibration, poses, problem, note = None, None, '', ''
    try:
        calibration = store.load_calibration(sensor, units)
    except (AccelCalibError, OSError) as error:
        problem = str(error)
    try:
        poses = store.load_poses()
    except (AccelCalibError, OSError) as error:
        note = f'{error}; {_kept(store.poses)}'
    return Loaded(calibration, poses, problem, note)


def _kept(path: Path) -> str:
    """Set a damaged file aside and say so."""
    try:
        return f'kept as {aside(path, "damaged")}'
    except OSError as error:
        return f'it stays where it is ({error})'


def store_of(calibration_file: str, sensor: str) -> Store:
    """
    Give the store of a sensor.

    Parameters
    ----------
    calibration_file : str
        Where the user wants it, ``~`` for home; empty: ``accel_calib/<sensor>.yaml`` in
        `ros_home`.
    sensor : str
        Name of the sensor.

    """
    if calibration_file:
        return Store(Path(calibration_file).expanduser().absolute())
    return Store(ros_home() / 'accel_calib' / f'{safe_name(sensor)}.yaml')


def aside(path: Path, word: str) -> Path:
    """Rename a file to ``<name>.<word><k>`` with the first free k; give that name."""
    names = (path.with_name(f'{path.name}.{word}{k}') for k in itertools.count(1))
    free = next(name for name in names if not name.exists())
    path.replace(free)
    return free
