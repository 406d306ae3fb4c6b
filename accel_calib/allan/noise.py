# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Noise figures of a sensor from a long rest.

Accelerometers and gyros have three figures by axis: the white-noise density N (velocity or angle
random walk), the bias instability B and the random walk K (of the acceleration, or of the rate).
Kalibr and VINS use N and K of all axes together, for which the mean of the squares is taken.

"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

from .components import Component, COMPONENTS, fit_components, Fitted
from .curve import (
    allan_variances,
    check_allantools,
    Counts,
    octaves,
    shares,
    Spread,
    spread_of,
)
from .limits import needs_of, notes_of
from .records import AxisNoise, Kind, NoiseFigures
from .rest import longest_rest, Rest
from ..table import Floats, Recording
from ..units import STANDARD_GRAVITY, Units

_POWERS = {'quantisation': 1.0, 'noise_density': 0.5, 'bias_instability': 0.0,
           'random_walk': -0.5, 'drift': -1.0}
"""Power of τ0 in each figure."""

_LEVEL = 0.95

_MOST_RATE = 0.03
"""Noise density that no gyro in rad/s has [rad/s/√Hz]: 100 times that of a cheap one."""

_COARSE = 1.0
"""Noise in units of the step of the output below which rounding changes the noise."""

_MOST_STEPS = 4096

_LEAST_VARIANCE = 1e-18
"""Allan variance that is only rounding, for samples with the standard deviation 1."""


def noise_of(recording: Recording, units: Units, gravity: float = STANDARD_GRAVITY,
             progress: Callable[[int, int], object] = lambda done, count: None) -> NoiseFigures:
    """
    Return the noise figures of a recording with a long rest.

    Parameters
    ----------
    recording : Recording
        The samples. The longest rest without an interruption is used.
    units : Units
        Unit of the readings. Figures of native readings stay in native units.
    gravity : float
        Local gravity [m/s²], for readings in g.
    progress : function of two int
        Called with the number of axes done and of all axes.

    Raises
    ------
    InputError
        If there is no rest of at least 64 samples, or allantools is not installed.

    """
    check_allantools()
    progress(0, 6 if 'rate' in recording else 3)
    rest = longest_rest(recording, units)
    lengths = octaves(rest.samples)
    spread = spread_of(lengths, rest.samples)
    axes, notes = [], list(rest.notes)
    rad_s = _in_rad_s(rest)
    if not rad_s:
        notes.append('the angular rates are not in rad/s, because their noise is too large: they '
                     'are taken as native')
    for k, values in enumerate(rest.values):
        kind, axis, scale, unit = _channel(k, units, gravity, rad_s=rad_s)
        if np.ptp(values) > 0.0 and np.std(values) > 0.0:
            axes.append(_axis(kind, axis, unit, values * scale, rest.rate, spread))
        else:
            notes.append(f'{kind} {axis}: all samples of the rest are the same, so that the axis '
                         'shows no noise; record with more digits or a smaller range')
        progress(k + 1, len(rest.values))
    temperature = _temperatures(rest)
    needs = needs_of(axes, rest)
    return NoiseFigures(tuple(axes), rest.start, rest.seconds, rest.samples, rest.rate,
                        temperature, (*notes, *notes_of(axes, temperature)), needs)


def _in_rad_s(rest: Rest) -> bool:
    """Return whether the noise of the rates is that of a gyro in rad/s."""
    rates = rest.values[3:]
    if not len(rates):
        return True
    density = np.std(np.diff(rates), axis=1) / np.sqrt(2.0 * rest.rate)
    return bool(np.all(density < _MOST_RATE))


def _channel(row: int, units: Units, gravity: float, *, rad_s: bool
             ) -> tuple[Kind, str, float, str]:
    """Return sensor, axis, factor from g or rad/s, and unit of a row of `Rest.values`."""
    if row > 2:
        return 'gyroscope', 'xyz'[row - 3], 1.0, 'rad/s' if rad_s else 'native'
    if units.name == 'native':
        return 'accelerometer', 'xyz'[row], units.per_g, 'native'
    return 'accelerometer', 'xyz'[row], gravity, 'm/s²'


def _axis(kind: Kind, axis: str, unit: str, values: Floats, rate: float, spread: Spread
          ) -> AxisNoise:
    """Return the noise of one axis."""
    lengths = octaves(len(values))
    size = float(np.std(values))
    variances = np.maximum(allan_variances(values / size, lengths), _LEAST_VARIANCE)
    fitted = fit_components(variances, lengths, spread)
    covariance = spread.covariance(fitted.squares)
    expected = shares(lengths) @ fitted.squares
    low, high = _band(variances, 2.0 * expected**2 / np.diag(covariance), fitted, spread)
    tau = lengths / rate
    return AxisNoise(
        kind, axis, unit, tau, size * np.sqrt(variances), size * low, size * high,
        size * np.sqrt(expected), 0.5 * np.diff(np.log2(variances)),
        _slope_sd(covariance / np.outer(expected, expected)),
        _figures(fitted, size, 1.0 / rate),
        (float(tau[fitted.first]), float(tau[fitted.last])), fitted.p_value,
        _coarse_step(values, size * float(np.sqrt(variances[0]))))


def _band(variances: Floats, freedom: Floats, fitted: Fitted, spread: Spread
          ) -> tuple[Floats, Floats]:
    """Return the 95 % interval of the Allan deviations from their degrees of freedom."""
    # Beyond the range the form is not known: a random walk has the fewest degrees of freedom.
    beyond = np.arange(len(variances)) > fitted.last
    lengths = 2**np.arange(len(variances), dtype=np.int64)
    known = np.where(beyond, _freedom_of_walk(spread, lengths), freedom)
    tail = 0.5 - 0.5 * _LEVEL
    low, high = (np.sqrt(variances * known / chi2.ppf(part, known)) for part in (1.0 - tail, tail))
    return low, high


def _slope_sd(relative: Floats) -> Floats:
    """Return the standard deviations of the slopes from the relative covariance."""
    across = np.diff(np.eye(len(relative)), axis=0)
    return np.asarray(0.5 / np.log(2.0) * np.sqrt(np.diag(across @ relative @ across.T)))


def _freedom_of_walk(spread: Spread, lengths: Counts) -> Floats:
    """Return the equivalent degrees of freedom of a random walk at each length."""
    walk = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    return 2.0 * (shares(lengths) @ walk)**2 / np.diag(spread.covariance(walk))


def _figures(fitted: Fitted, size: float, spacing: float) -> dict[str, Component]:
    """Return the components in the unit of the figures."""
    made = {}
    for name, found in zip(COMPONENTS, fitted.components, strict=True):
        scale = size * spacing ** _POWERS[name]
        made[name] = Component(found.value * scale, found.sd * scale,
                               (found.interval[0] * scale, found.interval[1] * scale),
                               found.upper * scale, found.share)
    return made


def _coarse_step(values: Floats, noise: float) -> float:
    """Return the step of the output if the noise of a sample is smaller, otherwise 0."""
    levels = np.unique(values[:1_000_000])
    if len(levels) > _MOST_STEPS:
        return 0.0
    gaps = np.diff(levels)
    # Rounding of a computation leaves gaps that are not steps.
    gaps = gaps[gaps > 1e-9 * max(float(np.max(np.abs(levels))), noise)]
    step = float(np.min(gaps)) if len(gaps) else 0.0
    return step if noise < _COARSE * step else 0.0


def _temperatures(rest: Rest) -> tuple[float, float] | None:
    """Return the lowest and highest mean temperature of a hundredth of the rest."""
    if rest.temperature is None or not np.isfinite(rest.temperature).any():
        return None
    known = rest.temperature[np.isfinite(rest.temperature)]
    means = [float(np.mean(part)) for part in np.array_split(known, min(100, len(known)))]
    return min(means), max(means)
