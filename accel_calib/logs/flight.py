# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Readers of flight logs: PX4 (ULog, on `pyulog`), and ArduPilot (DataFlash, on `pymavlink`).

All accelerations are in x forward, y right, z down and in m/s². In the order of preference:

====================  ==========================================================================
message of PX4        content
====================  ==========================================================================
sensor_accel          reading of one sensor before PX4 corrects it, with its temperature
sensor_combined       mean of the selected sensor, corrected by the stored CAL_ACC parameters
vehicle_imu           change of velocity of one sensor over an interval, corrected likewise
vehicle_acceleration  filtered and corrected reading of the selected sensor, without its bias
====================  ==========================================================================

====================  ==========================================================================
message of ArduPilot  content, corrected by the stored INS_ACC parameters
====================  ==========================================================================
IMU                   reading and angular rate of a sensor, with its temperature T
ACC                   reading of a sensor at its own rate, where LOG_BITMASK asks for raw samples
====================  ==========================================================================

The default profile of PX4 logs `sensor_accel` once a second. It is read if it is dense enough.
Since ArduPilot 4.1 the field I is the number of the sensor. Before, the second sensor has the
messages IMU2 and ACC2. An ArduPilot log states the fields of each message in messages FMT. Its
text form (``.log``) has the same messages, one per line.

[1] https://docs.px4.io/main/en/dev_log/ulog_file_format
[2] https://docs.px4.io/main/en/msg_docs/
[3] https://ardupilot.org/copter/docs/logmessages.html
[4] https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html

"""

from collections.abc import Mapping, Sequence
from functools import partial
import io
from itertools import chain
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .autopilot import (
    ardupilot_correction, at, choose, FlightLog, Message, Parameters, px4_correction, px4_slot,
    sound, vectors)
from .names import MICRO, names_of, PX4_FIELDS
from ..errors import InputError
from ..table import Autopilot, Floats
from ..text import counted

PX4_MESSAGES, ARDUPILOT_MESSAGES = tuple(PX4_FIELDS), ('IMU', 'ACC')
"""Messages with accelerations, in order of preference."""


# --------------------------------------------------------------------------------------- PX4

_INVALID = 0x7fffffff
"""Relative timestamp of sensor_combined without a valid sample of the accelerometer."""

_RELATIVE = 'accelerometer_timestamp_relative'
_RAW = 'sensor_accel'
_NEEDED = {name: {*chain(*map(names_of, patterns.values()))}
           for name, patterns in PX4_FIELDS.items()}
_NEEDED['sensor_combined'].add(_RELATIVE)


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


@np.errstate(divide='ignore', invalid='ignore', over='ignore')  # such rows are left out
def read_ulg(path: Path, topic: str = '', sensor: str = '') -> FlightLog:
    """
    Read the accelerations of one sensor of a PX4 log.

    By default the message is the first of `PX4_MESSAGES` that is dense enough, and the sensor the
    lowest number. Another text for the sensor is a name. Raise InputError if pyulog is not
    installed, or the file is damaged or has no such message.

    """
    found, parameters, release, notes = _px4_messages(path)
    known = [message for message in found
             if message.name in _NEEDED and _NEEDED[message.name] <= set(message.fields)]
    choice = choose(known, PX4_MESSAGES, topic, sensor, str(path))
    chosen = choice.message
    columns, invalid = sound(chosen, _px4_columns(chosen), 'PX4 marks them as invalid')
    time = columns['time']
    if not len(time):
        raise InputError(f'{path}: no row of {chosen} is valid, expected samples',
                         'name another message with --topic')
    device, is_raw = _device(chosen, found), chosen.name == _RAW
    warm = [message for message in found
            if message.name == _RAW and 'temperature' in message.fields]
    if is_raw:
        gyros = (message for message in found
                 if (message.name, message.instance) == ('sensor_gyro', chosen.instance))
        columns |= choice.rates(time, gyros, ('x', 'y', 'z'))
        warm = [message for message in warm if message.instance == chosen.instance]
    else:  # the sensor_accel of the same device, or the only one
        warm = ([message for message in warm if device and _device(message) == device]
                or (warm if len(warm) == 1 else []))
    columns |= at(time, 'temperature', ((message, message.fields['temperature'])
                                        for message in warm[:1]))
    stated = [values for _, _, values in parameters.spans()]
    autopilot = Autopilot('px4', px4_slot(stated, device), device or None,
                          px4_slot(stated, device, 'TC_A'))
    correction = partial(px4_correction, parameters, autopilot, release, chosen.name)
    return choice.log(columns, autopilot, parameters, None if is_raw else correction,
                      (*notes, *invalid))


def _px4_columns(message: Message) -> dict[str, Floats]:
    """Return the times, readings and rates of a message; the times of invalid rows are NaN."""
    columns = {key: vectors(message.fields, names_of(pattern))
               for key, pattern in PX4_FIELDS[message.name].items()}
    time = message.time
    if _RELATIVE in message.fields:
        relative = message.fields[_RELATIVE].astype(float)
        time = np.where(relative != _INVALID, time + relative * MICRO, np.nan)
    for key in [key for key in columns if key.endswith('/')]:
        seconds = columns.pop(key) * MICRO
        time = np.where(seconds[:, 0] > 0.0, time, np.nan)
        columns[key[:-1]] /= seconds
    return {'time': time, **columns}


def _px4_messages(path: Path
                  ) -> tuple[list[Message], Parameters, tuple[int, int] | None, list[str]]:
    """Return the messages and parameters that matter, the release of PX4, and notes on damage."""
    from pyulog import ULog

    with _WholeReads(io.FileIO(path)) as file:
        log = ULog(file, [*PX4_MESSAGES, 'sensor_gyro', 'sensor_selection'])
    found = []
    for data in log.data_list:
        stamps = data.data['timestamp']
        if 'timestamp_sample' in data.data and np.all(data.data['timestamp_sample'] > 0):
            stamps = data.data['timestamp_sample']
        if len(stamps):
            found.append(Message(data.name, data.multi_id, data.data,
                                 stamps.astype(float) * MICRO))
    notes = []
    if log.file_corruption:
        notes.append('the log is damaged in part; its sound part is read')
    if log.dropouts:
        lost = sum(dropout.duration for dropout in log.dropouts)
        notes.append(f'PX4 reports {counted(len(log.dropouts), "dropout")} of the log, {lost} ms')
    release = log.msg_info_dict.get('ver_sw_release')
    stated = chain(((0, *each) for each in log.initial_parameters.items()), log.changed_parameters)
    return found, Parameters(stated, MICRO), (
        (release >> 24, release >> 16 & 0xff) if isinstance(release, int) else None), notes


def _device(chosen: Message, found: Sequence[Message] = ()) -> int:
    """Return the device id of the accelerometer of a message; 0 if it is not known, or changes."""
    stated = [chosen.fields[name] for name in ('device_id', 'accel_device_id')
              if name in chosen.fields]
    stated += [message.fields['accel_device_id'] for message in found
               if message.name == 'sensor_selection' and 'accel_device_id' in message.fields]
    return int(stated[0][-1]) if stated and np.ptp(stated[0]) == 0 else 0


# --------------------------------------------------------------------------------- ArduPilot

_READING, _RATES = ('AccX', 'AccY', 'AccZ'), ('GyrX', 'GyrY', 'GyrZ')
_MOST_SENSORS = 255
_NAME = re.compile(r'PARM|(IMU|ACC|GYR)([1-9]?)')
DATAFLASH = b'\xa3\x95\x80'
"""First bytes of a binary log: the head of a message FMT."""

_STAMPS = {'SampleUS': MICRO, 'TimeUS': MICRO, 'SampleMS': 1e-3, 'TimeMS': 1e-3}
"""Fields with the time of a sample, the best first, and their factors to seconds."""

_Table = dict[str, NDArray[Any]]


@np.errstate(invalid='ignore', over='ignore')  # rows that are not numbers are left out
def read_dataflash(path: Path, topic: str = '', sensor: str = '') -> FlightLog:
    """
    Read the accelerations of one sensor of an ArduPilot log.

    By default the message is IMU if it is dense enough, otherwise ACC, and the sensor the lowest
    number. Another text for the sensor is a name. Raise InputError if the file is damaged or has
    no such message, or pymavlink is not installed (binary logs only).

    """
    with path.open('rb') as file:
        is_binary = file.read(len(DATAFLASH)) == DATAFLASH
    tables, notes = _binary(path) if is_binary else _text(path)
    found = _ardupilot_messages(tables)
    choice = choose(found, ARDUPILOT_MESSAGES, topic, sensor, str(path))
    chosen = choice.message
    columns, dropped = sound(
        chosen, {'time': chosen.time, 'reading': vectors(chosen.fields, _READING)},
        'the reading is not a number')
    sources = (message for message in (chosen, *found) if message.instance == chosen.instance)
    columns |= choice.rates(columns['time'], sources, _RATES)
    columns |= at(columns['time'], 'temperature', (
        (message, message.fields[name]) for message in found for name in ('T', 'Temp')
        if (message.name, message.instance) == ('IMU', chosen.instance)
        and np.any(message.fields.get(name, 0.0))))
    stated, number = tables.get('PARM', {}), chosen.instance + 1
    stamp = next((key for key in _STAMPS if key in stated), '')
    rows = (zip(*(stated[key].tolist() for key in (stamp, 'Name', 'Value')))
            if stamp and {'Name', 'Value'} <= set(stated) else ())  # damaged ones are left out
    parameters = Parameters((
        (time, name.decode('latin-1') if isinstance(name, bytes) else str(name), value)
        for time, name, value in rows), _STAMPS.get(stamp, 1.0))
    *_, (_, _, values) = parameters.spans()
    device = values.get(f'INS_ACC{"" if number == 1 else number}_ID', 0.0)
    warm = values.get(f'INS_TCAL{number}_ENABLE', 0.0) != 0.0
    autopilot = Autopilot('ardupilot', number, int(device) or None, number if warm else None)
    return choice.log(columns, autopilot, parameters,
                      partial(ardupilot_correction, parameters, number), (*notes, *dropped))


def _ardupilot_messages(tables: Mapping[str, _Table]) -> list[Message]:
    """Return the messages of each sensor: by the field I, or by the number in the name."""
    found = []
    for name, stated in tables.items():
        table = {key: values for key, values in stated.items() if values.dtype.kind in 'iuf'}
        match = _NAME.fullmatch(name)
        stamp = next((key for key in _STAMPS if key in table), '')
        needed = _RATES if name.startswith('GYR') else _READING
        if not match or not match[1] or not stamp or not set(needed) <= set(table):
            continue
        numbers = table.get('I', np.full(len(table[stamp]), int(match[2] or 1) - 1))
        instances = np.clip(np.nan_to_num(numbers.astype(float)), 0.0, _MOST_SENSORS)
        for instance in np.unique(instances.astype(int)).tolist():
            of = instances.astype(int) == instance
            fields = {key: values[of] for key, values in table.items()}
            found.append(Message(match[1], instance, fields,
                                 fields[stamp].astype(float) * _STAMPS[stamp]))
    return found


def _binary(path: Path) -> tuple[dict[str, _Table], list[str]]:
    from pymavlink.DFReader import DFReader_binary, FORMAT_TO_STRUCT

    class Index(DFReader_binary):  # type: ignore[misc]
        def init_clock(self) -> None:
            """Skip the search for a GPS time, which parses a whole log that has none."""

    log = Index(str(path))  # it knows where each message begins
    log.close()
    data = np.frombuffer(path.read_bytes(), np.uint8)
    tables, cut = {}, 0
    for number, form in log.formats.items():
        starts = np.array(log.offsets[number], dtype=np.int64) + 3
        is_sound = all(form.columns) and len(form.format) == len(form.columns) == len(
            set(form.columns))  # one letter for each field, and a name of its own for each
        if not _NAME.fullmatch(form.name) or not len(starts) or not is_sound:
            continue
        # Types and factors of the fields, from the letters of a message FMT [4].
        fields = [(name, *FORMAT_TO_STRUCT[letter][:2])
                  for name, letter in zip(form.columns, form.format)]
        layout = np.dtype([(name, f'S{kind[:-1]}' if kind[-1] == 's' else f'<{kind}')
                           for name, kind, _ in fields])
        whole = starts[starts + layout.itemsize <= len(data)]
        cut += len(starts) - len(whole)
        rows = data[whole[:, np.newaxis] + np.arange(layout.itemsize)]
        values = rows.view(layout)[:, 0]
        tables[form.name] = {name: values[name] * factor if factor else values[name]
                             for name, _, factor in fields}
    notes = [f'{counted(cut, "message")} cut off at the end'] if cut else []
    known = sum(len(log.offsets[number]) * form.len for number, form in log.formats.items())
    if known < len(data):
        notes.append(f'{counted(len(data) - known, "byte")} between messages left out')
    return tables, notes


def _text(path: Path) -> tuple[dict[str, _Table], list[str]]:
    names: dict[str, list[str]] = {}
    lines: dict[str, list[str]] = {}
    notes: list[str] = []
    bad = 0
    with path.open(encoding='latin-1') as file:
        for line in file:
            if not line.endswith('\n'):
                notes.append('the last line left out: it has no end')
                break
            kind, _, rest = line.partition(',')
            if kind == 'FMT':
                cells = [cell.strip() for cell in rest.split(',')]
                if len(cells) > 4 and _NAME.fullmatch(cells[2]):
                    names.setdefault(cells[2], cells[4:])
            elif kind in names and rest.count(',') == len(names[kind]) - 1:
                lines.setdefault(kind, []).append(rest)
            else:
                bad += kind in names
    tables: dict[str, _Table] = {}
    for kind, rows in lines.items():
        try:  # only the fields of PARM are not all numbers
            table = (np.array([list(map(str.strip, row.split(','))) for row in rows])
                     if kind == 'PARM' else
                     np.loadtxt(rows, delimiter=',', ndmin=2, comments=None))
        except ValueError as err:
            raise InputError(f'{path}: message {kind}: {err}, expected numbers',
                             'correct the line or remove it') from err
        tables[kind] = dict(zip(names[kind], table.T))
    if bad:
        notes.append(f'{counted(bad, "line")} of another length left out')
    return tables, notes
