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
A dwell: the sums of the chunks of a still stretch, and what they come to.

Mean and standard deviation are those of all samples. The number of samples is divided by the
excess of the noise of the mean over that of independent samples (see `noise`), so that
std/√count is the noise of the mean. One short dwell tells the excess badly, and it belongs to
the sensor: the median over its dwells is used, unless a dwell shows clearly more. Samples that
are rounded to steps of q leave an error in the mean that no averaging removes when their own
noise σ is less than a step: its variance is (q²/12) exp(-4π² σ²/q²) [1]_. The quietest
stretch seen tells σ; samples that flip between two steps do not.

A dwell is refused when its windows vary on average more than `DWELL_RATIO` times the sensor's
noise, by more than the uncertainty of that average: a tremor that the threshold of a single
window let pass. The noise may become known after the dwell ended, so dwells are judged again
when they are asked for. And it is refused when the reading moved steadily through it, or when
its noise would hide that: it must show that it was not turned (see `rule.TURN_G`), which takes
the longer the noisier the sensor is. Once five dwells have told the bias of the gyro, the gyro
decides.

References
----------
.. [1] B. Widrow, I. Kollar, Quantization Noise, Cambridge 2008, chapter 4: the first term of
   the bias of a mean, q/π sin(2πx/q) exp(-2π² σ²/q²), scaled to q²/12 at σ = 0.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .noise import strength_of, Trend
from .rule import DWELL_SLOPE_G, Rule, STRENGTH, WEAK_STRENGTH
from .sliding import Line
from ..table import Floats

DWELL_RATIO = 3.2
"""Mean variance of the windows of a dwell over the noise, at most."""

DWELL_RATE_RATIO = 1600.0
"""The same for the rate: what the accelerometer does not feel does no harm."""

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


# What `Candidate.levels` holds, of three axes each.
LOWEST = slice(0, 6)     # lower end of the mean variance of the windows
AVERAGE = slice(6, 12)   # mean variance of the windows
MEAN = slice(12, 18)
SLOPE = slice(18, 33)    # slope, residuals, neighbours, white; time_square, length, spacing


@dataclass(frozen=True)
class Candidate:
    """
    A dwell with what it is judged by.

    Parameters
    ----------
    dwell : Dwell
        The dwell.
    levels : (33,) array
        `LOWEST`, `AVERAGE` and `MEAN` of reading and rate, and `SLOPE` of the reading.
    excess : float
        Variance of the mean over that of independent samples, estimated from this dwell.
    beside_slope : bool
        True if the reading sloped just before or after.

    """

    dwell: Dwell
    levels: Floats
    excess: float
    beside_slope: bool


def judged(candidates: Sequence[Candidate], rule: Rule, first: int = 0) -> list[Dwell | None]:
    """
    Give each dwell from the first on if it is still by what is known now.

    Its count, and the bias of the gyro, go by all of them.

    """
    if not candidates:
        return []
    levels = np.array([each.levels for each in candidates]).T
    slopes = _slopes(levels[SLOPE])
    beside = np.array([each.beside_slope for each in candidates])
    own = np.array([each.excess for each in candidates])
    quiet = _quiet(levels, slopes, beside, rule)
    common = float(np.median(own[quiet])) if quiet.any() else 1.0
    excess = np.maximum(max(1.0, common), own / _OWN_EXCESS)
    turned, sure = _by_gyro(levels, quiet, rule)
    good = quiet & ~turned & (sure | rule.rests(slopes, excess))
    std, count = _counts(candidates[first:], levels[MEAN][:3, first:], excess[first:], rule)
    return [replace(each.dwell, std=std[:, k].copy(), count=float(count[k])) if good[first + k]
            else None for k, each in enumerate(candidates[first:])]


def _slopes(parts: Floats) -> Trend:
    slope, square, neighbours, white = parts[:12].reshape(4, 3, -1)
    return strength_of(Line(slope, square, neighbours, parts[12], parts[13]), parts[14], white,
                       slice(0, 3))


def _quiet(levels: Floats, slopes: Trend, beside: NDArray[np.bool_], rule: Rule
           ) -> NDArray[np.bool_]:
    """Tell which are still by the noise that is known now, and did not move steadily."""
    limit = rule.limit_of(rule.noise_of(levels[MEAN]), DWELL_RATIO, DWELL_RATE_RATIO)
    strength = np.where(beside, WEAK_STRENGTH, STRENGTH)
    moved = rule.moved(slopes, np.asarray(rule.scale), levels[AVERAGE][:3], strength,
                       DWELL_SLOPE_G)
    return np.asarray(~moved & ~np.any(levels[LOWEST] > limit, axis=0))


def _by_gyro(levels: Floats, quiet: NDArray[np.bool_], rule: Rule
             ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """
    Tell by the gyro which dwells were turned, and which surely were not.

    Its bias is the median over the dwells, and a rate about the vertical turns no pose.

    Parameters
    ----------
    levels : (33, k) array
        As those of a candidate.
    quiet : (k,) array of bool
        Dwells to learn from.
    rule : Rule
        Tells whether the rates are in rad/s.

    """
    up, rates = levels[MEAN][:3], levels[MEAN][3:]
    known = quiet & np.isfinite(rates).all(axis=0)
    if not rule.si_rates or known.sum() < _BIAS_DWELLS:
        return np.zeros_like(quiet), np.zeros_like(quiet)
    off = rates - np.median(rates[:, known], axis=1, keepdims=True)
    spread = _MAD * float(np.max(np.median(np.abs(off[:, known]), axis=1)))
    tilting = (np.linalg.norm(np.cross(off, up, axis=0), axis=0)
               / np.maximum(np.linalg.norm(up, axis=0), 1e-300))
    alive = np.all(levels[AVERAGE][3:] > 0.0, axis=0)
    sure = known & alive & (tilting < _GYRO_RATE) & (_SPREADS * spread < _GYRO_RATE)
    return known & (tilting > max(_GYRO_RATE, 2.0 * _SPREADS * spread)), sure


def _counts(candidates: Sequence[Candidate], mean: Floats, excess: Floats, rule: Rule
            ) -> tuple[Floats, Floats]:
    """Give (3, k) standard deviations and (k,) independent samples, rounding included."""
    std = np.array([each.dwell.std for each in candidates]).T
    samples = np.array([each.dwell.samples for each in candidates])
    resolution, left = rule.rounding(mean, std)
    std = np.maximum(std, resolution)
    variance = std**2 * excess / samples + left
    return std, np.asarray(np.sum(std**2, axis=0) / np.sum(variance, axis=0))
