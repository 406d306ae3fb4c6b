# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses in a store before a node starts, and messages while its services are called."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from accel_calib.logs import write_table
from accel_calib.units import STANDARD_GRAVITY
from inside import Model, simulate_poses, spread_directions
import numpy as np

_AT_ONCE = 5
"""Number of messages between two looks at the services."""


def start_poses(path: Path, count: int) -> None:
    """Store poses [m/s²], with which a calibrator starts."""
    poses = simulate_poses(Model({}), spread_directions(count), np.random.default_rng(2),
                           noise_g=0.0005)
    path.parent.mkdir(parents=True)
    write_table(path, poses.with_columns(reading=poses.reading * STANDARD_GRAVITY,
                                         std=poses['std'] * STANDARD_GRAVITY))


def send_until(bench: Any, turned: Any, over: Callable[[], Any], seconds: float = 60.0) -> None:
    """Publish readings until a condition holds; they go on where the last call ended."""
    def sent() -> Any:
        for _ in range(_AT_ONCE):
            bench.sent = getattr(bench, 'sent', 0) + 1
            bench.send(bench.imu(turned[bench.sent % len(turned)]))
        bench.came_out.clear()
        return over()

    bench.spin(sent, seconds)
