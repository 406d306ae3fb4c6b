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
with the moderated variance of `accel_calib.calibrate.likelihood.Fit`) is left out and the rest
fitted again, several times over; as many are then called disturbed as the generalised extreme
studentised deviate test (Rosner 1983) finds at the level `_LEVEL`, which is not masked when
several poses are disturbed.

"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .likelihood import Fit
from ..table import Floats

_LEVEL = 0.01
_LARGEST_SHARE = 0.25


def disturbed(fit_rows: Callable[[NDArray[np.int64]], Fit], count: int,
              free: int) -> NDArray[np.int64]:
    """
    Find disturbed poses.

    Parameters
    ----------
    fit_rows : callable
        Fits the poses at these indices.
    count : int
        Number of poses.
    free : int
        Free parameters of the fit.

    Returns
    -------
    (d,) array of int
        Indices of the disturbed poses.

    """
    kept = np.arange(count)
    out: list[int] = []
    found = 0
    for _ in range(min(int(_LARGEST_SHARE * count), count - free - 1)):
        fit = fit_rows(kept)
        worst, size = _largest(fit)
        if size > _critical(fit, len(kept)):
            found = len(out) + 1
        out.append(int(kept[worst]))
        kept = np.delete(kept, worst)
    return np.array(sorted(out[:found]), int)


def studentised(fit: Fit) -> Floats:
    """Give each residual over its deviation as the others tell it, (n,); 0 where they can't."""
    free_share = 1.0 - fit.leverage
    tells = free_share > 1e-6
    squared = np.where(tells, fit.weighted ** 2 / np.where(tells, free_share, 1.0), 0.0)
    others = (fit.variance * fit.variance_dof - squared) / (fit.variance_dof - 1.0)
    with np.errstate(divide='ignore', invalid='ignore'):
        ratio = np.sqrt(squared / np.maximum(others, 0.0))
    return np.nan_to_num(ratio, nan=0.0, posinf=np.inf)


def _largest(fit: Fit) -> tuple[int, float]:
    sizes = studentised(fit)
    return int(np.argmax(sizes)), float(np.max(sizes))


def _critical(fit: Fit, count: int) -> float:
    """Give Student's t that one of `count` clean poses exceeds with probability `_LEVEL`."""
    from scipy.special import stdtrit

    return float(stdtrit(fit.variance_dof - 1.0, 1.0 - _LEVEL / (2.0 * count)))
