# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From any log to poses: a recording is captured, a pose table is taken as it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from .capture import capture, settings_from
from .errors import InputError
from .logs import LogOptions, open_log, Progress
from .table import Poses
from .text import counted
from .units import Units


@dataclass(frozen=True)
class Intake:
    """
    Poses of a table or captured from a recording, with the unit of their readings.

    `read_as` is how the log was read, in one line, empty if nothing was assumed. `notes` are what
    was left out of the log, and how the poses were captured.

    """

    poses: Poses
    units: Units
    read_as: str = ''
    notes: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """Return `read_as` and the notes, for the terminal and the page."""
        return tuple(filter(None, (self.read_as and f'read as: {self.read_as}', *self.notes)))


def poses_of(path: Path, options: LogOptions = LogOptions(),
             settings: Mapping[str, Any] = {},
             progress: Progress = lambda done, count: None) -> Intake:
    """
    Return the poses of any log; a recording is captured.

    Parameters
    ----------
    path : Path
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
            return Intake(log.poses, log.units, log.read_as, tuple(log.notes))
        found = capture(log.watched(progress), log.units, settings_from(dict(settings), log.units))
        if not len(found.poses):
            raise nothing_still(str(path), found.recorded)
        words = (f'captured {counted(len(found.poses), "pose")} from '
                 f'{counted(found.recorded, "sample")} in {found.seconds:.0f} s')
        return Intake(replace(found.poses, units=log.units.name), log.units, log.read_as,
                      (*log.notes, words))


def nothing_still(source: str, samples: int) -> InputError:
    """Return the error for a recording without a still stretch."""
    return InputError(f'{source} has no still stretch in {counted(samples, "sample")}, expected '
                      'at least one', 'hold the sensor still in each pose for some seconds, or '
                      'set still_std_max and min_dwell')
