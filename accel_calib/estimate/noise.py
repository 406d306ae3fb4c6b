# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Weight of the measured noise of poses against the residuals of a fit.

The variance of a residual is λ times the variance predicted by the noise of its pose. Either the
noise is correct and λ = 1, or poses repeat worse or better than their samples predict. Then log λ
is uniformly distributed from log 0.01 to log 10⁴. The residuals decide between both (Bayes' rule
with the likelihood λ^(-dof/2) exp(-chi²/2λ)). The distribution of a parameter is then a mixture of
normal distributions. Its stated variance is chosen so that ±1.96 standard deviations contain 95 %
of the mixture. If the noise was not measured, λ is estimated from the residuals alone, and the
mixture is Student's t. If there are no degrees of freedom either, the noise of a common sensor is
assumed.

In tests the measured noise counts as a number of degrees of freedom (moderated variance, Smyth
2004).

"""

from __future__ import annotations

from functools import cache

import numpy as np

from ..table import Floats

USUAL_NOISE_G = 5e-4
"""Noise of a pose mean of a common MEMS sensor, assumed if it was not measured [g]."""

_NO_NOISE_G = 1e-9
"""Noise below this counts as no noise [g]."""

LEAST_NOISE = 0.1
"""Smallest noise of a pose, relative to the median over the poses."""

_BELIEF = 8.0
_BELIEF_IN_USUAL = 3.0
"""Degrees of freedom in a test that measured noise, and assumed noise, count as."""

_RIGHT = 0.7
"""Prior probability that the measured noise is correct."""

_INTERVAL = 0.95
_NORMAL = 1.959964
_SCALES = np.logspace(-2.0, 4.0, 121)
_ONE = 40
"""Values of λ; index of λ = 1."""

_BEYOND = 1e3
"""chi² per degree of freedom above which the measured noise is ignored."""


def believable(noise: Floats | None) -> Floats | None:
    """
    Return the noise of poses, raised where it is far below that of the other poses.

    Parameters
    ----------
    noise : (n, 3) array or None
        Standard deviation of pose means [g].

    Returns
    -------
    (n, 3) array or None
        None if the noise is not known, or is zero for most poses.

    """
    if noise is None or not len(noise):
        return None
    median = np.median(noise)
    return np.maximum(noise, LEAST_NOISE * median) if median > _NO_NOISE_G else None


def belief_in(noise_known: bool) -> float:
    """Return the degrees of freedom that the noise counts as in a test."""
    return _BELIEF if noise_known else _BELIEF_IN_USUAL


@cache
def _grid() -> tuple[Floats, Floats]:
    """Return (k,) half widths, and the (m, k) part of N(0, λ) within each of them."""
    from scipy.special import ndtr

    width = np.geomspace(0.15, 250.0, 141)
    return width, 2.0 * ndtr(width / np.sqrt(_SCALES)[:, np.newaxis]) - 1.0


def variance_factor(chi2: float, dof: int, noise_known: bool) -> float:
    """
    Return the ratio of the stated variance to the variance predicted by the noise.

    Parameters
    ----------
    chi2 : float
        Sum of the squared residuals in units of the noise.
    dof : int
        Number of equations minus number of free values.
    noise_known : bool
        Whether the noise was measured; otherwise the unit of `chi2` is `USUAL_NOISE_G`.

    """
    if dof <= 0:
        return 1.0 if noise_known else _student(_BELIEF_IN_USUAL)
    if not noise_known or chi2 > _BEYOND * dof:
        return chi2 / dof * _student(dof)
    return _of_mixture(chi2, dof)


def _student(dof: float) -> float:
    """Return the squared ratio of the 95 % intervals of Student's t and a normal variable."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + _INTERVAL / 2.0) / _NORMAL) ** 2


def _of_mixture(chi2: float, dof: int) -> float:
    """Return the factor for measured noise, which may be correct."""
    width, held = _grid()
    likelihood = (chi2 * (1.0 - 1.0 / _SCALES) - dof * np.log(_SCALES)) / 2.0
    largest = np.max(likelihood)
    weight = np.exp(likelihood - largest) * (1.0 - _RIGHT)
    weight[_ONE] += _RIGHT * len(_SCALES) * np.exp(-largest)
    part = (weight / np.sum(weight)) @ held
    above = int(np.argmax(part >= _INTERVAL))
    share = (_INTERVAL - part[above - 1]) / (part[above] - part[above - 1])
    between = width[above - 1] * (width[above] / width[above - 1]) ** share
    return float(between / _NORMAL) ** 2
