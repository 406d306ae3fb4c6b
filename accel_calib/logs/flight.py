# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the readers of binary flight logs share: their result, and how they choose among sensors.

A flight log holds several messages with accelerations, each of several sensors. `choose` takes the
first message in order of preference whose samples are dense enough for the capture of poses.

"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
import errno
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..table import columns_from, Floats, numbered, Recording
from ..units import UnitName

AXES = ('ax', 'ay', 'az')
RATES = ('gx', 'gy', 'gz')
MICRO = 1e-6

_STANDARD_ERROR = 2

DENSE_HZ = 5.0
"""Samples per second below which another message is preferred."""


@dataclass(frozen=True)
class FlightLog:
    """
    The samples of one sensor of a flight log.

    Parameters
    ----------
    columns : mapping of str to array
        n values by the names of a recording: ``time`` [s], ``ax,ay,az``, and where the log has
        them ``gx,gy,gz`` [rad/s] and ``temperature`` [°C].
    units : {'m/s2', 'g', 'native'}
        Unit of the readings.
    sensor : str
        Message and number of the sensor, such as ``sensor_accel 0``.
    read_as : str
        What was read, one line.
    notes : tuple of str
        What was not used, and what to know of the readings.

    """

    columns: Mapping[str, Floats]
    units: UnitName
    sensor: str
    read_as: str
    notes: tuple[str, ...] = ()

    def recording(self, source: str) -> Recording:
        """
        Return the samples as a recording.

        Raises
        ------
        InputError
            If a number is not finite.

        """
        columns = columns_from(self.columns, ('time', 'reading'), source)
        return Recording(columns, numbered(columns), self.units, self.sensor)


@dataclass(frozen=True)
class Message:
    """
    The samples of one message of one sensor, as in the log.

    Parameters
    ----------
    name : str
        Name of the message.
    instance : int
        Number of the sensor.
    fields : mapping of str to array
        n values by the names of the log.
    time : (n,) array
        Time of the samples [s].

    """

    name: str
    instance: int
    fields: Mapping[str, NDArray[Any]]
    time: Floats

    @property
    def rate_hz(self) -> float:
        """Return the samples per second; 0 for less than two samples."""
        span = float(np.ptp(self.time)) if len(self.time) > 1 else 0.0
        return (len(self.time) - 1) / span if span > 0.0 else 0.0

    def __str__(self) -> str:
        return f'{self.name} {self.instance}'


def choose(found: Sequence[Message], preferred: Sequence[str], topic: str, sensor: str,
           source: str) -> Message:
    """
    Return the message to read.

    Parameters
    ----------
    found : sequence of Message
        The messages of the log, those without samples left out.
    preferred : sequence of str
        Names of the messages that have accelerations, the best first.
    topic : str
        Name of the message that the user names; empty: by preference.
    sensor : str
        Number of the sensor, alone or after the name of its message. Other texts are a name for
        the sensor, and do not choose.
    source : str
        Name of the log in error messages.

    Raises
    ------
    InputError
        If there is no such message.

    """
    usable = [each for each in found if each.name in preferred and len(each.time)]
    if not usable:
        raise InputError(f'{source} has none of the messages {", ".join(preferred)}, expected one '
                         'with accelerations', 'log the accelerometer, see docs/log_formats.md')
    number = sensor if is_number(sensor, found) else ''
    wanted = [each for each in usable if topic in ('', each.name)
              and number in ('', str(each.instance), str(each))]
    if not wanted:
        raise InputError(f'{source} has {", ".join(map(str, usable))}, expected '
                         f'{" ".join(filter(None, (topic or "a message", number)))}',
                         'name one of these, for example --topic '
                         f'{usable[0].name} --sensor {usable[0].instance}')
    order = sorted(wanted, key=lambda each: (preferred.index(each.name), each.instance))
    dense = [each for each in order if each.rate_hz >= DENSE_HZ]
    return dense[0] if dense else max(order, key=lambda each: each.rate_hz)


def is_number(sensor: str, found: Sequence[Message]) -> bool:
    """Return whether a text is the number of a sensor, alone or after the name of a message."""
    return sensor.isdecimal() or sensor in map(str, found)


def others(chosen: Message, found: Sequence[Message], preferred: Sequence[str]) -> tuple[str, ...]:
    """Return a note on the other sensors of the same message, if there are any."""
    rest = [each for each in found
            if each.name == chosen.name and each.instance != chosen.instance and len(each.time)]
    other = [each for each in found if each.name in preferred and each.name != chosen.name
             and len(each.time)]
    notes = []
    if rest:
        notes.append(f'{chosen} is read; other sensors: {", ".join(map(str, rest))} '
                     f'(--sensor {rest[0].instance})')
    if other:
        names = ', '.join(dict.fromkeys(f'{each.name} ({each.rate_hz:.3g} Hz)' for each in other
                                        if each.instance == other[0].instance))
        notes.append(f'not used: {names} (--topic {other[0].name})')
    return tuple(notes)


def at(time: Floats, source: Message, values: NDArray[Any]) -> Floats:
    """Return values of another message at these times, interpolated; the ends are held."""
    order = np.argsort(source.time, kind='stable')
    return np.interp(time, source.time[order], values[order].astype(float))


def finite(*columns: NDArray[Any]) -> bool:
    """Return whether there are values and all are finite numbers."""
    return all(len(each) > 0 and bool(np.all(np.isfinite(each))) for each in columns)


def sound_rows(columns: Mapping[str, Floats]) -> NDArray[np.bool_]:
    """Return a mask of the rows whose values are all finite numbers."""
    return np.logical_and.reduce([np.isfinite(each) for each in columns.values()])


@contextmanager
def sound_log(path: Path, expected: str) -> Iterator[None]:
    """
    Turn what a library raises for a damaged log into one error, and drop what it prints.

    Libraries of flight logs raise errors of any class, and print.

    Raises
    ------
    InputError
        If the log is damaged.
    OSError
        If the file cannot be read.

    """
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), _silent_c():
            yield
    except Exception as err:
        # A seek to before the start of a file, by a damaged length.
        if isinstance(err, OSError) and err.errno != errno.EINVAL:
            raise
        why = ' '.join(str(err).split()) or type(err).__name__
        raise InputError(f'{path} is damaged ({why}), expected {expected}',
                         'copy it from the vehicle again') from err


@contextmanager
def _silent_c() -> Iterator[None]:
    """Drop what C code prints to standard error, which Python cannot redirect."""
    try:
        kept = os.dup(_STANDARD_ERROR)
    except OSError:  # standard error is closed, so nothing is printed
        yield
        return
    try:
        with open(os.devnull, 'wb') as nowhere:
            os.dup2(nowhere.fileno(), _STANDARD_ERROR)
            yield
    finally:
        os.dup2(kept, _STANDARD_ERROR)
        os.close(kept)


def missing(library: str, what: str, err: ImportError) -> InputError:
    """Return the error for a library that is not installed."""
    return InputError(f'{library} is not installed, it reads {what} ({err})',
                      f'run pip install {library}')
