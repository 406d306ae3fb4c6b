# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

`session` is the entry point, and `commands` contains what the user can ask for. `sensor` is what
belongs to one sensor: `live_capture` captures its poses, and `guidance` says which pose is next.
`store` manages files, and `sensor_files` locks them. `work` contains the computations, and
`worker` runs the tasks. `stream` describes the messages, `state` and `health` the state, `reports`
has log lines. `settings` defines the parameters.

"""

from . import state
from .events import Event, Log, LogFilter, Mounting, ShowPoses, Still
from .guidance import Progress
from .health import Check, checks, Health, Level, worst
from .session import BATCH, Session
from .settings import CalibratorSettings, WEB_PORT
from .worker import Compute, Files, Step, Task

__all__ = ['BATCH', 'WEB_PORT', 'CalibratorSettings', 'Check', 'Compute', 'Event', 'Files',
           'Health', 'Level', 'Log', 'LogFilter', 'Mounting', 'Progress', 'Session', 'ShowPoses',
           'Step', 'Still', 'Task', 'checks', 'state', 'worst']
