# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The executable ``calibrator_lifecycle``: the calibrator as a managed node.

==============  ==========================================================================
transition      effect
==============  ==========================================================================
``configure``   reads the parameters and loads the calibration; poses can be captured
``activate``    publishes corrected messages
``deactivate``  stops publishing them
``cleanup``     closes the files
==============  ==========================================================================

The work is done by `calibrator_node.Calibrator`, as in the plain node.

"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from .run import run

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(args: Sequence[str] | None = None) -> int:
    """Run the managed calibrator until it is ended; return the exit status."""
    return run('.managed_node:ManagedCalibrator', args)


if __name__ == '__main__':
    sys.exit(main())
