# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Direction and length of the newest reading, raw and corrected, for the view of a session."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..calibrate import Calibration
from ..errors import InputError
from ..messages.one_reading import Known, OneReading, Triple
from ..units import Units

_NONE: Triple = (0.0, 0.0, 0.0)


class Newest(NamedTuple):
    """A reading: direction (empty if not known), |a| and corrected |a| [g] (NaN: not known)."""

    up: tuple[float, ...] = ()
    length: float = math.nan
    corrected: float = math.nan


class NewestReading:
    """
    Describe single readings, with the prepared correction.

    Parameters
    ----------
    units : Units
        Unit of the readings.

    """

    def __init__(self, units: Units) -> None:
        self._units = units
        self._prepared: tuple[Calibration, OneReading] | None = None

    def described(self, reading: Triple, calibration: Calibration | None, known: Known,
                  zero: tuple[float, ...] = ()) -> Newest:
        """
        Return direction and length of a reading.

        Native readings have a direction only if their zero is known: from a calibration, or about
        from the poses so far.

        Parameters
        ----------
        reading : (float, float, float)
            The reading, in the unit of the sensor.
        calibration : Calibration or None
            The calibration that corrects it.
        known : mapping
            Present context: time, and temperature with its lags if it is known.
        zero : tuple of float, optional
            Approximate zero of native readings before a calibration; empty if it is not known.

        """
        force = None if calibration is None else self._force(calibration, reading, known)
        corrected = math.nan if force is None else math.hypot(*force)
        if self._units.name != 'native':
            length = math.hypot(*reading)
            return Newest(_unit(reading, length), length / self._units.per_g, corrected)
        if calibration is None or force is None:
            parts = tuple(part - at for part, at in zip(reading, zero, strict=False))
            return Newest(_unit(parts, math.hypot(*parts)))
        turned = (calibration.rotation @ force).tolist()
        return Newest(_unit(turned, corrected), corrected=corrected)

    def _force(self, calibration: Calibration, reading: Triple, known: Known) -> Triple | None:
        """Return the corrected force [g]; None if the effects cannot be corrected now."""
        if self._prepared is None or self._prepared[0] is not calibration:
            self._prepared = (calibration, OneReading(calibration, 1.0 / calibration.force_per_g))
        context = {'std': _NONE, 'previous': _NONE, 'rate': _NONE, **known}
        try:
            return self._prepared[1].at(context).correct(*reading)
        except InputError:
            return None  # a quantity is not known yet, or the reading is out of range


def _unit(vector: tuple[float, ...] | list[float], length: float) -> tuple[float, ...]:
    return tuple(part / length for part in vector) if 0.0 < length < math.inf else ()
