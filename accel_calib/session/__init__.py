# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

`session` is the entry point, and `state` what all other modules read. `commands` contains what the
user can ask for, and `use` their computations and what follows when the calibration or the poses
change. `poses` captures poses and chooses the next one. `stream` describes the messages.
`conditions` is what is the case, the next step, and how topics and pages show them. `store`
manages and locks files. `worker` runs the tasks and defines the events. `settings` defines the
parameters. Imports point one way.

"""

from .commands import BUTTONS, COMMANDS, enable, run
from .conditions import (
    APART, Check, conditions, diagnostics, figures, next_step, Progress, progress, words_of_state)
from .session import BATCH, Session
from .settings import (
    CalibratorSettings, changed, columns_of, expected, parameter, Settings, WEB_PORT)
from .state import Surroundings, title
from .store import ros_home
from .stream import Around
from .worker import (
    Answer, answered, CallSoon, Compute, Event, Files, Log, Mounting, nothing, Result, Severity,
    ShowPoses, Step, Still, Task, Throttle, Worker, WorkerProcess)
