# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
Calibrations of many recordings on Dask: rows in a Parquet data set, grouped by sensor.

`recording` finds the recordings, names their sensors, and makes the row of one. `sensors` stores
each row once, and compares the calibrations of each sensor over time. `overview` has the
statistics, the typical values and the page of the fleet. `run` submits the tasks.

"""

from .overview import changes_of
from .recording import Input, Options, recordings
from .run import cluster, LIMIT_S, run, STATUS, Summary
from .sensors import Store
