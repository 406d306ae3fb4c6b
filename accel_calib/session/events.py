# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a session tells the node."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from ..calibrate import NextPose
from ..table import Floats

Compute = Callable[..., Any]
"""Function and its arguments -> its result, as `worker_process.WorkerProcess.call`."""

Severity = Literal['info', 'warning', 'error']


@dataclass(frozen=True)
class Job:
    """
    Work beside the stream.

    Parameters
    ----------
    run : callable
        Takes `Compute`; uses nothing of the session, and may raise AccelCalibError or OSError.
    finish : callable
        Takes the result of `run`, in the thread of the session, and returns an answer; it may
        raise AccelCalibError. An empty answer is not logged.

    """

    run: Callable[[Compute], Any]
    finish: Callable[[Any], str]


@dataclass(frozen=True)
class Log:
    """A line for the log; if `once_in` is not 0, at most once in this time [s]."""

    severity: Severity
    words: str
    once_in: float = 0.0


@dataclass(frozen=True)
class Still:
    """Whether the sensor is still, from now on."""

    still: bool


@dataclass(frozen=True)
class ShowPoses:
    """The poses to draw: (n, 3) directions of up in the frame of the sensor, and the next one."""

    up: Floats
    asked: NextPose
    frame_id: str


Event = Log | Still | ShowPoses | Job
