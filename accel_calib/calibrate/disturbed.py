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

"""
Disturbed poses: knocked, or not still. A fault of the data, found and left out.

The pose whose residual is the largest against what the other poses say (externally studentised,
with the moderated variance of `accel_calib.calibrate.likelihood.Fit`) is taken out, and so on,
several times over; as many are then called disturbed as the generalised extreme studentised
deviate test (Rosner 1983) finds at the level `_LEVEL`, which is not masked when several poses are
disturbed. Between the poses taken out the fit is followed to first order; it is then made anew
without them, and the search goes on until it finds no more.

"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .likelihood import Fit
from ..table import Floats

_LEVEL = 0.01
_LARGEST_SHARE = 0.25
_ROUNDS = 4


def disturbed(fit_rows: Callable[[NDArray[np.int64]], Fit], count: int) -> NDArray[np.int64]:
    """
    Find disturbed poses.

    Parameters
    ----------
    fit_rows : callable
        Fits the poses at these indices.
    count : int
        Number of poses.

    Returns
    -------
    (d,) array of int
        Indices of the disturbed poses.

    """
    kept = np.arange(count)
    for _ in range(_ROUNDS):
        fit = fit_rows(kept)
        most = int(_LARGEST_SHARE * count) - (count - len(kept))
        found = _extreme(fit, min(most, fit.dof - 1))
        if not found:
            break
        kept = np.delete(kept, found)
    return np.setdiff1d(np.arange(count), kept)


def _extreme(fit: Fit, most: int) -> list[int]:
    """Give the residuals that the test calls extreme, among at most so many."""
    rows, found = np.arange(len(fit.residual)), 0
    out: list[int] = []
    belief = fit.variance_dof - fit.dof
    for _ in range(most):
        sizes, dof = studentised(fit.weighted[rows], fit.jacobian[rows], belief)
        worst = int(np.argmax(sizes))
        if sizes[worst] > _critical(dof, len(rows)):
            found = len(out) + 1
        out.append(int(rows[worst]))
        rows = np.delete(rows, worst)
    return out[:found]


def studentised(weighted: Floats, jacobian: Floats, belief: float) -> tuple[Floats, float]:
    """
    Give each residual over its deviation as the others tell it.

    Parameters
    ----------
    weighted : (m,) array
        Residuals over their noise, of a fit that need not be these rows' own.
    jacobian : (m, q) array
        Their derivative by the free values.
    belief : float
        Degrees of freedom that the measured noise counts as.

    Returns
    -------
    (m,) array, float
        Student's t of each, and its degrees of freedom; 0 where the others cannot tell.

    """
    onto = np.linalg.qr(jacobian)[0]
    residual = weighted - onto @ (onto.T @ weighted)
    own = 1.0 - np.sum(onto ** 2, axis=1)
    tells = own > 1e-6
    squared = np.where(tells, residual ** 2 / np.where(tells, own, 1.0), 0.0)
    dof = belief + len(weighted) - jacobian.shape[1] - 1.0
    others = np.maximum(belief + residual @ residual - squared, 1e-300) / max(dof, 1e-9)
    return np.sqrt(squared / others), dof


def _critical(dof: float, count: int) -> float:
    """Give Student's t that one of `count` clean poses exceeds with probability `_LEVEL`."""
    from scipy.special import stdtrit

    return float(stdtrit(max(dof, 1.0), 1.0 - _LEVEL / (2.0 * count)))
