# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a session reports: log lines, what to publish, and tasks to run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Literal

from .worker import Task
from ..calibrate import NextPose
from ..table import Floats

Severity = Literal['info', 'warning', 'error']


@dataclass(frozen=True)
class Log:
    """A log line; lines of one kind, if it has one, are logged at most once in `once_in` [s]."""

    severity: Severity
    words: str
    kind: str = ''
    once_in: float = 0.0


@dataclass(frozen=True)
class Still:
    """A change of whether the sensor is still."""

    still: bool


@dataclass(frozen=True)
class ShowPoses:
    """The poses to draw: (n, 3) directions of up in the sensor frame, and the next pose."""

    up: Floats
    asked: NextPose
    frame_id: str


@dataclass(frozen=True)
class Mounting:
    """The mounting in use: ΔR, (3, 3), and the frame of the sensor."""

    rotation: Floats
    frame_id: str


class LogFilter:
    """
    Decide which lines are logged: not empty, and none of the same kind within `once_in`.

    Parameters
    ----------
    clock : callable
        Steady clock [s].

    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._last: dict[str, float] = {}

    def passes(self, line: Log) -> bool:
        """Return whether to log a line, and note it."""
        if not line.kind:
            return bool(line.words)
        now = self._clock()
        if now - self._last.get(line.kind, -line.once_in) < line.once_in:
            return False
        self._last[line.kind] = now
        return True


Event = Log | Mounting | Still | ShowPoses | Task
