# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Figures of residuals over the sphere: two hemispheres in Lambert's equal-area projection.

A direction u is at the radius √(1 - |u_z|) from the pole. Equal areas of the sphere have equal
areas on the map.

"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np

from .style import ACCENT, DIVERGING, FAINT, INK, new_figure, residual_label, SEQUENTIAL, styled
from ..table import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEIGHT_INCHES = 3.3
_INK_PER_POSE = 3500.0
"""Total area of the markers [points²]; markers are larger for fewer poses."""


def equal_area(force: Floats) -> Floats:
    """Return the (n, 2) positions of (n, 3) directions on the maps, which are unit discs."""
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    flat = unit[:, :2]
    across = np.linalg.norm(flat, axis=1, keepdims=True)
    radius = np.sqrt(1.0 - np.abs(unit[:, 2:]))
    return flat / np.where(across > 0.0, across, 1.0) * radius


def draw_map(title: str, force: Floats, residual_mg: Floats, limit_mg: float, *,
             signed: bool, left_out: Floats, rows: tuple[int, ...]) -> Figure:
    """
    Draw residuals over the sphere.

    Parameters
    ----------
    title : str
        Title of the figure.
    force : (n, 3) array
        Direction of up in each pose, in the sensor axes.
    residual_mg : (n,) array
        Residual of each pose [mg].
    limit_mg : float
        Residual at the end of the colour scale [mg].
    signed : bool
        Whether the residuals are signed.
    left_out : (d, 3) array
        Directions of the poses left out.
    rows : tuple of int
        Rows of the poses left out.

    """
    with styled():
        figure = new_figure(_HEIGHT_INCHES)
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        discs = figure.subplots(1, 2)
        for disc, up in zip(discs, (True, False), strict=True):
            _draw_disc(disc, up=up)
            here = (force[:, 2] >= 0.0) == up
            drawn = _draw_poses(disc, force[here], residual_mg[here], limit_mg, signed,
                                _INK_PER_POSE / max(len(force), 12))
            _draw_left_out(disc, left_out, rows, up=up)
        bar = figure.colorbar(drawn, ax=list(discs), orientation='horizontal', aspect=40,
                              shrink=0.8, pad=0.03)
        bar.set_label(residual_label(signed=signed))
        bar.outline.set_visible(False)
    return figure


def _draw_disc(disc: Any, *, up: bool) -> None:
    """Draw the map of the hemisphere +z or -z with the sensor axes."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    disc.fill(np.cos(angle), np.sin(angle), facecolor='#fafafa', edgecolor='#888888', zorder=0)
    middle = np.sqrt(1.0 - np.sqrt(0.5))
    disc.plot(middle * np.cos(angle), middle * np.sin(angle), color=FAINT, linewidth=0.8, zorder=1)
    disc.plot([-1, 1], [0, 0], [0, 0], [-1, 1], color=FAINT, linewidth=0.8, zorder=1)
    for name, x, y in (('+x', 1, 0), ('-x', -1, 0), ('+y', 0, 1), ('-y', 0, -1)):
        disc.text(1.13 * x, 1.12 * y, name.replace('-', '−'), ha='center', va='center',
                  fontsize=8.5)
    disc.text(-1.22, 1.08, '+z up' if up else '−z up', fontsize=9.5)
    disc.set(xlim=(-1.24, 1.24), ylim=(-1.22, 1.22), aspect='equal')
    disc.axis('off')


def _draw_poses(disc: Any, force: Floats, residual_mg: Floats, limit_mg: float, signed: bool,
                area: float) -> Any:
    place = equal_area(force)
    order = np.argsort(np.abs(residual_mg))
    return disc.scatter(*place[order].T, c=residual_mg[order], s=min(area, 130.0),
                        cmap=DIVERGING if signed else SEQUENTIAL,
                        vmin=-limit_mg if signed else 0.0, vmax=limit_mg,
                        edgecolors=INK, linewidths=0.5, zorder=3)


def _draw_left_out(disc: Any, left_out: Floats, rows: tuple[int, ...], *, up: bool) -> None:
    """Draw the poses left out as hollow squares with their rows."""
    for place, z, row in zip(equal_area(left_out), left_out[:, 2], rows, strict=True):
        if (z >= 0.0) == up:
            disc.plot(*place, marker='s', markersize=8, fillstyle='none', color=ACCENT, zorder=4)
            disc.annotate(str(row), place, (5, 4), textcoords='offset points', fontsize=8.5,
                          color=ACCENT, zorder=4)
