# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Rules for still: ours, and two simple ones to compare with.

Each takes a case and gives the stretches that it calls a pose, as first and last stamp, mean and
standard deviation of the mean.

The others are told what ours has to find out: that the sensor rests in the first two seconds.
**variance**: standard deviation over a sliding second, by axis, below three times that of the
first two seconds, or 0.33 mg (imu_tk, and others, use a multiple of the variance in a first
rest). **gyro**: mean rate over half a second within 0.5 °/s of that of the first two. A pose is a
stretch of a second or more; both take the samples for independent.

"""

from __future__ import annotations

from typing import NamedTuple

from accel_calib.capture import CaptureSettings, StillDetector
from accel_calib.table import Floats
from accel_calib.units import units_of
import numpy as np
from stillness_case import Case

_FIRST = 2.0        # [s] that are known to be a rest
_MIN_DWELL = 1.0    # [s]
_TIMES = 3.0
_LEAST = 3.3e-4     # [g]
_TURNING = np.radians(0.5)


class Pose(NamedTuple):
    """A stretch called still: first and last stamp [s], mean and noise of the mean [g]."""

    start: float
    end: float
    mean: Floats
    noise: Floats


def ours(case: Case, gyro: bool) -> list[Pose]:
    """Give what the stillness detector finds."""
    rate = case.rate if gyro else np.full_like(case.rate, np.nan)
    samples = np.column_stack([case.time, case.reading, rate, np.full((len(rate), 2), np.nan)])
    detector = StillDetector(CaptureSettings(), units_of(case.units))
    detector.push_block(samples)
    detector.close()
    return [Pose(each.start, each.end, each.mean, each.std / np.sqrt(each.count))
            for each in detector.dwells()]


def variance(case: Case) -> list[Pose]:
    """Give what a fixed threshold of the variance finds."""
    width = round(case.sensor.rate)
    first = case.reading[:round(_FIRST * case.sensor.rate)].std(axis=0)
    mean = _sliding(case.reading, width)
    spread = np.sqrt(np.maximum(_sliding(np.square(case.reading), width) - mean**2, 0.0))
    least = _LEAST if case.units == 'g' else 0.0
    return _poses(case, np.all(spread < np.maximum(_TIMES * first, least), axis=1))


def gyro(case: Case) -> list[Pose]:
    """Give what a threshold of the mean rate finds."""
    bias = case.rate[:round(_FIRST * case.sensor.rate)].mean(axis=0)
    mean = _sliding(case.rate - bias, round(0.5 * case.sensor.rate))
    return _poses(case, np.linalg.norm(mean, axis=1) < _TURNING)


def _sliding(values: Floats, width: int) -> Floats:
    """Give means over windows centred on each sample, shorter at the ends."""
    sums = np.vstack([np.zeros(values.shape[1]), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low = np.maximum(index - width // 2, 0)
    high = np.minimum(index + (width + 1) // 2, len(values))
    return np.asarray((sums[high] - sums[low]) / (high - low)[:, np.newaxis])


def _poses(case: Case, still: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[Pose]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    found = []
    for start, stop in edges.reshape(-1, 2):
        part = case.reading[start:stop]
        if len(part) >= _MIN_DWELL * case.sensor.rate:
            found.append(Pose(float(case.time[start]), float(case.time[stop - 1]),
                              part.mean(axis=0), part.std(axis=0, ddof=1) / np.sqrt(len(part))))
    return found
