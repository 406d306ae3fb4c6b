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

"""Sliding windows over rows of sums: their means, variances and slopes, and the least variance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from .noise import Trend, trend
from .sums import CHUNKS_PER_WINDOW, COUNT, FIRST, SECOND
from ..table import Floats

RELATIVE = 1e-6
"""Standard deviation over the size of a reading that is granted to data without noise."""

STD_FLOOR_G = 3.3e-4
"""Noise that is granted to any sensor [g]: smaller shaking does no harm."""


def rolling(values: Floats, length: int, last: int) -> Floats:
    """Give the last windows of this length over rows: (last, columns, length)."""
    if last == 1:
        return values[len(values) - length:].T[np.newaxis]
    return sliding_window_view(values[len(values) - last - length + 1:], length, axis=0)


def windows(rows: Floats, origin: Floats) -> tuple[Floats, Floats]:
    """Give mean and variance of the windows."""
    sums = sliding_window_view(rows[:, :SECOND.stop], CHUNKS_PER_WINDOW, axis=0).sum(axis=-1)
    count = sums[:, COUNT, np.newaxis]
    mean = sums[:, FIRST] / count
    level = np.maximum(sums[:, SECOND] - sums[:, FIRST] * mean, 0.0) / (count - 1.0)
    return mean + origin, level


class Stretch(NamedTuple):
    """
    What was over the last chunks before each.

    Parameters
    ----------
    trend : Trend
        Slopes of reading and rate, (m, 2, 3).
    variance : (m, 6) array
        Mean of the windows' variances.
    highest : (m, 6) array
        Highest of them.
    samples : (m,) array
        Samples.

    """

    trend: Trend
    variance: Floats
    highest: Floats
    samples: Floats


def stretch(rows: Floats, level: Floats, length: int, size: int, spacing: float) -> Stretch:
    """Give what was over so many chunks, for the last rows."""
    inside = rolling(level, length - CHUNKS_PER_WINDOW + 1, size)
    variance = inside.mean(axis=-1)
    count = rolling(rows[:, COUNT, np.newaxis], length, size).sum(axis=-1)
    means = rolling(rows[:, FIRST] / rows[:, COUNT, np.newaxis], length, size)
    white = variance * length / count
    found = trend(means.reshape(size, 2, 3, length), spacing, white.reshape(size, 2, 3))
    return Stretch(found, variance, inside.max(axis=-1), count[:, 0])


def at_least(floor: Floats, step: Floats, mean: Floats) -> Floats:
    """Give (..., 6) variances, not less than the resolution and the size of the mean allow."""
    known = np.where(np.isfinite(step), step, 0.0)
    resolution = np.repeat(0.25 * known**2, 3, axis=-1)
    return np.asarray(np.fmax(np.fmax(floor, resolution), _tiny(mean)))


def _tiny(mean: Floats) -> Floats:
    size = np.sqrt(np.sum(mean.reshape((*mean.shape[:-1], 2, 3))**2, axis=-1))
    return np.repeat((RELATIVE * size)**2, 3, axis=-1)


def clipped(average: Floats, step: Floats, mean: Floats) -> NDArray[np.bool_]:
    """Tell which axes are constant while another varies by more than rounding: no noise."""
    least = at_least(np.zeros(6), step, mean)[:, :3]
    constant = average[:, :3] <= _tiny(mean)[:, :3]
    varies = np.any(average[:, :3] > 2.0 * least, axis=1)
    rates = np.zeros_like(constant)
    return np.hstack([constant & varies[:, np.newaxis], rates])


def granted(noise: Floats, scale: Floats) -> Floats:
    """Give (..., 6) variances, those of the reading not less than is granted to any sensor."""
    reading = np.fmax(noise[..., :3], (STD_FLOOR_G * scale[..., np.newaxis])**2)
    return np.concatenate([reading, noise[..., 3:]], axis=-1)


def rounding(step: float, floor: Floats, mean: Floats, std: Floats) -> tuple[Floats, Floats]:
    """Give what steps of the reading do to samples and to their mean; see `Rule.rounding`."""
    step = step if np.isfinite(step) else 0.0
    tiny = RELATIVE * float(np.linalg.norm(mean))
    square = step**2 / 12.0
    own = np.minimum(np.sqrt(floor[:3]), std)
    left = square * np.exp(-np.square(2.0 * np.pi * own / max(step, tiny)))
    return np.full(3, max(np.sqrt(square), tiny)), np.maximum(left, 1e-2 * tiny**2)
