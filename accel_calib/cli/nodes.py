# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
    made.epilog = f'{made.epilog}\n\nall from --ros-args on is passed on to ROS'
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the node until it is told to stop."""
    module = import_module(f'accel_calib.ros.{_MODULES[args.command]}')
    status: int = module.main([args.command, *args.for_ros])
    return status
