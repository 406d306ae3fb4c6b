# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Units of readings, converted to g at the edge of the package, and the other names users choose.

They stand below all folders, so that ``accel-calib fit --help`` does not load the calibration.

"""

from dataclasses import dataclass
from typing import Any, get_args, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.intp]
Bools = NDArray[np.bool_]

UnitName = Literal['m/s2', 'g', 'native']
UNIT_NAMES: tuple[str, ...] = get_args(UnitName)

FrameName = Literal['ros', 'ned', 'android', 'win8']
FRAMES: tuple[str, ...] = get_args(FrameName)
"""Levelled frames."""

Method = Literal['ml', 'algebraic']
METHODS: tuple[str, ...] = get_args(Method)
"""Methods of a fit: maximum likelihood, and the cost functions of the documents."""

MODEL_NAMES = ('auto', '4', '7', '9', '10', '12')
"""Models of a fit."""

BASES = ('auto', 'ideal', '4', '7', '10', '12')
"""Models that a refinement can start from."""

STANDARD_GRAVITY = 9.80665
"""Standard acceleration of free fall [m/s²], ISO 80000-3."""

MG = 1e3
"""Milli-g in one g."""


@dataclass(frozen=True)
class Units:
    """
    The unit of a sensor's readings.

    Parameters
    ----------
    name : {'m/s2', 'g', 'native'}
        ``native`` is any other unit, such as counts or volts.
    per_g : float
        Value of 1 g of local gravity in this unit: the local gravity [m/s²] for ``m/s2``, 1 for
        ``g``, and the sensitivity for ``native``, which the fit estimates.

    """

    name: UnitName
    per_g: float

    def __post_init__(self) -> None:
        if self.name not in UNIT_NAMES:
            raise ValueError(f'unit is {self.name!r}, expected one of {UNIT_NAMES}')
        if not self.per_g > 0.0:
            raise ValueError(f'per_g is {self.per_g}, expected a positive number')

    @property
    def is_native(self) -> bool:
        """Whether the scale is not known, and a fit estimates it."""
        return is_native(self.name)

    @property
    def is_si(self) -> bool:
        """Whether it is m/s², the unit of Imu messages."""
        return self.name == 'm/s2'

    @property
    def symbol(self) -> str:
        """How people write the unit: m/s², g or native."""
        return 'm/s²' if self.is_si else self.name

    @property
    def force_per_g(self) -> float:
        """Corrected force per g: 1 for native readings, whose corrected force is in g."""
        return 1.0 if self.is_native else self.per_g

    def to_g(self, reading: Floats) -> Floats:
        return reading / self.per_g

    def from_g(self, reading_g: Floats) -> Floats:
        return reading_g * self.per_g


def is_native(name: str) -> bool:
    """Return whether this is the name of native units, whose scale is not known."""
    return name == 'native'


def units_of(name: UnitName, gravity: float = STANDARD_GRAVITY) -> Units:
    """
    Return the unit with this name; `gravity` is the local gravity [m/s²], used by ``m/s2``.

    The sensitivity of native units is 1 until a fit estimates it.

    """
    return Units(name, gravity if name == 'm/s2' else 1.0)
