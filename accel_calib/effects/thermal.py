# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Lag and rate of the temperature, for poses and for streams of samples.

A temperature that acts on the sensor with a lag L differs from the recorded temperature T:

    the die lags:                 L dA/dt + A = T,   A = T at the start
    the temperature sensor lags:  A = T + L dT/dt

**Rate.** The temperature is modelled as a process whose third derivative is white noise. It is
recorded with an error of the size of a small step. A smoother over all poses (a quintic smoothing
spline, Wahba 1978) estimates the rate at the poses; a Kalman filter with the same model estimates
it from the past samples of a stream. The noise is chosen for periods of 400 s and more: the filter
follows them, and it averages the steps of the temperature sensor.

**Steps.** A thermometer of step q states a temperature that is wrong by up to q / 2. In a slow
change these errors are not random: what is computed from time fits better than the true cause. The
temperatures at the poses are therefore estimated. The temperature is a process whose second
derivative is white noise, recorded with errors of the variance q² / 12. Its posterior mean is a
cubic smoothing spline. With Q the second divided differences, and τ² R the covariance of the
process in them (Green and Silverman 1994, equations 2.1 and 2.2), the mean for the readings y is

    y - q² / 12 Q C⁻¹ Qᵀ y        C = q² / 12 QᵀQ + τ² R

with the covariance q² / 12 (I - q² / 12 Q C⁻¹ Qᵀ), which enters that of the fitted values. τ is
that with the largest restricted likelihood. A temperature that jumps from pose to pose thus
remains as it is. The step is measured: readings that occur more than once are multiples of it.

**Low pass.** The solution of the first equation is exact for the interpolated temperature: between
poses a cubic with the temperatures and the rates at its ends, between samples a straight line.
Times need not be sorted. A row without time or temperature is NaN, and the other rows ignore it.

"""

from array import array
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
import scipy

from ..table import Floats

_ERROR = 0.01
"""Standard deviation of a recorded temperature [°C]."""

_JERK = 3e-10
"""Spectral density of the third derivative of the temperature [°C²/s⁵]."""

_START_RATE = 0.05
_START_BEND = 5e-4
"""Standard deviation of the first and second derivative before the data [°C/s], [°C/s²]."""

_BIN = 1.0
"""Duration over which samples are averaged for the rate [s]. Over shorter steps, the smoother
loses the digits of a temperature that hardly changes."""

_RESTART = 1.0
"""If the time of a stream jumps back by more than this, the stream starts again [s]."""

_SHORTEST = 0.1
"""Shortest interval for the smoothers [s]; earlier rows count as simultaneous."""

_LEAST_MOMENTS = 5
"""Smallest number of moments at which temperatures in steps are estimated."""

_LEAST_LEVELS = 4
"""Smallest number of temperatures that occur more than once, by which steps are known."""

_COARSEST = 1.01
"""Largest step of a thermometer [°C]: larger ones may be exact temperatures that were set."""

_REPEATED = 0.5
"""Smallest part of temperatures in steps that occur more than once."""

_ON_STEP = 0.02
"""Largest distance of a temperature from a multiple of the step, in steps."""

_CHANGES = 10.0 ** np.arange(-10.0, 9.0, 0.5)
"""Values of τ² that are tried, for a median interval and relative to q² / 12."""


class Lag(NamedTuple):
    """Lag of a temperature: its size [s], and whether the temperature sensor lags."""

    seconds: float
    of_sensor: bool


def rate_at(context: Mapping[str, Any]) -> Any:
    """Return the rate of the temperature in a context [°C/s]; one row alone has the rate 0."""
    if 'temperature_rate' in context:
        return context['temperature_rate']
    if np.ndim(context['temperature']) == 0:
        return 0.0
    return rate_of(context['time'], context['temperature'])


def acting_temperature(context: Mapping[str, Any], key: str, lag: float, of_sensor: bool) -> Any:
    """
    Return the (n,) temperature that acts with a lag [°C], or the column `key` if present.

    The rows of ``time`` and ``temperature`` are the whole history; one row alone has no lag.

    """
    if key in context:
        return context[key]
    if np.ndim(context['temperature']) == 0:
        return context['temperature']
    if of_sensor:
        return context['temperature'] + lag * rate_at(context)
    return low_passed(context['time'], context['temperature'], lag, rate_at(context))


def rate_of(time: Floats, temperature: Floats) -> Floats:
    """Return the (n,) rate of the temperature at poses [°C/s]; NaN where an input is NaN."""
    known = np.isfinite(time) & np.isfinite(temperature)
    rate, (moments, place, mean) = np.full(len(time), np.nan), _at_moments(
        time[known], temperature[known])
    rate[known] = _smoothed_rate(moments, mean)[place] if len(moments) > 1 else 0.0
    return rate


def _at_moments(time: Floats, temperature: Floats) -> tuple[Floats, NDArray[np.intp], Floats]:
    """Return m increasing times, the place of each row among them, and the mean at each."""
    merged = np.round(time / _SHORTEST) * _SHORTEST  # almost equal times become equal
    moments, place = np.unique(merged, return_inverse=True)
    if len(moments) > 1 and np.median(np.diff(moments)) < _BIN:  # samples, averaged as in a stream
        place = np.unique(np.round(time / _BIN), return_inverse=True)[1]
        moments = np.bincount(place, time) / np.bincount(place)
    return moments, place, np.bincount(place, temperature) / np.bincount(place)


class _Steps(NamedTuple):
    """
    Temperatures in steps, with the symbols of the module.

    The step [°C], the `known` rows, the (m,) `variance` at the moments and the `place` of each
    known row among them; the rows of Qᵀ, the Cholesky factor of C in bands, and the (m,) mean.

    """

    step: float
    known: NDArray[np.bool_]
    place: NDArray[np.intp]
    variance: Floats
    rows: tuple[Floats, Floats, Floats]
    root: Floats
    mean: Floats


def between_steps(time: Floats, temperature: Floats) -> Floats:
    """Return (n,) temperatures at poses [°C]; those in steps are estimated within half a step."""
    found, estimated = _steps_of(time, temperature), temperature.copy()
    if found is None:
        return temperature
    values, half = temperature[found.known], found.step / 2.0
    estimated[found.known] = np.clip(found.mean[found.place], values - half, values + half)
    return estimated


def step_of(columns: Mapping[str, Any]) -> float:
    """Return the step of the temperatures of poses [°C]; 0 if they are not in steps."""
    found = _steps_of(columns['time'], columns['temperature']) if (
        {'time', 'temperature'} <= columns.keys()) else None
    return 0.0 if found is None else found.step


def covariance_of_steps(time: Floats, temperature: Floats, onto: Floats) -> Floats:
    """
    Return the (p, p) covariance that the errors of `between_steps` cause, 0 without steps.

    It is that of (p, n) sums of the errors. Errors of neighbouring poses are alike.

    """
    found = _steps_of(time, temperature)
    if found is None:
        return np.zeros((len(onto), len(onto)))
    summed = np.array([np.bincount(found.place, row, len(found.mean))
                       for row in onto[:, found.known]])
    moved = summed * found.variance
    across = sum(row * moved[:, k:k + len(row)] for k, row in enumerate(found.rows))
    return np.asarray(summed @ moved.T - across @ scipy.linalg.cho_solve_banded(
        (found.root, True), np.transpose(across)))


def _steps_of(time: Floats, temperature: Floats) -> _Steps | None:
    """Return the temperatures in steps; None if they are not, or at too few moments."""
    known = np.isfinite(time) & np.isfinite(temperature)
    values = temperature[known]
    different, count = np.unique(values, return_counts=True)
    repeated = different[count > 1]
    if len(repeated) < _LEAST_LEVELS or np.sum(count[count > 1]) < _REPEATED * len(values):
        return None
    step = float(np.min(np.diff(repeated)))
    steps = (repeated - repeated[0]) / step
    moments, place, mean = _at_moments(time[known], values)
    if (step > _COARSEST or np.max(np.abs(steps - np.round(steps))) > _ON_STEP
            or len(moments) < _LEAST_MOMENTS):
        return None
    variance = step ** 2 / 12.0 / np.bincount(place)
    return _Steps(step, known, place, variance, *_spline(moments, mean, variance))


def _spline(time: Floats, mean: Floats, variance: Floats
            ) -> tuple[tuple[Floats, Floats, Floats], Floats, Floats]:
    """Return `rows`, `root` and `mean` of `_Steps` from readings at n increasing times."""
    apart = np.diff(time) / np.median(np.diff(time))
    size, first, last = len(mean) - 2, 1.0 / apart[:-1], 1.0 / apart[1:]
    rows = first, -first - last, last
    of_error, of_process = np.zeros((2, 3, size))  # diagonals of the lower triangle
    for k, row in enumerate(rows):
        for beside in range(k + 1):
            of_error[k - beside, :size - k + beside] += row[:size - k + beside] * rows[beside][
                k - beside:] * variance[k:size + beside]
    of_process[0], of_process[1, :-1] = (apart[:-1] + apart[1:]) / 3.0, apart[1:-1] / 6.0
    across = np.sum([row * mean[k:size + k] for k, row in enumerate(rows)], axis=0)
    roots = [scipy.linalg.cholesky_banded(of_error + change * of_process, lower=True)
             for change in _CHANGES * np.max(variance)]
    root = max(roots, key=lambda root: -np.sum(np.log(root[0])) - across @
               scipy.linalg.cho_solve_banded((root, True), across) / 2.0)
    solved, moved = scipy.linalg.cho_solve_banded((root, True), across), np.zeros(len(mean))
    for k, row in enumerate(rows):
        moved[k:size + k] += row * solved
    return rows, root, mean - variance * moved


def _smoothed_rate(time: Floats, temperature: Floats) -> Floats:
    """Return the (n,) rate at n increasing times: a least-squares problem with 3 n unknowns."""
    count, step = len(time), np.diff(time)
    middle = float(np.mean(temperature))
    unit = np.array([1.0, 1.0 / float(np.median(step)), float(np.median(step)) ** -2])
    moved, spread = _motion(step)
    weight = np.linalg.inv(spread)
    blocks, beside = np.zeros((count, 3, 3)), np.zeros((count, 3, 3))
    blocks[:-1] += np.swapaxes(moved, 1, 2) @ weight @ moved
    blocks[1:] += weight
    beside[1:] = -weight @ moved
    blocks[:, 0, 0] += _ERROR ** -2
    blocks[0, [1, 2], [1, 2]] += np.array([_START_RATE, _START_BEND]) ** -2.0
    blocks, beside = (each * unit * unit[:, np.newaxis] for each in (blocks, beside))
    banded = np.zeros((6, count, 3))  # diagonals of the lower triangle
    for row in range(3):
        for column in range(3):
            if row >= column:
                banded[row - column, :, column] = blocks[:, row, column]
            banded[3 + row - column, :-1, column] = beside[1:, row, column]
    right = np.zeros((count, 3))
    right[:, 0] = (temperature - middle) / _ERROR ** 2
    found = scipy.linalg.solveh_banded(banded.reshape(6, -1), right.ravel(), lower=True)
    return found[1::3] * unit[1]


def _motion(step: Floats) -> tuple[Floats, Floats]:
    """Return the (m, 3, 3) transition over each step, and the covariance that it adds."""
    one, none = np.ones_like(step), np.zeros_like(step)
    moved = np.array([[one, step, step ** 2 / 2.0], [none, one, step], [none, none, one]])
    spread = np.array([[step ** 5 / 20.0, step ** 4 / 8.0, step ** 3 / 6.0],
                       [step ** 4 / 8.0, step ** 3 / 3.0, step ** 2 / 2.0],
                       [step ** 3 / 6.0, step ** 2 / 2.0, step]]) * _JERK
    return np.moveaxis(moved, 2, 0), np.moveaxis(spread, 2, 0)


def low_passed(time: Floats, temperature: Floats, lag: float, rate: Floats) -> Floats:
    """
    Return the (n,) low pass of a temperature [°C], which starts in equilibrium.

    With the `rate` [°C/s] the temperature is cubic between the times; at equal times it jumps. NaN
    where an input is NaN.

    """
    found = np.full(len(time), np.nan)
    order = np.argsort(time, kind='stable')
    order = order[np.isfinite(time[order]) & np.isfinite(temperature[order])]
    if not len(order):
        return found
    step, rise, rate = np.diff(time[order]), np.diff(temperature[order]), rate[order]
    usable = step > 0.0
    # Cubic Hermite: the rate is the mean rate plus a(1 - 2s) + b(1 - 6s + 6s²), s from 0 to 1,
    # and ∫ rate exp(-(1 - s) x) ds over the step with moments M_k = ∫ s^k exp(-(1 - s) x) ds,
    # which are 1F1(1; k + 2; -x) / (k + 1) (Abramowitz and Stegun 1964, eq. 13.2.1).
    mean = np.divide(rise, step, out=np.zeros_like(rise), where=usable)
    first, last = np.nan_to_num(rate[:-1]), np.nan_to_num(rate[1:])
    odd, even = (first - last) / 2.0, (first + last) / 2.0 - mean
    m_0, m_1, m_2 = (scipy.special.hyp1f1(1.0, k + 2.0, -step / lag) / (k + 1.0)
                     for k in range(3))
    bent = odd * (m_0 - 2.0 * m_1) + even * (m_0 - 6.0 * m_1 + 6.0 * m_2)
    # T - A: zero at the start, then its decay plus how far A falls behind over each step. After
    # pass k each sum has its last 2^k steps, and `kept` what remains of what is older.
    behind = np.append(0.0, rise * m_0 + np.where(usable, step * bent, 0.0))
    kept, reach = np.exp(-np.diff(time[order], prepend=-np.inf) / lag), 1
    while reach < len(behind) and np.any(kept):
        behind[reach:] += kept[reach:] * behind[:-reach]
        kept[reach:] *= kept[:-reach]
        reach *= 2
    found[order] = temperature[order] - behind
    return found


class _RateFilter:
    """Kalman filter of temperature, rate and bend (°C/s²) from averages of past samples."""

    def __init__(self, time: float, temperature: float) -> None:
        self.time = time
        self.state = np.array([temperature, 0.0, 0.0])
        self._spread = np.diag(np.square([_ERROR, _START_RATE, _START_BEND]))

    def add(self, time: float, temperature: float) -> None:
        moved, added = (each[0] for each in _motion(np.array([time - self.time])))
        state = moved @ self.state
        spread = moved @ self._spread @ moved.T + added
        gain = spread[:, 0] / (spread[0, 0] + _ERROR ** 2)
        self.state = state + gain * (temperature - state[0])
        self._spread = spread - np.outer(gain, spread[0])
        self.time = time


class ThermalStream:
    """
    Lag and rate of the temperature of a stream, from each sample and earlier ones.

    `lags` are by column of the temperature that acts (`accel_calib.effects.Model.lags`). With
    `rate`, the column ``temperature_rate`` is computed. `value` has the columns at the last sample
    with a temperature; it is empty before it.

    """

    def __init__(self, lags: Mapping[str, Lag], *, rate: bool) -> None:
        self._lags = lags
        self._gives_rate = rate
        self._uses_rate = rate or any(lag.of_sensor for lag in lags.values())
        self.value: dict[str, float] = {}
        self._last = (math.nan, math.nan)

    def add(self, time: float, temperature: float) -> None:
        """Add a sample; it is ignored if its time or temperature is NaN."""
        if not math.isfinite(time + temperature):
            return
        if not time >= self._last[0] - _RESTART:  # the first sample, too
            self._last = time, temperature
            self._behind = dict.fromkeys(self._lags, 0.0)
            self._filter: _RateFilter | None = None
            self._begin, self._count, self._times, self._sum = time, 0, 0.0, 0.0
            self._line = (0.0, 0.0)
        before, warm = self._last
        time = max(time, before)
        rate = self._rate(time, temperature) if self._uses_rate else 0.0
        value: dict[str, float] = {}
        for key, (seconds, of_sensor) in self._lags.items():
            if of_sensor:
                value[key] = temperature + seconds * rate
                continue
            steps = (time - before) / seconds
            share = -math.expm1(-steps) / steps if steps > 0.0 else 1.0
            behind = self._behind[key] * math.exp(-steps) + (temperature - warm) * share
            self._behind[key], value[key] = behind, temperature - behind
        if self._gives_rate:
            value['temperature_rate'] = rate
        self._last, self.value = (time, temperature), value

    def _rate(self, time: float, temperature: float) -> float:
        """Return the rate with a sample in the present average; the filter takes full ones."""
        if time >= self._begin + _BIN:
            middle, mean = self._begin + self._times / self._count, self._sum / self._count
            if self._filter is None:
                self._filter = _RateFilter(middle, mean)
            else:
                self._filter.add(middle, mean)
            self._begin, self._count, self._times, self._sum = time, 0, 0.0, 0.0
            _, rate, bend = self._filter.state.tolist()
            self._line = rate + bend * (time - self._filter.time), bend
        self._count += 1
        self._times += time - self._begin
        self._sum += temperature
        return self._line[0] + self._line[1] * (time - self._begin)

    def add_all(self, time: Floats, temperature: Floats) -> dict[str, Floats]:
        """
        Add samples, in the order of time, and return the columns at each.

        These are the temperatures that act [°C] and ``temperature_rate`` [°C/s]; NaN in rows
        without time or temperature.

        """
        order = np.argsort(time, kind='stable')
        order = order[np.isfinite(time[order] + temperature[order])]
        keys = (*self._lags, *(('temperature_rate',) if self._gives_rate else ()))
        values = array('d')
        for moment, warm in zip(time[order].tolist(), temperature[order].tolist()):
            self.add(moment, warm)
            values.extend(self.value.values())
        found = np.full((len(time), len(keys)), np.nan)
        found[order] = np.reshape(values, (-1, len(keys)))
        return dict(zip(keys, found.T))
