# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Figures of residuals against a variable, such as force along an axis or time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .style import ACCENT, new_figure, residual_label, styled
from ..effects import AXES, effect_named
from ..table import Floats, Poses
from ..units import MG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def variables_of(effect: str, poses_g: Poses, force: Floats) -> list[Variable]:
    """Return the variables that an effect depends on: one variable, or one per axis."""
    key = next((name for name in effect_named(effect).needs if name in poses_g), None)
    if key == 'previous':
        return [Variable(f'from the previous pose, {axis}', poses_g[key][:, k], True)
                for k, axis in enumerate(AXES)]
    if key is None:
        return [Variable(f'force along {axis} [g]', force[:, k], True)
                for k, axis in enumerate(AXES)]
    return [_variable(key, poses_g)]


def recorded(poses_g: Poses) -> list[Variable]:
    """Return the variables of the context that change between poses."""
    found = [_variable(key, poses_g) for key in _CONTEXT if key in poses_g]
    return [variable for variable in found if np.ptp(variable.values) > 0.0]


def _variable(key: str, poses_g: Poses) -> Variable:
    values = poses_g[key]
    if key == 'time':
        return _time(values)
    if key == 'std':
        return Variable('standard deviation of the samples [mg]',
                        np.sqrt(np.mean(values ** 2, axis=1)) * MG)
    if key == 'rate':
        return Variable('angular rate [rad/s]', np.linalg.norm(values, axis=1))
    label, unit = {'temperature': ('temperature', '°C'), 'supply_voltage': ('supply', 'V')}[key]
    return Variable(f'{label} [{unit}]', values)


def _time(seconds: Floats) -> Variable:
    since = seconds - np.min(seconds)
    span = np.max(since)
    for unit, size in (('h', 3600.0), ('min', 60.0)):
        if span > 3.0 * size:
            return Variable(f'time since the first pose [{unit}]', since / size)
    return Variable('time since the first pose [s]', since)


def draw_against(title: str, variables: Sequence[Variable], residual_mg: Floats,
                 limit_mg: float, *, signed: bool, colour: str) -> Figure:
    """
    Draw residuals against variables, with one panel per variable.

    Parameters
    ----------
    title : str
        Title of the figure.
    variables : sequence of Variable
        Variable of each panel.
    residual_mg : (n,) array
        Residual of each pose [mg].
    limit_mg : float
        Limit of the residual axis [mg].
    signed : bool
        Whether the residuals are signed.
    colour : str
        Colour of the poses.

    """
    with styled():
        figure = new_figure(1.0 + 1.45 * len(variables) + (0.8 if len(variables) == 1 else 0.0))
        panels = figure.subplots(len(variables), 1, sharey=True, squeeze=False)[:, 0]
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        size = float(np.clip(5.5 - len(residual_mg) / 80.0, 2.5, 5.5))
        for panel, variable in zip(panels, variables, strict=True):
            panel.grid(visible=True)
            panel.axhline(0.0, color=ACCENT, linewidth=1.0)
            panel.plot(variable.values, residual_mg, 'o', color=colour, markersize=size,
                       markeredgecolor='white', markeredgewidth=0.4)
            panel.set_xlabel(variable.label)
            if variable.unit_range:
                panel.set(xlim=(-1.06, 1.06), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
            panel.set_ylim(-limit_mg if signed else -0.04 * limit_mg, limit_mg)
        figure.supylabel(residual_label(signed=signed), fontsize=10.0)
    return figure
