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

"""The simulator: an Imu that turns through poses; see `simulator_node`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from .run import run

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run the simulator until it is told to end; give the exit status."""
    return run('.simulator_node:SimulatorNode', args)


if __name__ == '__main__':
    sys.exit(main())
