# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A stored calibration as the base: it is the simulation, the new poses are the measurement.

The poses that the calibration was fitted to stand beside the new ones, with the time of the stored
ones left out, for clocks of two recordings need not agree. How the sensor has changed since then
are effects that act on the new poses alone (`accel_calib.effects.CHANGES`). Where one of its
conditions differs between the two sets, an effect of that condition competes with them.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..calibrate import Calibration, in_g
from ..effects import CHANGES, effect_named
from ..model import Model, parameter_names
from ..table import COLUMNS, Floats, Poses

_DIGITS = 7
"""Decimals [g] to which two readings of the same pose agree."""

_EITHER = ('temperature', 'supply_voltage', 'rate', 'previous')
"""Context that counts as not known for a set of poses that lacks it."""


def beside_stored(poses_g: Poses, calibration: Calibration) -> Poses:
    """
    Return new poses with those of a stored calibration behind them.

    Parameters
    ----------
    poses_g : Poses
        The new poses, in g.
    calibration : Calibration
        The stored calibration.

    Returns
    -------
    Poses
        With the column ``new``; the poses alone, without it, if the calibration has none of its
        own, was fitted to some of these, or has effects of time.

    """
    stored = in_g(calibration.used_poses, calibration.units)
    timed = 'time' in calibration.model.needs
    if not len(stored) or timed or _shares(poses_g, stored):
        return poses_g
    count = (len(poses_g), len(stored))
    columns = {key: _joined(key, poses_g, stored) for key in COLUMNS
               if (key in poses_g and key in stored) or (key in _EITHER and key in poses_g)}
    if 'time' in poses_g:
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
    """Return poses with those of a stored calibration behind them, in the unit of the readings."""
    stored = calibration.used_poses
    columns = {key: np.concatenate([poses[key], stored[key]]) for key in poses.columns
               if key in stored}
    return Poses(columns, _rows(poses, stored))


def _rows(poses: Poses, stored: Poses) -> NDArray[np.int64]:
    return np.concatenate([poses.row, int(poses.row.max()) + 1 + np.arange(len(stored))])


def _shares(poses_g: Poses, stored: Poses) -> bool:
    """Return whether any of these poses is one of the stored ones."""
    one, other = ({tuple(row) for row in each.reading.round(_DIGITS).tolist()}
                  for each in (poses_g, stored))
    return not one.isdisjoint(other)


def _joined(key: str, poses_g: Poses, stored: Poses) -> Floats:
    ours = poses_g[key]
    theirs = stored[key] if key in stored else np.full((len(stored), *ours.shape[1:]), np.nan)
    return np.concatenate([ours, theirs])


def with_changes(model: Model) -> tuple[Model, Floats]:
    """
    Return a model with the changes since the stored calibration added to its own effects.

    Parameters
    ----------
    model : Model
        With effects of `accel_calib.effects.CHANGES`, or without.

    Returns
    -------
    Model, (q, p) array
        The model as it is now, and the matrix from the values of the given one to its values.

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
