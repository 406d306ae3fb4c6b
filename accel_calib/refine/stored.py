# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A stored calibration as the base of a refinement.

The calibration is the simulation, and the new poses are the measurement. The poses of the
calibration are added to the new poses, without their times, because the clocks of two recordings
can differ. If the file was edited by hand, or the new poses are partly those of the calibration
and contradict it, the readings that the calibration predicts replace its measured ones. Changes of
the sensor since the calibration are effects that act only on the new poses
(`accel_calib.effects.CHANGES`). If the context differs between the two sets, effects of the
context compete with these changes.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..calibrate import Calibration, in_g
from ..effects import CHANGES, effect_named, Model, parameter_names
from ..estimate import estimate, judge
from ..finding import has
from ..geometry import unit
from ..table import COLUMNS, Floats, Poses

_DIGITS = 7
"""Number of decimals [g] in which two readings of the same pose are equal."""

_SAME = 0.999
"""Quantile of chi² below which a stored calibration agrees with poses of its fit."""

_EITHER = ('temperature', 'supply_voltage', 'rate', 'previous')
"""Context that is set to NaN if the stored poses do not have it."""


def beside_stored(poses_g: Poses, calibration: Calibration) -> Poses:
    """
    Return new poses followed by those of a stored calibration.

    Parameters
    ----------
    poses_g : Poses
        The new poses, in g.
    calibration : Calibration
        The stored calibration.

    Returns
    -------
    Poses
        All poses, with the column ``new``. Only the new poses, without this column, if the
        calibration has no effects or no poses, or was fitted to some of the new poses and still
        agrees with them.

    """
    stored = in_g(calibration.used_poses, calibration.units)
    if not len(stored) or not calibration.model.effects:
        return poses_g
    shared, edited = _shares(poses_g, stored), has(calibration.noted, 'edited')
    if shared and not edited and _agrees(calibration, poses_g):
        return poses_g
    if shared or edited:
        stored = _as_calibrated(stored, calibration)
    count = (len(poses_g), len(stored))
    columns = {key: _joined(key, poses_g, stored) for key in COLUMNS
               if (key in poses_g and key in stored) or (key in _EITHER and key in poses_g)}
    if 'time' in calibration.ranges:  # limited to the range of the calibration
        held = np.clip(poses_g['time'], *calibration.ranges['time'])
        columns['time'] = np.concatenate([held, stored['time']])
    elif 'time' in poses_g:
        columns['time'] = np.concatenate([poses_g['time'], np.full(count[1], np.nan)])
    if 'orientation' in poses_g:
        least = float(np.min(poses_g['orientation']))
        columns['orientation'] = np.concatenate([
            poses_g['orientation'], least - 1.0 - np.arange(count[1])])
    if 'std' not in columns or 'count' not in columns:
        columns = {key: values for key, values in columns.items() if key not in ('std', 'count')}
    columns['new'] = np.repeat([1.0, 0.0], count)
    return Poses(columns, _rows(poses_g, stored))


def with_stored(poses: Poses, calibration: Calibration) -> Poses:
    """Return poses followed by those of a stored calibration, in the unit of the readings."""
    stored = calibration.used_poses
    columns = {key: np.concatenate([poses[key], stored[key]]) for key in poses.columns
               if key in stored}
    return Poses(columns, _rows(poses, stored))


def _rows(poses: Poses, stored: Poses) -> NDArray[np.int64]:
    return np.concatenate([poses.row, int(poses.row.max()) + 1 + np.arange(len(stored))])


def _shares(poses_g: Poses, stored: Poses) -> bool:
    """Return whether a pose is in both tables."""
    one, other = ({tuple(row) for row in each.reading.round(_DIGITS).tolist()}
                  for each in (poses_g, stored))
    return not one.isdisjoint(other)


def _agrees(calibration: Calibration, poses_g: Poses) -> bool:
    """Return whether a fit to the poses is no better than the calibration as stored."""
    from scipy.special import chdtri

    model = Model(calibration.model.values)
    fit = estimate(model, poses_g)
    excess = judge(model, calibration.held(poses_g)).chi2 - fit.chi2
    worse = max(fit.chi2 / max(fit.dof, 1), 1.0)
    return bool(excess / worse < chdtri(len(model.vector), 1.0 - _SAME))


def _as_calibrated(stored: Poses, calibration: Calibration) -> Poses:
    """Return the poses with the readings that the calibration predicts in their directions."""
    here = calibration.model.at(stored.columns)
    return stored.with_columns(reading=here.reading(unit(here.force(stored.reading))))


def _joined(key: str, poses_g: Poses, stored: Poses) -> Floats:
    ours = poses_g[key]
    theirs = stored[key] if key in stored else np.full((len(stored), *ours.shape[1:]), np.nan)
    return np.concatenate([ours, theirs])


def with_changes(model: Model) -> tuple[Model, Floats]:
    """
    Return a model with the changes since the stored calibration included in its effects.

    Parameters
    ----------
    model : Model
        A model with or without effects of `accel_calib.effects.CHANGES`.

    Returns
    -------
    Model, (q, p) array
        The model without changes, and the matrix from the values of `model` to its values.

    """
    effects = [name for name in model.effects if name not in CHANGES]
    if 'gain' in effects and 'axis_gain_change' in model.values:
        effects[effects.index('gain')] = 'axis_gain'
    for name in model.effects:
        own = name.removesuffix('_change')
        if name in CHANGES and own not in effects and not (
                own == 'gain' and 'axis_gain' in effects):
            effects.append(own)
    names, given = parameter_names(tuple(effects)), parameter_names(model.effects)
    matrix = np.zeros((len(names), len(given)))
    for k, name in enumerate(given):
        own = name.replace('_change.', '.')
        if own == 'gain.all' and own not in names:
            for axis in 'xyz':
                matrix[names.index(f'axis_gain.{axis}'), k] = 1.0
        else:
            matrix[names.index(own), k] = 1.0
    values, start = {}, 0
    for name in effects:
        size = len(effect_named(name).values)
        values[name] = (matrix @ model.vector)[start:start + size]
        start += size
    return Model(values, model.rotation), matrix
