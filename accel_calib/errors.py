# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Errors that a user can fix; each message says what was found, expected and what to do."""


class AccelCalibError(Exception):
    """
    Input of the user cannot be used.

    Parameters
    ----------
    message : str
        One line: what was found and what was expected.
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
    """A file, a column or a number cannot be read as what it should be."""


class RefusedFitError(AccelCalibError):
    """The poses do not determine what was asked for."""


class StoredCalibrationError(AccelCalibError):
    """A stored calibration is newer than this package, or not of this sensor."""


class DamagedCalibrationError(StoredCalibrationError):
    """A stored calibration is damaged, or not one that a sensor can have."""
