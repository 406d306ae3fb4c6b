# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One thread for each matrix operation of commands and nodes.

Arrays here are small, and threads that share one wait for each other in busy loops. Beside two
other processes on two processors, a refinement with the OpenBLAS of numpy 1.26 took 10 times as
long with two threads as with one.

"""

import os

ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
"""Environment variables that libraries for matrices read when numpy is imported."""


def use_one_thread() -> None:
    """Set the variables that are not set yet. Call it before numpy is imported."""
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)
