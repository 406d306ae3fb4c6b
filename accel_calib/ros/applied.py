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
The calibration in use, and what rests say of it.

Gravity is the mean corrected force of the last rest, held and subtracted while the sensor moves
(Intan RHD2000 application note): good for motion near the attitude of that rest.

"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .context import context_of_rest

if TYPE_CHECKING:
    from ..calibrate import Calibration
    from ..capture import Dwell
    from ..table import Floats


class Applied:
    """
    A calibration, whether it is switched on, and the last rest.

    Parameters
    ----------
    gravity : float
        Local gravity [m/s²].

    """

    def __init__(self, gravity: float) -> None:
        self._g = gravity
        self._squares = 0.0
        self._rests = 0
        self.calibration: Calibration | None = None
        self.scale = 1.0
        self.enabled = True
        self.rest: Dwell | None = None
        self.gravity: Floats | None = None

    def adopt(self, calibration: Calibration | None) -> None:
        """Use this calibration from now on; drift is counted anew."""
        self.calibration = calibration
        self.scale = 1.0 if calibration is None else output_scale(calibration, self._g)
        self._squares, self._rests = 0.0, 0
        self._hold()

    def rested(self, rest: Dwell) -> None:
        """Hold gravity as this rest has it."""
        self.rest = rest
        self._hold()

    def ended(self, rest: Dwell) -> None:
        """Count a rest that ended towards the drift."""
        force = self._force(rest)
        if force is not None:
            self._squares += self._error(force) ** 2
            self._rests += 1

    def _hold(self) -> None:
        self.gravity = None if self.rest is None else self._force(self.rest)

    def _force(self, rest: Dwell) -> Floats | None:
        """Give the corrected force of a rest [m/s²]; None where it cannot be corrected."""
        if self.calibration is None:
            return None
        context = context_of_rest(rest, self.calibration.units)
        if any(key not in context for key in self.calibration.model.needs):
            return None
        return self.calibration.correct(rest.mean[np.newaxis], context)[0] * self.scale

    def _error(self, force: Floats) -> float:
        """Give |a| - 1 g [g]."""
        return float(np.linalg.norm(force)) / self._g - 1.0

    @property
    def residual(self) -> float:
        """Give |a| - 1 g at the last rest [g]; NaN where it is not known."""
        return math.nan if self.gravity is None else self._error(self.gravity)

    @property
    def drift(self) -> float:
        """Give the RMS of |a| - 1 g over the rests with this calibration [g]; NaN: none."""
        return math.sqrt(self._squares / self._rests) if self._rests else math.nan


def output_scale(calibration: Calibration, gravity: float) -> float:
    """
    Say how many m/s² are one unit of corrected force.

    Parameters
    ----------
    calibration : Calibration
        Gives force in the unit of its readings, or in g.
    gravity : float
        Local gravity [m/s²].

    """
    return 1.0 if calibration.units.name == 'm/s2' else gravity / calibration.force_per_g
