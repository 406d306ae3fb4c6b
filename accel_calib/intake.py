# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From any log to poses: a recording is captured, a pose table is taken as it is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from .capture import capture, Captured, settings_from
from .errors import InputError
from .logs import Frame, LogOptions, open_log, Piped, Progress
from .table import Poses, Recording
from .text import counted
from .units import Units

_FEW = 6
"""Fewer poses than these are too few for a calibration with all axes."""

_WIDER = (1.5, 4.0, 10.0)
"""Factors by which the limit of the standard deviation is widened, to advise another one."""


@dataclass(frozen=True)
class Intake:
    """
    Poses of a table or captured from a recording, with the unit of their readings.

    `read_as` is how the log was read, in one line, empty if nothing was assumed. `notes` are what
    was left out of the log, and `captured` how the poses were captured, if they were.

    """

    poses: Poses
    units: Units
    read_as: str = ''
    notes: tuple[str, ...] = ()
    captured: tuple[str, ...] = ()

    @property
    def said(self) -> str:
        """Return how the log was read and captured, in one line, for an error about it."""
        return ', '.join(filter(None, (self.read_as, *self.captured)))

    @property
    def lines(self) -> tuple[str, ...]:
        """Return `read_as` and the notes, for the terminal and the page."""
        return tuple(filter(None, (self.read_as and f'read as: {self.read_as}', *self.notes,
                                   *self.captured)))


def poses_of(path: Path | Piped | Frame, options: LogOptions = LogOptions(),
             settings: Mapping[str, Any] = {},
             progress: Progress = lambda done, count: None) -> Intake:
    """
    Return the poses of any log; a recording is captured.

    Parameters
    ----------
    path : Path, Piped or Frame
        Pose table or recording, in any format that `accel_calib.logs` reads.
    options : LogOptions
        How to read the log; by default it is recognised.
    settings : mapping
        Fields of `accel_calib.capture.CaptureSettings` for a recording.
    progress : function of two int
        Called with the number of samples done and of all samples.

    Raises
    ------
    InputError
        If the log cannot be read, or a recording has no still stretch.
    OSError
        If the file cannot be read.

    """
    with open_log(path, options) as log:
        if log.poses is not None:
            return Intake(log.poses, log.units, log.read_as, log.notes)
        found, wider = still_poses(str(path), log.units, settings, log.watched(progress),
                                   lambda: samples_again(path, options))
        words = (f'captured {counted(len(found.poses), "pose")} from '
                 f'{counted(found.recorded, "sample")} in {found.seconds:.0f} s')
        return Intake(replace(found.poses, units=log.units.name), log.units, log.read_as,
                      log.notes, (words, *wider))


def samples_again(path: Path | Piped | Frame, options: LogOptions) -> Iterator[Recording]:
    """Yield the blocks of a log from its beginning."""
    with open_log(path, options) as log:
        yield from log.blocks


def still_poses(source: str, units: Units, settings: Mapping[str, Any],
                samples: Recording | Iterable[Recording],
                again: Callable[[], Recording | Iterable[Recording]]
                ) -> tuple[Captured, tuple[str, ...]]:
    """
    Return the capture of samples, and a note if a wider limit finds many more poses.

    `again` returns the samples from their beginning. Raise InputError without a still stretch.

    """
    found = capture(samples, units, settings_from(settings, units))
    count = len(found.poses)
    if count >= _FEW:
        return found, ()
    wider = _wider(found, units, settings, again)
    finds = f'{wider[1]} with still_std_max {wider[0]:.3g}'
    if not count:
        raise _nothing_still(source, found, units, settings, finds if wider[1] else '')
    return found, (f'{counted(count, "pose")} only, {finds}',) if wider[1] >= 2 * count else ()


def _wider(found: Captured, units: Units, settings: Mapping[str, Any],
           again: Callable[[], Recording | Iterable[Recording]]) -> tuple[float, int]:
    """Return a wider limit and the number of poses with it; the narrowest that finds enough."""
    tried = (0.0, 0)
    for factor in _WIDER:
        limit = _two_digits(factor * max(found.threshold, found.quietest))
        if math.isfinite(limit) and tried[1] < _FEW:
            asked = settings_from({**settings, 'still_std_max': limit}, units)
            tried = max(tried, (limit, len(capture(again(), units, asked).poses)),
                        key=lambda each: each[1])
    return tried


def _two_digits(value: float) -> float:
    return float(f'{value:.2g}')


def _nothing_still(source: str, found: Captured, units: Units, settings: Mapping[str, Any],
                   finds: str) -> InputError:
    """Return the error for a recording without a still stretch."""
    window = settings_from(settings, units).still_window
    numbers = (f': in its quietest {window:g} s the standard deviation is {found.quietest:.2g} '
               f'{units.name}, the limit is {found.threshold:.2g}'
               if math.isfinite(found.quietest) else '')
    tried = (f'; {finds} (wide limits make poses inaccurate)' if finds else
             '; a wider limit (still_std_max) finds none either')
    return InputError(f'{source} has no still stretch in {counted(found.recorded, "sample")}'
                      f'{numbers}; expected at least one', 'hold the sensor still in each pose '
                      f'for some seconds{tried}')
