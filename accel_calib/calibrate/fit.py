# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses to Calibration: the way in, whatever is known of the orientations."""

from __future__ import annotations

from dataclasses import replace

from .calibration import Calibration, level, Rejected, set_heading
from .checks import check_units, wiring_warnings
from .gate import gated, sound_rows, sure_rows
from .known_orientation import fit_known
from .mounting import FrameName
from .unknown_orientation import fit_unknown, Method, METHODS
from ..errors import InputError, RefusedFitError
from ..table import Floats, Poses
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
        ``auto`` takes 12 if the orientations are known, and otherwise the smallest of 4, 7 and 10
        that the poses call for. 12 falls back to 10 if |force| = 1 g shows that the orientations
        are not as given.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of the documents.
    sensor, date : str
        Kept in the record; without a sensor that of the poses.

    Returns
    -------
    Calibration
        In the sensor axes, see `accel_calib.calibrate.calibration.level`; with known orientations
        in theirs.

    Raises
    ------
    RefusedFitError
        If the poses cannot determine the model, or the result is not plausible.
    InputError
        If the readings are clearly not in that unit.

    """
    if model not in MODEL_NAMES or method not in METHODS:
        raise ValueError(f'model {model!r}, method {method!r}; expected {MODEL_NAMES}, {METHODS}')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    if rejected and method == 'algebraic':
        raise RefusedFitError(f'row {rejected[0].row}: {rejected[0].reason}, and the method '
                              'algebraic keeps every row', 'remove the row, or use the method ml')
    calibration, rejected = _without_doubtful(sound, rejected, units, model, method)
    left_out = sorted((*rejected, *calibration.rejected), key=lambda each: each.row)
    return gated(replace(
        calibration, sensor=sensor or poses.sensor, date=date,
        poses=_as_given(poses, calibration.poses), rejected=tuple(left_out),
        warnings=(*wiring_warnings(calibration), *calibration.warnings)))


def level_by_rows(calibration: Calibration, poses: Poses, frame: FrameName, flat: int | None,
                  nose_down: int | None) -> Calibration:
    """
    Level the mounting from rows of a pose table.

    Parameters
    ----------
    calibration : Calibration
        With any ΔR.
    poses : Poses
        The table, in the unit of the calibration.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    flat : int or None
        Row in which the robot was level, from 1.
    nose_down : int or None
        Row in which the nose of the robot was tilted straight down, from 1; it fixes the heading.

    Returns
    -------
    Calibration
        The same with ΔR of these rows.

    Raises
    ------
    InputError
        If there is no such row, a heading without a flat row, or the nose is down by less than
        10°.

    """
    if flat is None:
        if nose_down is not None:
            raise InputError('the row with the nose down is given without the flat one',
                             'give both, or the flat one alone')
        return replace(calibration, frame=frame)
    levelled = level(calibration, _reading_in(poses, flat), frame)
    return levelled if nose_down is None else set_heading(levelled, _reading_in(poses, nose_down))


def _reading_in(poses: Poses, row: int) -> Floats:
    if not 1 <= row <= len(poses):
        raise InputError(f'row {row} is not in the table, which has {len(poses)} rows',
                         'rows count from 1')
    return poses.reading[row - 1]


def _without_doubtful(poses: Poses, rejected: tuple[Rejected, ...], units: Units, model: str,
                      method: Method) -> tuple[Calibration, tuple[Rejected, ...]]:
    """Fit without the doubtful poses if the others determine the same model."""
    sure, doubts = sure_rows(poses)
    if not doubts or method == 'algebraic':
        return _fitted(poses, units, model, method), rejected
    every = _fitted(poses, units, model, method)
    try:
        without = _fitted(sure, units, model, method)
    except RefusedFitError:
        without = every
    if without is not every and (model != 'auto' or without.name == every.name):
        return without, (*rejected, *doubts)
    rows = ', '.join(str(each.row) for each in doubts)
    return replace(every, warnings=(
        *every.warnings, f'the sensor may have moved in the poses {rows}, which the fit needs: '
        'capture them again')), rejected


def _fitted(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    if model == '12' or (model == 'auto' and 'reference' in poses):
        return fit_known(poses, units, method)
    return fit_unknown(poses, units, model, method)


def _as_given(poses: Poses, fitted: Poses) -> Poses:
    """Return all poses; with the reference of the fit where all were fitted."""
    return fitted if len(fitted) == len(poses) else poses
