# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of PX4 flight logs (ULog, ``.ulg``), on `pyulog`, and what it shares with that of ArduPilot.

A flight log holds several messages with accelerations, each of several sensors. `choose` takes the
first message in order of preference whose samples are dense enough for the capture of poses.

Four messages of PX4 have accelerations, all in x forward, y right, z down and in m/s²:

====================  ==========================================================================
message               content
====================  ==========================================================================
sensor_accel          reading of one sensor before PX4 corrects it, with its temperature
sensor_combined       mean of the selected sensor, corrected by the stored CAL_ACC parameters
vehicle_imu           change of velocity of one sensor over an interval, corrected likewise
vehicle_acceleration  filtered and corrected reading of the selected sensor, without its bias
====================  ==========================================================================

The default profile of PX4 logs `sensor_accel` once a second. It is read if it is dense enough.
[1] https://docs.px4.io/main/en/dev_log/ulog_file_format
[2] https://docs.px4.io/main/en/msg_docs/

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
import errno
import io
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .autopilot import (
    Correction, Parameters, px4_correction, px4_slot, px4_thermal_slot, raw_columns, Stated)
from .formats import PX4_FIELDS, PX4_SPANS
from ..errors import InputError, needing
from ..table import Autopilot, COLUMNS, columns_from, Floats, numbered, Recording
from ..text import counted, some

AXES, RATES = COLUMNS['reading'].names, COLUMNS['rate'].names
MICRO = 1e-6

_STANDARD_ERROR = 2

DENSE_HZ = 5.0
"""Samples per second below which another message is preferred."""


@dataclass(frozen=True)
class Message:
    """The samples of one message of one sensor: fields by the names of the log, and time [s]."""

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


@dataclass(frozen=True)
class FlightLog:
    """
    The samples of one sensor of a flight log, in m/s².

    Columns have the names of a recording: ``time`` [s], ``ax,ay,az``, and where the log has them
    ``gx,gy,gz`` [rad/s] and ``temperature`` [°C]. The sensor is message and number, such as
    ``sensor_accel 0``. Notes state what was not used, and what to know of the readings.

    """

    columns: Mapping[str, Floats]
    sensor: str
    read_as: str
    autopilot: Autopilot
    notes: tuple[str, ...] = ()

    def recording(self, source: str) -> Recording:
        """Return the samples as a recording; a number that is not finite is an InputError."""
        columns = columns_from(self.columns, ('time', 'reading'), source)
        return Recording(columns, numbered(columns), 'm/s2', self.sensor, self.autopilot)


@dataclass(frozen=True)
class AsSensed:
    """Columns of a flight log without the correction of the vehicle, if that is known."""

    columns: Mapping[str, Floats]
    autopilot: Autopilot
    turned: bool = False
    notes: tuple[str, ...] = ()


def as_sensed(columns: Mapping[str, Floats], parameters: Parameters, autopilot: Autopilot,
              correction: Callable[[], Correction], advice: str) -> AsSensed:
    """Return columns without the correction, or as they are with a note why that is not known."""
    try:
        raw = raw_columns(columns, parameters, correction())
    except InputError as err:
        return AsSensed(columns, replace(autopilot, corrected=err.message), notes=(
            f'readings are left as the vehicle corrected them ({err.message}), so do not load an '
            f'export of their calibration into it; {advice}',))
    undone = (f'the correction by the vehicle is undone: {parameters.words}',)
    return AsSensed(raw, autopilot, parameters.turned, undone if parameters.words else ())


@dataclass(frozen=True)
class Choice:
    """
    The message to read, and all messages of the log that matter.

    `preferred` are the names of those with accelerations, the best first; `name` is that of the
    sensor, if the user states one.

    """

    message: Message
    found: Sequence[Message]
    preferred: Sequence[str]
    name: str

    def log(self, kind: str, found: AsSensed, temperature: str, notes: Iterable[str]
            ) -> FlightLog:
        """Return the log; `temperature` describes that column, if there is one."""
        chosen = self.message
        axes = ('axes of the sensor, before the rotation of the board' if found.turned else
                'x forward, y right, z down')
        read_as = f'{kind}, {chosen} at {chosen.rate_hz:.4g} Hz, m/s2, {axes}'
        if 'temperature' in found.columns:
            read_as += f', {temperature}'
        return FlightLog(found.columns, self.name or str(chosen), read_as, found.autopilot,
                         (*notes, *found.notes))

    def others(self) -> list[str]:
        """Return notes on the other sensors of the same message, and on other messages."""
        chosen, notes = self.message, []
        usable = [message for message in self.found if len(message.time)]
        rest = [message for message in usable
                if message.name == chosen.name and message.instance != chosen.instance]
        other = [message for message in usable
                 if message.name in self.preferred and message.name != chosen.name]
        if rest:
            notes.append(f'{chosen} is read; other sensors: {some(rest)} '
                         f'(--sensor {rest[0].instance})')
        if other:
            names = ', '.join(dict.fromkeys(f'{message.name} ({message.rate_hz:.3g} Hz)'
                                            for message in other
                                            if message.instance == other[0].instance))
            notes.append(f'not used: {names} (--topic {other[0].name})')
        return notes

    def rates(self, time: Floats, sources: Iterable[Message], names: Sequence[str]
              ) -> dict[str, Floats]:
        """Return the angular rates of the first source with these fields that is as dense."""
        for message in sources:
            if message.rate_hz >= 0.5 * self.message.rate_hz and set(names) <= set(message.fields):
                rates = taken(message.fields, RATES, names)
                if finite(*rates.values()):
                    return {key: at(time, message, values) for key, values in rates.items()}
        return {}


def choose(found: Sequence[Message], preferred: Sequence[str], topic: str, sensor: str,
           source: str) -> Choice:
    """
    Return the message to read, from those `found`; raise InputError if there is none.

    `topic` is the name of the message; empty: the first of `preferred` that is dense. `sensor` is
    the number of the sensor, alone or after the name of its message; any other text is a name for
    the sensor, and does not choose.

    """
    usable = [message for message in found if message.name in preferred and len(message.time)]
    if not usable:
        raise InputError(f'{source} has none of the messages {", ".join(preferred)}, expected one '
                         'with accelerations', 'log the accelerometer, see docs/log_formats.md')
    chooses = sensor.isdecimal() or sensor in map(str, found)
    number = sensor if chooses else ''
    wanted = [message for message in usable if topic in ('', message.name)
              and number in ('', str(message.instance), str(message))]
    if not wanted:
        raise InputError(f'{source} has {some(usable)}, expected '
                         f'{" ".join(filter(None, (topic or "a message", number)))}',
                         'name one of these, for example --topic '
                         f'{usable[0].name} --sensor {usable[0].instance}')
    order = sorted(wanted, key=lambda message: (preferred.index(message.name), message.instance))
    dense = [message for message in order if message.rate_hz >= DENSE_HZ]
    best = dense[0] if dense else max(order, key=lambda message: message.rate_hz)
    return Choice(best, found, preferred, '' if chooses else sensor)


def taken(fields: Mapping[str, NDArray[Any]], keys: Sequence[str], names: Sequence[str]
          ) -> dict[str, Floats]:
    """Return the first fields as floats under our names."""
    return {key: np.asarray(fields[name], float) for key, name in zip(keys, names)}


def at(time: Floats, source: Message, values: NDArray[Any]) -> Floats:
    """Return values of another message at these times, interpolated; the ends are held."""
    order = np.argsort(source.time, kind='stable')
    return np.interp(time, source.time[order], values[order].astype(float))


def finite(*columns: NDArray[Any]) -> bool:
    """Return whether there are values and all are finite numbers."""
    return all(len(values) > 0 and bool(np.all(np.isfinite(values))) for values in columns)


def sound(message: Message, columns: Mapping[str, Floats], why: str,
          valid: NDArray[np.bool_] | bool = True) -> tuple[dict[str, Floats], list[str]]:
    """Return the valid rows whose values are all finite, and a note on the others."""
    valid = valid & np.logical_and.reduce([np.isfinite(values) for values in columns.values()])
    dropped = int(np.sum(~valid))
    notes = [f'{counted(dropped, "row")} of {message} left out: {why}'] if dropped else []
    return {key: values[valid] for key, values in columns.items()}, notes


@contextmanager
def sound_log(path: Path, expected: str, advice: str = 'copy it from the vehicle again'
              ) -> Iterator[None]:
    """
    Turn what a library raises for a damaged log into one InputError, and drop what it prints.

    Libraries of logs raise errors of any class, and print. Errors of the system pass.

    """
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()), _silent_c():
            yield
    except Exception as err:
        # Of a library, or a seek to before the start of a file, by a damaged length.
        if isinstance(err, OSError) and err.errno not in (None, errno.EINVAL):
            raise
        why = ' '.join(str(err).split()) or type(err).__name__
        raise InputError(f'{path} is damaged ({why}), expected {expected}',
                         advice) from err


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


# --------------------------------------------------------------------------------------- PX4

MAGIC = b'ULog\x01\x12\x35'
_INVALID = 0x7fffffff
"""Relative timestamp of sensor_combined without a valid sample of the accelerometer."""

_ADVICE = ('read sensor_accel, which CAL_ACC does not correct (add 4 or 64 to SDLOG_PROFILE to '
           'log it at 10 Hz)')
_RELATIVE = 'accelerometer_timestamp_relative'
_XYZ = ('x', 'y', 'z')
PREFERRED = tuple(PX4_FIELDS)
_FILTERED = 'vehicle_acceleration'
_MORE = {'sensor_combined': (_RELATIVE,), 'vehicle_imu': tuple(PX4_SPANS)}
_NEEDED = {name: {*fields, *_MORE.get(name, ())} for name, fields in PX4_FIELDS.items()}
_ALSO = ('sensor_gyro', 'sensor_selection')


class _WholeReads(io.BufferedReader):
    """
    A file that moves on by as many bytes as were asked for, beyond its end, too.

    `pyulog` goes back by the stated length of a damaged message. If fewer bytes were left, or
    none, it would go back too far and read the same bytes without end.

    """

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            self.seek(size - len(data), io.SEEK_CUR)
        return data


def is_ulg(path: Path) -> bool:
    """Return whether a file is a ULog, from its first bytes."""
    if not path.is_file():
        return False
    with path.open('rb') as file:
        return file.read(len(MAGIC)) == MAGIC


@np.errstate(invalid='ignore', over='ignore')  # rows that are not numbers are left out
def read_ulg(path: Path, topic: str = '', sensor: str = '') -> FlightLog:
    """
    Read the accelerations of one sensor of a PX4 log.

    By default the message is the first of `PREFERRED` that is dense enough, and the sensor the
    lowest number. Another text for the sensor is a name. Raise InputError if pyulog is not
    installed, or the file is damaged or has no such message.

    """
    found, parameters, release, notes = _messages(path)
    known = [message for message in found
             if message.name in _NEEDED and _NEEDED[message.name] <= set(message.fields)]
    choice = choose(known, PREFERRED, topic, sensor, str(path))
    chosen = choice.message
    columns, invalid = _samples(chosen)
    time = columns['time']
    if not len(time):
        raise InputError(f'{path}: no row of {chosen} is valid, expected samples',
                         'name another message with --topic')
    if chosen.name == PREFERRED[0]:
        gyros = (message for message in found
                 if (message.name, message.instance) == ('sensor_gyro', chosen.instance))
        columns |= choice.rates(time, gyros, _XYZ)
    columns |= _temperature(chosen, time, found)
    device = _device(chosen, found)
    autopilot = Autopilot('px4', px4_slot(parameters, device), device or None,
                          px4_thermal_slot(parameters, device))
    if chosen.name == PREFERRED[0]:
        sensed = AsSensed(columns, autopilot)
    else:
        sensed = as_sensed(columns, parameters, autopilot, lambda: _correction(
            chosen, parameters, device, release), _ADVICE)
    return choice.log('PX4 log', sensed, 'temperature of the sensor',
                      (*notes, *invalid, *choice.others()))


def _correction(chosen: Message, parameters: Parameters, device: int,
                release: tuple[int, int] | None) -> Correction:
    """Return the correction of a message; raise InputError if it is not known."""
    if chosen.name == _FILTERED:
        raise InputError(f'{chosen.name} lacks the bias that PX4 estimates',
                         'name another message with --topic')
    return px4_correction(parameters, device, release)


def _messages(path: Path) -> tuple[list[Message], Parameters, tuple[int, int] | None, list[str]]:
    """Return the messages and parameters that matter, the release of PX4, and notes on damage."""
    with needing('pyulog', 'a PX4 log (.ulg)'):
        from pyulog import ULog
    if not is_ulg(path):
        raise InputError(f'{path} does not start as a ULog does, expected a PX4 log (.ulg)',
                         'check that this is the intended file')
    with _WholeReads(io.FileIO(path)) as file, sound_log(path, 'a PX4 log (.ulg)'):
        log = ULog(file, [*PREFERRED, *_ALSO])
        found = [Message(data.name, data.multi_id, data.data, _time(data.data))
                 for data in log.data_list if len(data.data['timestamp'])]
    notes = []
    if log.file_corruption:
        notes.append('the log is damaged in part; its sound part is read')
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f'PX4 reports {counted(len(log.dropouts), "dropout")} of the log, {lost} ms')
    release = log.msg_info_dict.get('ver_sw_release')
    return found, Parameters([
        *(Stated(-np.inf, name, float(value)) for name, value in log.initial_parameters.items()),
        *(Stated(stamp * MICRO, name, float(value))
          for stamp, name, value in log.changed_parameters)]), (
        (release >> 24, release >> 16 & 0xff) if isinstance(release, int) else None), notes


def _time(fields: Mapping[str, NDArray[Any]]) -> Floats:
    """Return the time of the samples [s]; timestamp_sample where it is set."""
    stamps = fields['timestamp']
    if 'timestamp_sample' in fields and np.all(fields['timestamp_sample'] > 0):
        stamps = fields['timestamp_sample']
    return stamps.astype(float) * MICRO


def _samples(message: Message) -> tuple[dict[str, Floats], list[str]]:
    """Return time, readings and rates of the valid rows, and a note on the others."""
    fields, time = message.fields, message.time
    columns = taken(fields, (*AXES, *RATES), PX4_FIELDS[message.name])
    valid = np.ones(len(time), dtype=bool)
    if _RELATIVE in fields:
        relative = fields[_RELATIVE].astype(float)
        time, valid = time + relative * MICRO, relative != _INVALID
    for name, keys in PX4_SPANS.items():
        if name in fields:
            seconds = fields[name] * MICRO
            valid &= seconds > 0.0
            for key in keys:
                columns[key] = columns[key] / np.where(seconds > 0.0, seconds, 1.0)
    return sound(message, {'time': time, **columns}, 'PX4 marks them as invalid', valid)


def _device(chosen: Message, found: Sequence[Message] = ()) -> int:
    """Return the device id of the accelerometer of a message; 0 if it is not known, or changes."""
    stated = [chosen.fields[name] for name in ('device_id', 'accel_device_id')
              if name in chosen.fields]
    stated += [message.fields['accel_device_id'] for message in found
               if message.name == 'sensor_selection' and 'accel_device_id' in message.fields]
    return int(stated[0][-1]) if stated and np.ptp(stated[0]) == 0 else 0


def _temperature(chosen: Message, time: Floats, found: Sequence[Message]) -> dict[str, Floats]:
    """Return the temperature that sensor_accel of the same device reports."""
    sources = [message for message in found
               if message.name == PREFERRED[0] and 'temperature' in message.fields]
    device = _device(chosen, found)
    same = [message for message in sources if device and _device(message) == device]
    if chosen.name == PREFERRED[0]:
        same = [message for message in sources if message.instance == chosen.instance]
    elif not same and len(sources) == 1:
        same = sources
    if not same or not finite(same[0].fields['temperature']):
        return {}
    return {'temperature': at(time, same[0], same[0].fields['temperature'])}
