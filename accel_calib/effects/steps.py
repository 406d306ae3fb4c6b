# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A temperature that is recorded in steps: its values between them, by those before and after.

A thermometer of step q states a temperature that is wrong by up to q / 2. In a slow change these
errors are not random: what is computed from time fits better than the true cause. The values at
the poses are therefore estimated. The temperature is a process whose second derivative is white
noise, recorded with errors of the variance q² / 12. Its posterior mean is a cubic smoothing spline
(Wahba 1978). With Q the second divided differences, and τ² R the covariance of the process in
them (Green and Silverman 1994, equations 2.1 and 2.2), the mean for the readings y is

    y - q² / 12 Q C⁻¹ Qᵀ y        C = q² / 12 QᵀQ + τ² R

τ is that with the largest restricted likelihood. A temperature that jumps from pose to pose thus
remains as it is. The step is measured: readings that occur more than once are multiples of it.

"""

import numpy as np
import scipy

from ..table import Floats

_LEAST = 5
"""Smallest number of moments at which a temperature is estimated."""

_LEAST_LEVELS = 4
"""Smallest number of levels that occur more than once, by which steps are known."""

_COARSEST = 0.51
"""Largest step of a thermometer [°C]: larger ones may be exact temperatures that were set."""

_REPEATED = 0.5
"""Smallest part of readings in steps that occur more than once."""

_ON_STEP = 0.02
"""Largest distance of a reading from a multiple of the step, in steps."""

_CHANGES = 10.0 ** np.arange(-10.0, 9.0, 0.5)
"""Variances τ² that are tried, for a median interval and relative to that of the step."""


def between_steps(time: Floats, temperature: Floats) -> Floats:
    """Return (n,) temperatures [°C], estimated within half a step if they are in steps."""
    known = np.isfinite(time) & np.isfinite(temperature)
    values, estimated = temperature[known], temperature.copy()
    different, count = np.unique(values, return_counts=True)
    repeated = different[count > 1]
    if len(repeated) < _LEAST_LEVELS or np.sum(count[count > 1]) < _REPEATED * len(values):
        return temperature
    step = float(np.min(np.diff(repeated)))
    steps = (repeated - repeated[0]) / step
    if step > _COARSEST or np.max(np.abs(steps - np.round(steps))) > _ON_STEP:
        return temperature
    estimated[known] = _estimated(time[known], values, step)
    return estimated


def _estimated(time: Floats, values: Floats, step: float) -> Floats:
    """Return (n,) temperatures, estimated from those with a step."""
    moments, place, count = np.unique(time, return_inverse=True, return_counts=True)
    if len(moments) < _LEAST:
        return values
    mean, best = np.bincount(place, values) / count, (-np.inf, values)
    apart = np.diff(moments) / np.median(np.diff(moments))
    size, variance = len(apart) - 1, step ** 2 / 12.0 / count
    first, last = 1.0 / apart[:-1], 1.0 / apart[1:]
    middle = -first - last
    of_error, of_process = np.zeros((2, 3, size))  # diagonals of the lower triangle
    of_error[0] = first ** 2 * variance[:-2] + middle ** 2 * variance[1:-1] + (
        last ** 2 * variance[2:])
    of_error[1, :-1] = (middle[:-1] * first[1:] * variance[1:-2]
                        + last[:-1] * middle[1:] * variance[2:-1])
    of_error[2, :-2] = last[:-2] * first[2:] * variance[2:-2]
    of_process[0], of_process[1, :-1] = (apart[:-1] + apart[1:]) / 3.0, apart[1:-1] / 6.0
    across = first * mean[:-2] + middle * mean[1:-1] + last * mean[2:]
    for change in _CHANGES * step ** 2 / 12.0:
        root = scipy.linalg.cholesky_banded(of_error + change * of_process, lower=True)
        solved = scipy.linalg.cho_solve_banded((root, True), across)
        likelihood = -float(np.sum(np.log(root[0])) + across @ solved / 2.0)
        if likelihood > best[0]:
            moved = np.zeros(size + 2)
            for row, part in enumerate((first, middle, last)):
                moved[row:size + row] += part * solved
            best = likelihood, mean - variance * moved
    return np.clip(best[1][place], values - step / 2.0, values + step / 2.0)
