# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Reader of logs: text of any dialect, bags, flight logs of PX4 and ArduPilot, and DataFrames.

`open_log` recognises the format, the columns and the units. What it assumed is one line,
`OpenLog.read_as`, and what it left out is in `OpenLog.notes`. `child` reads binary files in a
process with limits. `bag` defines the places of the fields in serialized messages.

"""

from .autopilot import ARDUPILOT_REFERENCE, ByAxis, DEGREE, PER_MILLION
from .bag import (
    ACCELERATION, ACCELERATION_COVARIANCE, ANGULAR_VELOCITY, ANGULAR_VELOCITY_COVARIANCE,
    IMU_DOUBLES, imus_of, joined, Layout, layout_of, layout_with, LITTLE_ENDIAN, NAME_AT, NINE,
    NO_QUANTITIES, open_bag, ORIENTATION, ORIENTATION_COVARIANCE, STAMP, STAMP_AT, THREE)
from .bag_samples import field_of, messages_of, named_topics, topic_and_field
from .child import parts_of
from .columns import LogOptions
from .containers import Frame, Piped
from .formats import (
    BAG, FORMATS, is_bag, open_log, OpenLog, Progress, read_poses, read_recording, SUFFIXES)
from .names import NAMES
from .port import is_port, open_port
from .quantities import are_samples
from .text import LineReader, write_blocks, write_table
