# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator without ROS: samples and commands in, answers and events out.

`session` is the way in. `live_capture` and `pose_book` capture poses, `active_calibration` holds
the calibration in use, `store` and `sensor_files` are about files, `work` computes, in the process
of `worker_process`; `statistics` and `health` describe the state; `settings` and `parameters` are
the parameters.

"""

from .events import Event, Job, Log, ShowPoses, Still
from .health import Finding, findings, Health, Level, worst
from .session import Session
from .settings import CalibratorSettings

__all__ = ['CalibratorSettings', 'Event', 'Finding', 'Health', 'Job', 'Level', 'Log', 'Session',
           'ShowPoses', 'Still', 'findings', 'worst']
