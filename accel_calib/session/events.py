# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The events that a session reports to the node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any, Literal

from ..calibrate import NextPose
from ..table import Floats

Compute = Callable[..., Any]
"""Function and its arguments -> result, as in `worker_process.WorkerProcess.call`."""

Severity = Literal['info', 'warning', 'error']


@dataclass(frozen=True)
class Job:
    """
    Long work that must not delay the stream.

    Parameters
    ----------
    run : callable
        Function of a `Compute`. It does not use the session, and can raise AccelCalibError or
        OSError.
    finish : callable
        Function of the result of `run`, called in the thread of the session. It returns an answer,
        or the job that continues, and can raise AccelCalibError. An empty answer is not logged.
    computes : bool
        Whether `run` computes and uses no files. Commands and other jobs run at the same time.
        Only such a job calls its `Compute`.

    """

    run: Callable[[Compute], Any]
    finish: Callable[[Any], str | Job]
    computes: bool = False


@dataclass(frozen=True)
class Log:
    """A log line; if `once_in` is not 0, it is logged at most once in this time [s]."""

    severity: Severity
    words: str
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
    Decide which lines are logged: not empty, and not again within their `once_in`.

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
        if not line.once_in:
            return bool(line.words)
        kind, now = line.words[:20], self._clock()
        if now - self._last.get(kind, -line.once_in) < line.once_in:
            return False
        self._last[kind] = now
        return True


Event = Log | Mounting | Still | ShowPoses | Job
