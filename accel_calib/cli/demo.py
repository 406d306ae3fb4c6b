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

"""``accel-calib demo``: the main job without hardware."""

from __future__ import annotations

import argparse
from typing import Any

from . import options

_SUMMARY = 'the main job without hardware: simulated Imu, calibrator node, before and after'
_EXAMPLE = 'accel-calib demo'


def add_to(commands: Any) -> None:
    """Add the command."""
    made = options.command(commands, 'demo', _SUMMARY, _EXAMPLE)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run simulator and calibrator in processes of their own and show what comes of it."""
    from ..ros.demo import main

    return main(args)
