# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""One row of sums for each chunk of samples, and what its columns are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..table import Floats

Indices = NDArray[np.intp]

CONTEXT = ('temperature', 'supply_voltage')
"""Columns of `accel_calib.table.COLUMNS` that are averaged beside reading and rate."""

WIDTH = 7 + len(CONTEXT)
"""Columns of a sample: time, reading, rate (NaN: none), context (NaN: none)."""

CHUNKS_PER_WINDOW = 5

# Columns of a row of sums, over the samples of a chunk.
COUNT = 0
TIME = 1
FIRST = slice(2, 8)
SECOND = slice(8, 14)
CONTEXT_COUNT = slice(14, 16)
CONTEXT_SUM = slice(16, 18)
ROW = 18


def sums_of(samples: Floats, starts: Indices, epoch: float, origin: Floats) -> Floats:
    """
    Give the (ROW, m) sums over the samples from each start to the next.

    Parameters
    ----------
    samples : (k, n) array
        Time and reading (k = 4), and rate (7), and context (WIDTH).
    starts : (m,) array of int
        First samples of the chunks.
    epoch, origin : float, (6,) array
        What time, and reading and rate, are relative to.

    """
    sums = np.full((ROW, len(starts)), np.nan)
    sums[CONTEXT_COUNT] = sums[CONTEXT_SUM] = 0.0
    if not len(starts):
        return sums
    sums[COUNT] = np.diff(starts, append=samples.shape[1])
    sums[TIME] = np.add.reduceat(samples[0] - epoch, starts)
    values = min(len(samples), 7) - 1
    centred = samples[1:1 + values] - origin[:values, np.newaxis]
    sums[FIRST.start:FIRST.start + values] = np.add.reduceat(centred, starts, axis=1)
    np.multiply(centred, centred, out=centred)
    sums[SECOND.start:SECOND.start + values] = np.add.reduceat(centred, starts, axis=1)
    if len(samples) == WIDTH:
        known = np.isfinite(samples[7:])
        sums[CONTEXT_COUNT] = np.add.reduceat(known.astype(float), starts, axis=1)
        sums[CONTEXT_SUM] = np.add.reduceat(np.where(known, samples[7:], 0.0), starts, axis=1)
    return sums


def smallest_steps(values: Floats, starts: Indices, least: float) -> Floats:
    """
    Give the (m,) smallest steps within chunks that are not 0, where they are below `least`.

    Infinity elsewhere: only a new smallest one matters, and it shows at a glance.

    """
    step = np.abs(values[:, 1:] - values[:, :-1])
    if np.count_nonzero(step < least) == np.count_nonzero(step == 0.0):
        return np.full(len(starts), np.inf)
    step[~(step > 0.0)] = np.inf
    lowest = np.full(values.shape[1], np.inf)
    lowest[1:] = step.min(axis=0)
    lowest[starts] = np.inf
    found = np.minimum.reduceat(lowest, starts)
    return np.asarray(np.where(found < least, found, np.inf))
