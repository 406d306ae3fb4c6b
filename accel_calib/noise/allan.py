# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The Allan deviation of one axis, the covariance of its estimates, and the noise components in it.

**Deviation.** For the averaging time τ = m τ0, the Allan variance is half the mean square of the
difference between successive averages of m samples. The overlapping estimate uses each start
(IEEE Std 952-1997, annex C [1]_; NIST SP 1065 [2]_, eq. 11). With x the integral of the samples,
the difference is the second difference of x::

    d(k) = (x(k + 2m) - 2 x(k + m) + x(k)) / (m √2),    variance = mean of d(k)²

**Components.** A sum of independent components is fitted to the variance:

| component | variance at τ | slope of the deviation | c(t) |
|---|---|---|---|
| quantisation Q | 3 Q²/τ² | -1 | Q² at t = 0 |
| white noise N | N²/τ | -1/2 | -N² abs(t)/2 |
| bias instability B | B² 2 ln2/π | 0 | B² t² ln(abs(t))/(2π) |
| random walk K | K² τ/3 | +1/2 | K² abs(t)³/12 |
| drift R | R² τ²/2 | +1 | none: it is not random |

√(2 ln2/π) = 0.664 is the factor between the flat part of the curve and B.

**Covariance.** c(t) is the generalised covariance of x: second differences do not depend on the
polynomials that it leaves open. It gives the covariance γ of any two differences d in closed form,
for different m, too. For Gaussian noise, the covariance of two estimates is::

    cov = 2 / (n_i n_j) · sum over all pairs of γ²

This includes the overlap, the few averages at long τ, and mixed components. For one component it
agrees with the equivalent degrees of freedom, edf = 2 variance² / cov, of Greenhall and Riley
[3]_. A drift adds its product with the mean of d, whose covariance is a sum of γ.
The sum over the lags uses points that are dense near the kinks of γ.

The deviation is that of allantools. It has no covariance between two τ, which the fit needs: in
300 simulated rests with a plain B or K, 95 % intervals from the variances alone hold the true N, B
and K in 84 to 90 %, and those with the covariance in 95 to 99 %. Its intervals for the deviations
agree with ours in width (within 5 %) and in coverage, but it has none for the last two or three
octaves, since it must identify the noise first, and that needs 30 averages.

**Fit.** Generalised least squares with the covariance, which depends on the
components and is therefore updated until they are constant. Sizes below 0 are excluded.

**Range.** The components do not describe each sensor at each τ: a low-pass filter reduces the
variance at short τ, vibration adds a hump, and a change of temperature raises the variance at long
τ. If χ² is not plausible, octaves are dropped from the ends until it is.

**Seen or not.** A component is seen if leaving it out raises χ² by more than 9, and if it makes
a large part of the variance at some τ of the range, so that the curve has its slope there.
Otherwise only its upper limit is known. Quantisation and drift are in the final fit only if they
are seen; N, B and K always, because neighbours have similar slopes.

**Uncertainty.** The interval of the squared size is that of a χ² variable with edf = 2 size⁴ /
variance. If the components do not describe the curve, such as beside a vibration, variance is
multiplied by χ² per degree of freedom [4]_. In simulated rests, 95 % intervals hold the true value
in 93 to 98 % of those with a plain N, B or K. A figure that is just seen is more often too large
than too small.

References
----------
.. [1] IEEE Std 952-1997, annex C; IEEE Std 1293-2018, annex on noise of accelerometers.
.. [2] W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065, 2008.
.. [3] C. A. Greenhall, W. J. Riley, Uncertainty of stability variances based on finite
   differences, PTTI 2003.
.. [4] R. T. Birge, The calculation of errors by the method of least squares, Phys. Rev. 40 (1932)
   207.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

import numpy as np
from numpy.typing import NDArray
import scipy

from ..errors import needing
from ..statistics import rms
from ..units import Floats

FLAT = 2.0 * np.log(2.0) / np.pi
"""Allan variance of flicker noise in units of B²."""

LEAST_AVERAGES = 4
"""Smallest number of averages of length τ in the record, at the longest τ."""

_GROWTH = 1.15
"""Ratio of successive distances of the lags from a kink."""

_RANDOM = 4
"""Number of components that are random."""

_SECOND = np.array([1.0, -2.0, 1.0])
_FLICKER = np.array([[0.0], [0.0], [1.0], [0.0]])
_FAR = 16
"""Lag in units of m_i + m_j from which γ of flicker noise is its fourth derivative."""

COMPONENTS = ('quantisation', 'noise_density', 'bias_instability', 'random_walk', 'drift')

_LEAST_SHARE = (0.5, 0.5, 0.3, 0.5, 0.5)
"""Smallest part of the variance at some τ. Flicker noise lies between two others."""

_RISE = (9.0, 9.0, 9.0, 16.0, 9.0)
"""
Rise of χ² without a component that is seen: 3 standard deviations, and 4 for the random walk,
because the few averages at long τ have a skewed distribution.

"""

_EVERY = [0, 1, 2, 3, 4]
_MARGIN = (2, 1)
"""Further octaves that are dropped at the start and at the end, if one had to be."""

LEAST_P = 5e-3
"""Smallest probability of χ² for a range of τ, otherwise shorter ranges are tried."""

_LONG_RANGE = 7
"""Smallest number of octaves in a range that shows more than white noise."""

_PER_OCTAVE = 6.0
"""Decrease of χ² that is worth one octave: chance alone must not shorten the range."""

_LEAST_RANGE = 5
"""Smallest number of octaves in a range."""

_ROUNDS = 12
LEVEL = 0.95
"""Probability of intervals; upper limits are one-sided."""

Kind = Literal['accelerometer', 'gyroscope']
KINDS: tuple[Kind, ...] = ('accelerometer', 'gyroscope')

FIGURES = COMPONENTS[1:4]
"""Figures that are reported by axis, in the order of τ."""

Counts = NDArray[np.int64]


def octaves(samples: int) -> Counts:
    """Return the numbers of samples per average: powers of 2."""
    most = samples // LEAST_AVERAGES
    return 2 ** np.arange(most.bit_length(), dtype=np.int64)


def shares(lengths: Counts) -> Floats:
    """Return the (k, 5) variance of each component of size 1 at each length, for τ0 = 1."""
    m = lengths.astype(float)
    return np.column_stack([3.0 / m**2, 1.0 / m, np.full(len(m), FLAT), m / 3.0, 0.5 * m**2])


def allan_variances(values: Floats, lengths: Counts) -> Floats:
    """Return the overlapping Allan variances of (n,) samples at (k,) lengths of at most n/2."""
    found = import_module('allantools').oadev(values - np.mean(values), rate=1.0,
                                              data_type='freq', taus=lengths.astype(float))
    return np.asarray(found[1], dtype=float) ** 2


def check_allantools() -> None:
    """Raise InputError if allantools is not installed."""
    with needing('allantools', 'the Allan deviation'):
        import allantools  # noqa: F401


@dataclass(frozen=True)
class Spread:
    """
    Covariances of the estimates at all k lengths, for any sizes of the components.

    For the p `pairs` of lengths i <= j, `gamma` (p, 4, g) is the covariance of the differences at
    each lag, for each component of size 1, and `weight` (p, g) is the weight of the square at each
    lag. `of_mean` (4, k, k) is the covariance of the mean differences times m_i m_j, for each
    component of size 1.

    """

    pairs: tuple[NDArray[np.intp], NDArray[np.intp]]
    gamma: Floats
    weight: Floats
    of_mean: Floats

    def covariance(self, sizes: Floats) -> Floats:
        """Return the (k, k) covariance of the variances for (5,) squared components, τ0 = 1."""
        used = np.flatnonzero(sizes[:_RANDOM])
        gamma = np.einsum('c,pcg->pg', sizes[used], self.gamma[:, used])
        matrix = np.zeros(self.of_mean.shape[1:])
        matrix[self.pairs] = matrix.T[self.pairs] = np.einsum('pg,pg->p', self.weight, gamma**2)
        if sizes[_RANDOM] > 0.0:
            # Without the negative eigenvalues of rounded sums.
            values, vectors = np.linalg.eigh(np.einsum('c,cij->ij', sizes[:_RANDOM], self.of_mean))
            matrix += 2.0 * sizes[_RANDOM] * (vectors * np.maximum(values, 0.0) @ vectors.T)
        return matrix


def spread_of(lengths: Counts, samples: int) -> Spread:
    """Return the covariances for these lengths and this number of samples."""
    first, second = np.triu_indices(len(lengths))
    lags = []  # between the centres of two differences, dense near each kink of γ
    for one, two in zip(lengths[first], lengths[second], strict=True):
        last = samples + 1 - one - two
        growth = np.arange(1.0, np.log(max(last, 2)) / np.log(_GROWTH) + 1.0)
        distance = np.concatenate([np.arange(9), np.round(_GROWTH**growth).astype(np.int64)])
        kinks = np.array([0, one, two, two - one, two + one])
        around = kinks[:, np.newaxis] + np.concatenate([-distance, distance])
        lags.append(np.unique(np.append(around[(around >= 0) & (around <= last)], [0, last])))
    most = max(map(len, lags))
    gamma, weight = np.zeros((len(lags), 4, most)), np.zeros((len(lags), most))
    for p, (i, j, lag) in enumerate(zip(first, second, lags, strict=True)):
        gamma[p, :, :len(lag)] = _between(lag, lengths[i], lengths[j])
        # The weight of γ² is 2/(n_i n_j) times the number of pairs.
        counts = [float(samples + 1 - 2 * lengths[k]) for k in (i, j)]
        pairs = np.minimum(min(counts), samples + 1.0 - lengths[i] - lengths[j] - lag)
        width = np.convolve(np.diff(lag), [0.5, 0.5])  # of the trapezoidal rule
        weight[p, :len(lag)] = 4.0 / (counts[0] * counts[1]) * width * np.maximum(pairs, 0.0)
    of_mean = np.zeros((_RANDOM, len(lengths), len(lengths)))
    of_mean[:, first, second] = 0.5 * np.einsum('pg,pcg->cp', weight, gamma) * (
        lengths[first] * lengths[second])
    of_mean[:, second, first] = of_mean[:, first, second]
    return Spread((first, second), gamma, weight, of_mean)


def _between(lag: Counts, one: int, two: int) -> Floats:
    """Return the (4, g) covariance of two differences for components of size 1."""
    total = np.zeros((4, len(lag)))
    for a, weight_a in zip((-1, 0, 1), _SECOND, strict=True):
        for b, weight_b in zip((-1, 0, 1), _SECOND, strict=True):
            # c(t), the generalised covariance of the integral.
            t = np.abs(lag + a * one - b * two).astype(float)
            log = np.log(np.maximum(t, 1.0))
            total += weight_a * weight_b * np.array([
                (t == 0.0).astype(float), -0.5 * t, t**2 * log / (2.0 * np.pi), t**3 / 12.0])
    # Rounding would exceed the small differences at long lags: all but flicker noise is 0 there.
    total[:, lag > one + two] *= _FLICKER
    far = lag > _FAR * (one + two)
    total[2, far] = -(float(one) * float(two) / lag[far])**2 / np.pi
    return total / (2.0 * float(one) * float(two))


@dataclass(frozen=True)
class Component:
    """
    One component of the noise of one axis, in the unit of the figure.

    `value`, `sd` and the 95 % `interval` are NaN if it is not seen. `upper` is then its upper
    limit, otherwise the end of the interval.

    """

    value: float
    sd: float
    interval: tuple[float, float]
    upper: float

    @property
    def seen(self) -> bool:
        """Whether the curve shows this component."""
        return bool(np.isfinite(self.value))

    def times(self, scale: float) -> Component:
        """Return the component in another unit."""
        low, high = self.interval
        return Component(self.value * scale, self.sd * scale, (low * scale, high * scale),
                         self.upper * scale)


@dataclass(frozen=True)
class Fitted:
    """
    Components of one axis, in the order of `COMPONENTS` and for τ0 = 1.

    `squares` (5,) are the squared sizes of those that are seen. `first` and `last` are the octaves
    at the ends of the range, inclusive, and `p_value` is the probability of χ² in it.

    """

    squares: Floats
    components: tuple[Component, ...]
    first: int
    last: int
    p_value: float


@dataclass(frozen=True)
class _Solution:
    """Squared sizes, their covariance (0 where the size is 0), χ², and the probability of it."""

    squares: Floats
    covariance: Floats
    chi_square: float
    p_value: float


def fit_components(variances: Floats, lengths: Counts, spread: Spread) -> Fitted:
    """Fit the components to (k,) overlapping Allan variances > 0 at these (k,) lengths."""
    shape = shares(lengths)
    first, last = _find_range(variances, shape, spread)
    which = slice(first, last + 1)
    curve = _RangeFit(variances[which], shape[which], spread, which)
    free = [c for c in _EVERY if COMPONENTS[c] in FIGURES or curve.rise(_EVERY, c) > _RISE[c]]
    rises = np.array([curve.rise(free, c) if c in free else 0.0 for c in _EVERY])
    found = curve.solve(free)
    parts = curve.shape * found.squares
    large = np.max(parts / parts.sum(axis=1, keepdims=True), axis=0) >= _LEAST_SHARE
    seen = (found.squares > 0.0) & large & (rises > _RISE)
    if last - first + 1 < _LONG_RANGE:
        seen[2:] = False
    return Fitted(curve.noisy(found.squares),
                  tuple(curve.component(found, c, bool(seen[c])) for c in _EVERY),
                  first, last, found.p_value)


@dataclass(frozen=True)
class _RangeFit:
    """The variances of one axis in a range of τ, to which components are fitted."""

    variances: Floats
    shape: Floats
    spread: Spread
    which: slice

    def _whitened(self, squares: Floats) -> tuple[Floats, Floats]:
        """Return shape and variances, transformed so that the errors are independent."""
        covariance = self.spread.covariance(self.noisy(squares))[self.which, self.which]
        # The matrix is small: its inverse is faster than solve_triangular, which starts threads.
        whitening = np.linalg.inv(np.linalg.cholesky(covariance))
        return whitening @ self.shape, whitening @ self.variances

    def noisy(self, squares: Floats) -> Floats:
        """Return the squares with some white noise: without noise there is no covariance."""
        least = 1e-6 * float(np.min(self.variances / self.shape[:, 1]))
        return np.where(np.arange(len(squares)) == 1, np.maximum(squares, least), squares)

    def solve(self, free: list[int]) -> _Solution:
        """Return the fit of the free components."""
        squares: Floats = np.zeros(len(COMPONENTS))
        given = self.shape[:, free] / self.variances[:, np.newaxis]
        squares[free] = scipy.optimize.nnls(given, np.ones(len(given)))[0]
        for _ in range(_ROUNDS):
            before, squares = squares, np.zeros(len(COMPONENTS))
            shape, variances = self._whitened(before)
            squares[free] = scipy.optimize.nnls(shape[:, free], variances)[0]
            if np.all(np.abs(squares - before) <= 1e-3 * before):
                break
        shape, variances = self._whitened(squares)
        left = variances - shape @ squares
        freedom, chi_square = max(len(left) - int(np.sum(squares > 0.0)), 1), float(left @ left)
        chance = float(scipy.special.chdtrc(freedom, chi_square))
        beyond = chi_square / freedom if chance < LEAST_P else 1.0  # of another form [4]_
        return _Solution(squares, beyond * _covariance(free, shape), chi_square, chance)

    def rise(self, kept: list[int], without: int) -> float:
        """Return the rise of χ² without a component, with the covariance of the fit without."""
        rest = self.solve([c for c in kept if c != without])
        shape, variances = self._whitened(rest.squares)
        return rest.chi_square - float(scipy.optimize.nnls(shape[:, kept], variances)[1])**2

    def component(self, found: _Solution, which: int, seen: bool) -> Component:
        """Return one component, or its upper limit."""
        if not seen:  # the size whose estimate is this small with a probability of 5 %
            free = sorted({which, *np.flatnonzero(found.squares)})
            estimate = self.solve(free)
            trial = estimate.squares.copy()
            trial[which] = max(trial[which], 1e-3 * float(np.min(
                self.variances / self.shape[:, which])))
            for _ in range(_ROUNDS):
                variance = _covariance(free, self._whitened(trial)[0])[which, which]
                trial[which] = estimate.squares[which] + 1.645 * np.sqrt(variance)
            return Component(np.nan, np.nan, (np.nan, np.nan), float(np.sqrt(trial[which])))
        square, variance = found.squares[which], found.covariance[which, which]
        value, freedom = float(np.sqrt(square)), 2.0 * square**2 / variance
        ends = np.sqrt(square * freedom / scipy.stats.chi2.ppf(
            [0.5 + 0.5 * LEVEL, 0.5 - 0.5 * LEVEL], freedom))
        return Component(value, float(np.sqrt(variance)) / (2.0 * value),
                         (float(ends[0]), float(ends[1])), float(ends[1]))


def _covariance(free: list[int], shape: Floats) -> Floats:
    """Return the (5, 5) covariance of the squares, including free ones that are 0."""
    covariance = np.zeros((len(COMPONENTS), len(COMPONENTS)))
    covariance[np.ix_(free, free)] = np.linalg.inv(shape[:, free].T @ shape[:, free])
    return covariance


def _find_range(variances: Floats, shape: Floats, spread: Spread) -> tuple[int, int]:
    """Return the first and last octave of the range over which the components are plausible."""
    tried, visited = [(0, len(variances) - 1)], []
    while True:
        solved = []
        for first, last in tried:
            which = slice(first, last + 1)
            found = _RangeFit(variances[which], shape[which], spread, which).solve(_EVERY)
            solved.append((found.chi_square, found.p_value, first, last))
        chi_square, chance, first, last = min(solved)
        dropped = len(variances) - 1 - (last - first)
        visited.append((chi_square + _PER_OCTAVE * dropped, first, last))
        if chance >= LEAST_P or last - first < _LEAST_RANGE:
            break
        tried = [(first + 1, last), (first, last - 1)]
    _, first, last = min(visited)
    # A filter or a drift fades over some octaves beyond those where it is plain.
    if last < len(variances) - 1:
        last = max(last - _MARGIN[1], first + _LEAST_RANGE - 1)
    if first > 0:
        first = min(first + _MARGIN[0], last - _LEAST_RANGE + 1)
    return first, last


@dataclass(frozen=True)
class AxisNoise:
    """
    The Allan deviation of one axis, and its components.

    Parameters
    ----------
    kind : {'accelerometer', 'gyroscope'}
    axis : {'x', 'y', 'z'}
    unit : {'m/s²', 'rad/s', 'native'}
        Unit of the deviation.
    tau, deviation, low, high, model : (k,) array
        Averaging times [s], Allan deviation, its 95 % interval, and the deviation of the
        components that were found.
    slope, slope_sd : (k - 1,) array
        Slope of the logarithms between successive τ, and its standard deviation.
    figures : mapping of str to Component
        Keys of `COMPONENTS`; Q, N, B, K and drift in the unit times s, √s, 1, 1/√s and 1/s.
    used, p_value : (2,) tuple of float, float
        Range of τ that the figures are from [s], and the probability of the χ² of the fit.
    step : float
        Step of the output, if its noise is smaller; otherwise 0.

    """

    kind: Kind
    axis: str
    unit: str
    tau: Floats
    deviation: Floats
    low: Floats
    high: Floats
    model: Floats
    slope: Floats
    slope_sd: Floats
    figures: Mapping[str, Component]
    used: tuple[float, float]
    p_value: float
    step: float = 0.0


@dataclass(frozen=True)
class NoiseFigures:
    """
    The noise of a sensor at rest.

    `axes` are accelerometer x, y, z, then gyro x, y, z if the recording has rates, without those
    whose reading does not change. `start` and `seconds` are the first stamp and duration of the
    rest [s], and `rate` is in Hz. `temperature` is the lowest and highest one [°C], averaged over
    a hundredth of the rest. `notes` state what limits the figures. `needs` has, for each sensor
    and figure that is not seen on all axes, the reason and what to do.

    """

    axes: tuple[AxisNoise, ...]
    start: float
    seconds: float
    samples: int
    rate: float
    temperature: tuple[float, float] | None
    notes: tuple[str, ...]
    needs: Mapping[tuple[Kind, str], str]

    def of(self, kind: Kind) -> tuple[AxisNoise, ...]:
        """Return the axes of one sensor."""
        return tuple(axis for axis in self.axes if axis.kind == kind)

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Sensors that have an axis with noise."""
        return tuple(kind for kind in KINDS if self.of(kind))

    def common(self, kind: Kind, figure: str) -> tuple[float, float]:
        """Return the RMS of a figure over the axes that show it, and its sd; NaN without one."""
        found = [axis.figures[figure] for axis in self.of(kind) if axis.figures[figure].seen]
        if not found:
            return np.nan, np.nan
        values, sds = (np.array([getattr(each, name) for each in found])
                       for name in ('value', 'sd'))
        common = rms(values)
        return common, float(np.sqrt(np.sum((values * sds)**2))) / (len(found) * common)
