# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The noise of a sensor at rest, as records, and the units of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from .components import Component, COMPONENTS
from ..table import Floats
from ..units import STANDARD_GRAVITY

Kind = Literal['accelerometer', 'gyroscope']

FIGURES = COMPONENTS[1:4]
"""Figures that are reported by axis, in the order of τ."""

WORDS = {'quantisation': 'quantisation noise', 'noise_density': 'white noise',
         'bias_instability': 'bias instability', 'random_walk': 'random walk'}

_MICRO_G = 1e6 / STANDARD_GRAVITY

_MILLI_DEGREES = float(np.degrees(1e3))

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
        The sensor.
    axis : {'x', 'y', 'z'}
        The axis.
    unit : {'m/s²', 'rad/s', 'native'}
        Unit of the deviation.
    tau : (k,) array
        Averaging times [s].
    deviation, low, high : (k,) array
        Allan deviation, and its 95 % interval.
    model : (k,) array
        Deviation of the components that were found.
    slope, slope_sd : (k - 1,) array
        Slope of the logarithms between successive τ, and its standard deviation.
    figures : mapping of str to Component
        Keys of `COMPONENTS`; Q, N, B, K and drift in the unit times s, √s, 1, 1/√s and 1/s.
    used : (2,) tuple of float
        Range of τ that the figures are from [s].
    p_value : float
        Probability of the χ² of the fit.
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

    Parameters
    ----------
    axes : tuple of AxisNoise
        Accelerometer x, y, z, then gyro x, y, z if the recording has rates. An axis whose reading
        does not change is missing.
    start, seconds : float
        First stamp and duration of the rest [s].
    samples : int
        Number of samples.
    rate : float
        Samples per second [Hz].
    temperature : (2,) tuple of float or None
        Lowest and highest temperature [°C], averaged over a hundredth of the rest.
    notes : tuple of str
        What limits the figures.
    needs : mapping of (Kind, str) to str
        For each sensor and figure that is not seen on all axes: the reason and what to do.

    """

    axes: tuple[AxisNoise, ...]
    start: float
    seconds: float
    samples: int
    rate: float
    temperature: tuple[float, float] | None
    notes: tuple[str, ...]
    needs: Mapping[tuple[Kind, str], str] = field(default_factory=dict)

    def of(self, kind: Kind) -> tuple[AxisNoise, ...]:
        """Return the axes of one sensor."""
        return tuple(axis for axis in self.axes if axis.kind == kind)

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Sensors that have an axis with noise."""
        every: tuple[Kind, ...] = ('accelerometer', 'gyroscope')
        return tuple(kind for kind in every if self.of(kind))

    def common(self, kind: Kind, figure: str) -> tuple[float, float]:
        """
        Return a figure of all axes together and its standard deviation.

        It is the root of the mean square over the axes on which it is seen; NaN if there is none.

        """
        found = [axis.figures[figure] for axis in self.of(kind) if axis.figures[figure].seen]
        if not found:
            return np.nan, np.nan
        values, sds = (np.array([getattr(each, name) for each in found])
                       for name in ('value', 'sd'))
        common = float(np.sqrt(np.mean(values**2)))
        return common, float(np.sqrt(np.sum((values * sds)**2))) / (len(found) * common)


def shown_unit(kind: str, figure: str, unit: str) -> tuple[str, float]:
    """Return the unit of a figure for people, and the factor from the unit of the figure."""
    if unit == 'native':
        return _NATIVE[figure], 1.0
    return _SHOWN[kind, figure]
