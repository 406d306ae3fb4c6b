# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reader of logs: text of any dialect, bags, and flight logs of PX4 and ArduPilot.

`open_log` recognises the format, the columns and the units. What it assumed is one line,
`OpenLog.read_as`, and what it left out is in `OpenLog.notes`.

"""

from .incoming import LineReader
from .read import open_log, open_own, OwnTable, read_log, read_recording
from .records import are_samples, Log, LogOptions, OpenLog

__all__ = ['LineReader', 'Log', 'LogOptions', 'OpenLog', 'OwnTable', 'are_samples', 'open_log',
           'open_own', 'read_log', 'read_recording']
