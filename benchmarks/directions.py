# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Random directions, for benchmarks that draw poses."""

from accel_calib.geometry import unit
from accel_calib.table import Floats
import numpy as np


def random_directions(count: int, rng: np.random.Generator) -> Floats:
    """Return (count, 3) unit vectors, uniformly distributed over the sphere."""
    return unit(rng.normal(size=(count, 3)))
