# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Opening of logs of all kinds, and of tables with our own names."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ardupilot import is_dataflash, read_dataflash
from .bag import is_bag, open_samples, together
from .columns import Source
from .dialect import Layout
from .flight import FlightLog
from .names import OURS, READING
from .px4 import is_ulg, read_ulg
from .quantities import decided, Quantities
from .records import are_samples, are_untimed_samples, Log, LogOptions, OpenLog
from .selection import chosen, is_log_header, with_indices
from .text import Cells, open_text, TextTable
from ..disk import check_regular
from ..errors import InputError
from ..table import check_units, check_values, COLUMNS, Poses, present, Recording
from ..units import UnitName, Units, units_of

_Block = tuple[dict[str, NDArray[Any]], NDArray[np.int64]]
_SHOWN = 12


def read_log(path: Path, options: LogOptions = LogOptions()) -> Log:
    """
    Read a log of any kind; parameters and errors as in `open_log`.

    Returns
    -------
    Log
        The poses of a pose table, or the samples of a recording.

    """
    with open_log(path, options) as log:
        table = log.poses if log.poses is not None else together(list(log.blocks))
        return Log(table, log.units, log.read_as, log.notes)


def read_recording(path: Path, topic: str = '', sensor: str = '') -> Recording:
    """Return all samples of a recording; `topic`, `sensor` and errors as in `open_log`."""
    with open_log(path, LogOptions(topic=topic, sensor=sensor)) as log:
        return together(list(log.blocks))


@contextmanager
def open_log(path: Path, options: LogOptions = LogOptions()) -> Iterator[OpenLog]:
    """
    Open a log of any kind: text, a bag, or a flight log of PX4 or ArduPilot.

    Parameters
    ----------
    path : Path
        The file, or the folder of a rosbag2.
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
    if not path.is_dir():
        check_regular(path)
    if is_bag(path):
        with open_samples(path, options.topic, options.sensor,
                          temperature_topic=options.temperature_topic,
                          supply_topic=options.supply_topic) as bag:
            # Drivers exist that publish g, although Imu messages are in m/s².
            units = units_of(options.units or 'm/s2', options.gravity)
            yield OpenLog(_checked(path, bag.blocks, units), bag.samples, units, bag.sensor,
                          noted=lambda: bag.notes)
    elif is_ulg(path):
        yield _flight(path, read_ulg(path, options.topic, options.sensor), options)
    elif is_dataflash(path):
        yield _flight(path, read_dataflash(path, options.topic, options.sensor), options)
    else:
        with open_text(path, lambda cells: is_log_header(cells, options)) as text:
            yield _text(path, text, options)


def _units(path: Path, name: UnitName, options: LogOptions) -> Units:
    """Return the unit that a log states; refuse another one."""
    if options.units and options.units != name:
        raise InputError(f'{path} is in {name}, but --units is {options.units}',
                         'remove --units')
    return units_of(name, options.gravity)


def _checked(path: Path, blocks: Iterator[Recording], units: Units) -> Iterator[Recording]:
    """Yield the blocks, and check the unit of the first one."""
    first = next(blocks, None)
    if first is not None:
        check_units(first, units, str(path))
        yield first
        yield from blocks


def _flight(path: Path, log: FlightLog, options: LogOptions) -> OpenLog:
    """Return a flight log that is read."""
    recording = log.recording(str(path))
    units = _units(path, log.units, options)
    return OpenLog(_checked(path, iter((recording,)), units), len(recording), units, log.sensor,
                   log.read_as, noted=lambda: log.notes)


def _text(path: Path, text: TextTable, options: LogOptions) -> OpenLog:
    """Return an open text log."""
    columns = chosen(text.layout, options)
    cells = text.blocks(columns.numeric, columns.text, columns.dates, skip_bad=options.skip_bad)
    first = next(cells)
    quantities = decided(columns, first, options)
    blocks = _timed(path, _converted(path, chain((first,), cells), quantities), options.rate)
    read_as = ', '.join(filter(None, (quantities.read_as, _rate_words(options.rate))))
    sensor = str(text.layout.about.get('sensor', ''))

    def noted() -> Sequence[str]:
        return (*text.notes, *quantities.all_notes)

    head, name = next(blocks), quantities.units.name
    check_units(Poses(*head), quantities.units, str(path))
    if are_samples(head[0]):
        recordings = (Recording(*block, name, sensor) for block in chain((head,), blocks))
        return OpenLog(recordings, _samples(path, text, head), quantities.units, sensor,
                       read_as, noted=noted)
    poses = Poses(*_whole([head, *blocks]), name, sensor)
    if are_untimed_samples(poses.columns):
        raise InputError(f'{path} has no times, but its {len(poses)} rows look like samples of a '
                         'recording, expected a column time', 'state the samples per second with '
                         '--rate HZ, or name the column with --columns time=NAME')
    return OpenLog(_as_samples(path, poses), len(poses), quantities.units, sensor, read_as, poses,
                   noted)


def _timed(path: Path, blocks: Iterator[_Block], rate_hz: float | None) -> Iterator[_Block]:
    """Yield blocks, with the times of a stated rate if there is one."""
    for columns, row in blocks:
        if rate_hz is not None and 'time' in columns:
            raise InputError(f'{path} has times, but --rate is {rate_hz:g}', 'remove --rate, or '
                             'leave the times out with --columns time=')
        yield columns if rate_hz is None else {**columns, 'time': (row - 1) / rate_hz}, row


def _rate_words(rate_hz: float | None) -> str:
    return '' if rate_hz is None else f'{rate_hz:g} Hz (stated)'


def _converted(path: Path, cells: Iterator[Cells], quantities: Quantities) -> Iterator[_Block]:
    """Yield blocks in our units."""
    for each in cells:
        columns, row = quantities.columns(each)
        check_values(columns, str(path))
        yield columns, row


def _whole(blocks: Sequence[_Block]) -> _Block:
    """Return blocks as one."""
    if len(blocks) == 1:
        return blocks[0]
    return ({key: np.concatenate([columns[key] for columns, _ in blocks])
             for key in blocks[0][0]}, np.concatenate([row for _, row in blocks]))


def _samples(path: Path, text: TextTable, head: _Block) -> int:
    """Return the number of samples, from the size of the file and of the first block."""
    if not text.more:
        return len(head[1])
    width = 2 if text.layout.encoding.startswith('utf-16') else 1
    return max(len(head[1]), int(path.stat().st_size / width / max(text.characters, 1)
                                 * len(head[1])))


def _as_samples(path: Path, poses: Poses) -> Iterator[Recording]:
    """Yield the rows of a table as samples, for a command that needs samples."""
    if 'time' not in poses:
        raise InputError(f'{path} has no column time, expected a recording', 'add the times of '
                         'the samples, or name their column with --columns time=NAME')
    yield Recording(poses.columns, poses.row, poses.units, poses.sensor)


# -------------------------------------------------------------------------- our own tables

@dataclass(frozen=True)
class OwnTable:
    """
    An open table with our own names and units; `open_own` makes it.

    Parameters
    ----------
    blocks : iterator of (dict, array)
        Columns under the keys of `COLUMNS`, and row numbers.
    about : mapping
        Units and sensor, if the table states them.
    samples : int
        Number of rows; of a long table, an estimate from the size of the file.

    """

    blocks: Iterator[_Block]
    about: dict[str, Any]
    samples: int


@contextmanager
def open_own(path: Path, needed: Sequence[str]) -> Iterator[OwnTable]:
    """
    Open a table with our own names, in any dialect.

    Parameters
    ----------
    path : Path
        The file.
    needed : sequence of str
        Required keys of `COLUMNS`.

    Raises
    ------
    InputError
        If the table is empty, lacks columns, or contains a value that is not a finite number;
        also while it is read.
    OSError
        If the file cannot be read.

    """
    check_regular(path)
    expected = ','.join(name for key in needed for name in COLUMNS[key].names)
    with open_text(path, lambda cells: set(READING) <= set(cells), strict=True,
                   expected=expected) as text:
        index = {name: k for k, name in enumerate(text.layout.header)}
        columns = with_indices(text.layout, {
            name: Source(index[name], name)
            for key in _own_keys(text.layout, needed) for name in COLUMNS[key].names})
        quantities = Quantities(columns, units_of('g'))
        blocks = _converted(path, text.blocks(columns.numeric, columns.text), quantities)
        head = next(blocks)
        yield OwnTable(chain((head,), blocks), dict(text.layout.about),
                       _samples(path, text, head))


def _own_keys(layout: Layout, needed: Sequence[str]) -> list[str]:
    """Return the keys of the columns of a table; refuse duplicate and incomplete columns."""
    header = [name for name in layout.header if name in OURS]
    for name in header[:2 * len(OURS)]:
        if header.count(name) > 1:
            raise InputError(f'{layout.path} has {header.count(name)} columns {name}, expected '
                             'one', 'remove or rename the others')
    others = [name for name in layout.header[:_SHOWN] if name not in OURS]
    return present([*header, *others], needed, str(layout.path))
