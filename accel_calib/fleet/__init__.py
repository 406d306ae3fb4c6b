# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrations of many recordings on Dask: rows in a Parquet data set, grouped by sensor.

`inputs` finds the recordings and names their sensors. `task` calibrates one recording on a worker,
and stores the result once. `sensors` compares the calibrations of each sensor over time, and
computes typical values. `overview` has the statistics over the fleet that `page` shows with the
figures of `charts`. `run` submits the tasks.

"""

from .inputs import Input, recordings
from .run import cluster, LIMIT_S, run, Summary
from .task import Options, STATUS, Store

__all__ = ['LIMIT_S', 'STATUS', 'Input', 'Options', 'Store', 'Summary', 'cluster', 'recordings',
           'run']
