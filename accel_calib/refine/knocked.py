# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Disturbed poses in the refinement: a knocked pose looks like anything, so it is found first.

Poses are taken out one after another, each time the one that stands out most from what the others
say; as many are disturbed as make the information criterion fall most, where each costs its
equations and the choice of it among all.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .equations import Equations
from .least_squares import Fitted
from .score import fall

_LARGEST_SHARE = 0.2
_LEVEL = 0.005
"""Probability that a clean set loses a pose."""


@dataclass(frozen=True)
class Knocked:
    """
    Poses that stand out.

    Parameters
    ----------
    poses : (d,) array of int
        Their indices.
    fall : float
        By how much the criterion falls without them.

    """

    poses: NDArray[np.intp]
    fall: float


def knocked(equations: Equations, fitted: Fitted) -> Knocked:
    """Find the poses that stand out from what the others say."""
    dof = equations.count - fitted.onto.shape[1]
    total = len(np.unique(equations.pose))
    out: list[int] = []
    best = Knocked(np.zeros(0, np.intp), 0.0)
    now = fitted
    for _ in range(min(int(_LARGEST_SHARE * total), dof - 4)):
        left = equations.count - now.onto.shape[1]
        worst, size = _furthest(equations, now, left)
        stands_out = size > _critical(left - 1, total)
        out.append(worst)
        rows = np.flatnonzero(equations.pose == worst)
        indicator = np.zeros((len(fitted.residual), len(rows)))
        indicator[rows, np.arange(len(rows))] = 1.0
        now = now.with_columns(indicator)
        # 2 log(total) a pose is for its choice among all.
        falls = fall(fitted.rss - now.rss, fitted.rss, dof, now.onto.shape[1]
                     - fitted.onto.shape[1]) - 2.0 * len(out) * np.log(total)
        if falls > best.fall and stands_out:
            best = Knocked(np.array(sorted(out), np.intp), falls)
    return best


def _critical(dof: int, total: int) -> float:
    """Give Student's t that one of so many clean poses exceeds with probability `_LEVEL`."""
    from scipy.special import stdtrit

    return float(stdtrit(max(dof, 1), 1.0 - _LEVEL / (2.0 * total)))


def _furthest(equations: Equations, fitted: Fitted, dof: int) -> tuple[int, float]:
    """Give the pose that stands out most, and how far, in standard deviations of the others."""
    own = 1.0 - np.sum(fitted.onto ** 2, axis=1)
    squared = np.where(own > 0.02, fitted.residual ** 2 / np.maximum(own, 0.02), 0.0)
    by_pose = np.bincount(equations.pose, squared)
    worst = int(np.argmax(by_pose))
    others = max(fitted.rss - by_pose[worst], 1e-300) / max(dof - 1, 1)
    return worst, float(np.sqrt(by_pose[worst] / others))
