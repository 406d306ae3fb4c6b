# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From poses of known or unknown orientation to a Calibration: the entry point."""

from __future__ import annotations

from dataclasses import replace

from .calibration import Calibration, Rejected
from .checks import wiring_warnings
from .gate import gated, sound_rows, sure_rows
from .known_orientation import fit_known
from .levelling import level, set_heading
from .mounting import FrameName
from .rest_noise import with_rest_noise
from .unknown_orientation import fit_unknown, Method, METHODS
from ..errors import InputError, RefusedFitError
from ..table import check_units, Floats, Poses
from ..text import listed
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
        Unit of the readings. The fit estimates the sensitivity of native units.
    model : {'auto', '4', '7', '9', '10', '12'}
        ``auto`` selects 12 if the orientations are known, and otherwise the smallest of 4, 7 and
        10 that the data support. Model 12 is replaced by 10 if |force| = 1 g contradicts the known
        orientations.
    method : {'ml', 'algebraic'}
        Maximum likelihood, or the cost functions of AN5286 and the ESGI'95 report.
    sensor, date : str
        Name of the sensor and date, stored in the record. By default the name in the poses.

    Returns
    -------
    Calibration
        The calibration with ΔR = I; for known orientations with the ΔR that they determine.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model, or the result is not plausible.
    InputError
        If the readings are clearly in another unit.

    """
    if model not in MODEL_NAMES or method not in METHODS:
        raise ValueError(f'model is {model!r} and method {method!r}, expected one of '
                         f'{MODEL_NAMES} and one of {METHODS}')
    check_units(poses, units)
    sound, rejected = sound_rows(poses, units)
    if rejected and method == 'algebraic':
        raise RefusedFitError(f'row {rejected[0].row}: {rejected[0].reason}, but the method '
                              'algebraic uses every row', 'remove the row, or use the method ml')
    calibration, rejected = _without_doubtful(sound, rejected, units, model, method)
    left_out = sorted((*rejected, *calibration.rejected), key=lambda each: each.row)
    return with_rest_noise(gated(replace(
        calibration, sensor=sensor or poses.sensor, date=date,
        poses=_all_poses(poses, calibration.poses), rejected=tuple(left_out),
        warnings=(*wiring_warnings(calibration), *calibration.warnings))), poses)


def level_by_rows(calibration: Calibration, poses: Poses, frame: FrameName, flat: int | None,
                  nose_down: int | None) -> Calibration:
    """
    Return a calibration with the mounting from rows of a pose table.

    Parameters
    ----------
    calibration : Calibration
        The calibration, with any ΔR.
    poses : Poses
        The table, in the unit of the calibration.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    flat : int or None
        Row of a pose with the robot level, 1-based.
    nose_down : int or None
        Row of a pose with the nose of the robot tilted straight down, 1-based. It determines the
        heading.

    Returns
    -------
    Calibration
        The calibration with ΔR from these rows.

    Raises
    ------
    InputError
        If a row does not exist, `nose_down` is set without `flat`, or the nose is tilted down by
        less than 10°.

    """
    if flat is None:
        if nose_down is not None:
            raise InputError('there is a row with the nose down but no flat row, expected both',
                             'set both rows, or only the flat row')
        return replace(calibration, frame=frame)
    levelled = level(calibration, _reading_in(poses, flat), frame)
    return levelled if nose_down is None else set_heading(levelled, _reading_in(poses, nose_down))


def _reading_in(poses: Poses, row: int) -> Floats:
    if not 1 <= row <= len(poses):
        raise InputError(f'row {row} is not in the table, expected 1 to {len(poses)}',
                         'correct the row number')
    return poses.reading[row - 1]


def _without_doubtful(poses: Poses, rejected: tuple[Rejected, ...], units: Units, model: str,
                      method: Method) -> tuple[Calibration, tuple[Rejected, ...]]:
    """Fit without the doubtful poses, if the other poses determine the same model."""
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
    rows = listed('row', [each.row for each in doubts])
    return replace(every, warnings=(
        *every.warnings, f'the sensor may have moved during the poses of {rows}, and the fit '
        'needs them: capture them again')), rejected


def _fitted(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    if model == '12' or (model == 'auto' and 'reference' in poses):
        return fit_known(poses, units, method)
    return fit_unknown(poses, units, model, method)


def _all_poses(poses: Poses, fitted: Poses) -> Poses:
    """Return all poses of the input; the fitted table, with its references, if it is complete."""
    return fitted if len(fitted) == len(poses) else poses
