# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How many cases of a long series run: a sample in ``make test``, all in ``make faults``.

``ACCEL_CALIB_TRIALS`` is a factor on the number of random trials. It is 1 in ``make test``; lists
of cases run whole from 2 on.

"""

from collections.abc import Iterable
import os
from typing import TypeVar

import numpy as np

FACTOR = int(os.environ.get('ACCEL_CALIB_TRIALS', '1'))
T = TypeVar('T')


def sample(cases: Iterable[T], few: int, seed: int = 1) -> list[T]:
    """
    Return some cases of a series.

    Parameters
    ----------
    cases : iterable
        The whole series.
    few : int
        Number of cases if `FACTOR` is 1; otherwise all are returned.
    seed : int
        Seed of the choice.

    Returns
    -------
    list
        The cases, in their order.

    """
    series = list(cases)
    if FACTOR > 1 or few >= len(series):
        return series
    chosen = np.random.default_rng(seed).choice(len(series), few, replace=False)
    return [series[k] for k in sorted(chosen.tolist())]
