# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Errors that a user can fix, and helpers for their messages.

Each message has three parts: what was found, what was expected, and what to do.

"""

from collections.abc import Sequence
import errno


class AccelCalibError(Exception):
    """
    The input is not valid.

    Parameters
    ----------
    message : str
        One line: what was found, and what was expected.
    advice : str
        One line: what to do.

    """

    def __init__(self, message: str, advice: str) -> None:
        super().__init__(message, advice)
        self.message = message
        self.advice = advice

    def __str__(self) -> str:
        return f'{self.message}; {self.advice}'


class InputError(AccelCalibError):
    """A file, a column or a number is not valid."""


class RefusedFitError(AccelCalibError):
    """The poses do not determine the model, or the result is not plausible."""


class StoredCalibrationError(AccelCalibError):
    """A stored calibration is newer than this package, or belongs to another sensor."""


class DamagedCalibrationError(StoredCalibrationError):
    """A stored calibration is damaged, or has values that are not plausible."""


def is_full(error: OSError) -> bool:
    """Return whether an error of the system is that of a full disk."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def system_error(error: OSError) -> InputError:
    """Return an error of the system, with the name of its file and what to do."""
    name = f'{error.filename}: ' if error.filename else ''
    return InputError(f'{name}{error.strerror or error}', FREE_SPACE if is_full(error) else
                      'check the name and the permissions')


FREE_SPACE = 'free space on the disk'
"""Advice for a full disk."""

TAKE_ALL_SIDES = 'take poses with each side of the sensor up and down, and some edges'
"""Advice for poses that do not determine a calibration."""

NEEDS_ROS = ("source /opt/ros/jazzy/setup.bash, or run pip install '.[ros]' in the folder of the "
             'sources')
"""Advice if ROS 2 is not installed."""


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 pose`` or ``2 poses``."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def listed(noun: str, items: Sequence[object]) -> str:
    """Return items with their noun, such as ``row 1`` or ``rows 1, 2``."""
    return f'{noun}{"" if len(items) == 1 else "s"} {", ".join(map(str, items))}'
