# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations of many recordings on Dask: rows in a Parquet data set, grouped by sensor.

`inputs` finds the recordings, and `identity` names their sensors. `task` calibrates one recording
on a worker. `store` writes the results, so that each is there once. `sensors` compares the
calibrations of each sensor over time. `run` submits the tasks.

"""

from .inputs import Input, recordings
from .run import cluster, run, Summary
from .store import Store
from .task import Options, STATUS

__all__ = ['STATUS', 'Input', 'Options', 'Store', 'Summary', 'cluster', 'recordings', 'run']
