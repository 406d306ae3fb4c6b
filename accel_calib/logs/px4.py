# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of PX4 flight logs (ULog, ``.ulg``), on `pyulog`.

Four messages have accelerations, all in x forward, y right, z down and in m/s²:

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

from collections.abc import Callable, Mapping
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .flight import (
    at,
    AXES,
    choose,
    finite,
    FlightLog,
    is_number,
    Message,
    MICRO,
    missing,
    others,
    RATES,
    sound_log,
    sound_rows,
)
from ..errors import InputError
from ..table import Floats
from ..text import counted

MAGIC = b'ULog\x01\x12\x35'
PREFERRED = ('sensor_accel', 'sensor_combined', 'vehicle_imu', 'vehicle_acceleration')
_ALSO = ('sensor_gyro', 'sensor_selection')
_INVALID = 0x7fffffff
"""Relative timestamp of sensor_combined without a valid sample of the accelerometer."""


class _WholeReads(io.BufferedReader):
    """
    A file that moves on by as many bytes as were asked for, beyond its end, too.

    `pyulog` goes back by the stated length of a damaged message. If fewer bytes were left, it
    would go back too far and read the same bytes without end.

    """

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes: at the end of the file fewer than `size`."""
        data = super().read(size)
        if size is not None and 0 < len(data) < size:
            self.seek(size - len(data), io.SEEK_CUR)
        return data


def is_ulg(path: Path) -> bool:
    """Return whether a file is a ULog, from its first bytes."""
    return path.is_file() and _has_magic(path)


def _has_magic(path: Path) -> bool:
    with path.open('rb') as file:
        return file.read(len(MAGIC)) == MAGIC


@np.errstate(invalid='ignore', over='ignore')  # rows that are not numbers are left out
def read_ulg(path: Path, topic: str = '', sensor: str = '') -> FlightLog:
    """
    Read the accelerations of one sensor of a PX4 log.

    Parameters
    ----------
    path : Path
        The ``.ulg`` file.
    topic : str
        Name of the message; by default the first of `PREFERRED` that is dense enough.
    sensor : str
        Number of the sensor; by default the lowest. Another text is a name for the sensor.

    Returns
    -------
    FlightLog
        The samples in m/s².

    Raises
    ------
    InputError
        If pyulog is not installed, the file is damaged, or it has no such message.
    OSError
        If the file cannot be read.

    """
    found, notes = _messages(path)
    chosen = choose([each for each in found if _is_known(each)], PREFERRED, topic, sensor,
                    str(path))
    time, columns, dropped = _READERS[chosen.name](chosen)
    if dropped:
        notes.append(f'{counted(dropped, "row")} of {chosen} left out: PX4 marks them as invalid')
    if not len(time):
        raise InputError(f'{path}: no row of {chosen} is valid, expected samples',
                         'name another message with --topic')
    device = _device(chosen, found)
    extra = _rates(chosen, time, found) if chosen.name == 'sensor_accel' else {}
    warm = _temperature(chosen, time, found, device)
    name = sensor if sensor and not is_number(sensor, found) else str(chosen)
    read_as = (f'PX4 log, {chosen} at {chosen.rate_hz:.4g} Hz, m/s2, x forward, y right, z down'
               + (', temperature of the sensor' if warm else ''))
    notes += [*others(chosen, found, PREFERRED), *_corrected(chosen)]
    return FlightLog({'time': time, **columns, **extra, **warm}, 'm/s2', name, read_as,
                     tuple(notes))


def _messages(path: Path) -> tuple[list[Message], list[str]]:
    """Return the messages that matter, and notes on a log that is damaged in part."""
    try:
        from pyulog import ULog
    except ImportError as err:
        raise missing('pyulog', 'PX4 logs (.ulg)', err) from err
    if not _has_magic(path):
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
        lost = sum(each.duration for each in log.dropouts)
        notes.append(f'PX4 reports {counted(len(log.dropouts), "dropout")} of the log, {lost} ms')
    return found, notes


def _is_known(message: Message) -> bool:
    """Return whether a message has the fields that are read; those of other versions differ."""
    return set(_FIELDS.get(message.name, ())) <= set(message.fields)


def _time(fields: Mapping[str, NDArray[Any]]) -> Floats:
    """Return the time of the samples [s]; timestamp_sample where it is set."""
    stamps = fields['timestamp']
    if 'timestamp_sample' in fields and np.all(fields['timestamp_sample'] > 0):
        stamps = fields['timestamp_sample']
    return stamps.astype(float) * MICRO


def _take(fields: Mapping[str, NDArray[Any]], pattern: str, keys: tuple[str, ...],
          names: tuple[str, ...] = ('0', '1', '2')) -> dict[str, Floats]:
    return {key: np.asarray(fields[pattern.replace('{}', name)], float)
            for key, name in zip(keys, names)}


_FIELDS = {
    'sensor_accel': ('x', 'y', 'z'),
    'sensor_combined': ('accelerometer_timestamp_relative', 'accelerometer_m_s2[0]',
                        'gyro_rad[0]'),
    'vehicle_imu': ('delta_velocity[0]', 'delta_angle[0]', 'delta_velocity_dt', 'delta_angle_dt'),
    'vehicle_acceleration': ('xyz[0]',),
}
"""Fields that are read, the first of each array."""

_Read = tuple[Floats, dict[str, Floats], int]


def _kept(time: Floats, columns: dict[str, Floats], valid: NDArray[np.bool_]) -> _Read:
    """Return the valid rows, and the number of others."""
    return (time[valid], {key: values[valid] for key, values in columns.items()},
            int(np.sum(~valid)))


def _accel(message: Message) -> _Read:
    columns = _take(message.fields, '{}', AXES, ('x', 'y', 'z'))
    return _kept(message.time, columns, sound_rows(columns))


def _combined(message: Message) -> _Read:
    relative = message.fields['accelerometer_timestamp_relative'].astype(float)
    columns = {**_take(message.fields, 'accelerometer_m_s2[{}]', AXES),
               **_take(message.fields, 'gyro_rad[{}]', RATES)}
    valid = (relative != _INVALID) & sound_rows(columns)
    return _kept(message.time + relative * MICRO, columns, valid)


def _imu(message: Message) -> _Read:
    fields = message.fields
    spans = {'velocity': fields['delta_velocity_dt'] * MICRO,
             'angle': fields['delta_angle_dt'] * MICRO}
    valid = (spans['velocity'] > 0.0) & (spans['angle'] > 0.0)
    changes = {'velocity': _take(fields, 'delta_velocity[{}]', AXES),
               'angle': _take(fields, 'delta_angle[{}]', RATES)}
    columns: dict[str, Floats] = {
        key: values / np.where(valid, spans[name], 1.0)
        for name, found in changes.items() for key, values in found.items()}
    return _kept(message.time, columns, valid & sound_rows(columns))


def _vehicle(message: Message) -> _Read:
    columns = _take(message.fields, 'xyz[{}]', AXES)
    return _kept(message.time, columns, sound_rows(columns))


_READERS: dict[str, Callable[[Message], _Read]] = {
    'sensor_accel': _accel, 'sensor_combined': _combined, 'vehicle_imu': _imu,
    'vehicle_acceleration': _vehicle}


def _device(chosen: Message, found: list[Message]) -> int:
    """Return the device id of the accelerometer of a message; 0 if it is not known."""
    for name in ('device_id', 'accel_device_id'):
        if name in chosen.fields:
            return int(chosen.fields[name][-1])
    for each in found:
        if each.name == 'sensor_selection' and 'accel_device_id' in each.fields:
            return int(each.fields['accel_device_id'][-1])
    return 0


def _temperature(chosen: Message, time: Floats, found: list[Message], device: int
                 ) -> dict[str, Floats]:
    """Return the temperature that sensor_accel of the same device reports."""
    sources = [each for each in found
               if each.name == 'sensor_accel' and 'temperature' in each.fields]
    same = [each for each in sources if device and _device(each, []) == device]
    if chosen.name == 'sensor_accel':
        same = [each for each in sources if each.instance == chosen.instance]
    elif not same and len(sources) == 1:
        same = sources
    if not same or not finite(same[0].fields['temperature']):
        return {}
    return {'temperature': at(time, same[0], same[0].fields['temperature'])}


def _rates(chosen: Message, time: Floats, found: list[Message]) -> dict[str, Floats]:
    """Return the angular rates of sensor_gyro with the same number, if it is as dense."""
    for each in found:
        if (each.name, each.instance) == ('sensor_gyro', chosen.instance):
            rates = _take(each.fields, '{}', RATES, ('x', 'y', 'z'))
            if each.rate_hz >= 0.5 * chosen.rate_hz and finite(*rates.values()):
                return {key: at(time, each, values) for key, values in rates.items()}
    return {}


def _corrected(chosen: Message) -> list[str]:
    """Return a note if the readings are corrected by PX4 already."""
    if chosen.name == 'sensor_accel':
        return []
    return [f'{chosen.name} is corrected by the stored CAL_ACC parameters; sensor_accel is not '
            '(add 4 or 64 to SDLOG_PROFILE to log it at 10 Hz)']
