# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Noise components of one axis, fitted to its Allan variances, and records of the figures.

**Fit.** Generalised least squares with the covariance of `accel_calib.noise.curve`, which depends
on the components and is therefore updated until they are constant. Sizes below 0 are excluded.

**Range.** The components do not describe each sensor at each τ: a low-pass filter reduces the
variance at short τ, vibration adds a hump, and a change of temperature raises the variance at long
τ. If χ² is not plausible, octaves are dropped from the ends until it is.

**Seen or not.** A component is seen if leaving it out raises χ² by more than 9, and if it makes
a large part of the variance at some τ of the range, so that the curve has its slope there.
Otherwise only its upper limit is known. Quantisation and drift are in the final fit only if they
are seen; N, B and K always, because neighbours have similar slopes.

**Uncertainty.** The interval of the squared size is that of a χ² variable with edf = 2 size⁴ /
variance. In simulated rests, 95 % intervals hold the true value in 93 to 98 % of those with a
plain N, B or K. A figure that is just seen is more often too large than too small.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from .curve import Counts, shares, Spread
from ..units import Floats, is_native, rms, STANDARD_GRAVITY

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
        freedom = len(left) - int(np.sum(squares > 0.0))
        return _Solution(squares, _covariance(free, shape), float(left @ left),
                         float(scipy.special.chdtrc(max(freedom, 1), left @ left)))

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


Kind = Literal['accelerometer', 'gyroscope']
KINDS: tuple[Kind, ...] = ('accelerometer', 'gyroscope')

FIGURES = COMPONENTS[1:4]
"""Figures that are reported by axis, in the order of τ."""

WORDS = {'quantisation': 'quantisation noise', 'noise_density': 'white noise',
         'bias_instability': 'bias instability', 'random_walk': 'random walk'}

_MICRO_G = 1e6 / STANDARD_GRAVITY

_MILLI_DEGREES = float(np.degrees(1e3))

_ONE_SIDED = 2.0 ** 0.5
"""Data sheets state the density for positive frequencies alone, which is √2 N."""

TYPICAL: Mapping[tuple[str, str, str], tuple[float, float]] = {
    ('accelerometer', 'noise_density', 'm/s²'): (
        70.0 / _MICRO_G / _ONE_SIDED, 400.0 / _MICRO_G / _ONE_SIDED),
    ('gyroscope', 'noise_density', 'rad/s'): (
        2.8 / _MILLI_DEGREES / _ONE_SIDED, 5.0 / _MILLI_DEGREES / _ONE_SIDED)}
"""
N of a quiet and of a noisy common part, by sensor, figure and unit.

From the data sheets of ICM-42688-P (TDK DS-000347, tables 1 and 2) and MPU-6050 (InvenSense
PS-MPU-6000A-00, revision 3.4, sections 6.1 and 6.2). They do not state the other figures.

"""

_SHOWN = {
    ('accelerometer', 'noise_density'): ('µg/√Hz', _MICRO_G),
    ('accelerometer', 'bias_instability'): ('µg', _MICRO_G),
    ('accelerometer', 'random_walk'): ('µg/s/√Hz', _MICRO_G),
    ('gyroscope', 'noise_density'): ('m°/s/√Hz', _MILLI_DEGREES),
    ('gyroscope', 'bias_instability'): ('°/h', float(np.degrees(3600.0))),
    ('gyroscope', 'random_walk'): ('m°/s²/√Hz', _MILLI_DEGREES),
}

_NATIVE = {'noise_density': 'native/√Hz', 'bias_instability': 'native',
           'random_walk': 'native/s/√Hz'}


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


def shown_unit(kind: str, figure: str, unit: str) -> tuple[str, float]:
    """Return the unit of a figure for people, and the factor from the unit of the figure."""
    if is_native(unit):
        return _NATIVE[figure], 1.0
    return _SHOWN[kind, figure]
