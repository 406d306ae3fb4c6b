# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Lines of a log that arrive one after the other, for example from a serial port."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from .dialect import layout_of
from .quantities import decided
from .records import LogOptions
from .selection import chosen, is_log_header
from .text import Cells, TextTable
from ..errors import InputError
from ..table import check_values, Recording


class LineReader:
    """
    Samples of lines that are read as the lines of a text log are.

    Dialect, columns and units are recognised from the first lines, the head. A line that cannot be
    read is skipped, because a serial port can lose characters.

    Parameters
    ----------
    name : str
        Name of the port, for messages.
    head : sequence of str
        The first complete lines.
    seconds : float
        Time in which they arrived, for lines without times [s].
    options : LogOptions
        How to read the lines; by default it is recognised.

    Attributes
    ----------
    units : Units
        Unit of the readings.
    read_as : str
        How the lines are read, in one line.
    first : Recording or None
        The samples of the head.

    Raises
    ------
    InputError
        If the lines have no accelerometer, or contradict the options, or hold no gravity.

    """

    def __init__(self, name: str, head: Sequence[str], seconds: float, options: LogOptions
                 ) -> None:
        lines = _ended(head)
        layout = layout_of(Path(name), lines, lambda cells: is_log_header(cells, options),
                           'utf-8', strict=False, expected='t,ax,ay,az')
        self._name = name
        self._columns = chosen(layout, options)
        self._table = TextTable(layout, iter(()), strict=False)
        first = self._cells(lines[layout.start:])
        if not len(first.row):
            raise InputError(f'{name} sends no row of numbers, expected one line for each sample',
                             'check the format of the lines')
        timed = 'time' in self._columns.sources
        self._rate_hz = None if timed else options.rate or len(first.row) / seconds
        self._quantities = decided(self._columns, first, replace(options, rate=self._rate_hz))
        self.units = self._quantities.units
        rate = '' if timed else (f'no times, {self._rate_hz:.4g} Hz '
                                 f'({"stated" if options.rate else "measured"})')
        self.read_as = ', '.join(filter(None, (self._quantities.read_as, rate)))
        self.first = self._recording(first)

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is not used, and what was skipped so far."""
        return (*self._table.notes, *self._quantities.all_notes)

    def samples(self, lines: Sequence[str]) -> Recording | None:
        """Return the samples of the next complete lines; None if there are none."""
        return self._recording(self._cells(_ended(lines)))

    def _cells(self, lines: Sequence[str]) -> Cells:
        columns = self._columns
        return self._table.read(lines, columns.numeric, columns.text, columns.dates,
                                skip_bad=True)

    def _recording(self, cells: Cells) -> Recording | None:
        """Return rows as samples."""
        if not len(cells.row):
            return None
        columns, row = self._quantities.columns(cells)
        check_values(columns, self._name)
        if self._rate_hz is not None:
            columns['time'] = (row - 1) / self._rate_hz
        return Recording(columns, row, self.units.name) if len(row) else None


def _ended(lines: Sequence[str]) -> list[str]:
    """Return lines with their ends, as in a file."""
    return [f'{line}\n' for line in lines]
