# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reading of logs of all kinds, of lines from a serial port, and of our own tables.

A log is recognised by its first bytes. Our own tables have ``#`` comments, one header line, and
columns by name: those of `accel_calib.table.COLUMNS`; other columns of numbers are quantities.
Three kinds of comments are read, with values in JSON: ``# units: "m/s2"``,
``# sensor: "imu_link"`` and ``# autopilot: {…}``.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, replace
from itertools import chain
import json
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .autopilot import FlightLog
from .bag import Bag, open_bag
from .bag_samples import context_of, imu_samples, rate_words
from .columns import chosen, is_log_header, LogOptions
from .containers import Frame, open_table, Piped
from .dialect import layout_of
from .flight import read_dataflash, read_ulg
from .formats import CONTAINERS, FLIGHT_LOG, HEAD, ULOG
from .quantities import are_samples, are_untimed_samples, decided, Quantities
from .text import Cells, open_text, TextTable
from ..disk import check_regular, FIRST_LINE, write_atomically
from ..errors import InputError, saying
from ..table import (
    check_units, check_values, column_of, COLUMNS, concatenated, Poses, Recording, Table)
from ..text import counted, some
from ..units import Units, units_of

_BAG_SUFFIXES = ('.bag', '.mcap', '.db3')

_DIGITS = '.12g'

Progress = Callable[[int, int], object]
"""Function called with the number of samples done, and that of all samples."""


@dataclass(frozen=True)
class OpenLog:
    """
    An open log that is read block by block; `open_log` makes it.

    `blocks` are the samples, in order; their size does not depend on that of the log. An error is
    raised when a table without times is read as samples. `samples` is the number of samples; of a
    long text log, an estimate from the size of the file. `sensor` is empty if it is not stated.
    `read_as` is how the log is read, in one line, empty if nothing is assumed. `poses` are those
    of a pose table. `noted` returns the notes so far: what was left out.

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


def read_poses(path: Path) -> Poses:
    """Return the poses of a pose table; a recording is an InputError, as others in `open_log`."""
    with open_log(path) as log:
        if log.poses is not None:
            return log.poses
        raise InputError(f'{path} is a recording of {counted(sum(map(len, log.blocks)), "sample")}'
                         ', expected a pose table', 'use capture')


def read_recording(path: Path, topic: str = '', sensor: str = '') -> Recording:
    """Return all samples of a recording; `topic`, `sensor` and errors as in `open_log`."""
    with open_log(path, LogOptions(topic=topic, sensor=sensor)) as log:
        return concatenated(list(log.blocks))


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
    if not isinstance(path, Path):
        name = Path(str(path))
        with path.table.text(name, options) as text:
            yield _text(name, text, options)
        return
    if is_bag(path):
        with open_bag(path) as bag:
            yield _bag(bag, options)
        return
    with path.open('rb') as file:
        head = file.read(HEAD)
    if head.startswith(FIRST_LINE.encode()):
        raise InputError(f'{path} is a calibration, expected a log or a table of poses',
                         'use the log or the table that it was made from; most commands take a '
                         'calibration with -c')
    if head.startswith(CONTAINERS) or (path.suffix == '.mat' and b'\0' in head):
        with open_table(path, head, options) as (member, text):
            log = _text(path / member, text, options)
            yield replace(log, read_as=', '.join(filter(None, (member, log.read_as))))
    elif FLIGHT_LOG.search(head):
        read_flight = read_ulg if head.startswith(ULOG) else read_dataflash
        yield _flight(path, read_flight(path, options.topic, options.instance), options)
    else:
        with open_text(path, lambda cells: is_log_header(cells, options)) as text:
            yield _text(path, text, options)


def is_bag(path: Path) -> bool:
    """Return whether a path names a bag rather than a table."""
    return path.is_dir() or path.suffix in _BAG_SUFFIXES


def _bag(bag: Bag, options: LogOptions) -> OpenLog:
    topic = bag.imu_topic(options.topic)
    sensor = options.sensor or bag.first_frame_id(topic)
    context = context_of(bag, topic, sensor, options)
    notes = [*bag.notes, *context.notes]
    blocks = imu_samples(bag, topic, sensor, chosen=bool(options.sensor), context=context,
                         notes=notes)
    # Drivers exist that publish g, although Imu messages are in m/s².
    units = units_of(options.units or options.default_units or 'm/s2', options.gravity)
    return OpenLog(_checked(bag.path, blocks, units), bag.count(topic), units, sensor,
                   f'Imu messages of {topic}{rate_words(bag, topic)} in {units.name}',
                   noted=lambda: notes)


def _flight(path: Path, log: FlightLog, options: LogOptions) -> OpenLog:
    recording = log.recording
    check_values(recording.columns, str(path))
    units = units_of('m/s2', options.gravity)
    if options.units not in ('', units.name):
        raise InputError(f'{path} is in {units.name}, but --units is {options.units}',
                         'remove --units')
    return OpenLog(_checked(path, iter((recording,)), units), len(recording), units,
                   recording.sensor, log.read_as, noted=lambda: log.notes)


def _checked(path: Path, blocks: Iterator[Recording], units: Units) -> Iterator[Recording]:
    """Yield the blocks, and check the unit of the first one."""
    for first in blocks:
        check_units(first, units, str(path))
        yield first
        yield from blocks


def _text(path: Path, text: TextTable, options: LogOptions) -> OpenLog:
    columns = chosen(text.layout, options)
    text.choose(columns, skip_bad=options.skip_bad)
    cells = text.blocks()
    first = next(cells)
    quantities = decided(columns, first, options)
    if quantities.clock.newest_first:
        first, *rest = (Cells(each.numbers[::-1], [part[::-1] for part in each.texts],
                              each.row[::-1]) for each in [first, *cells][::-1])
        cells = iter(rest)
    with saying(quantities.read_as):
        return _decided(path, text, chain((first,), cells), quantities)


def _decided(path: Path, text: TextTable, cells: Iterator[Cells], quantities: Quantities
             ) -> OpenLog:
    blocks = _converted(path, text.layout.about, cells, quantities)
    head = next(blocks)
    check_units(head, quantities.units, str(path))
    poses = None
    samples: Iterator[Recording]
    if are_samples(head.columns):
        samples = (block.as_recording() for block in chain((head,), blocks))
        count = _estimated(text, len(head))
    else:
        poses = _without_lacking(concatenated([head, *blocks]), quantities.notes)
        if are_untimed_samples(poses.columns):
            raise InputError(f'{path} has no times, but its {len(poses)} rows look like samples '
                             'of a recording, expected a column time', 'state the samples per '
                             'second with --rate HZ, or name the column with --columns '
                             'time=NAME; if each row is a pose, add a column orientation')
        samples, count = _as_samples(path, poses), len(poses)
    rate = '' if quantities.rate_hz is None else f'{quantities.rate_hz:g} Hz (stated)'
    return OpenLog(samples, count, quantities.units, head.sensor,
                   ', '.join(filter(None, (quantities.read_as, rate))), poses,
                   noted=lambda: (*text.notes, *quantities.all_notes))


def _converted(path: Path, about: Mapping[str, Any], cells: Iterator[Cells],
               quantities: Quantities) -> Iterator[Poses]:
    for block in cells:
        columns, row = quantities.columns(block)
        check_values(columns, str(path))
        yield Poses(columns, row, **{**about, 'units': quantities.units.name})


def _without_lacking(poses: Poses, notes: list[str]) -> Poses:
    """Return poses without quantities that lack a number in a row; they are noted."""
    lacking = [key for key in poses.quantities if not np.isfinite(poses[key]).all()]
    if lacking:
        notes.append(f'not used, because cells are not numbers: {some(lacking)}')
    return poses.without_columns(*lacking)


def _estimated(text: TextTable, count: int) -> int:
    """Return the number of rows, from the size of the file and of the `count` of a block."""
    if not text.more:
        return count
    width = 2 if text.layout.encoding.startswith('utf-16') else 1
    return max(count, int(text.size / width / max(text.characters, 1) * count))


def _as_samples(path: Path, poses: Poses) -> Iterator[Recording]:
    """Yield the rows of a table as samples, for a command that needs samples."""
    if 'time' not in poses:
        raise InputError(f'{path} has no column time, expected a recording', 'add the times of '
                         'the samples, or name their column with --columns time=NAME')
    yield poses.as_recording()


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
                file.writelines(f'# {name}: {json.dumps(value, ensure_ascii=False)}\n'
                                for name, value in block.about.items())
                writer.writerow([name for key in keys for name in column_of(key).names])
            parts = [_as_text(block[key]) for key in keys]
            writer.writerows(zip(*(column for part in parts for column in part), strict=True))
            rows += len(block)

    write_atomically(path, write)
    return rows


def _as_text(values: NDArray[Any]) -> list[list[str]]:
    """Return the columns of an array as text, with enough digits for all sensors."""
    if values.dtype.kind in 'US':
        return [values.tolist()]
    digits = '.16g' if values.ndim == 1 else _DIGITS  # stamps need all digits
    return [[format(value, digits) for value in column.tolist()]
            for column in np.atleast_2d(values.T)]


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
        lines = _ended(head)
        layout = layout_of(Path(name), lines, lambda cells: is_log_header(cells, options), 'utf-8')
        self._name = name
        columns = chosen(layout, options)
        self._table = TextTable(layout, iter(()))
        self._table.choose(columns, skip_bad=True)
        first = self._table.read(lines[layout.start:])
        if not len(first.row):
            raise InputError(f'{name} sends no row of numbers, expected one line for each sample',
                             'check the format of the lines')
        timed = 'time' in columns.sources
        rate_hz = options.rate or len(first.row) / (len(lines) - layout.start) / interval
        self._quantities = decided(columns, first, options if timed else
                                   replace(options, rate=rate_hz))
        self.units = self._quantities.units
        rate = '' if timed else (f'no times, {rate_hz:.4g} Hz '
                                 f'({"stated" if options.rate else "measured"})')
        self.read_as = ', '.join(filter(None, (self._quantities.read_as, rate)))
        self.first = self._recording(first)

    def samples(self, lines: Sequence[str]) -> Recording | None:
        """Return the samples of the next complete lines; None if there are none."""
        return self._recording(self._table.read(_ended(lines)))

    def _recording(self, cells: Cells) -> Recording | None:
        if not len(cells.row):
            return None
        columns, row = self._quantities.columns(cells)
        check_values(columns, self._name)
        return Recording(columns, row, self.units.name) if len(row) else None


def _ended(lines: Sequence[str]) -> list[str]:
    return [f'{line}\n' for line in lines]
