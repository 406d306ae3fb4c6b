# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A sample of a long pose table, which bounds the time and the memory of a refinement.

Nobody turns a sensor to thousands of poses by hand: long tables come from machines, or are samples
in place of poses. With `MOST` equations a refinement takes 10 s and 300 MB as a rule, and about a
minute and 900 MB in the worst case: all context, and noise that no effect explains. A pose has one
equation, or three if its orientation is known or shared.

The sample takes one pose out of each part of the table. The place in the part changes by the
golden ratio, so that a table that repeats the same turns gives all of them.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..table import Poses

MOST = 6000
"""Largest number of equations that a refinement uses."""

_VECTORS = 3
"""Number of equations of a pose of known or shared orientation."""

_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def sampled(poses: Poses) -> Poses:
    """
    Return the poses for `MOST` equations, and as many of those of a stored calibration.

    Poses that share their orientation stay together, unless too many do.

    """
    most = MOST // (_VECTORS if {'reference', 'orientation'} & set(poses.columns) else 1)
    if len(poses) <= most:
        return poses
    new = poses['new'] > 0.0 if 'new' in poses else np.ones(len(poses), bool)
    parts = [part[_kept(poses.take(part), most)]
             for part in (np.flatnonzero(new), np.flatnonzero(~new)) if len(part)]
    return poses.take(np.sort(np.concatenate(parts)))


def sample_words(used: int, total: int) -> str:
    """Return a warning about a sample."""
    return (f'the refinement uses {used} of {total} poses, spread evenly over the table, to bound '
            'its time and memory; it does not look for disturbed poses among the others; choose '
            'rows to use others')


def _kept(poses: Poses, most: int) -> NDArray[np.intp]:
    """Return the indices of the sample."""
    count = len(poses)
    if 'orientation' in poses and count > most:
        group = np.unique(poses['orientation'], return_inverse=True)[1]
        groups = int(group.max()) + 1
        kept = np.flatnonzero(np.isin(group, _spread(groups, max(most * groups // count, 1))))
        if most // 2 <= len(kept) <= 2 * most:
            return kept
    return _spread(count, most)


def _spread(count: int, wanted: int) -> NDArray[np.intp]:
    """Return at most `wanted` different indices, one out of each part of the range."""
    if count <= wanted:
        return np.arange(count)
    part = np.arange(wanted)
    return np.unique(((part + part * _GOLDEN % 1.0) * (count / wanted)).astype(np.intp))
