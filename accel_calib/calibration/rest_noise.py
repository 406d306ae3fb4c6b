# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Bias of the gyro and white noise of the samples, from the rests.

**Bias.** The mean rate of a rest is the bias of the gyro, plus noise. Its variance has two parts:

    v_i  the white noise of the samples, ``rate_std``² / ``count``; 0 if the table lacks them
    τ²   the scatter from rest to rest: slow drift of the bias, dependence on the orientation, the
         rotation of the Earth (0.004 °/s)

The bias is the mean with the weights 1 / (v_i + τ²). τ² is the value at which the weighted squares
of the residuals have their expected sum (Paule and Mandel [1]_). For k rests, τ is only as certain
as k - 1 squares make it. Its part of the variance is therefore multiplied by the square of the
ratio of the Student to the normal quantile. Successive rests can have similar errors, if the bias
drifts. With the correlation ρ between neighbours, the variance is multiplied by (1 + ρ) / (1 - ρ),
as for slopes in `accel_calib.stillness.trend`.

**Turning rests.** A sensor that turns steadily about the vertical has a constant reading. A rest
is therefore left out if its rate on any axis is further from the others than noise and scatter
explain. For this, the centre is the median, and τ is the median absolute deviation, with the
factors of Croux and Rousseeuw for few values [2]_, which a few such rests do not affect.

**Temperature.** With a temperature for each rest, a line is fitted, too. An axis has a slope if
the line shows it with p < 0.001. A bias that drifts while the temperature rises looks the same.
Rests are then left out by their distance from a robust line: its slope is the median of the slopes
of all pairs, weighted by their difference of temperature [3]_.

**Noise.** The noise of a sample is the median over the rests, by axis, so that disturbed rests do
not affect it. For the rate, `accel_calib.stillness` measures it in windows of 0.5 s, without slow
drift. For the reading it is ``std``, over the whole rest, because all pose tables have it. On real
recordings with rests of some seconds, both agree within 4 %.

References
----------
.. [1] R. C. Paule, J. Mandel, Consensus values and weighting factors, J. Res. NBS 87 (1982) 377.
.. [2] C. Croux, P. J. Rousseeuw, Time-efficient algorithms for two highly robust estimators of
   scale, COMPSTAT 1992, section 2: the factors of MAD.
.. [3] G. L. Sievers, Weighted rank statistics for simple linear regression, JASA 73 (1978) 628.

"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
import scipy

from ..statistics import NORMAL_95, SIGMA_OF_MAD
from ..stillness import Dwell
from ..table import Floats, Poses, range_of, Record

LARGEST_BIAS = 1.0
"""Largest bias of a gyro [rad/s]; a larger rate is in another unit, or is no rest."""

LEAST_RESTS = 2
"""Fewest rests that show how much the bias differs from rest to rest."""

_LARGEST_AT_REST = 0.1
"""Largest bias of a gyro from one rest [rad/s]; MEMS gyros have up to 5 °/s."""

_LARGEST_SD = 0.05
"""Largest standard deviation of a useful bias [rad/s]; it is larger if the sensor was turned."""

_ENOUGH = 8                # fewest rests for a slope over temperature, and for a correlation
_TAIL = 5e-4               # probability, on each side, of a rest left out or a slope by chance
_CONFIDENCE = 0.975        # quantile at which the uncertainty of τ is included
_CORRELATION_MAX = 0.9
_PAIRED = 200              # rests used for the slopes of pairs
_TINY = 1e-30              # variance added to rests without noise [(rad/s)²]
_MAD_FEW = (1.0, 1.0, 1.196, 1.495, 1.363, 1.206, 1.200, 1.140, 1.129, 1.107)
"""Factors on the median absolute deviation of 0 to 9 values."""


@dataclass(frozen=True, eq=False)
class GyroBias(Record):
    """
    Mean angular rate of a gyro at rest.

    Parameters
    ----------
    bias : (3,) array
        The rate to subtract, in the axes of the sensor [rad/s].
    sd : (3,) array
        Standard deviation of the bias [rad/s].
    rests : int
        Number of rests used.
    temperature : float
        Temperature at which `bias` holds [°C]; NaN if it is not known.
    slope : (3,) array
        Change of the bias with the temperature [rad/s/°C]; 0 unless the rests show it.
    temperatures : tuple of float
        Lowest and highest temperature of the rests [°C]; empty if they are not known.

    """

    bias: Floats
    sd: Floats
    rests: int
    temperature: float
    slope: Floats
    temperatures: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, bound in (('bias', LARGEST_BIAS), ('sd', math.inf), ('slope', math.inf)):
            values = getattr(self, name)
            if np.shape(values) != (3,) or not np.all(np.abs(values) < bound):
                raise ValueError(f'the {name} of the gyro is {np.asarray(values).tolist()}, '
                                 f'expected three numbers below {bound:g} in magnitude')
        if np.any(self.sd < 0.0):
            raise ValueError(f'the sd of the gyro bias is {self.sd.tolist()}, expected 0 or more')
        if self.rests < 1:
            raise ValueError(f'the gyro bias has {self.rests} rests, expected at least 1')
        known = tuple(self.temperatures)
        if not known and math.isnan(self.temperature) and not np.any(self.slope):
            return
        if len(known) != 2 or not -math.inf < known[0] <= self.temperature <= known[1] < math.inf:
            raise ValueError(f'the gyro bias holds at {self.temperature} °C, and its rests have '
                             f'temperatures {list(known)}, expected a temperature between the '
                             'lowest and the highest, or none and no slope')

    def at(self, temperature: float) -> Floats:
        """
        Return the (3,) bias at a temperature [°C], which is limited to that of the rests.

        It is `bias` if the temperature is NaN, or the rests have no temperatures.

        """
        if not self.temperatures or math.isnan(temperature):
            return self.bias
        held = min(max(temperature, self.temperatures[0]), self.temperatures[1])
        return self.bias + self.slope * (held - self.temperature)


@dataclass(frozen=True, eq=False)
class SampleNoise(Record):
    """
    White noise of one sample at rest.

    Parameters
    ----------
    force : (3,) array
        Standard deviation of the reading by axis, in the unit of the readings; NaN if not known.
    rate : (3,) array
        Standard deviation of the angular rate by axis [rad/s]; NaN if not known.

    """

    force: Floats
    rate: Floats

    def __post_init__(self) -> None:
        for name in ('force', 'rate'):
            values = getattr(self, name)
            if np.shape(values) != (3,) or np.any(values < 0.0) or np.any(np.isinf(values)):
                raise ValueError(f'the noise of the {name} is {np.asarray(values).tolist()}, '
                                 'expected three numbers of 0 or more')


def sample_noise_of(poses: Poses) -> SampleNoise | None:
    """Return the noise of one sample, NaN on an axis that never changes; None if not stated."""
    found = [np.median(poses[key], axis=0) if key in poses and len(poses) else np.zeros(3)
             for key in ('std', 'rate_std')]
    force, rate = (np.where(each > 0.0, each, np.nan) for each in found)
    if 'rate' in poses and len(poses) and not np.all(
            np.abs(np.median(poses['rate'], axis=0)) < LARGEST_BIAS):
        rate = np.full(3, np.nan)
    if np.isnan(force).all() and np.isnan(rate).all():
        return None
    return SampleNoise(force, rate)


def gyro_bias_of(poses: Poses) -> GyroBias | None:
    """
    Return the bias of the gyro, from the rates of the rests that did not turn.

    It is None with fewer than `LEAST_RESTS` rests, if the rates are missing, all 0 or not in
    rad/s, or if they differ so much that the poses are not rests.

    """
    if 'rate' not in poses or len(poses) < LEAST_RESTS:
        return None
    middle = np.median(poses['rate'], axis=0)
    if not np.any(poses['rate']) or not np.all(np.abs(middle) < LARGEST_BIAS):
        return None
    if 'time' in poses:
        poses = poses.take(np.argsort(poses['time'], kind='stable'))
    noise = np.full(poses['rate'].shape, _TINY)  # variances of the mean rates, by the samples
    if 'rate_std' in poses and 'count' in poses:
        noise = poses['rate_std'] ** 2 / poses['count'][:, np.newaxis] + _TINY
    agree = _find_agreeing(poses, noise)
    rests, noise = poses.take(agree), noise[agree]
    level = line = np.ones((len(rests), 1))
    warm = rests.columns.get('temperature', np.zeros(len(rests)))
    if len(rests) >= _ENOUGH and np.ptp(warm) > 0.0:
        line = np.column_stack([level, warm - warm.mean()])
    (_, slope), (_, slope_sd) = _fit_axes([line] * 3, rests['rate'], noise)
    limit = float(scipy.special.stdtrit(len(rests) - 2, 1.0 - _TAIL))
    sloping = np.abs(slope) > limit * slope_sd
    (bias, slope), (sd, _) = _fit_axes([line if each else level for each in sloping],
                                       rests['rate'], noise)
    if np.any(np.abs(bias) >= LARGEST_BIAS) or np.any(sd >= _LARGEST_SD):
        return None
    if 'temperature' not in rests:
        return GyroBias(bias, sd, len(rests), math.nan, slope, temperatures=())
    limits = range_of(rests, 'temperature')
    mean = float(np.clip(rests['temperature'].mean(), *limits))
    return GyroBias(bias, sd, len(rests), mean, slope, temperatures=limits)


def gyro_bias_of_rest(rest: Dwell) -> GyroBias | None:
    """Return the bias of the gyro from one rest; None if its rate is all 0 or not plausible."""
    rate = rest.context.get('rate', 0.0)
    if not np.any(rate) or not np.all(np.isfinite(rest.rate_std)) or np.any(
            np.abs(rate) > _LARGEST_AT_REST):
        return None
    temperature = float(np.asarray(rest.context.get('temperature', math.nan)))
    known = () if math.isnan(temperature) else (temperature, temperature)
    return GyroBias(np.asarray(rate, float), rest.rate_std / math.sqrt(rest.count), rests=1,
                    temperature=temperature, slope=np.zeros(3), temperatures=known)


def _find_agreeing(rests: Poses, noise: Floats) -> NDArray[np.bool_]:
    """Return which rests have the rate that noise and scatter explain."""
    count, left = len(rests), rests['rate']
    with_slope = 'temperature' in rests and count >= _ENOUGH
    if with_slope:  # that of a robust line
        temperature = rests['temperature']
        rows = np.unique(np.linspace(0, count - 1, min(count, _PAIRED)).astype(np.intp))
        one, other = (rows[each] for each in np.triu_indices(len(rows), 1))
        apart = temperature[other] - temperature[one]
        one, other, apart = (each[apart != 0.0] for each in (one, other, apart))
        if len(apart):
            slopes = (left[other] - left[one]) / apart[:, np.newaxis]
            order = np.argsort(slopes, axis=0)
            weight = np.cumsum(np.abs(apart)[order], axis=0)
            middle = np.argmax(weight >= 0.5 * weight[-1], axis=0)
            slope = slopes[order[middle, np.arange(3)], np.arange(3)]
            left = left - temperature[:, np.newaxis] * slope
    left = np.abs(left - np.median(left, axis=0))
    factor = _MAD_FEW[count] if count < len(_MAD_FEW) else count / (count - 0.8)
    spread = SIGMA_OF_MAD * factor * np.median(left, axis=0)
    scatter = np.maximum(spread ** 2 - np.median(noise, axis=0), 0.0)
    limit = float(scipy.special.stdtrit(count - 1 - with_slope, 1.0 - _TAIL))
    return np.asarray(np.all(left ** 2 <= limit ** 2 * (noise + scatter), axis=1))


def _fit_axes(designs: Sequence[Floats], rates: Floats, noises: Floats) -> tuple[Floats, Floats]:
    """
    Fit the (n, 3) rates with noise (variances) and scatter, each by its (n, 1 or 2) design.

    Return the (2, 3) bias and slope by axis, and their standard deviations, which include the
    correlation of successive rests.

    """
    values, variances, residual = [], [], []
    for design, rate, noise in zip(designs, rates.T, noises.T, strict=True):
        (count, size), scatter = design.shape, 0.0
        # At τ², the weighted squares have their expected sum; see the module. The steps are
        # Newton's for one over this sum, which is linear in τ² for rests of equal noise.
        for _ in range(50):
            variance = noise + scatter
            inverse = np.linalg.inv(design.T / variance @ design)
            found = inverse @ (design.T / variance @ rate)
            left = rate - design @ found
            squares = left ** 2 / variance
            total = np.sum(squares)
            step = float(total * (total / (count - size) - 1.0)
                         / max(np.sum(squares / variance), 1e-300))
            if step <= 1e-9 * scatter:  # rounding
                break
            scatter += step
        surplus = float(scipy.special.stdtrit(count - size, _CONFIDENCE)) / NORMAL_95
        share = (noise + surplus ** 2 * scatter) / variance ** 2
        covariance = inverse @ (design.T * share @ design) @ inverse
        values.append(np.pad(found, (0, 2 - size)))
        variances.append(np.pad(np.diag(covariance), (0, 2 - size)))
        residual.append(left / np.sqrt(variance))
    found, spread, left = map(np.column_stack, (values, variances, residual))
    count, square = len(left), float(np.sum(left ** 2))
    if count >= _ENOUGH and square > 0.0:
        # Without the mean, independent residuals have a correlation of -1/n.
        correlation = float(np.sum(left[1:] * left[:-1])) / square + 1.0 / count
        correlation = min(max(correlation, 0.0), _CORRELATION_MAX)
        spread = spread * ((1.0 + correlation) / (1.0 - correlation))
    return found, np.sqrt(spread)
