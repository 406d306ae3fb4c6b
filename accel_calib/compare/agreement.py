# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Test whether the parameters of several runs agree within their covariances.

Runs of one sensor have parameters x_i with covariances C_i. Contrasts of the x_i, such as their
differences, are then normally distributed about zero with the covariance K diag(C_i) Kᵀ, and

    T² = dᵀ (K diag(C_i) Kᵀ)⁺ d,   d = K x

divided by its rank has an F distribution with the degrees of freedom of the noise. T² tests all
directions at once. In addition, each parameter of each run is compared with the mean of the other
runs (Student's t), to detect a change of a single parameter. The smaller of the two probabilities
is used, corrected for two tests and for the number of parameters (Bonferroni). The differing run
is the run whose removal reduces T² most.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..table import Floats

LEVEL = 0.03
"""Probability that runs of an unchanged sensor are reported to differ."""

SAME_G = 1e-7
"""Differences below this count as zero [g]."""

_NO_SPREAD = 1e-10
"""A variance below this part of the largest counts as zero."""


@dataclass(frozen=True)
class Runs:
    """Runs in common parameters: (n, t) values, (n, t, t) covariances, and dof of the noise."""

    values: Floats
    covariances: Floats
    dof: float

    def without(self, run: int) -> Runs:
        """Return the runs without one run."""
        return Runs(np.delete(self.values, run, 0), np.delete(self.covariances, run, 0), self.dof)

    @property
    def squared(self) -> tuple[float, int]:
        """T² and its rank: squared differences in all directions over their variances."""
        count = len(self.values)
        contrasts = np.linalg.svd(np.ones((1, count)))[2][1:]
        away = (contrasts @ self.values).ravel()
        covariance = np.einsum('ai,irs,bi->arbs', contrasts, self.covariances, contrasts)
        variances, vectors = np.linalg.eigh(covariance.reshape(away.size, away.size))
        along = vectors.T @ away
        vary = variances > _NO_SPREAD * max(float(np.max(variances, initial=0.0)), 1e-300)
        if np.linalg.norm(along[~vary]) > SAME_G:
            return np.inf, int(np.sum(vary))
        return float(np.sum(along[vary] ** 2 / variances[vary])), int(np.sum(vary))

    @property
    def least(self) -> Floats:
        """(n,) array, the probability of the most deviating parameter of each run."""
        from scipy.special import stdtr

        variance = np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0) + SAME_G ** 2
        weight = 1.0 / variance
        others = np.sum(weight, axis=0) - weight
        mean = (np.sum(weight * self.values, axis=0) - weight * self.values) / others
        sizes = np.abs(self.values - mean) / np.sqrt(variance + 1.0 / others)
        number = np.sum(np.any(variance > 4.0 * SAME_G ** 2, axis=0))
        least: Floats = 2.0 * stdtr(self.dof, -np.max(sizes, axis=1)) * max(number, 1)
        return least

    @property
    def p_value(self) -> float:
        """Probability of differences at least this large, if the runs agree."""
        count = len(self.values)
        tests = 1 if count == 2 else count
        return _either(_beyond(*self.squared, self.dof), float(np.min(self.least)) * tests)


def _beyond(chi2: float, rank: int, dof: float) -> float:
    """Return the probability of a T² of this rank that is at least this large."""
    from scipy.special import chdtrc, fdtrc

    if rank == 0 or not np.isfinite(chi2):
        return 1.0 if np.isfinite(chi2) else 0.0
    return float(chdtrc(rank, chi2) if np.isinf(dof) else fdtrc(rank, dof, chi2 / rank))


def _either(first: float, second: float) -> float:
    return min(1.0, 2.0 * min(first, second))


def p_values(runs: Runs) -> Floats:
    """Return the probability of the differences between each run and the others."""
    if len(runs.values) == 2:
        return np.full(2, runs.p_value)
    chi2, rank = runs.squared
    found = []
    for k, least in enumerate(runs.least):
        others, others_rank = runs.without(k).squared
        found.append(_either(_beyond(chi2 - others, rank - others_rank, runs.dof), float(least)))
    return np.array(found)


def outlier(runs: Runs) -> int | None:
    """Return the index of the run without which the others agree, or None."""
    if len(runs.values) == 2:
        return None
    left = [runs.without(k) for k in range(len(runs.values))]
    best = int(np.argmin([others.squared[0] for others in left]))
    return best if left[best].p_value >= LEVEL else None
