# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
How far the residuals let the measured noise be believed.

The variance of a residual is λ times what the noise of its pose says. Either the noise is right,
λ = 1, or poses repeat worse than their samples say, or better, by a factor of which nothing is
known: log λ is evenly spread from log 0.01 to log 10⁴. The residuals weigh the one against the
other (Bayes' rule with the likelihood λ^(-dof/2) exp(-chi²/2λ)); a value is then spread as a
mixture of normal distributions, and its stated variance is such that ±1.96 standard deviations
hold 95 % of it. Where the noise is not measured at all, λ comes from the residuals alone and the
mixture is Student's t.

"""

from __future__ import annotations

from functools import cache

import numpy as np

from ..table import Floats

USUAL_NOISE_G = 5e-4
"""Noise of a pose of a common MEMS sensor, where it was not measured."""

_NO_NOISE_G = 1e-9
"""Samples that scatter less do not scatter at all."""

LEAST_NOISE = 0.1
"""A pose that claims less than this part of the median noise is not believed."""

_BELIEF = 8.0
_BELIEF_IN_USUAL = 3.0
"""What measured noise, and the noise of a common sensor, count as in a test."""

_RIGHT = 0.7
"""Probability that the measured noise is right, before the residuals are seen."""

_INTERVAL = 0.95
_NORMAL = 1.959964
_SCALES = np.logspace(-2.0, 4.0, 121)
_ONE = 40
"""λ looked at; the place of λ = 1."""

_BEYOND = 1e3


def believable(noise: Floats | None) -> Floats | None:
    """
    Raise noise that is far below that of the other poses of a sensor.

    Parameters
    ----------
    noise : (..., n, 3) array or None
        Standard deviation of pose means [g]; leading axes are sensors.

    Returns
    -------
    (..., n, 3) array or None
        None where it is not known, or most poses claim to have none at all; among several
        sensors such a one has `USUAL_NOISE_G`.

    """
    if noise is None:
        return None
    median = np.median(noise, axis=(-1, -2), keepdims=True)
    has = median > _NO_NOISE_G
    if not np.any(has):
        return None
    return np.where(has, np.maximum(noise, LEAST_NOISE * median), USUAL_NOISE_G)


def belief_in(noise_known: bool) -> float:
    """Say how many degrees of freedom the noise counts as (moderated variance, Smyth 2004)."""
    return _BELIEF if noise_known else _BELIEF_IN_USUAL


@cache
def _grid() -> tuple[Floats, Floats]:
    """Give half widths (k,), and the part of N(0, λ) that each of them holds, (m, k)."""
    from scipy.special import ndtr

    width = np.geomspace(0.15, 250.0, 141)
    return width, 2.0 * ndtr(width / np.sqrt(_SCALES)[:, np.newaxis]) - 1.0


def variance_factor(chi2: Floats | float, dof: Floats | int, noise_known: bool) -> Floats:
    """
    Say by how much to multiply the variance that the noise alone would leave a value.

    Parameters
    ----------
    chi2 : (...) array or float
        Sum of the squared residuals over their noise.
    dof : (...) array or int
        Residuals less free values.
    noise_known : bool
        Whether the noise was measured; if not, `chi2` is in whatever unit it was taken to be.

    Returns
    -------
    (...) array
        The factor. Where nothing is left to judge by it is 1 for noise that was measured, and
        otherwise NaN.

    """
    chi2, dof = np.broadcast_arrays(np.asarray(chi2, float), np.asarray(dof, float))
    factor = _of_residuals(chi2, np.maximum(dof, 1.0))
    if noise_known:
        factor = np.where(chi2 > _BEYOND * dof, factor, _of_mixture(chi2, dof))
    return np.where(dof > 0, factor, 1.0 if noise_known else np.nan)


def _of_residuals(chi2: Floats, dof: Floats) -> Floats:
    """Give the factor where the residuals alone say what the noise is: Student's t."""
    from scipy.special import stdtrit

    return chi2 / dof * (stdtrit(dof, 0.5 + _INTERVAL / 2.0) / _NORMAL) ** 2


def _of_mixture(chi2: Floats, dof: Floats) -> Floats:
    """Give the factor where the noise is measured, and may be right."""
    width, held = _grid()
    likelihood = (chi2[..., np.newaxis] * (1.0 - 1.0 / _SCALES)
                  - dof[..., np.newaxis] * np.log(_SCALES)) / 2.0
    largest = np.max(likelihood, axis=-1, keepdims=True)
    weight = np.exp(likelihood - largest) * (1.0 - _RIGHT)
    weight[..., _ONE] += _RIGHT * len(_SCALES) * np.exp(-largest[..., 0])
    part = (weight / np.sum(weight, axis=-1, keepdims=True)) @ held
    above = np.argmax(part >= _INTERVAL, axis=-1)
    here, before = (np.take_along_axis(part, k[..., np.newaxis], axis=-1)[..., 0]
                    for k in (above, above - 1))
    share = (_INTERVAL - before) / (here - before)
    between = width[above - 1] * (width[above] / width[above - 1]) ** share
    return (between / _NORMAL) ** 2
