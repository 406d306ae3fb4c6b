# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

`session` is the entry point, and `commands` contains what the user can ask for. `sensor` is what
belongs to one sensor: `live_capture` captures its poses, and `guidance` says which pose is next.
`store` manages and locks files. `worker` runs the tasks and defines the events. `stream` describes
the messages, `state` the state. `settings` defines the parameters.

"""

from . import state
from .commands import COMMANDS, Commands
from .sensor import title
from .session import BATCH, Session
from .settings import (
    CalibratorSettings, changed, columns_of, context_topics, default_of, expected, parameter,
    Settings, WEB_PORT)
from .state import Check, checks, figures, Level, Progress, words_of_state, worst
from .store import ros_home
from .worker import (
    Answer, answered, CallSoon, Compute, Event, Files, Log, Mounting, nothing, Result, Severity,
    ShowPoses, Step, Still, Task, Throttle, Worker, WorkerProcess)

__all__ = ['BATCH', 'COMMANDS', 'WEB_PORT', 'Answer', 'CalibratorSettings', 'CallSoon', 'Check',
           'Commands', 'Compute', 'Event', 'Files', 'Level', 'Log', 'Throttle', 'Mounting',
           'Progress', 'Result', 'Session', 'Settings', 'Severity', 'ShowPoses', 'Step', 'Still',
           'Task', 'Worker', 'WorkerProcess', 'answered', 'changed', 'checks', 'columns_of',
           'context_topics', 'default_of', 'expected', 'figures', 'nothing', 'parameter',
           'ros_home', 'state', 'title', 'words_of_state', 'worst']
