# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Input outside of the range in which a calibration was seen.

The effects of a calibration are not extrapolated: beyond the range of the poses, the correction
uses the limit of the range (`Calibration.ranges`). A curve over the vibration has a range, too. A
single sample does not show its vibration, so that the correction uses the lower limit.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration
from ..effects import Context, EMPIRICAL, empirical_parts
from ..table import COLUMNS, Floats
from ..text import counted
from ..units import MG

USES_LIMIT = 'the correction uses the limit of the range'

_QUANTITIES: dict[str, tuple[str, str, float]] = {
    'time': ('time since the start of the calibration', 'h', 1.0 / 3600.0),
    'temperature_rate': ('rate of temperature', '°C/min', 60.0),
    'std': ('vibration', 'mg', MG)}
"""Name, unit and factor of the quantities that are not shown as in `COLUMNS`."""


@dataclass(frozen=True)
class Outside:
    """
    A quantity of the context, compared with the range of a calibration.

    Parameters
    ----------
    key : str
        The quantity: a column of the context.
    count, samples : int
        Number of samples outside of the range, and of all samples.
    low, high : float
        Range in the poses of the calibration.
    least, most : float
        Range of all samples.

    """

    key: str
    count: int
    samples: int
    low: float
    high: float
    least: float
    most: float

    @property
    def name(self) -> str:
        """Return the quantity in words."""
        return _QUANTITIES[self.key][0] if self.key in _QUANTITIES else (
            self.key.replace('_', ' '))

    def range_words(self, low: float, high: float) -> str:
        """Return a range, or one value, with its unit; times count from the first pose."""
        _, unit, factor = _QUANTITIES.get(self.key, ('', COLUMNS[self.key].unit, 1.0))
        start = self.low if self.key == 'time' else 0.0
        first, last = (f'{(value - start) * factor:.4g}' for value in (low, high))
        return f'{first} {unit}' if first == last else f'{first} to {last} {unit}'

    @property
    def words(self) -> str:
        """Return what was found and what the range of the calibration is."""
        return (f'{self.name} is {self.range_words(self.least, self.most)}, but the range of the '
                f'calibration is {self.range_words(self.low, self.high)}')

    @property
    def line(self) -> str:
        """Return a line about a recording."""
        return (f'{self.count} of {counted(self.samples, "sample")} are outside of the range of '
                f'the calibration: {self.words}; {USES_LIMIT}')


def outside(calibration: Calibration, known: Context) -> dict[str, Outside]:
    """
    Compare the context of samples with the range of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    known : mapping of str to array
        Context of the samples, n rows each.

    Returns
    -------
    dict of str to Outside
        Result for each quantity with a range, by column; ``count`` is 0 if it is inside.

    """
    found = {}
    for key, (low, high) in {**calibration.ranges, **_vibration_range(calibration)}.items():
        values = _size(known[key]) if key in known else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            count = int(np.sum((values < low) | (values > high)))
            found[key] = Outside(key, count, len(values), low, high, float(np.min(values)),
                                 float(np.max(values)))
    return found


def _size(values: Floats) -> Floats:
    """Return the values of a quantity; for vectors, the RMS over the axes."""
    return np.sqrt(np.mean(values ** 2, axis=1)) if values.ndim > 1 else values


def _vibration_range(calibration: Calibration) -> dict[str, tuple[float, float]]:
    """Return the range of the empirical curves over the vibration, if there are any."""
    ends = [values[-2:] for name, values in calibration.model.values.items()
            if name.startswith(f'{EMPIRICAL}-') and empirical_parts(name)[1] == 'std']
    if not ends:
        return {}
    return {'std': (float(np.max([low for low, _ in ends])),
                    float(np.min([high for _, high in ends])))}


def joined_ranges(one: Mapping[str, Outside], other: Mapping[str, Outside]) -> dict[str, Outside]:
    """Return the quantities of two blocks of samples as one."""
    found = {**one, **other}
    for key in one.keys() & other.keys():
        a, b = one[key], other[key]
        found[key] = replace(a, count=a.count + b.count, samples=a.samples + b.samples,
                             least=min(a.least, b.least), most=max(a.most, b.most))
    return found
