# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The executable ``simulator``; see `simulator_node`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from .run import run

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run the simulator until it is ended; return the exit status."""
    return run('.simulator_node:SimulatorNode', args)


if __name__ == '__main__':
    sys.exit(main())
