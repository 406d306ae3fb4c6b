# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How good a candidate is, and whether it is good enough.

Candidates are ranked by the Bayesian information criterion with the scale of the noise free
(Schwarz 1978): it falls by

    N log(RSS / (RSS - gain)) - q log N - 2 log(shapes tried)

when q parameters explain `gain` of the residual sum of squares. A name is admitted by an F test,
its probability multiplied by the number of candidates and of shapes tried, and only if the poses
left out agree. The scale is free because poses repeat worse than their samples say; measured noise
is for saying that a gap remains.

"""

from __future__ import annotations

import numpy as np

from .candidates import Candidate
from .least_squares import Fitted
from ..table import Floats

LEVEL = 0.005
"""Probability, over all candidates, of a name where nothing is hidden."""


def fall(gain: float, rss: float, count: int, parameters: float, tried: float = 1.0) -> float:
    """Give by how much the criterion falls, from the gain of a candidate; more is better."""
    left = max(rss - gain, 1e-12 * rss, 1e-300)
    return float(count * np.log(max(rss, 1e-300) / left) - parameters * np.log(count)
                 - 2.0 * np.log(tried))


def gain_of(columns: Floats, fitted: Fitted) -> float:
    """Give how much of the residual sum of squares orthonormal columns explain."""
    return float(np.sum((columns.T @ fitted.residual) ** 2))


def fall_of(candidate: Candidate, fitted: Fitted, count: int) -> float:
    """Give by how much the criterion falls with this candidate."""
    return fall(gain_of(candidate.columns, fitted), fitted.rss, count, candidate.parameters,
                candidate.tried)


def probability(candidate: Candidate, fitted: Fitted, dof: int, among: int) -> float:
    """
    Give the probability that noise alone makes one of the candidates this good.

    Parameters
    ----------
    candidate : Candidate
        The best of them.
    fitted : Fitted
        The model without it.
    dof : int
        Independent equations less parameters of the model.
    among : int
        Number of candidates.

    """
    from scipy.special import fdtrc

    added = candidate.parameters
    left = dof - added
    if left < 1:
        return 1.0
    gain = gain_of(candidate.columns, fitted)
    rss = max(fitted.rss - gain, 1e-300)
    p = float(fdtrc(added, left, gain / added / (rss / left)))
    return min(1.0, p * among * candidate.tried)


def agrees(candidate: Candidate, fitted: Fitted) -> bool:
    """Tell whether poses left out are predicted better with the candidate than without."""
    with_it = fitted.plus(candidate.columns).left_out
    return bool(with_it @ with_it < fitted.left_out @ fitted.left_out)
