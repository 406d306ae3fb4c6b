# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Statistics that several parts of the package use."""

import numpy as np

from .units import Floats

NORMAL_95 = 1.959964
"""Half the width of the interval that holds a normal value in 95 % of all cases [σ]."""

SIGMA_OF_MAD = 1.4826
"""Standard deviation of normal values by their median absolute deviation."""


STATED_NOISE = 0.7
"""Prior probability that the measured noise is the noise of the pose means."""


def rms(values: Floats) -> float:
    """Return the root of the mean square of numbers."""
    return float(np.sqrt(np.mean(values ** 2)))


def rms_of_rows(values: Floats) -> Floats:
    """Return the RMS of (…, n) numbers over the last axis."""
    return np.sqrt(np.mean(values ** 2, axis=-1))


def over_axes(values: Floats) -> Floats:
    """Return the (n,) values of a quantity; of (n, 3) vectors, the RMS over the axes."""
    return rms_of_rows(values) if values.ndim > 1 else values
