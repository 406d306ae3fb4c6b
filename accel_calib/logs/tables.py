# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables with our own names: ``#`` comments, one header line, columns by name.

The column names are those of `accel_calib.table.COLUMNS`; other columns of numbers are quantities.
Three kinds of comments are read, with values in JSON: ``# units: "m/s2"``,
``# sensor: "imu_link"`` and ``# autopilot: {…}``. Tables are written as CSV, and read in any
dialect (`accel_calib.logs`).

"""

from __future__ import annotations

from collections.abc import Iterable
import csv
import json
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .columns import check_once, Source, with_indices
from .names import OURS, READING
from .quantities import Quantities
from .read import converted, joined, whole
from .text import open_text
from ..disk import check_regular, write_atomically
from ..table import column_of, COLUMNS, numbered, Poses, present, Table
from ..units import units_of

_DIGITS = '.12g'
_SHOWN = 12
"""Number of other columns in an error message."""


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
    check_regular(path)
    with open_text(path, lambda cells: set(READING) <= set(cells), strict=True,
                   expected=','.join(READING)) as text:
        layout = text.layout
        check_once(layout)
        others = [name for name in layout.header[:_SHOWN] if name not in OURS]
        keys = present([*(name for name in layout.header if name in OURS), *others],
                       ('reading',), str(path))
        columns = with_indices(layout, {name: Source(layout.header.index(name), name)
                                        for key in keys for name in COLUMNS[key].names})
        text.choose(columns.numeric, columns.text, spare=len(columns.quantities))
        blocks = list(converted(path, text.blocks(), Quantities(columns, units_of('g'))))
        table, _ = whole(joined(blocks), [])
        return Poses(table, numbered(table), **layout.about)


def write_table(path: Path, table: Table) -> None:
    """Write poses or samples; errors as in `write_blocks`."""
    write_blocks(path, (table,))


def write_blocks(path: Path, blocks: Iterable[Table]) -> int:
    """
    Write poses or samples block by block, and return the number of rows.

    The memory needed is that of one block. The tables have the same columns, units and sensor. If
    the file cannot be written (OSError), or the iterable fails, an earlier file is unchanged.

    """
    rows = 0

    def write(file: TextIO) -> None:
        nonlocal rows
        writer = csv.writer(file, lineterminator='\n')
        keys: list[str] = []
        for block in blocks:
            if not keys:
                keys = [key for key, column in COLUMNS.items() if key in block and not column.made]
                keys += block.quantities
                _write_head(file, block)
                writer.writerow([name for key in keys for name in column_of(key).names])
            parts = [_as_text(block[key]) for key in keys]
            writer.writerows(zip(*(column for part in parts for column in part), strict=True))
            rows += len(block)

    write_atomically(path, write)
    return rows


def _write_head(file: TextIO, table: Table) -> None:
    for name, value in table.about.items():
        file.write(f'# {name}: {json.dumps(value, ensure_ascii=False)}\n')


def _as_text(values: NDArray[Any]) -> list[list[str]]:
    """Return the columns of an array as text, with enough digits for all sensors."""
    if values.dtype.kind in 'US':
        return [values.tolist()]
    digits = '.16g' if values.ndim == 1 else _DIGITS  # stamps need all digits
    return [[format(value, digits) for value in column.tolist()]
            for column in np.atleast_2d(values.T)]
