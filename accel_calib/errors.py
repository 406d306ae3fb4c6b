# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Errors that a user can fix, the last resort for others, and what a program sets when it starts.

An error has a `message` (one line: what was found, what was expected) and an `advice` (one line:
what to do). If it is about a log, `read_as` says how the log was read.

**One thread** for each matrix operation of commands and nodes: arrays here are small, and threads
that share one wait for each other in busy loops. Beside two other processes on two processors, a
refinement with the OpenBLAS of numpy 1.26 took 10 times as long with two threads as with one.

"""

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import os
import platform
import sys
import tempfile
import traceback
import warnings

from . import __version__
from .text import one_line

_LONGEST = 2000
"""Longest message [characters]."""


class AccelCalibError(Exception):
    """The input is not valid."""

    read_as = ''

    def __init__(self, message: str, advice: str) -> None:
        if len(message) > _LONGEST:  # it quotes a name of a damaged file
            message = f'{message[:_LONGEST // 2]} … {message[-_LONGEST // 2:]}'
        self.message, self.advice = one_line(message), one_line(advice)
        super().__init__(self.message, self.advice)

    def __str__(self) -> str:
        return f'{self.message}; {self.advice}'


@contextmanager
def saying(read_as: str) -> Iterator[None]:
    """Let the errors inside say how a log was read, unless they do already."""
    try:
        yield
    except AccelCalibError as error:
        if read_as and not error.read_as:
            error.read_as = read_as
            if sys.version_info >= (3, 11):  # a traceback, as in a notebook, shows it
                error.add_note(f'read as: {read_as}')
        raise


class InputError(AccelCalibError):
    """A file, a column or a number is not valid."""


class DamagedLogError(InputError):
    """A library cannot read a log."""


class OwnEffectError(InputError):
    """A function of a user fails, or returns what is no function of its arguments."""


@contextmanager
def needing(libraries: str, what: str) -> Iterator[None]:
    """Turn the ImportError of an optional library, or of several, into an InputError."""
    try:
        yield
    except ImportError as err:
        raise InputError(f'{libraries.split()[0]} is not installed, but {what} needs it ({err})',
                         f'run pip install {libraries}') from err


class RefusedFitError(AccelCalibError):
    """
    The poses do not determine the model, or the result is not plausible.

    Where more poses are the only remedy, `offer` is what is possible without them, or ''.

    """

    offer: str | None = None


class StoredCalibrationError(AccelCalibError):
    """A stored calibration has another version, or belongs to another sensor."""


class DamagedCalibrationError(StoredCalibrationError):
    """A stored calibration is damaged, or has values that are not plausible."""


def is_full(error: OSError) -> bool:
    """Return whether an error of the system is that of a full disk."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def known_error(error: Exception) -> AccelCalibError:
    """Return any error as one for users; of a defect of this program, the traceback is stored."""
    if isinstance(error, AccelCalibError):
        return error
    if not isinstance(error, OSError):
        return InputError(crash_words(error), 'report it, with the input')
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


ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
"""Environment variables that libraries for matrices read when numpy is imported."""


def use_one_thread() -> None:
    """Set the variables that are not set yet. Call it before numpy is imported."""
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)


def hide_warnings() -> None:
    """Keep warnings of numpy, on which no user can act, from the terminal; also of children."""
    if not sys.warnoptions:
        warnings.simplefilter('ignore', RuntimeWarning)
        os.environ['PYTHONWARNINGS'] = 'ignore::RuntimeWarning'


def crash_words(error: BaseException) -> str:
    """
    Write the traceback of an error to a temporary file, and return one line about it.

    The line names the file, if it could be written; the name contains an id.

    """
    what = f'internal error: {type(error).__name__}: {error}'
    try:
        handle, name = tempfile.mkstemp(prefix='accel_calib-', suffix='.txt')
        with os.fdopen(handle, 'w', encoding='utf-8', errors='backslashreplace') as file:
            file.write(f'accel_calib {__version__}, Python {platform.python_version()}, '
                       f'{platform.platform()}\n{" ".join(sys.argv)}\n\n')
            file.write(''.join(traceback.format_exception(error)))
    except OSError:
        return f'{what}; please report it with what you did'
    return f'{what}; please report it with the file {name}'
