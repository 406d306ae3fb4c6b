# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Pose tables and recordings as CSV: ``#`` comments, one header line, columns by name.

The names are those of `accel_calib.table.COLUMNS`. Columns of other names are left alone.

"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .atomic import write_atomically
from ..errors import InputError
from ..table import COLUMNS, numbered, Poses, Recording, Table

_DIGITS = '.12g'


def read_poses(path: Path) -> Poses:
    """
    Read a pose table.

    Raises
    ------
    InputError
        If it is empty, lacks columns, or holds something that is not a finite number.
    OSError
        If it cannot be read.

    """
    columns = _read(path, needed=('reading',))
    if 'count' in columns and not np.all(columns['count'] > 0):
        raise InputError(f'{path}: column count holds numbers that are not above 0',
                         'give the number of samples of each pose')
    if 'std' in columns and not np.all(columns['std'] >= 0):
        raise InputError(f'{path}: column std_x, std_y or std_z holds negative numbers',
                         'give standard deviations')
    return Poses(columns, numbered(columns))


def read_samples(path: Path) -> Recording:
    """
    Read a recording, one row a sample; raises as `read_poses`.

    Raises
    ------
    InputError
        If it is empty, lacks columns, or holds something that is not a finite number.
    OSError
        If it cannot be read.

    """
    columns = _read(path, needed=('time', 'reading'))
    return Recording(columns, numbered(columns))


def write_table(path: Path, table: Table) -> None:
    """
    Write poses or samples; a reader finds the same columns.

    Raises
    ------
    OSError
        If it cannot be written; a file that was there is then as it was.

    """
    keys = [key for key in COLUMNS if key in table]
    names = [name for key in keys for name in COLUMNS[key].names]
    parts = [_as_text(table[key]) for key in keys]

    def write(file: TextIO) -> None:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(names)
        writer.writerows(zip(*(column for part in parts for column in part), strict=True))

    write_atomically(path, write)


def _as_text(values: NDArray[Any]) -> list[list[str]]:
    """Give the columns of an array as text, digits enough for any sensor."""
    if values.dtype.kind in 'US':
        return [values.tolist()]
    digits = '.16g' if values.ndim == 1 else _DIGITS  # stamps need them all
    return [[format(value, digits) for value in column.tolist()]
            for column in np.atleast_2d(values.T)]


def _read(path: Path, needed: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read a table into columns of `COLUMNS`."""
    try:
        filled = filter(str.strip, path.read_text(encoding='utf-8').splitlines())
        lines = [line for line in filled if line[0] != '#']
    except UnicodeDecodeError as err:
        raise InputError(f'{path} is not a text file', 'give a CSV table or a bag') from err
    if not lines:
        raise InputError(f'{path} is empty', f'expected a header line such as '
                         f'{",".join(_names(needed))} and a row for each pose or sample')
    header = [name.strip() for name in lines[0].split(',')]
    keys = _present(path, header, needed)
    if len(lines) == 1:
        raise InputError(f'{path} has a header line and no rows',
                         'give one row for each pose or sample')
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
    return columns


def _names(keys: Iterable[str]) -> list[str]:
    return [name for key in keys for name in COLUMNS[key].names]


def _present(path: Path, header: list[str], needed: Sequence[str]) -> list[str]:
    """Tell which columns are there, and make sure that none is there in part."""
    for name in header:
        if header.count(name) > 1 and name in _names(COLUMNS):
            raise InputError(f'{path} has {header.count(name)} columns {name}', 'keep one')
    keys = []
    for key, column in COLUMNS.items():
        missing = [name for name in column.names if name not in header]
        if not missing:
            keys.append(key)
        elif key in needed or len(missing) < len(column.names):
            raise InputError(f'{path} has the columns {", ".join(header)}, and lacks '
                             f'{", ".join(missing)}',
                             f'name the columns {", ".join(column.names)} in the header line')
    return keys


def _numbers(path: Path, rows: list[str], header: list[str],
             names: list[str]) -> NDArray[np.float64]:
    """Read these columns of all rows."""
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
    """Find the first thing that is not a finite number."""
    for number, cells in enumerate(csv.reader(rows), 1):
        if len(cells) < len(header):
            return InputError(f'{path}: row {number} has {len(cells)} values, expected '
                              f'{len(header)}', 'complete the row or take it out')
        for name in names:
            text = cells[header.index(name)].strip()
            try:
                sound = bool(np.isfinite(float(text)))
            except ValueError:
                sound = False
            if not sound:
                return InputError(f'{path}: row {number}, column {name} is {text!r}, expected a '
                                  'finite number', 'mend the row or take it out')
    return InputError(f'{path} cannot be read as a table', 'check it for stray characters')
