# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of ArduPilot flight logs (DataFlash): binary ``.bin`` on `pymavlink`, and text ``.log``.

Two messages have accelerations, both in x forward, y right, z down, in m/s², and corrected by the
stored INS_ACC parameters:

=======  ===========================================================================
message  content
=======  ===========================================================================
IMU      reading and angular rate of a sensor, with its temperature T
ACC      reading of a sensor at its own rate, where LOG_BITMASK asks for raw samples
=======  ===========================================================================

Since version 4.1 the field I is the number of the sensor. Before, the second sensor has the
messages IMU2 and ACC2. A log states the fields of each message (message FMT), which are read here.
The text log has the same messages, one per line.
[1] https://ardupilot.org/copter/docs/logmessages.html
[2] https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import re
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .autopilot import ardupilot_correction, Parameters, Stated
from .flight import (
    as_sensed, at, AXES, choose, finite, FlightLog, Message, MICRO, sound, sound_log, taken)
from ..errors import InputError, needing
from ..table import Autopilot, Floats
from ..text import counted

PREFERRED = ('IMU', 'ACC')
_READING = ('AccX', 'AccY', 'AccZ')
_RATES = ('GyrX', 'GyrY', 'GyrZ')
_MAGIC = b'\xa3\x95\x80'
"""First bytes of a binary log: the head of a message FMT."""

_ADVICE = 'take the log from the vehicle whole: it begins with all parameters'
_TEXT = re.compile(r'^FMT, *\d+, *\d+, *\w+, *\w+', re.MULTILINE)
_HEAD = 8192
_MOST_SENSORS = 255
_NAME = re.compile(r'(IMU|ACC|GYR)([1-9]?)')
_STAMPS = {'SampleUS': MICRO, 'TimeUS': MICRO, 'SampleMS': 1e-3, 'TimeMS': 1e-3}
"""Fields with the time of a sample, the best first, and their factors to seconds."""

_SCALES = {'c': 1e-2, 'C': 1e-2, 'e': 1e-2, 'E': 1e-2, 'L': 1e-7}
_TYPES = {'b': 'i1', 'B': 'u1', 'M': 'u1', 'h': '<i2', 'H': '<u2', 'c': '<i2', 'C': '<u2',
          'i': '<i4', 'I': '<u4', 'L': '<i4', 'e': '<i4', 'E': '<u4', 'f': '<f4', 'd': '<f8',
          'g': '<f2', 'q': '<i8', 'Q': '<u8', 'n': 'S4', 'N': 'S16', 'Z': 'S64', 'a': 'S64'}
"""Types of the fields, from the letters of a message FMT [2]."""

_Table = dict[str, NDArray[Any]]


def is_dataflash(path: Path) -> bool:
    """Return whether a file is an ArduPilot log, binary or text, from its first bytes."""
    return path.is_file() and bool(_kind(path))


def _kind(path: Path) -> Literal['binary', 'text', '']:
    """Return the kind of an ArduPilot log; empty for other files."""
    with path.open('rb') as file:
        head = file.read(_HEAD)
    if head.startswith(_MAGIC):
        return 'binary'
    return 'text' if _TEXT.search(head.decode('latin-1')) else ''


@np.errstate(invalid='ignore', over='ignore')  # rows that are not numbers are left out
def read_dataflash(path: Path, topic: str = '', sensor: str = '') -> FlightLog:
    """
    Read the accelerations of one sensor of an ArduPilot log.

    By default the message is IMU if it is dense enough, otherwise ACC, and the sensor the lowest
    number. Another text for the sensor is a name. Raise InputError if the file is damaged or has
    no such message, or pymavlink is not installed (binary logs only).

    """
    kind = _kind(path)
    if not kind:
        raise InputError(f'{path} has no messages FMT, expected an ArduPilot log (.bin or .log)',
                         'check that this is the intended file')
    tables, notes = _binary(path) if kind == 'binary' else _text(path)
    found = _messages(tables)
    choice = choose(found, PREFERRED, topic, sensor, str(path))
    chosen = choice.message
    columns, dropped = sound(
        chosen, {'time': chosen.time, **taken(chosen.fields, AXES, _READING)},
        'the reading is not a number')
    sources = (message for message in (chosen, *found) if message.instance == chosen.instance)
    columns |= choice.rates(columns['time'], sources, _RATES)
    columns |= _temperature(chosen, columns['time'], found)
    parameters = _parameters(tables.get('PARM', {}))
    sensed = as_sensed(columns, parameters, _autopilot(parameters, chosen.instance + 1),
                       lambda: ardupilot_correction(parameters, chosen.instance + 1),
                       _ADVICE)
    return choice.log('ArduPilot log', sensed, 'temperature T',
                      (*notes, *dropped, *choice.others()))


def _messages(tables: Mapping[str, _Table]) -> list[Message]:
    """Return the messages of each sensor: by the field I, or by the number in the name."""
    found = []
    for name, stated in tables.items():
        table = {key: values for key, values in stated.items() if values.dtype.kind in 'iuf'}
        match = _NAME.fullmatch(name)
        stamp = next((key for key in _STAMPS if key in table), '')
        needed = _RATES if name.startswith('GYR') else _READING
        if not match or not stamp or not set(needed) <= set(table):
            continue
        instances = _instances(table, len(table[stamp]), max(int(match[2] or 1) - 1, 0))
        for instance in np.unique(instances).tolist():
            of = instances == instance
            fields = {key: values[of] for key, values in table.items()}
            found.append(Message(match[1], instance, fields,
                                 fields[stamp].astype(float) * _STAMPS[stamp]))
    return found


def _instances(table: _Table, count: int, number: int) -> NDArray[np.int64]:
    """Return the number of the sensor of each message; damaged numbers are 0."""
    stated = table.get('I', np.full(count, number))
    return np.clip(np.nan_to_num(stated.astype(float)), 0.0, _MOST_SENSORS).astype(np.int64)


def _temperature(chosen: Message, time: Floats, found: Sequence[Message]) -> dict[str, Floats]:
    """Return the temperature that IMU of the same sensor reports."""
    for message in found:
        name = next((key for key in ('T', 'Temp') if key in message.fields), '')
        if (message.name, message.instance) == ('IMU', chosen.instance) and name:
            values = message.fields[name]
            if finite(values) and np.any(values):
                return {'temperature': at(time, message, values)}
    return {}


def _autopilot(parameters: Parameters, instance: int) -> Autopilot:
    """Return the place of an accelerometer, numbered from 1."""
    *_, (_, values) = parameters.spans()
    device = values.get(f'INS_ACC{"" if instance == 1 else instance}_ID', 0.0)
    warm = values.get(f'INS_TCAL{instance}_ENABLE', 0.0) != 0.0
    return Autopilot('ardupilot', instance, int(device) or None, instance if warm else None)


def _parameters(table: _Table) -> Parameters:
    """Return the messages PARM, in order; damaged ones are left out."""
    stamp = next((key for key in _STAMPS if key in table), '')
    if not stamp or not {'Name', 'Value'} <= set(table):
        return Parameters([])
    rows = zip(*(table[key].tolist() for key in (stamp, 'Name', 'Value')))
    return Parameters([
        Stated(float(time) * _STAMPS[stamp],
               name.decode('latin-1') if isinstance(name, bytes) else str(name), float(value))
        for time, name, value in rows if _is_number(time) and _is_number(value)])


def _is_number(value: float | str) -> bool:
    try:
        return math.isfinite(float(value))
    except ValueError:  # a damaged line of text
        return False


def _wanted(name: str) -> bool:
    return name == 'PARM' or bool(_NAME.fullmatch(name))


def _indexed(path: Path) -> Any:
    """Return the log of pymavlink, which knows where each message begins."""
    with needing('pymavlink', 'an ArduPilot log (.bin)'):
        from pymavlink.DFReader import DFReader_binary

    class Index(DFReader_binary):  # type: ignore[misc]
        def init_clock(self) -> None:
            """Skip the search for a GPS time, which parses a whole log that has none."""

    with sound_log(path, 'an ArduPilot log (.bin)'):
        log = Index(str(path))
        log.close()
    return log


def _binary(path: Path) -> tuple[dict[str, _Table], list[str]]:
    """Return the fields of the messages of a binary log."""
    log = _indexed(path)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    tables, cut = {}, 0
    for number, form in log.formats.items():
        starts = np.array(log.offsets[number], dtype=np.int64) + 3
        if not _wanted(form.name) or not len(starts) or not _is_sound(form):
            continue
        layout = np.dtype([(name, _TYPES[letter])
                           for name, letter in zip(form.columns, form.format)])
        whole = starts[starts + layout.itemsize <= len(data)]
        cut += len(starts) - len(whole)
        rows = data[whole[:, np.newaxis] + np.arange(layout.itemsize)]
        values = rows.view(layout)[:, 0]
        tables[form.name] = {name: values[name] * _SCALES[letter] if letter in _SCALES
                             else values[name] for name, letter in zip(form.columns, form.format)}
    notes = [f'{counted(cut, "message")} cut off at the end'] if cut else []
    known = sum(len(log.offsets[number]) * form.len for number, form in log.formats.items())
    if known < len(data):
        notes.append(f'{counted(len(data) - known, "byte")} between messages left out')
    return tables, notes


def _is_sound(form: Any) -> bool:
    """Return whether a message has one letter for each field, and a name of its own for each."""
    return all(form.columns) and len(form.format) == len(form.columns) == len(set(form.columns))


def _text(path: Path) -> tuple[dict[str, _Table], list[str]]:
    """Return the fields of the messages of a text log: ``IMU, 123456, 0, …`` on each line."""
    names: dict[str, list[str]] = {}
    lines: dict[str, list[str]] = {}
    notes: list[str] = []
    with path.open(encoding='latin-1') as file:
        for line in file:
            if not line.endswith('\n'):
                notes.append('the last line left out: it has no end')
                break
            kind, _, rest = line.partition(',')
            if kind == 'FMT':
                cells = [cell.strip() for cell in rest.split(',')]
                if len(cells) > 4 and _wanted(cells[2]):
                    names[cells[2]] = cells[4:]
            elif kind in names:
                lines.setdefault(kind, []).append(rest)
    tables: dict[str, _Table] = {}
    bad = 0
    for kind, rows in lines.items():
        sound = [row for row in rows if row.count(',') == len(names[kind]) - 1]
        bad += len(rows) - len(sound)
        if sound:
            tables[kind] = _parsed(path, kind, names[kind], sound)
    if bad:
        notes.append(f'{counted(bad, "line")} of another length left out')
    return tables, notes


def _parsed(path: Path, kind: str, names: Sequence[str], rows: Sequence[str]) -> _Table:
    """Return the fields of the lines of one message; only those of PARM are not all numbers."""
    if kind == 'PARM':
        cells = [[cell.strip() for cell in row.split(',')] for row in rows]
        return dict(zip(names, np.array(cells, dtype=str).reshape(-1, len(names)).T))
    try:
        numbers = np.loadtxt(rows, delimiter=',', ndmin=2, comments=None)
    except ValueError as err:
        raise InputError(f'{path}: message {kind}: {err}, expected numbers',
                         'correct the line or remove it') from err
    return dict(zip(names, numbers.reshape(-1, len(names)).T))
