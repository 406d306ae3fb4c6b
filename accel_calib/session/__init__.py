# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: it takes samples and commands, and returns answers and events.

`session` is the entry point. `live_capture` captures poses, and `active_calibration` contains the
calibration in use. `store` manages files. `work` contains the computations, which run in
`worker_process`. `health` describes the state. `settings` defines the parameters.

"""

from .events import Event, Job, Log, ShowPoses, Still
from .health import Finding, findings, Health, worst
from .session import Session
from .settings import CalibratorSettings

__all__ = ['CalibratorSettings', 'Event', 'Finding', 'Health', 'Job', 'Log', 'Session',
           'ShowPoses', 'Still', 'findings', 'worst']
