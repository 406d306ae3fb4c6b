# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The variables that residuals and curves are drawn over: of an effect, and of the context."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..effects import acting_temperature, AXES, effect_named, rate_at
from ..table import Floats, Poses
from ..units import MG

_CONTEXT = ('temperature', 'time', 'supply_voltage', 'std', 'rate')


@dataclass(frozen=True)
class Variable:
    """
    A variable for the horizontal axis.

    Parameters
    ----------
    label : str
        Name and unit.
    values : (n,) array
        One value per pose.
    unit_range : bool
        Whether the range is -1 to 1 by definition.

    """

    label: str
    values: Floats
    unit_range: bool = False


def variables_of(effect: str, poses_g: Poses, force: Floats, shape: Floats | None = None
                 ) -> list[Variable]:
    """
    Return the variables that an effect depends on: one variable, or one per axis.

    Parameters
    ----------
    effect : str
        Name of the effect in the model.
    poses_g : Poses
        The poses, in g.
    force : (n, 3) array
        Force of each pose [g].
    shape : (s,) array, optional
        Shape of the effect, such as a lag; by default zeros.

    """
    found = effect_named(effect)
    shape = np.zeros(len(found.shape)) if shape is None else shape
    known = with_thermal(poses_g, found.lagged, shape)
    key = next((name for name in found.over_of(shape) if name in known), None)
    if key == 'previous':
        return [Variable(f'from the previous pose, {axis}', known[key][:, k], True)
                for k, axis in enumerate(AXES)]
    if key is None:
        return [Variable(f'force along {axis} [g]', force[:, k], True)
                for k, axis in enumerate(AXES) if k in _axes_of(effect)]
    return [variable_of(key, known[key])]


def _axes_of(effect: str) -> list[int]:
    """Return the axes of an effect of the force: those of its terms."""
    return sorted({term.axis for term in effect_named(effect).terms}) or [0, 1, 2]


def with_thermal(poses_g: Poses, lagged: str, shape: Floats) -> Poses:
    """Return poses with the rate of the temperature and the temperature that acts, if known."""
    if 'time' not in poses_g or 'temperature' not in poses_g:
        return poses_g
    found = {'temperature_rate': rate_at(poses_g.columns)}
    if lagged and shape[0]:
        found[lagged] = acting_temperature(poses_g.columns, lagged, shape[0], bool(shape[1]))
    return poses_g.with_columns(**found)


def recorded(poses_g: Poses) -> list[Variable]:
    """Return the variables of the context that change between poses."""
    found = [variable_of(key, poses_g[key]) for key in _CONTEXT if key in poses_g]
    return [variable for variable in found if np.ptp(variable.values) > 0.0]


_LABELS = {
    'temperature': ('temperature [°C]', 1.0),
    'temperature_of_offset': ('temperature that acts on the offset [°C]', 1.0),
    'temperature_of_gain': ('temperature that acts on the gain [°C]', 1.0),
    'temperature_rate': ('rate of temperature [°C/min]', 60.0),
    'supply_voltage': ('supply [V]', 1.0), 'std': ('standard deviation of the samples [mg]', MG),
    'rate': ('angular rate [rad/s]', 1.0), 'force': ('force along the axis [g]', 1.0)}
"""Label and factor of each variable."""


def variable_of(key: str, values: Floats) -> Variable:
    """Return a variable for the horizontal axis: (n,) values, or the (n, 3) ones of a vector."""
    if key == 'time':
        return _time(values)
    if values.ndim > 1:
        mean = np.mean if key == 'std' else np.sum
        values = np.sqrt(mean(values ** 2, axis=1))
    label, factor = _LABELS[key]
    return Variable(label, values * factor)


def since_first(poses: Poses) -> Floats:
    """Return the (n,) time of each pose since the first [s]."""
    return poses['time'] - np.min(poses['time'])


def _time(seconds: Floats) -> Variable:
    since = seconds - np.min(seconds)
    span = np.max(since)
    for unit, size in (('h', 3600.0), ('min', 60.0)):
        if span > 3.0 * size:
            return Variable(f'time since the first pose [{unit}]', since / size)
    return Variable('time since the first pose [s]', since)
