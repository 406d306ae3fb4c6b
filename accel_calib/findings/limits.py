# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The limits of the rating, all in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """A limit of the rating: its name, value and unit, and what it means."""

    name: str
    value: float
    unit: str
    meaning: str


GOOD_ERROR = Limit(
    'error of a good calibration', 5.0, 'mg', 'largest error in new orientations, RMS over the '
    'sphere, as a bound; 5 mg is a tilt of 0.3°, and the zero-g offset of common parts is 20 to '
    '60 mg')
WORST_ERROR = Limit(
    'error in the worst direction', 10.0, 'mg', 'largest uncertainty in any direction of a good '
    'calibration')
BAD_ERROR = Limit(
    'error of a bad calibration', 30.0, 'mg', 'above this error the calibration is BAD: a common '
    'part without calibration has about this error')
MATTERS = Limit(
    'error that matters', 1.0, 'mg', 'a residual beyond the noise, or an effect that cannot be '
    'corrected, is ignored below this; 1 mg is a tilt of 0.06°')
HIDDEN = Limit(
    'scatter of the poses', 2.0, 'times the noise', 'if the scatter is larger, and the part '
    'beyond the noise is above the error that matters, the model lacks an effect or poses moved')
LEFT_OUT = Limit(
    'poses left out', 20.0, '%', 'largest share of a good calibration')
TO_CHECK = Limit(
    'poses to check the fit', 3.0, 'poses', 'fewest poses beyond the number of values, if the '
    'noise is not known or outliers were left out')
PER_OUTLIER = Limit(
    'more poses to check, per outlier', 2.0, 'poses', 'a few poses can agree by chance after '
    'outliers were left out')
CHANGED = Limit(
    'error of new poses', 2.0, 'times the error that the fit states', 'if a verification shows a '
    'larger error, and it is above the error that matters, the sensor has changed')
COVERED = Limit(
    'covered part of the sphere', 85.0, '%', 'smallest share within 45° of a pose: elsewhere '
    'nothing checks the model. A verification that covers less is not rated better than the '
    'calibration itself')
TILT = Limit(
    'tilt between level poses', 0.3, '°', 'above this, the mountings of compared calibrations '
    'differ')
NEAR_FLAT = Limit(
    'pose near level', 20.0, '°', 'a pose within this angle of the level pose is suggested as the '
    'flat pose')
SPAN = Limit(
    'range of temperature', 4.0, '°C', 'smallest range for which a calibration is said to be '
    'valid')

GOOD_MG = GOOD_ERROR.value
"""Largest expected error of a good calibration [mg]."""

LIMITS = (GOOD_ERROR, WORST_ERROR, BAD_ERROR, MATTERS, HIDDEN, LEFT_OUT, TO_CHECK, PER_OUTLIER,
          CHANGED, COVERED, TILT, NEAR_FLAT, SPAN)
"""All limits of the rating."""
