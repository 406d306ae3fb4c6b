# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Records of logs: how to read one, an open one, and one that is read."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..table import Poses, Recording
from ..units import STANDARD_GRAVITY, UnitName, Units

Progress = Callable[[int, int], object]
"""Function called with the number of samples done, and that of all samples."""

_SAMPLES_APART_S = 0.5
"""Rows that are nearer in time are samples."""

_MANY_ROWS = 5000
"""More rows than these are samples."""

_FEW_POSES = 200
"""Fewer rows without times are poses."""

_SAME = 0.1
"""Successive samples at rest are nearer than this, relative to the spread of the readings."""


@dataclass(frozen=True)
class LogOptions:
    """
    How to read a log. By default everything is recognised.

    Parameters
    ----------
    columns : mapping of str to str
        Columns of a text log under our names: a name in the header or a number from 1, such as
        ``{'time': 'timestamp_ms', 'ax': 'accX'}``. An empty text leaves a column out.
    format : str
        Name of a maker's layout, from `accel_calib.logs.formats.NAMES`.
    skip_bad : bool
        Whether lines that cannot be read are skipped, rather than an error.
    rate : float or None
        Samples per second of a text log without times [Hz].
    units : {'m/s2', 'g', 'native', ''}
        Unit of the readings.
    default_units : {'m/s2', 'g', 'native', ''}
        Unit of readings whose unit the log does not state, instead of a recognised one.
    gravity : float
        Local gravity [m/s²].
    topic : str
        Imu topic of a bag, or message of a flight log.
    sensor : str
        frame_id of the messages of a bag, or number of the sensor of a flight log.
    temperature_topic, supply_topic : str
        Topics of temperature and supply voltage of a bag, ``TOPIC`` or ``TOPIC:FIELD``.

    """

    columns: Mapping[str, str] = field(default_factory=dict)
    format: str = ''  # noqa: A003
    skip_bad: bool = False
    rate: float | None = None
    units: UnitName | Literal[''] = ''
    default_units: UnitName | Literal[''] = ''
    gravity: float = STANDARD_GRAVITY
    topic: str = ''
    sensor: str = ''
    temperature_topic: str = ''
    supply_topic: str = ''


@dataclass(frozen=True)
class Log:
    """
    A log.

    Parameters
    ----------
    table : Poses or Recording
        The rows, with time in s and angular rate in rad/s.
    units : Units
        Unit of the readings.
    read_as : str
        How the log was read, in one line; empty if nothing was assumed.
    notes : tuple of str
        What was left out.

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
    sensor : str
        Name of the sensor; empty if the log does not state it.
    read_as : str
        How the log is read, in one line; empty if nothing is assumed.
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

    def watched(self, progress: Callable[[int, int], object]) -> Iterator[Recording]:
        """Yield the blocks, and call a function with the number of samples done and of all."""
        done = 0
        for block in self.blocks:
            yield block
            done += len(block)
            progress(done, max(done, self.samples))


def are_samples(columns: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether rows are samples: with time, without count, and dense or many."""
    if 'time' not in columns or 'count' in columns or len(columns['time']) < 2:
        return False
    apart = float(np.median(np.diff(columns['time'])))
    return apart < _SAMPLES_APART_S or len(columns['time']) > _MANY_ROWS


def are_untimed_samples(columns: Mapping[str, NDArray[Any]]) -> bool:
    """Return whether rows without times are samples: many, and mostly like the row before."""
    readings = columns['reading']
    if len(readings) < _FEW_POSES or {'time', 'count', 'orientation'} & set(columns):
        return False
    step = np.linalg.norm(np.diff(readings, axis=0), axis=1)
    spread = np.linalg.norm(readings - np.median(readings, axis=0), axis=1)
    return bool(np.median(step) < _SAME * np.median(spread))
