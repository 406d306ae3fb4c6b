# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figure of an empirical curve over its variable, with its uncertainty.

The curve is shown relative to its mean over the poses, because offset and gain contain the mean.
The band is 1.96 standard deviations on both sides. Outside of the range of the poses, the curve is
constant.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .style import ACCENT, AFTER, Chart, INK, new_figure, styled, THIRD
from .variables import variable_of, with_thermal
from ..effects import AXES, CARRIERS, effect_named, empirical_parts, parameter_names
from ..table import Floats, Poses
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement

_COLOURS = (AFTER, ACCENT, THIRD)
"""Colours of the parts of a curve."""

_GRID = 201
"""Number of points of a curve."""

_HEIGHT_INCHES = 3.3
_BAND = 1.96
"""Half the width of a band, in standard deviations: 95 %."""


@dataclass(frozen=True)
class CurvePart:
    """
    One part of an empirical curve: an axis, a pair of axes, or all.

    Parameters
    ----------
    name : str
        Name of the part.
    at : (g,) array
        Values of the variable.
    change, deviation : (g,) array
        Change of the reading from the mean over the poses, and its standard deviation [g, g/g].
    poses : (n,) array
        Value of the variable at each pose.

    """

    name: str
    at: Floats
    change: Floats
    deviation: Floats
    poses: Floats


def curve_parts(result: Refinement, name: str) -> list[CurvePart]:
    """Return the parts of an empirical curve of the refined model."""
    carrier, variable, modes = empirical_parts(name)
    calibration = result.calibration
    whole, _, part = carrier.partition('.')
    names = (part,) if part else CARRIERS[whole]
    count = len(names) * len(modes)
    first = parameter_names(calibration.model.effects).index(
        f'{name}.{effect_named(name).parameters[0]}')
    values = calibration.model.values[name]
    low, high = values[count:] if variable != 'force' else (-1.0, 1.0)
    at = np.linspace(low, high, _GRID)
    parts = []
    for k, own in enumerate(names):
        poses = (result.force[:, AXES.index(own)] if variable == 'force'
                 else _at_poses(variable, result.poses_g))
        waves = _waves(modes, at, low, high)
        waves = waves - np.mean(_waves(modes, poses, low, high), axis=1, keepdims=True)
        mine = first + k + len(names) * np.arange(len(modes))
        spread = calibration.covariance[np.ix_(mine, mine)]
        variance = np.einsum('kg,kl,lg->g', waves, spread, waves)
        parts.append(CurvePart(own, at, values[k:count:len(names)] @ waves,
                               np.sqrt(np.maximum(variance, 0.0)), poses))
    return parts


def _at_poses(variable: str, poses_g: Poses) -> Floats:
    """Return the variable of a curve at each pose; for vectors, its RMS over the axes."""
    values = with_thermal(poses_g, '', np.zeros(0))[variable]
    return np.sqrt(np.mean(values ** 2, axis=1)) if values.ndim > 1 else values


def _waves(modes: Sequence[int], values: Floats, low: float, high: float) -> Floats:
    """Return the (k, n) cosines of a curve, constant outside of its range."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.cos(np.pi * np.multiply.outer(np.array(modes), share))


def draw_curve(title: str, variable: str, parts: Sequence[CurvePart], unit: str) -> Chart:
    """
    Draw an empirical curve with its 95 % band, and ticks at the poses.

    Parameters
    ----------
    title : str
        Title of the figure.
    variable : str
        Key of the variable.
    parts : sequence of CurvePart
        The parts of the curve.
    unit : str
        Unit of a thousandth of the change.

    """
    with styled():
        figure = new_figure(_HEIGHT_INCHES)
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        panel = figure.subplots()
        panel.grid(visible=True)
        for part, colour in zip(parts, _COLOURS):
            both = variable_of(variable, np.concatenate([part.at, part.poses]))
            at, poses = np.split(both.values, [len(part.at)])
            change, band = part.change * MG, _BAND * part.deviation * MG
            panel.plot(at, change, color=colour, label=part.name)
            panel.fill_between(at, change - band, change + band, color=colour, alpha=0.25,
                               linewidth=0.0)
            panel.plot(poses, np.full(len(poses), 0.02), '|', color=INK, markersize=7,
                       transform=panel.get_xaxis_transform())
        panel.set_xlabel(both.label)
        panel.set_ylabel(f'change from the mean [{unit}]')
        panel.legend(ncols=len(parts))
    return Chart(figure)


def carrier_words(carrier: str) -> str:
    """Return a carrier in words."""
    whole, _, part = carrier.partition('.')
    words = 'gain of all axes' if whole == 'force' else whole.replace('_', '-')
    return f'{words} of {part}' if part else words
