# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrations of a sensor whose values can be compared.

A calibration is compared as if its effects were known to be right. A search in few poses sometimes
names another effect than in the other recordings, and offset and gain then differ by much more
than their uncertainty. Only calibrations with the same effects are therefore compared, those with
the most frequent effects of the sensor.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from .store import Row
from ..effects import LADDER


def alike(rows: Iterable[Row]) -> list[Row]:
    """
    Return the rows of a sensor whose values can be compared.

    Left out are recordings without a calibration, those whose poses do not determine offset, gain
    and cross-axis gain, and those without the most frequent effects. Models 4, 7 and 10 are alike,
    because `accel_calib.compare` compares them with the uncertainty of the largest one.

    Parameters
    ----------
    rows : iterable of dict
        Rows with ``calibration``, ``determined`` and ``effects``.

    Returns
    -------
    list of dict
        The rows that are left, in the same order.

    """
    good = [row for row in rows if row['calibration'] and row['determined']]
    most = next((kind for kind, _ in Counter(map(_kind, good)).most_common(1)), None)
    return [row for row in good if _kind(row) == most]


def _kind(row: Row) -> frozenset[str]:
    """Return the effects of a calibration; none if it has only those of models 4, 7 and 10."""
    effects = frozenset(row['effects'])
    return effects if effects - {*LADDER} else frozenset()
