# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

`session` is the entry point, and `commands` contains what the user can ask for. `live_capture`
captures poses, `guidance` says which pose is next, and `active_calibration` contains the
calibration in use. `store` manages files, and `sensor_files` locks them. `work` contains the
computations, which run in `worker_process`. `stream_statistics` and `health` describe the stream
and the state. `settings` defines the parameters.

"""

from . import state
from .guidance import Progress
from .health import Finding, findings, Health, Level, worst
from .session import BATCH, Session
from .settings import CalibratorSettings, WEB_PORT
from .work import (
    Compute,
    Event,
    Files,
    Log,
    LogFilter,
    Mounting,
    ShowPoses,
    Step,
    Still,
    Task,
)

__all__ = ['BATCH', 'WEB_PORT', 'CalibratorSettings', 'Compute', 'Event', 'Files', 'Finding',
           'Health', 'Level', 'Log', 'LogFilter', 'Mounting', 'Progress', 'Session', 'ShowPoses',
           'Step', 'Still', 'Task', 'findings', 'state', 'worst']
