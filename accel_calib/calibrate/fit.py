# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Poses to Calibration: poses of unknown orientation by |force| = 1 g, known ones by their vectors.

Poses of unknown orientation carry models 4, 7, 9 and 10 (`.unknown`); poses of known orientation
(a reference, or the six faces) carry 12 (`.known`). `ml`, the default, weighs poses by their noise
and leaves disturbed ones out; `algebraic` is the documents' own costs, unweighted, every row kept.

"""

from __future__ import annotations

from dataclasses import replace

from .calibration import Calibration
from .known import fit_known
from .unit_check import check_units
from .unknown import fit_unknown, Method, METHODS
from .wiring import wiring_warnings
from ..table import Poses
from ..units import Units

MODEL_NAMES = ('auto', '4', '7', '9', '10', '12')


def fit_poses(poses: Poses, units: Units, *, model: str = 'auto', method: Method = 'ml',
              sensor: str = '', date: str = '') -> Calibration:
    """
    Fit a calibration.

    Parameters
    ----------
    poses : Poses
        Still poses, in the unit of the readings.
    units : Units
        That unit; the sensitivity of native units is found here.
    model : {'auto', '4', '7', '9', '10', '12'}
        ``auto`` takes 12 where the orientations are known, and otherwise the smallest of 4, 7
        and 10 that the poses call for. 12 gives way to 10 where |force| = 1 g shows that the
        orientations are not what they are said to be.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the documents' own costs.
    sensor, date : str
        Kept in the record.

    Returns
    -------
    Calibration
        In the axes of the sensor, see `accel_calib.calibrate.calibration.level`; with known
        orientations in theirs.

    Raises
    ------
    RefusedFitError
        If the poses cannot carry the model.
    InputError
        If the readings are plainly not in that unit.

    """
    if model not in MODEL_NAMES or method not in METHODS:
        raise ValueError(f'model {model!r}, method {method!r}; expected {MODEL_NAMES}, {METHODS}')
    check_units(poses, units)
    if model == '12' or (model == 'auto' and 'reference' in poses):
        calibration = fit_known(poses, units, method)
    else:
        calibration = fit_unknown(poses, units, model, method)
    return replace(calibration, sensor=sensor, date=date,
                   warnings=(*wiring_warnings(calibration), *calibration.warnings))
