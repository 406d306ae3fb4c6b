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
    """Give the (m, ROW) sums over the samples from each start to the next."""
    sums = np.empty((len(starts), ROW))
    if not len(starts):
        return sums
    centred = samples[:, :7] - np.concatenate([[epoch], origin])
    context = samples[:, 7:]
    known = np.isfinite(context)
    sums[:, COUNT] = np.diff(np.append(starts, len(samples)))
    sums[:, TIME:FIRST.stop] = np.add.reduceat(centred, starts, axis=0)
    sums[:, SECOND] = np.add.reduceat(np.square(centred[:, 1:]), starts, axis=0)
    sums[:, CONTEXT_COUNT] = np.add.reduceat(known.astype(float), starts, axis=0)
    sums[:, CONTEXT_SUM] = np.add.reduceat(np.where(known, context, 0.0), starts, axis=0)
    return sums


def smallest_steps(samples: Floats, starts: Indices) -> Floats:
    """Give the (m, 2) smallest steps of reading and rate that are not 0, else infinity."""
    if not len(starts):
        return np.empty((0, 2))
    step = np.full((len(samples), 6), np.inf)
    np.abs(np.diff(samples[:, 1:7], axis=0), out=step[1:])
    step[starts] = np.inf
    step[~(step > 0.0)] = np.inf
    return np.asarray(np.minimum.reduceat(step.reshape(-1, 2, 3).min(axis=2), starts))
