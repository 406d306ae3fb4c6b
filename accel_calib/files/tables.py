# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Pose tables and recordings as CSV: ``#`` comments, one header line, columns by name.

The column names are those of `accel_calib.table.COLUMNS`; other columns are ignored. Two kinds of
comments are read, with values in JSON: ``# units: "m/s2"`` and ``# sensor: "imu_link"``.

**Recordings.** Readers of recordings, from CSV tables and bags: block by block, or as a whole.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass
import json
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .atomic import write_atomically
from .bag import first_frame_id, imu_samples, imu_topic, is_bag, open_bag, together
from ..errors import counted, InputError
from ..table import check_values, COLUMNS, numbered, Poses, present, Recording, Table
from ..units import UNIT_NAMES, UnitName

_DIGITS = '.12g'
_ABOUT = ('units', 'sensor')


def read_poses(path: Path) -> Poses:
    """
    Read a pose table.

    Raises
    ------
    InputError
        If the table is empty, lacks columns, or contains a value that is not a finite number.
    OSError
        If the file cannot be read.

    """
    columns, about = _read(path, needed=('reading',))
    check_values(columns, str(path))
    return Poses(columns, numbered(columns), **about)


def read_samples(path: Path) -> Recording:
    """
    Read a recording, one row per sample.

    Raises
    ------
    InputError
        If the table is empty, lacks columns, or contains a value that is not a finite number.
    OSError
        If the file cannot be read.

    """
    columns, about = _read(path, needed=('time', 'reading'))
    return Recording(columns, numbered(columns), **about)


def write_table(path: Path, table: Table) -> None:
    """
    Write poses or samples, with their columns, units and sensor.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    keys = [key for key, column in COLUMNS.items() if key in table and not column.made]
    names = [name for key in keys for name in COLUMNS[key].names]
    parts = [_as_text(table[key]) for key in keys]

    def write(file: TextIO) -> None:
        for name in _ABOUT:
            if getattr(table, name):
                file.write(f'# {name}: {json.dumps(getattr(table, name), ensure_ascii=False)}\n')
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(names)
        writer.writerows(zip(*(column for part in parts for column in part), strict=True))

    write_atomically(path, write)


def _as_text(values: NDArray[Any]) -> list[list[str]]:
    """Return the columns of an array as text, with enough digits for all sensors."""
    if values.dtype.kind in 'US':
        return [values.tolist()]
    digits = '.16g' if values.ndim == 1 else _DIGITS  # stamps need all digits
    return [[format(value, digits) for value in column.tolist()]
            for column in np.atleast_2d(values.T)]


def _read(path: Path, needed: Sequence[str]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the columns of a table under the keys of `COLUMNS`, and its units and sensor."""
    try:
        filled = list(filter(str.strip, path.read_text(encoding='utf-8').splitlines()))
    except UnicodeDecodeError as err:
        raise InputError(f'{path} is not a text file, expected a CSV table',
                         'use a CSV table or a bag') from err
    about = _about(path, [line for line in filled if line[0] == '#'])
    lines = [line for line in filled if line[0] != '#']
    if not lines:
        raise InputError(f'{path} is empty, expected a header line such as '
                         f'{",".join(_names(needed))} and one row for each pose or sample',
                         'check that this is the intended file')
    header = [name.strip() for name in lines[0].split(',')]
    keys = _keys(path, header, needed)
    if len(lines) == 1:
        raise InputError(f'{path} has a header line but no rows, expected one row for each pose '
                         'or sample', 'add the rows')
    columns: dict[str, NDArray[Any]] = {}
    numeric = [key for key in keys if key != 'label']
    names = _names(numeric)
    numbers = _numbers(path, lines[1:], header, names)
    for key in numeric:
        which = [names.index(name) for name in COLUMNS[key].names]
        columns[key] = numbers[:, which] if len(which) > 1 else numbers[:, which[0]]
    if 'label' in keys:
        rows = csv.reader(lines[1:])
        columns['label'] = np.array([row[header.index('label')] for row in rows], dtype=str)
    return columns, about


def _about(path: Path, comments: list[str]) -> dict[str, Any]:
    """Return units and sensor from the comments."""
    about = {}
    for line in comments:
        name, colon, text = line[1:].partition(':')
        if colon and name.strip() in _ABOUT:
            try:
                about[name.strip()] = json.loads(text)
            except ValueError:
                continue  # an ordinary comment
    if about.get('units', '') not in ('', *UNIT_NAMES):
        raise InputError(f'{path} has the units {about["units"]!r}, expected one of '
                         f'{", ".join(UNIT_NAMES)}', 'correct that line or remove it')
    return about


def _names(keys: Iterable[str]) -> list[str]:
    return [name for key in keys for name in COLUMNS[key].names]


def _keys(path: Path, header: list[str], needed: Sequence[str]) -> list[str]:
    """Return the keys of the columns in a header; refuse duplicate and incomplete columns."""
    for name in header:
        if header.count(name) > 1 and name in _names(COLUMNS):
            raise InputError(f'{path} has {header.count(name)} columns {name}, expected one',
                             'remove or rename the others')
    return present(header, needed, str(path))


def _numbers(path: Path, rows: list[str], header: list[str],
             names: list[str]) -> NDArray[np.float64]:
    """Return the (n, k) numbers in the columns with these names."""
    which = [header.index(name) for name in names]
    try:
        values = np.loadtxt(rows, delimiter=',', usecols=which, ndmin=2, comments=None,
                            quotechar='"')
    except ValueError:
        values = np.array([[np.nan]])
    if not np.all(np.isfinite(values)):
        raise _fault(path, rows, header, names)
    return values


def _fault(path: Path, rows: list[str], header: list[str], names: list[str]) -> InputError:
    """Return the error for the first cell that is not a finite number."""
    for number, cells in enumerate(csv.reader(rows), 1):
        if len(cells) < len(header):
            return InputError(f'{path}: row {number} has {counted(len(cells), "value")}, expected '
                              f'{len(header)}', 'complete the row or remove it')
        for name in names:
            text = cells[header.index(name)].strip()
            try:
                sound = bool(np.isfinite(float(text)))
            except ValueError:
                sound = False
            if not sound:
                return InputError(f'{path}: row {number}, column {name} is {text!r}, expected a '
                                  'finite number', 'correct the row or remove it')
    return InputError(f'{path} cannot be read, expected a CSV table',
                      'check it for stray characters')


@dataclass(frozen=True)
class OpenRecording:
    """
    An open recording that is read block by block; `open_recording` makes it.

    Parameters
    ----------
    blocks : iterator of Recording
        The samples, in order. The size of a block does not depend on that of the recording.
    samples : int
        Number of samples, according to the index of the file.
    units : {'m/s2', 'g', 'native', ''}
        Unit of the readings, m/s² for Imu messages; empty if the file does not state it.
    sensor : str
        frame_id of the messages; empty if the file does not state it.

    """

    blocks: Iterator[Recording]
    samples: int
    units: UnitName | str
    sensor: str


@contextmanager
def open_recording(path: Path, topic: str = '', sensor: str = '') -> Iterator[OpenRecording]:
    """
    Open a recording: a CSV table, a rosbag2 (folder, mcap, db3) or a ROS 1 bag.

    Parameters
    ----------
    path : Path
        The file or folder.
    topic : str
        Imu topic, for a bag with several Imu topics.
    sensor : str
        frame_id of the messages to read, for a topic with several sensors.

    Raises
    ------
    InputError
        If the format does not match the file name, or the file contains no samples or samples of
        several sensors; also while it is read.
    OSError
        If the file cannot be read.

    """
    if not is_bag(path):
        table = read_samples(path)
        yield OpenRecording(iter((table,)), len(table), table.units, table.sensor)
        return
    with open_bag(path) as bag:
        name = imu_topic(bag, topic)
        of = sensor or first_frame_id(bag, name)
        yield OpenRecording(imu_samples(bag, name, of, chosen=bool(sensor)), bag.count(name),
                            'm/s2', of)


def read_recording(path: Path, topic: str = '', sensor: str = '') -> Recording:
    """Return a whole recording; parameters and errors as in `open_recording`."""
    with open_recording(path, topic, sensor) as recording:
        return together(list(recording.blocks))
