# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
From poses of known or unknown orientation to a levelled Calibration: the entry point.

`mounting` computes ΔR from a flat pose, or from a pose with the nose down; here it becomes part of
a calibration, with the findings about it.

"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .calibration import Calibration, Rejected
from .checks import doubts_about_flat, wiring
from .gate import gated, sound_rows, sure_rows
from .known_orientation import fit_known
from .mounting import FrameName, heading_is_arbitrary, mounting, with_heading, with_heading_of
from .rest_noise import with_rest_noise
from .unknown_orientation import fit_unknown, Method, METHODS
from ..effects import Context, Model, MODELS, sensor_force
from ..errors import InputError, RefusedFitError
from ..finding import Finding, without
from ..table import check_units, Floats, Poses
from ..text import listed
from ..units import Units

MODEL_NAMES = ('auto', '4', '7', '9', '10', '12')
BASES = ('auto', 'ideal', '4', '7', '10', '12')
"""Models that a refinement can start from."""


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
        noted=(*wiring(calibration), *calibration.noted))), poses)


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
    rows = tuple(each.row for each in doubts)
    return replace(every, noted=(*every.noted, Finding(
        'doubtful', f'the sensor may have moved during the poses of {listed("row", rows)}, and '
        'the fit needs them', 'capture them again', 'USABLE', rows))), rejected


def _fitted(poses: Poses, units: Units, model: str, method: Method) -> Calibration:
    known = 'reference' in poses if model == 'auto' else MODELS[model].known_orientation
    if known:
        return fit_known(poses, units, method)
    return fit_unknown(poses, units, model, method)


def _all_poses(poses: Poses, fitted: Poses) -> Poses:
    """Return all poses of the input; the fitted table, with its references, if it is complete."""
    return fitted if len(fitted) == len(poses) else poses


_SAME_TILT = np.cos(np.radians(10.0))

_ARBITRARY_HEADING = Finding(
    'heading', 'the heading of the mounting is arbitrary, because an axis of the sensor that '
    'defines it is within 10° of the vertical', 'take a second pose with the nose of the robot '
    'down (~/set_heading or --nose-down), or give the mounting (mounting_rpy or base_frame)')


def level(calibration: Calibration, reading: Floats, frame: FrameName,
          context: Context | None = None) -> Calibration:
    """
    Return a calibration with the mounting from one flat pose.

    Parameters
    ----------
    calibration : Calibration
        The calibration, with any ΔR. The heading of an existing mounting is kept.
    reading : (3,) array
        Mean reading of the flat pose, in the unit of the readings.
    frame : {'ros', 'ned', 'android', 'win8'}
        The levelled frame.
    context : mapping of str to array, optional
        Columns that the effects need, one row.

    Returns
    -------
    Calibration
        The calibration with ΔR of this pose, and a finding if the wiring may be wrong.

    """
    rotation = mounting(_in_sensor_axes(calibration, reading, context), frame)
    kept = calibration.is_levelled and frame == calibration.frame
    arbitrary = not kept and heading_is_arbitrary(rotation, frame)
    if kept:
        rotation = with_heading_of(calibration.rotation, rotation)
    others = without(calibration.noted, 'flat_pose', 'heading')
    levelled = replace(calibration, model=Model(calibration.model.values, rotation), frame=frame)
    return replace(levelled, noted=(
        *wiring(levelled), *without(others, 'wiring'), *doubts_about_flat(rotation, frame),
        *((_ARBITRARY_HEADING,) if arbitrary else ())))


def set_heading(calibration: Calibration, reading: Floats, context: Context | None = None
                ) -> Calibration:
    """
    Return a calibration with the heading from one pose with the nose of the robot down.

    Parameters
    ----------
    calibration : Calibration
        The calibration, already levelled.
    reading : (3,) array
        Mean reading of the pose, in the unit of the readings.
    context : mapping of str to array, optional
        Columns that the effects need, one row.

    Returns
    -------
    Calibration
        The calibration with this heading.

    Raises
    ------
    InputError
        If the nose is tilted down by less than 10°.

    """
    nose_down = _in_sensor_axes(calibration, reading, context)
    rotation = with_heading(calibration.rotation, nose_down, calibration.frame)
    return with_mounting(calibration, rotation)


def with_mounting(calibration: Calibration, rotation: Floats) -> Calibration:
    """Return a calibration with another ΔR, whose heading is known."""
    turned = replace(calibration, model=Model(calibration.model.values, rotation))
    return replace(turned, noted=(*wiring(turned),
                                  *without(turned.noted, 'wiring', 'heading')))


def with_given_mounting(calibration: Calibration, rotation: Floats) -> Calibration:
    """
    Return a calibration with a mounting that is known from elsewhere, such as a URDF.

    A calibration that is levelled to within 10° of the given mounting keeps its tilt, which a flat
    pose measured, and takes only the heading.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    rotation : (3, 3) array
        The given ΔR.

    """
    if calibration.is_levelled and calibration.rotation[:, 2] @ rotation[:, 2] > _SAME_TILT:
        rotation = with_heading_of(rotation, calibration.rotation)
    return with_mounting(calibration, rotation)


def _in_sensor_axes(calibration: Calibration, reading: Floats, context: Context | None) -> Floats:
    """Return the specific force of one reading in the axes of the sensor [g]."""
    reading_g = calibration.units.to_g(np.asarray(reading, float))[np.newaxis]
    return sensor_force(calibration.model, reading_g, calibration.held_context(context))[0]
