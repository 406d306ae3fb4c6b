# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Dwells: still stretches, averaged and tested.

Mean and standard deviation are those of all samples. The number of samples is divided by the
excess of the noise of the mean (see `noise`), so that std/√count is the noise of the mean along
the force (see `average`). A short dwell is not enough to estimate the excess, which is a property
of the sensor. The median over all dwells is therefore used, unless a dwell has a clearly larger
excess. Samples that are rounded to steps of height q cause an error of the mean. Averaging does
not remove this error if the noise σ of the samples is less than a step: its variance is
(q²/12) exp(-4π² σ²/q²) [1]_. σ is estimated from the quietest stretch so far; samples that
alternate between two steps are not suitable.

A dwell is rejected in three cases:

- Its windows vary on average more than `DWELL_RATIO` times the noise of the sensor, significantly.
  This detects a tremor below the threshold of a single window.
- The reading has a slope through the dwell or through half of it.
- Its noise does not exclude a slow turn (see `rule.TURN_G`). A noisier sensor needs a longer
  dwell. Once five dwells determine the bias of the gyro, the gyro decides instead.

The noise may become known after the dwell ended, so each query tests the dwells again.

References
----------
.. [1] B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, chapter 4: the first term of
   the bias of a mean, q/π sin(2πx/q) exp(-2π² σ²/q²), scaled to q²/12 at σ = 0.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .average import trend_of
from .noise import Trend
from .rule import DWELL_SLOPE_G, Rule, STRENGTH, WEAK_STRENGTH
from .sums import CONTEXT, Records
from ..table import Floats

DWELL_RATIO = 3.2
"""Largest ratio of the mean variance of the windows of a dwell to the noise."""

DWELL_RATE_RATIO = 1600.0
"""The same for the rate: shaking that the accelerometer does not measure is harmless."""

PART_SLOPE_G = 5e-3
"""Largest slope through half of a dwell [g/s]."""

PART_STRENGTH = 20.0
"""This slope is significant if the sum of its squared scores is larger: p ≈ 2e-4."""

_OWN_EXCESS = 1.5   # factor of uncertainty of the excess of one dwell
_BIAS_DWELLS = 5    # fewest dwells that determine the bias of the gyro
_GYRO_RATE = np.radians(0.25)
"""Mean rate minus the bias that indicates turning [rad/s]."""
_SPREADS = 3.0      # standard deviations of the bias over the dwells that must be below this rate
_MAD = 1.4826       # ratio of standard deviation to median absolute deviation


@dataclass(frozen=True)
class Dwell:
    """
    An averaged still stretch.

    Parameters
    ----------
    start, end : float
        First and last stamp of the averaged samples [s].
    time : float
        Mean of the stamps [s].
    mean, std : (3,) array
        Mean and standard deviation of the samples [unit of the readings].
    count : float
        Independent samples: std/√count is the noise of the mean.
    samples : int
        Number of samples averaged.
    context : mapping of str to float or (3,) array
        Means of ``temperature``, ``supply_voltage`` and ``rate``, if known.
    orientation : int
        Dwells with the same number are parts of one dwell (see ``max_dwell``).
    doubtful : bool
        Whether the sensor may have moved, according to later dwells.

    """

    start: float
    end: float
    time: float
    mean: Floats
    std: Floats
    count: float
    samples: int
    context: Mapping[str, float | Floats]
    orientation: int
    doubtful: bool = False


def judged(table: Records, rule: Rule, first: int = 0) -> list[Dwell | None]:
    """
    Return each dwell, or None if it is not still according to the noise known now.

    Parameters
    ----------
    table : (k,) array of `average.FIGURES`
        The dwells. Excess and bias of the gyro are estimated from all of them.
    rule : Rule
        The rule, with the noise known now.
    first : int
        Index of the first dwell to return.

    """
    slopes = trend_of(table)
    quiet = _quiet(table, slopes, rule)
    across, along = (_excess(table[name], quiet) for name in ('excess', 'along'))
    excess = np.minimum(across, along)
    turned, sure = _by_gyro(table, quiet, rule)
    good = quiet & ~turned & (sure | rule.rests(slopes, across))
    std, count = _counts(table[first:], excess[first:], rule)
    return [_dwell(*each) if fine else None
            for fine, *each in zip(good[first:], table[first:], std.T.copy(), count.tolist())]


def _excess(own: Floats, quiet: NDArray[np.bool_]) -> Floats:
    """Return the excess of the noise of each mean, estimated from all dwells."""
    common = float(np.median(own[quiet])) if quiet.any() else 1.0
    return np.asarray(np.maximum(max(1.0, common), own / _OWN_EXCESS))


def _quiet(table: Records, slopes: Trend, rule: Rule) -> NDArray[np.bool_]:
    """Return which dwells are still according to the noise known now, and have no slope."""
    limit = rule.limit_of(rule.noise_of(table['mean'].T), DWELL_RATIO, DWELL_RATE_RATIO)
    strength = np.where(table['beside_slope'], WEAK_STRENGTH, STRENGTH)
    moved = rule.moved(slopes, np.asarray(rule.scale), table['average'].T[:3], strength,
                       DWELL_SLOPE_G)
    turned = np.any((table['part_slope'] > PART_SLOPE_G * rule.scale)
                    & (table['part_strength'] > PART_STRENGTH), axis=1)
    moved |= turned & (rule.scale > 0.0)
    return np.asarray(~moved & ~np.any(limit < table['lowest'].T, axis=0))


def _by_gyro(table: Records, quiet: NDArray[np.bool_], rule: Rule
             ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Return which dwells are turning according to the gyro, and which are certainly not.

    The bias of the gyro is the median over the quiet dwells. A rate about the vertical does not
    change a pose and is ignored. With native units the gyro is not used, because it may be in
    counts, too.

    """
    up, rates = table['mean'].T[:3], table['mean'].T[3:]
    known = quiet & np.isfinite(rates).all(axis=0)
    if not rule.known or known.sum() < _BIAS_DWELLS:
        return np.zeros_like(quiet), np.zeros_like(quiet)
    off = rates - np.median(rates[:, known], axis=1, keepdims=True)
    spread = _MAD * float(np.max(np.median(np.abs(off[:, known]), axis=1)))
    tilting = (np.linalg.norm(np.cross(off, up, axis=0), axis=0)
               / np.maximum(np.linalg.norm(up, axis=0), 1e-300))
    alive = np.all(table['average'].T[3:] > 0.0, axis=0)
    sure = known & alive & (tilting < _GYRO_RATE) & (_SPREADS * spread < _GYRO_RATE)
    return known & (tilting > max(_GYRO_RATE, 2.0 * _SPREADS * spread)), sure


def _counts(table: Records, excess: Floats, rule: Rule) -> tuple[Floats, Floats]:
    """Return (3, k) standard deviations and (k,) independent samples, including rounding."""
    resolution, left = rule.rounding(table['mean'].T[:3], table['std'].T)
    std = np.maximum(table['std'].T, resolution)
    variance = std**2 * excess / table['samples'] + left
    return std, np.asarray(np.sum(std**2, axis=0) / np.sum(variance, axis=0))


def _dwell(found: Any, std: Floats, count: float) -> Dwell:
    context: dict[str, float | Floats] = {
        name: value for name, value in zip(CONTEXT, found['around'].tolist())
        if math.isfinite(value)}
    mean = found['mean'].copy()
    if np.isfinite(mean).all():
        context['rate'] = mean[3:]
    return Dwell(float(found['begin']), float(found['end']), float(found['time']), mean[:3], std,
                 count, int(found['samples']), context, int(found['orientation']))
