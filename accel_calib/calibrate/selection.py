# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Model choice: the smallest model that the poses call for.

From the smallest model up, a larger one is taken where an F test at `_LEVEL`, with the moderated
variance of `accel_calib.calibrate.likelihood.Fit`, says that it explains more than noise would.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .likelihood import Fit
from ..units import MG

_LEVEL = 0.03


@dataclass(frozen=True)
class Choice:
    """
    A chosen model.

    Parameters
    ----------
    name : str
        The model.
    reason : str
        Why it and not another.

    """

    name: str
    reason: str


def choose(fits: Mapping[str, Fit]) -> Choice:
    """
    Choose among nested models.

    Parameters
    ----------
    fits : mapping of str to Fit
        By name, the smallest first; all to the same poses.

    Returns
    -------
    Choice
        The smallest model that the poses call for.

    """
    chosen, *larger = fits
    reasons: list[str] = []
    for name in larger:
        probability = _by_chance(fits[chosen], fits[name])
        gaps = f'{_gap_mg(fits[chosen]):.3g} to {_gap_mg(fits[name]):.3g} mg'
        if probability < _LEVEL:
            reasons.append(f'model {name} lowers the gap of model {chosen} from {gaps} '
                           f'(by chance: p = {probability:.1g})')
            chosen = name
        else:
            reasons.append(f'model {name} would change it from {gaps}, no more than noise would '
                           f'(p = {probability:.2g})')
    return Choice(chosen, '; '.join(reasons) or f'the poses carry no model but {chosen}')


def _gap_mg(fit: Fit) -> float:
    return float(np.sqrt(np.mean(fit.residual ** 2))) * MG


def _by_chance(small: Fit, large: Fit) -> float:
    """Give the probability that noise alone makes the larger model fit that much better."""
    from scipy.special import fdtrc

    added = small.dof - large.dof
    if large.variance_dof <= 0:
        return 1.0
    chi2_small = float(np.sum((small.residual / large.sigma) ** 2))
    gained = max(chi2_small - large.chi2, 0.0) / added
    return float(fdtrc(added, large.variance_dof, gained / max(large.variance, 1e-300)))
