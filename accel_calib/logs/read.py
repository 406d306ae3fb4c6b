# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Reading of logs of all kinds, and of lines that arrive from a serial port."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ardupilot import is_dataflash, read_dataflash
from .bag import Bag, is_bag, open_bag
from .bag_samples import context_of, imu_samples, together
from .columns import chosen, is_log_header, LogOptions
from .containers import Frame, member_of, members_of, Piped
from .dialect import layout_of
from .flight import FlightLog, is_ulg, read_ulg
from .quantities import are_samples, are_untimed_samples, decided, Quantities
from .text import Cells, open_text, TextTable
from ..disk import check_regular
from ..errors import InputError, saying
from ..table import check_units, check_values, is_quantity, Poses, Recording
from ..text import some
from ..units import Units, units_of

Progress = Callable[[int, int], object]
"""Function called with the number of samples done, and that of all samples."""

Block = tuple[dict[str, NDArray[Any]], NDArray[np.int64]]
"""Columns under the keys of `COLUMNS`, and row numbers."""


@dataclass(frozen=True)
class Log:
    """
    A log: rows with time in s and angular rate in rad/s, the unit of the readings, and notes.

    `read_as` is how it was read, in one line, empty if nothing was assumed; `notes` state what was
    left out.

    """

    table: Poses | Recording
    units: Units
    read_as: str = ''
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class OpenLog:
    """
    An open log that is read block by block; `open_log` makes it.

    Parameters
    ----------
    blocks : iterator of Recording
        The samples, in order. The size of a block does not depend on that of the log. An error is
        raised when a table without times is read as samples.
    samples : int
        Number of samples; of a long text log, an estimate from the size of the file.
    units : Units
        Unit of the readings.
    sensor, read_as : str
        Name of the sensor, empty if not stated; how the log is read, empty if nothing is assumed.
    poses : Poses or None
        The poses, if the log is a pose table.
    noted : function
        Returns the notes so far.

    """

    blocks: Iterator[Recording]
    samples: int
    units: Units
    sensor: str = ''
    read_as: str = ''
    poses: Poses | None = None
    noted: Callable[[], Sequence[str]] = tuple

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is left out; complete once all blocks are read."""
        return tuple(self.noted())

    def watched(self, progress: Progress) -> Iterator[Recording]:
        """Yield the blocks, and call a function with the number of samples done and of all."""
        done = 0
        for block in self.blocks:
            yield block
            done += len(block)
            progress(done, max(done, self.samples))


def read_log(path: Path, options: LogOptions = LogOptions()) -> Log:
    """Read the poses or the samples of a log; parameters and errors as in `open_log`."""
    with open_log(path, options) as log:
        table = log.poses if log.poses is not None else together(list(log.blocks))
        return Log(table, log.units, log.read_as, log.notes)


def read_recording(path: Path, topic: str = '', sensor: str = '') -> Recording:
    """Return all samples of a recording; `topic`, `sensor` and errors as in `open_log`."""
    with open_log(path, LogOptions(topic=topic, sensor=sensor)) as log:
        return together(list(log.blocks))


@contextmanager
def open_log(path: Path | Piped | Frame, options: LogOptions = LogOptions()) -> Iterator[OpenLog]:
    """
    Open a log of any kind: text, a bag, a flight log of PX4 or ArduPilot, or a DataFrame.

    Parameters
    ----------
    path : Path, Piped or Frame
        The file, the folder of a rosbag2, standard input, or the DataFrame.
    options : LogOptions
        How to read it; by default it is recognised.

    Raises
    ------
    InputError
        If the log cannot be read, has no accelerometer or several, contradicts the options, or
        holds no gravity; also while it is read.
    OSError
        If the file cannot be read.

    """
    if isinstance(path, Path) and not path.is_dir():
        check_regular(path)
    with _opened(path, options) as log, saying(log.read_as):
        yield log


@contextmanager
def _opened(path: Path | Piped | Frame, options: LogOptions) -> Iterator[OpenLog]:
    """Open a log; parameters and errors as in `open_log`."""
    if not isinstance(path, Path):
        name = Path(str(path))
        with path.table.text(name, options) as text:
            yield _text(name, text, options)
    elif is_bag(path):
        with open_bag(path) as bag:
            yield _bag(bag, options)
    elif is_ulg(path):
        yield _flight(path, read_ulg(path, options.topic, options.sensor), options)
    elif is_dataflash(path):
        yield _flight(path, read_dataflash(path, options.topic, options.sensor), options)
    else:
        with members_of(path) as members:
            if members:
                member = member_of(path, members, options)
                with member.text(path, options) as text:
                    log = _text(path / member.name, text, options)
                    yield replace(log, read_as=', '.join(filter(None, (member.name, log.read_as))))
            else:
                with open_text(path, lambda cells: is_log_header(cells, options)) as text:
                    yield _text(path, text, options)


def _bag(bag: Bag, options: LogOptions) -> OpenLog:
    topic = bag.imu_topic(options.topic)
    sensor = options.sensor or bag.first_frame_id(topic)
    context = context_of(bag, topic, sensor, options.temperature_topic, options.supply_topic)
    notes = [*bag.notes, *context.notes]
    blocks = imu_samples(bag, topic, sensor, chosen=bool(options.sensor), context=context,
                         notes=notes)
    # Drivers exist that publish g, although Imu messages are in m/s².
    units = units_of(options.units or 'm/s2', options.gravity)
    return OpenLog(_checked(bag.path, blocks, units), bag.count(topic), units, sensor,
                   f'Imu messages of {topic} in {units.name}', noted=lambda: notes)


def _flight(path: Path, log: FlightLog, options: LogOptions) -> OpenLog:
    recording = log.recording(str(path))
    units = units_of('m/s2', options.gravity)
    if options.units not in ('', units.name):
        raise InputError(f'{path} is in {units.name}, but --units is {options.units}',
                         'remove --units')
    return OpenLog(_checked(path, iter((recording,)), units), len(recording), units, log.sensor,
                   log.read_as, noted=lambda: log.notes)


def _checked(path: Path, blocks: Iterator[Recording], units: Units) -> Iterator[Recording]:
    """Yield the blocks, and check the unit of the first one."""
    for first in blocks:
        check_units(first, units, str(path))
        yield first
        yield from blocks


def _text(path: Path, text: TextTable, options: LogOptions) -> OpenLog:
    columns = chosen(text.layout, options)
    text.choose(columns.numeric, columns.text, columns.dates, spare=len(columns.quantities),
                skip_bad=options.skip_bad)
    cells = text.blocks()
    first = next(cells)
    quantities = decided(columns, first, options)
    with saying(quantities.read_as):
        return _decided(path, text, chain((first,), cells), quantities, options)


def _decided(path: Path, text: TextTable, cells: Iterator[Cells], quantities: Quantities,
             options: LogOptions) -> OpenLog:
    """Return a text log whose columns and units are known."""
    blocks = _timed(converted(path, cells, quantities), quantities.rate_hz)
    head = next(blocks)
    units, about = quantities.units, text.layout.about
    sensor, autopilot = str(about.get('sensor', '')), about.get('autopilot')
    check_units(Poses(*head), units, str(path))
    poses = None
    samples: Iterator[Recording]
    if are_samples(head[0]):
        samples = (Recording(*block, units.name, sensor, autopilot)
                   for block in chain((head,), blocks))
        count = _estimated(text, head)
    else:
        poses = Poses(*whole(joined([head, *blocks]), quantities.notes), units.name, sensor,
                      autopilot)
        if are_untimed_samples(poses.columns):
            raise InputError(f'{path} has no times, but its {len(poses)} rows look like samples '
                             'of a recording, expected a column time', 'state the samples per '
                             'second with --rate HZ, or name the column with --columns '
                             'time=NAME; if each row is a pose, add a column orientation')
        samples, count = _as_samples(path, poses), len(poses)
    said = [quantities.read_as] if quantities.read_as else []
    if quantities.rate_hz is not None:
        said.append(f'{quantities.rate_hz:g} Hz (stated)')
    return OpenLog(samples, count, units, sensor, ', '.join(said), poses,
                   noted=lambda: (*text.notes, *quantities.all_notes))


def _timed(blocks: Iterator[Block], rate_hz: float | None) -> Iterator[Block]:
    """Yield blocks, with the times of a stated rate if there is one."""
    for columns, row in blocks:
        yield columns if rate_hz is None else {**columns, 'time': (row - 1) / rate_hz}, row


def converted(path: Path, cells: Iterator[Cells], quantities: Quantities) -> Iterator[Block]:
    """Yield blocks in our units."""
    for block in cells:
        columns, row = quantities.columns(block)
        check_values(columns, str(path))
        yield columns, row


def joined(blocks: Sequence[Block]) -> Block:
    """Return blocks as one."""
    if len(blocks) == 1:
        return blocks[0]
    return ({key: np.concatenate([columns[key] for columns, _ in blocks])
             for key in blocks[0][0]}, np.concatenate([row for _, row in blocks]))


def whole(block: Block, notes: list[str]) -> Block:
    """Return a block without quantities that lack a number in a row; they are noted."""
    columns, row = block
    lacking = [key for key in columns if is_quantity(key) and not np.isfinite(columns[key]).all()]
    if lacking:
        notes.append(f'not used, because cells are not numbers: {some(lacking)}')
    return {key: values for key, values in columns.items() if key not in lacking}, row


def _estimated(text: TextTable, head: Block) -> int:
    """Return the number of rows, from the size of the file and of the first block."""
    count = len(head[1])
    if not text.more:
        return count
    width = 2 if text.layout.encoding.startswith('utf-16') else 1
    return max(count, int(text.size / width / max(text.characters, 1) * count))


def _as_samples(path: Path, poses: Poses) -> Iterator[Recording]:
    """Yield the rows of a table as samples, for a command that needs samples."""
    if 'time' not in poses:
        raise InputError(f'{path} has no column time, expected a recording', 'add the times of '
                         'the samples, or name their column with --columns time=NAME')
    yield Recording(poses.columns, poses.row, poses.units, poses.sensor, poses.autopilot)


# ----------------------------------------------------------------------------- serial ports

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
        The first complete lines; `first` are their samples.
    seconds : float
        Time in which they arrived, for lines without times [s].

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
        columns = chosen(layout, options)
        self._table = TextTable(layout, iter(()), strict=False)
        self._table.choose(columns.numeric, columns.text, columns.dates,
                           spare=len(columns.quantities), skip_bad=True)
        first = self._table.read(lines[layout.start:])
        if not len(first.row):
            raise InputError(f'{name} sends no row of numbers, expected one line for each sample',
                             'check the format of the lines')
        timed = 'time' in columns.sources
        self._rate_hz = None if timed else options.rate or len(first.row) / seconds
        self._quantities = decided(columns, first, options if timed else
                                   replace(options, rate=self._rate_hz))
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
        return self._recording(self._table.read(_ended(lines)))

    def _recording(self, cells: Cells) -> Recording | None:
        if not len(cells.row):
            return None
        columns, row = self._quantities.columns(cells)
        check_values(columns, self._name)
        if self._rate_hz is not None:
            columns['time'] = (row - 1) / self._rate_hz
        return Recording(columns, row, self.units.name) if len(row) else None


def _ended(lines: Sequence[str]) -> list[str]:
    return [f'{line}\n' for line in lines]
