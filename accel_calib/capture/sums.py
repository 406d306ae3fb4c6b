# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Sums over the samples of chunks, one record per chunk. Records of several chunks add up."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..table import Floats

Indices = NDArray[np.intp]

Records = NDArray[Any]
"""One-dimensional structured array."""

CONTEXT = ('temperature', 'supply_voltage')
"""Columns of `accel_calib.table.COLUMNS` that are averaged together with reading and rate."""

WIDTH = 7 + len(CONTEXT)
"""Numbers of a sample: time, reading, rate (NaN: none), context (NaN: none)."""

CHUNKS_PER_WINDOW = 5

SUMS = np.dtype([
    ('count', float),             # samples
    ('time', float),              # of the stamps, relative to the epoch [s]
    ('first', float, 6),          # of reading and rate, relative to the origin
    ('second', float, 6),         # of their squares
    ('context_count', float, 2),  # samples that have the context
    ('context_sum', float, 2)])


def blank(kind: np.dtype[Any], count: int) -> Records:
    """Return records with all numbers NaN."""
    return np.full(count * (kind.itemsize // 8), np.nan).view(kind)


def chained(*parts: Records) -> Records:
    """Concatenate records; `numpy.concatenate` alone would copy them field by field."""
    filled = [part for part in parts if len(part)] or list(parts[:1])
    if len(filled) == 1:
        return filled[0]
    kind = filled[0].dtype
    return np.concatenate([part.view(f'V{kind.itemsize}') for part in filled]).view(kind)


def summed(records: Records, size: int) -> Records:
    """Return the sums over groups of `size` consecutive records of floats."""
    numbers = np.ascontiguousarray(records).view(float).reshape(-1, size,
                                                                records.dtype.itemsize // 8)
    return numbers.sum(axis=1).view(records.dtype)[:, 0]


def sums_of(samples: Floats, starts: Indices, epoch: float, origin: Floats) -> Records:
    """
    Return the sums over the samples from each start to the next.

    Parameters
    ----------
    samples : (k, n) array
        Time and reading (k = 4), with rate (7), with context (WIDTH).
    starts : (m,) array of int
        Index of the first sample of each chunk.
    epoch, origin : float, (6,) array
        Subtracted from time, and from reading and rate.

    Returns
    -------
    (m,) array of SUMS
        The sums; those of a missing rate are NaN.

    """
    sums = blank(SUMS, len(starts))
    sums['context_count'] = sums['context_sum'] = 0.0
    if not len(starts):
        return sums
    sums['count'] = np.diff(starts, append=samples.shape[1])
    sums['time'] = np.add.reduceat(samples[0] - epoch, starts)
    values = min(len(samples), 7) - 1
    centred = samples[1:1 + values] - origin[:values, np.newaxis]
    sums['first'][:, :values] = np.add.reduceat(centred, starts, axis=1).T
    np.multiply(centred, centred, out=centred)
    sums['second'][:, :values] = np.add.reduceat(centred, starts, axis=1).T
    if len(samples) == WIDTH:
        known = np.isfinite(samples[7:])
        sums['context_count'] = np.add.reduceat(known.astype(float), starts, axis=1).T
        sums['context_sum'] = np.add.reduceat(np.where(known, samples[7:], 0.0), starts, axis=1).T
    return sums


def smallest_steps(values: Floats, starts: Indices, least: float) -> Floats:
    """
    Return the (m,) smallest nonzero steps within chunks, infinite unless they are below `least`.

    Only a new smallest step is of interest.

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
