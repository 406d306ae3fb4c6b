# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The executable ``calibrator``; see `calibrator_node`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from .run import run

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run the calibrator until it is ended; return the exit status."""
    return run('.calibrator_node:CalibratorNode', args)


if __name__ == '__main__':
    sys.exit(main())
