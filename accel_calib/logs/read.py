# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Our own tables, and lines from a serial port.

Our own tables have ``#`` comments, one header line, and
columns by name: those of `accel_calib.table.COLUMNS`; other columns of numbers are quantities.
Three kinds of comments are read, with values in JSON: ``# units: "m/s2"``,
``# sensor: "imu_link"`` and ``# autopilot: {…}``.

"""

from collections.abc import Iterable, Sequence
import csv
from dataclasses import replace
import json
from pathlib import Path
from typing import TextIO

import numpy as np

from .columns import LogOptions
from .dialect import Cells
from .formats import open_log
from .quantities import decided
from .text import TextTable
from ..disk import write_atomically
from ..errors import InputError
from ..table import check_values, column_of, COLUMNS, concatenated, Poses, Recording, Table
from ..text import counted, one_line


def read_poses(path: Path, *, partial: bool = False) -> Poses:
    """
    Return the poses of a pose table; a recording is an InputError, as others in `open_log`.

    `partial`: columns of the context with empty cells, which are NaN, are kept.

    """
    with open_log(path, LogOptions(partial=partial)) as log:
        if log.poses is not None:
            return log.poses
        raise InputError(f'{path} is a recording of {counted(sum(map(len, log.blocks)), "sample")}'
                         ', expected a pose table', 'use capture')


def read_recording(path: Path, topic: str = '', sensor: str = '', *, in_child: bool = True
                   ) -> Recording:
    """Return all samples of a recording; options as in `LogOptions`, errors as in `open_log`."""
    with open_log(path, LogOptions(topic=topic, sensor=sensor, in_child=in_child)) as log:
        return concatenated(list(log.blocks))


# ---------------------------------------------------------------------------- writing of tables

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
                file.writelines(f'# {name}: {one_line(json.dumps(value, ensure_ascii=False))}\n'
                                for name, value in block.about.items())
                writer.writerow([name for key in keys for name in column_of(key).names])
            columns: list[list[str]] = []
            for values in (block[key] for key in keys):
                digits = '.16g' if values.ndim == 1 else '.12g'  # stamps need all digits
                columns += [values.tolist()] if values.dtype.kind in 'US' else [
                    ['' if value != value else format(value, digits) for value in column.tolist()]
                    for column in np.atleast_2d(values.T)]
            writer.writerows(zip(*columns, strict=True))
            rows += len(block)

    write_atomically(path, write)
    return rows


# ----------------------------------------------------------------------------- serial ports

class LineReader:
    """
    Samples of lines that are read as the lines of a text log are.

    Dialect, columns and units are recognised from the `head`, the first complete lines; `first`
    are their samples, and `interval` is the time from one line to the next [s]. `name` is that of
    the port. A line that cannot be read is skipped, because a serial port can lose characters.
    Raise InputError if the lines have no accelerometer, contradict the options, or hold no
    gravity.

    """

    def __init__(self, name: str, head: Sequence[str], interval: float, options: LogOptions
                 ) -> None:
        lines = [f'{line}\n' for line in head]
        self._name = name
        self._table = TextTable(Path(name), lines, iter(()), replace(options, skip_bad=True))
        rows = lines[self._table.layout.start:]
        first = self._table.read(rows)
        if not len(first.row):
            raise InputError(f'{name} sends no row of numbers, expected one line for each sample',
                             'check the format of the lines')
        timed = 'time' in self._table.columns.sources
        rate_hz = options.rate or len(first.row) / len(rows) / interval
        self._quantities = decided(self._table.columns, first, options if timed else
                                   replace(options, rate=rate_hz))
        self.units = self._quantities.units
        rate = f'no times, {rate_hz:.4g} Hz ({"stated" if options.rate else "measured"})'
        self.read_as = ', '.join(filter(None, (self._quantities.read_as, '' if timed else rate)))
        self.first, self.findings = self._recording(first), tuple(self._quantities.findings)

    def samples(self, lines: Sequence[str]) -> Recording | None:
        """Return the samples of the next complete lines; None if there are none."""
        return self._recording(self._table.read([f'{line}\n' for line in lines]))

    def _recording(self, cells: Cells) -> Recording | None:
        if not len(cells.row):
            return None
        columns, row = self._quantities.columns(cells)
        check_values(columns, self._name)
        return Recording(columns, row, self.units.name) if len(row) else None
