# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A dwell: the sums of the chunks of a still stretch, and what they come to.

Mean and standard deviation are those of all samples. The number of samples is divided by the
excess of the noise of the mean over that of independent samples (see `noise`), so that
std/√count is the noise of the mean, along the force (see `average`). One short dwell tells the
excess badly, and it belongs to the sensor: the median over its dwells is used, unless a dwell
shows clearly more. Samples that are rounded to steps of q leave an error in the mean that no
averaging removes when their own noise σ is less than a step: its variance is
(q²/12) exp(-4π² σ²/q²) [1]_. The quietest stretch seen tells σ; samples that flip between two
steps do not.

A dwell is refused when its windows vary on average more than `DWELL_RATIO` times the sensor's
noise, by more than the uncertainty of that average: a tremor that the threshold of a single
window let pass. The noise may become known after the dwell ended, so dwells are judged again
when they are asked for. And it is refused when the reading moved steadily through it or through
half of it, or when its noise would hide that: it must show that it was not turned (see
`rule.TURN_G`), which takes the longer the noisier the sensor is. Once five dwells have told the
bias of the gyro, the gyro decides.

References
----------
.. [1] B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, chapter 4: the first term of
   the bias of a mean, q/π sin(2πx/q) exp(-2π² σ²/q²), scaled to q²/12 at σ = 0.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from . import average as row
from .noise import strength_of, Trend
from .rule import DWELL_SLOPE_G, Rule, STRENGTH, WEAK_STRENGTH
from .sliding import Line
from .sums import CONTEXT
from ..table import Floats

DWELL_RATIO = 3.2
"""Mean variance of the windows of a dwell over the noise, at most."""

DWELL_RATE_RATIO = 1600.0
"""The same for the rate: what the accelerometer does not feel does no harm."""

PART_SLOPE_G = 5e-3
"""Slope through half of a dwell that is let pass [g/s]."""

PART_STRENGTH = 20.0
"""It stands out if the sum of its squared scores is above: p about 2e-4."""

_OWN_EXCESS = 1.5   # an estimate of one dwell is that uncertain
_BIAS_DWELLS = 5    # that tell the bias of the gyro
_GYRO_RATE = np.radians(0.25)
"""Mean rate beside the bias that shows turning [rad/s]."""
_SPREADS = 3.0      # of the bias over the dwells, that are below this rate
_MAD = 1.4826       # standard deviation over median absolute deviation


@dataclass(frozen=True)
class Dwell:
    """
    A still stretch, averaged.

    Parameters
    ----------
    start, end : float
        First and last stamp that was averaged [s].
    time : float
        Mean of the stamps [s].
    mean, std : (3,) array
        Mean and standard deviation of the samples [unit of the readings].
    count : float
        Independent samples: std/√count is the noise of the mean.
    samples : int
        Samples averaged.
    context : mapping of str to float or (3,) array
        Means of ``temperature``, ``supply_voltage`` and ``rate``, where given.
    orientation : int
        Dwells that share it are parts of one (see ``max_dwell``).

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


def judged(table: Floats, rule: Rule, first: int = 0) -> list[Dwell | None]:
    """
    Give each dwell from the first on if it is still by what is known now.

    Its count, and the bias of the gyro, go by all of them.

    Parameters
    ----------
    table : (FIGURES, k) array
        The dwells, as `average.figures` gives them.
    rule : Rule
        Knows the noise.
    first : int
        Index of the first that is asked for.

    """
    slopes = _slopes(table[row.SLOPE])
    quiet = _quiet(table, slopes, rule)
    across, along = (_excess(table[each], quiet) for each in (row.EXCESS, row.ALONG))
    excess = np.minimum(across, along)
    turned, sure = _by_gyro(table, quiet, rule)
    good = quiet & ~turned & (sure | rule.rests(slopes, across))
    std, count = _counts(table[:, first:], excess[first:], rule)
    return [_dwell(*each) if fine else None
            for fine, *each in zip(good[first:], table.T[first:], std.T.copy(), count.tolist())]


def _excess(own: Floats, quiet: NDArray[np.bool_]) -> Floats:
    """Give the excess of the noise of each mean, by all of them."""
    common = float(np.median(own[quiet])) if quiet.any() else 1.0
    return np.asarray(np.maximum(max(1.0, common), own / _OWN_EXCESS))


def _slopes(parts: Floats) -> Trend:
    slope, square, neighbours, white = parts[:12].reshape(4, 3, -1)
    return strength_of(Line(slope, square, neighbours, parts[12], parts[13]), parts[14], white)


def _quiet(table: Floats, slopes: Trend, rule: Rule) -> NDArray[np.bool_]:
    """Tell which are still by the noise that is known now, and did not move steadily."""
    limit = rule.limit_of(rule.noise_of(table[row.MEAN]), DWELL_RATIO, DWELL_RATE_RATIO)
    strength = np.where(table[row.BESIDE] > 0.0, WEAK_STRENGTH, STRENGTH)
    moved = rule.moved(slopes, np.asarray(rule.scale), table[row.AVERAGE][:3], strength,
                       DWELL_SLOPE_G)
    parts = table[row.PARTS].reshape(2, 3, -1)
    turned = np.any((parts[0] > PART_SLOPE_G * rule.scale) & (parts[1] > PART_STRENGTH), axis=0)
    moved |= turned & (rule.scale > 0.0)
    return np.asarray(~moved & ~np.any(table[row.LOWEST] > limit, axis=0))


def _by_gyro(table: Floats, quiet: NDArray[np.bool_], rule: Rule
             ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Tell by the gyro which dwells were turned, and which surely were not.

    Its bias is the median over the dwells that are quiet, and a rate about the vertical turns no
    pose. Beside native units it may be in counts too, and is not asked.

    """
    up, rates = table[row.MEAN][:3], table[row.MEAN][3:]
    known = quiet & np.isfinite(rates).all(axis=0)
    if not rule.known or known.sum() < _BIAS_DWELLS:
        return np.zeros_like(quiet), np.zeros_like(quiet)
    off = rates - np.median(rates[:, known], axis=1, keepdims=True)
    spread = _MAD * float(np.max(np.median(np.abs(off[:, known]), axis=1)))
    tilting = (np.linalg.norm(np.cross(off, up, axis=0), axis=0)
               / np.maximum(np.linalg.norm(up, axis=0), 1e-300))
    alive = np.all(table[row.AVERAGE][3:] > 0.0, axis=0)
    sure = known & alive & (tilting < _GYRO_RATE) & (_SPREADS * spread < _GYRO_RATE)
    return known & (tilting > max(_GYRO_RATE, 2.0 * _SPREADS * spread)), sure


def _counts(table: Floats, excess: Floats, rule: Rule) -> tuple[Floats, Floats]:
    """Give (3, k) standard deviations and (k,) independent samples, rounding included."""
    resolution, left = rule.rounding(table[row.MEAN][:3], table[row.STD])
    std = np.maximum(table[row.STD], resolution)
    variance = std**2 * excess / table[row.SAMPLES] + left
    return std, np.asarray(np.sum(std**2, axis=0) / np.sum(variance, axis=0))


def _dwell(column: Floats, std: Floats, count: float) -> Dwell:
    column = column.copy()
    figure = column.tolist()
    begin, end, time = figure[row.SPAN]
    context: dict[str, float | Floats] = {
        name: value for name, value in zip(CONTEXT, figure[row.AROUND]) if math.isfinite(value)}
    mean = column[row.MEAN]
    if math.isfinite(figure[row.MEAN][-1]):
        context['rate'] = mean[3:]
    return Dwell(begin, end, time, mean[:3], std, count, int(figure[row.SAMPLES]), context,
                 int(figure[row.ORIENTATION]))
