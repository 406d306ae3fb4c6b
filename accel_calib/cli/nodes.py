# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib node`` and ``accel-calib simulator``: the ROS nodes, without ros2 run."""

from __future__ import annotations

import argparse
from importlib import import_module

from . import options

_MODULES = {'node': 'calibrator', 'simulator': 'simulator'}
_EXAMPLES = {'node': 'accel-calib node --ros-args -r imu/data_raw:=/imu/raw',
             'simulator': 'accel-calib simulator --ros-args -p poses:=12'}


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLES[made.prog.split()[-1]])
    made.epilog = f'{made.epilog}\n\nall arguments after --ros-args are passed to ROS'
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the node until it is ended."""
    module = import_module(f'accel_calib.ros.{_MODULES[args.command]}')
    status: int = module.main([args.command, *args.for_ros])
    return status
