# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables with our own names: ``#`` comments, one header line, columns by name.

The column names are those of `accel_calib.table.COLUMNS`; other columns are ignored. Two kinds of
comments are read, with values in JSON: ``# units: "m/s2"`` and ``# sensor: "imu_link"``. Tables
are written as CSV, and read in any dialect (`accel_calib.logs`).

"""

from __future__ import annotations

from collections.abc import Iterable
import csv
import json
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from . import open_own
from ..disk import write_atomically
from ..table import COLUMNS, numbered, Poses, Table

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
    with open_own(path, ('reading',)) as table:
        parts = list(table.blocks)
        columns = {key: np.concatenate([each[key] for each, _ in parts]) for key in parts[0][0]}
        return Poses(columns, numbered(columns), **table.about)


def write_table(path: Path, table: Table) -> None:
    """
    Write poses or samples, with their columns, units and sensor.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    write_blocks(path, (table,))


def write_blocks(path: Path, blocks: Iterable[Table]) -> int:
    """
    Write poses or samples block by block; the memory needed is that of one block.

    Parameters
    ----------
    path : Path
        The file.
    blocks : iterable of Table
        One or more tables with the same columns, units and sensor.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged, as after an error of
        the iterable.

    """
    rows = 0

    def write(file: TextIO) -> None:
        nonlocal rows
        writer = csv.writer(file, lineterminator='\n')
        keys: list[str] = []
        for block in blocks:
            if not keys:
                keys = [key for key, column in COLUMNS.items() if key in block and not column.made]
                _write_head(file, block)
                writer.writerow([name for key in keys for name in COLUMNS[key].names])
            parts = [_as_text(block[key]) for key in keys]
            writer.writerows(zip(*(column for part in parts for column in part), strict=True))
            rows += len(block)

    write_atomically(path, write)
    return rows


def _write_head(file: TextIO, table: Table) -> None:
    for name in _ABOUT:
        if getattr(table, name):
            file.write(f'# {name}: {json.dumps(getattr(table, name), ensure_ascii=False)}\n')


def _as_text(values: NDArray[Any]) -> list[list[str]]:
    """Return the columns of an array as text, with enough digits for all sensors."""
    if values.dtype.kind in 'US':
        return [values.tolist()]
    digits = '.16g' if values.ndim == 1 else _DIGITS  # stamps need all digits
    return [[format(value, digits) for value in column.tolist()]
            for column in np.atleast_2d(values.T)]
