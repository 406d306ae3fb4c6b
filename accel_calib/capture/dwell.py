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

from .noise import Trend
from .rule import DWELL_SLOPE_G, Rule, STRENGTH, WEAK_STRENGTH
from ..table import Floats

DWELL_RATIO = 3.2
"""Mean variance of the windows of a dwell over the noise, at most."""

DWELL_RATE_RATIO = 1600.0
"""The same for the rate: what the accelerometer does not feel does no harm."""

_OWN_EXCESS = 1.5   # an estimate of one dwell is that uncertain
_NO_RATE = np.full(3, np.nan)
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


@dataclass(frozen=True)
class Candidate:
    """
    A dwell with what it is judged by.

    Parameters
    ----------
    dwell : Dwell
        The dwell.
    variance : (6,) array
        Lower end of the mean variance of its windows, of reading and rate.
    average : (6,) array
        The mean variance itself.
    slope : Trend
        Slope of the reading through the dwell.
    excess : float
        Variance of the mean over that of independent samples, estimated from this dwell.
    beside_slope : bool
        True if the reading sloped just before or after.

    """

    dwell: Dwell
    variance: Floats
    average: Floats
    slope: Trend
    excess: float
    beside_slope: bool

    def quiet(self, rule: Rule) -> bool:
        """Tell whether it is still by the noise that is known now."""
        rate = self.dwell.context.get('rate', np.zeros(3))
        noise = rule.noise_of(np.concatenate([self.dwell.mean, np.atleast_1d(rate)]))
        limit = rule.limit_of(noise, DWELL_RATIO, DWELL_RATE_RATIO)
        strength = WEAK_STRENGTH if self.beside_slope else STRENGTH
        moved = rule.moved(self.slope, np.asarray(rule.scale), self.average[:3], strength,
                           DWELL_SLOPE_G)
        return not bool(moved) and not bool(np.any(self.variance > limit))


def judged(candidates: Sequence[Candidate], rule: Rule) -> list[Dwell | None]:
    """Give each dwell if it is still by what is known now, its count by all of them."""
    quiet = [each.quiet(rule) for each in candidates]
    excess = [each.excess for each, good in zip(candidates, quiet) if good]
    common = float(np.median(excess)) if excess else 1.0
    told = _by_gyro(candidates, np.array(quiet, dtype=bool), rule)
    found: list[Dwell | None] = []
    for each, good, turned in zip(candidates, quiet, told):
        own = max(1.0, common, each.excess / _OWN_EXCESS)
        rests = not turned if turned is not None else rule.rests(each.slope, own)
        found.append(_counted(each, own, rule) if good and rests else None)
    return found


def _by_gyro(candidates: Sequence[Candidate], quiet: NDArray[np.bool_], rule: Rule
             ) -> list[bool | None]:
    """
    Tell by the gyro which dwells were turned; None where it cannot tell.

    Its bias is the median over the dwells, and a rate about the vertical turns no pose.

    """
    rates = np.array([each.dwell.context.get('rate', _NO_RATE) for each in candidates])
    rates = rates.reshape(-1, 3)
    known = quiet & np.isfinite(rates).all(axis=1)
    if not rule.si_rates or known.sum() < _BIAS_DWELLS:
        return [None] * len(candidates)
    off = rates - np.median(rates[known], axis=0)
    spread = _MAD * float(np.max(np.median(np.abs(off[known]), axis=0)))
    up = np.array([each.dwell.mean / np.linalg.norm(each.dwell.mean) for each in candidates])
    tilting = np.linalg.norm(np.cross(off, up), axis=1)
    alive = np.array([bool(np.all(each.average[3:] > 0.0)) for each in candidates])
    sure = known & alive & (tilting < _GYRO_RATE) & (_SPREADS * spread < _GYRO_RATE)
    turned = known & (tilting > max(_GYRO_RATE, 2.0 * _SPREADS * spread))
    return [True if bad else False if good else None for bad, good in zip(turned, sure)]


def _counted(candidate: Candidate, excess: float, rule: Rule) -> Dwell:
    dwell = candidate.dwell
    resolution, rounding = rule.rounding(dwell.mean, dwell.std)
    std = np.maximum(dwell.std, resolution)
    variance = std**2 * excess / dwell.samples + rounding
    return replace(dwell, std=std, count=float(np.sum(std**2) / np.sum(variance)))
