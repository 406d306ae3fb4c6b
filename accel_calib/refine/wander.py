# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
`offset_wander`: an offset that changes slowly, in no form that is known.

The offset is a random walk in time, w(t), whose steps grow by q a second; the equations see it
through the same columns as an offset. Its size is found by restricted maximum likelihood
(Patterson and Thompson 1971): with the model projected out, in the axes of the eigenvectors of the
walk's covariance K, the residual z has the variances s² (1 + λ Λ_i).

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .equations import Equations
from .least_squares import Fitted
from ..table import Floats

_RATIOS = np.geomspace(1e-4, 1e6, 81)
_LARGEST_RATIO = 1e3
_LEAST_WHITE = 0.5
"""Part of the measured variance that is left to the poses themselves."""


@dataclass(frozen=True)
class Wander:
    """
    A random walk of the offset.

    Parameters
    ----------
    fall : float
        By how much the criterion falls with it.
    likelihood_ratio : float
        Twice the logarithm of the likelihood ratio against no walk.
    residual : (m,) array
        What is left with the estimated walk taken out.
    left_out : (m,) array
        The same, each equation estimated from the others.
    whitening : (m, m) array
        Makes equations with the walk independent again.

    """

    fall: float
    likelihood_ratio: float
    residual: Floats
    left_out: Floats
    whitening: Floats


def wander(equations: Equations, fitted: Fitted, time: Floats, known: bool) -> Wander:
    """
    Estimate a random walk of the offset.

    Parameters
    ----------
    equations : Equations
        Near the model.
    fitted : Fitted
        With the model projected out.
    time : (n,) array
        Of the poses [s].
    known : bool
        Whether the noise was measured: then no less is left than half its variance.

    """
    walk = _covariance(equations, time)
    onto = fitted.onto
    outside = walk - onto @ (onto.T @ walk)
    outside = outside - (outside @ onto) @ onto.T
    values, vectors = np.linalg.eigh((outside + outside.T) / 2.0)
    values = np.clip(values, 0.0, None) / max(values[-1], 1e-300)
    squared = (vectors.T @ fitted.residual) ** 2
    dof = equations.count - onto.shape[1]
    spread = 1.0 + _RATIOS[:, np.newaxis] * values
    scale = np.sum(squared / spread, axis=1) / dof
    allowed = scale >= _LEAST_WHITE if known else _RATIOS <= _LARGEST_RATIO
    allowed[0] = True
    deviance = np.sum(np.log(spread), axis=1) + dof * np.log(np.maximum(scale, 1e-300))
    none = dof * np.log(max(np.sum(squared), 1e-300) / dof)
    best = int(np.argmin(np.where(allowed, deviance, np.inf)))
    ratio = float(none - deviance[best])
    weights = 1.0 / spread[best]
    residual = vectors @ (weights * (vectors.T @ fitted.residual))
    # Without its own equation each residual is P z over the diagonal of P.
    diagonal = np.sum(vectors ** 2 * weights, axis=1) - np.sum(onto ** 2, axis=1)
    left_out = residual / np.maximum(diagonal, 0.02)
    largest = np.linalg.eigvalsh((outside + outside.T) / 2.0)[-1]
    covariance = np.eye(len(walk)) + _RATIOS[best] / max(float(largest), 1e-300) * walk
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    return Wander(ratio - np.log(max(dof, 2)), ratio, residual, left_out, whitening)


def _covariance(equations: Equations, time: Floats) -> Floats:
    """Give the (m, m) covariance of a walk with steps of 1 g²/s, as the equations see it."""
    order = np.argsort(time, kind='stable')
    steps = np.sqrt(np.diff(time[order], prepend=time[order[0]]))
    total = np.zeros((len(equations.residual),) * 2)
    for axis in range(3):
        unit = np.zeros((len(time), 3, 1))
        unit[:, axis, 0] = 1.0
        # Column j of the walk: a step at pose j, which all later poses keep.
        later = np.zeros((len(time), 3, len(time)))
        position = np.empty(len(time), int)
        position[order] = np.arange(len(time))
        later[:, axis, :] = (position[:, np.newaxis] >= np.arange(len(time))) * steps
        seen = equations.seen(later)
        total += seen @ seen.T
    return total
