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
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from . import options


def add_to(commands: Any) -> None:
    """Add both commands."""
    for name, module, summary, example in (
            ('node', 'calibrator', 'run the calibrator node',
             'accel-calib node --ros-args -r imu/data_raw:=/imu/raw'),
            ('simulator', 'simulator', 'run the simulated Imu node',
             'accel-calib simulator --ros-args -p poses:=12')):
        made = options.command(commands, name, summary, example)
        made.epilog = f'{made.epilog}\n\nall from --ros-args on is passed on to ROS'
        made.set_defaults(run=run, module=module)


def split(arguments: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Part the arguments of this program from those of ROS, which argparse would not let by."""
    at = list(arguments).index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return arguments[:at], arguments[at:]


def run(args: argparse.Namespace) -> int:
    """Run the node until it is told to stop."""
    module = import_module(f'accel_calib.ros.{args.module}')
    status: int = module.main([args.command, *args.for_ros])
    return status
