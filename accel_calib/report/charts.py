# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures over the sphere, against a variable, and before and after.

**Sphere map.** Figures of residuals over the sphere: two hemispheres in Lambert's equal-area
projection.

A direction u is at the radius √(1 - |u_z|) from the pole. Equal areas of the sphere have equal
areas on the map.

**Residual against a variable.** Figures of residuals against a variable, such as force along an
axis or time.

"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .residuals import Variable
from .style import (
    ACCENT,
    AFTER,
    BEFORE,
    Chart,
    DISC,
    DIVERGING,
    FAINT,
    INK,
    legend_below,
    Mark,
    new_figure,
    PAPER,
    residual_label,
    RIM,
    SEQUENTIAL,
    styled,
)
from ..estimate import uncovered
from ..table import Floats

_HEIGHT_INCHES = 3.3
_INK_PER_POSE = 3500.0
"""Total area of the markers [points²]; markers are larger for fewer poses."""

HALVES = ('down', 'up')
"""Names of the markers of the hemispheres -z and +z."""


_LEAST_MG = 1e-3
"""Smallest residual of a logarithmic axis [mg]."""


def equal_area(force: Floats) -> Floats:
    """Return the (n, 2) positions of (n, 3) directions on the maps, which are unit discs."""
    unit = force / np.linalg.norm(force, axis=1, keepdims=True)
    flat = unit[:, :2]
    across = np.linalg.norm(flat, axis=1, keepdims=True)
    radius = np.sqrt(1.0 - np.abs(unit[:, 2:]))
    return flat / np.where(across > 0.0, across, 1.0) * radius


def draw_map(title: str, force: Floats, residual_mg: Floats, limit_mg: float, *,
             signed: bool, left_out: Floats, rows: tuple[int, ...],
             marks: tuple[Mark, ...]) -> Chart:
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
    marks : tuple of Mark
        Text of each pose.

    """
    hover = {}
    with styled():
        figure, discs = _two_discs(title)
        for disc, up in zip(discs, (True, False), strict=True):
            here = np.flatnonzero((force[:, 2] >= 0.0) == up)
            here = here[np.argsort(np.abs(residual_mg[here]))]
            drawn = _draw_poses(disc, force[here], residual_mg[here], limit_mg, signed,
                                _INK_PER_POSE / max(len(force), 12))
            drawn.set_gid(HALVES[up])
            hover[HALVES[up]] = tuple(marks[k] for k in here)
            hover.update(_draw_left_out(disc, left_out, rows, up=up))
        bar = figure.colorbar(drawn, ax=list(discs), orientation='horizontal', aspect=40,
                              shrink=0.8, pad=0.03)
        bar.set_label(residual_label(signed=signed))
        bar.outline.set_visible(False)
    return Chart(figure, hover)


def draw_disc(disc: Any, *, up: bool) -> None:
    """Draw the map of the hemisphere +z or -z with the sensor axes."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    disc.fill(np.cos(angle), np.sin(angle), facecolor=DISC, edgecolor=RIM, zorder=0)
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
    return disc.scatter(*equal_area(force).T, c=residual_mg, s=min(area, 130.0),
                        cmap=DIVERGING if signed else SEQUENTIAL,
                        vmin=-limit_mg if signed else 0.0, vmax=limit_mg,
                        edgecolors=INK, linewidths=0.5, zorder=3)


def _draw_left_out(disc: Any, left_out: Floats, rows: tuple[int, ...], *, up: bool
                   ) -> dict[str, tuple[Mark, ...]]:
    """Draw the poses left out as hollow squares with their rows, and return their texts."""
    here = np.flatnonzero((left_out[:, 2] >= 0.0) == up)
    places = equal_area(left_out[here])
    disc.plot(*places.T, linestyle='none', marker='s', markersize=8, fillstyle='none',
              color=ACCENT, zorder=4, gid=f'out_{HALVES[up]}')
    for place, k in zip(places, here, strict=True):
        disc.annotate(str(rows[k]), place, (5, 4), textcoords='offset points', fontsize=8.5,
                      color=ACCENT, zorder=4)
    return {f'out_{HALVES[up]}': tuple(Mark(rows[k], f'row {rows[k]}, left out') for k in here)}


def draw_against(title: str, variables: Sequence[Variable], residual_mg: Floats,
                 limit_mg: float, *, signed: bool, colour: str, marks: tuple[Mark, ...]) -> Chart:
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
    marks : tuple of Mark
        Text of each pose.

    """
    with styled():
        figure = new_figure(1.0 + 1.45 * len(variables) + (0.8 if len(variables) == 1 else 0.0))
        panels = figure.subplots(len(variables), 1, sharey=True, squeeze=False)[:, 0]
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        size = float(np.clip(5.5 - len(residual_mg) / 80.0, 2.5, 5.5))
        for k, (panel, variable) in enumerate(zip(panels, variables, strict=True)):
            panel.grid(visible=True)
            panel.axhline(0.0, color=ACCENT, linewidth=1.0)
            panel.plot(variable.values, residual_mg, 'o', color=colour, markersize=size,
                       markeredgecolor=PAPER, markeredgewidth=0.4, gid=f'panel{k}')
            panel.set_xlabel(variable.label)
            if variable.unit_range:
                panel.set(xlim=(-1.06, 1.06), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
            panel.set_ylim(-limit_mg if signed else -0.04 * limit_mg, limit_mg)
        figure.supylabel(residual_label(signed=signed), fontsize=10.0)
    return Chart(figure, {f'panel{k}': marks for k in range(len(variables))})


def draw_coverage(title: str, force: Floats, next_pose: Floats | None,
                  marks: tuple[Mark, ...]) -> Chart:
    """
    Draw the poses over the sphere, and the directions that no pose covers.

    Parameters
    ----------
    title : str
        Title of the figure.
    force : (n, 3) array
        Direction of up in each pose, in the sensor axes.
    next_pose : (3,) array or None
        Direction of the next pose.
    marks : tuple of Mark
        Text of each pose.

    """
    open_ = uncovered(force)
    hover = {}
    with styled():
        figure, discs = _two_discs(title)
        for disc, up in zip(discs, (True, False), strict=True):
            disc.plot(*equal_area(open_[(open_[:, 2] >= 0.0) == up]).T, 'x', color=ACCENT,
                      markersize=3.5, label='not covered', zorder=2)
            here = np.flatnonzero((force[:, 2] >= 0.0) == up)
            disc.plot(*equal_area(force[here]).T, 'o', color=AFTER, markeredgecolor=PAPER,
                      markersize=7, label='pose', zorder=3, gid=HALVES[up])
            hover[HALVES[up]] = tuple(marks[k] for k in here)
            if next_pose is not None:
                there = next_pose[np.newaxis][[(next_pose[2] >= 0.0) == up]]
                disc.plot(*equal_area(there).T, '*', color=ACCENT, markersize=14,
                          label='next pose', zorder=4)
        legend_below(figure, 3, *discs[0].get_legend_handles_labels())
    return Chart(figure, hover)


def _two_discs(title: str) -> tuple[Any, Any]:
    """Return a new figure, and its discs of the hemispheres +z and -z."""
    figure = new_figure(_HEIGHT_INCHES)
    figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
    discs = figure.subplots(1, 2)
    for disc, up in zip(discs, (True, False), strict=True):
        draw_disc(disc, up=up)
    return figure, discs


def draw_before_after(title: str, rows: Sequence[int], before_mg: Floats, after_mg: Floats,
                      floor_mg: float | None, marks: tuple[tuple[Mark, ...], tuple[Mark, ...]],
                      *, signed: bool) -> Chart:
    """
    Draw the size of the residual of each pose without and with the calibration.

    Parameters
    ----------
    title : str
        Title of the figure.
    rows : sequence of int
        Row of each pose.
    before_mg, after_mg : (n,) array
        Residuals without and with the calibration [mg].
    floor_mg : float or None
        Noise floor [mg], if it is known.
    marks : tuple of two tuples of Mark
        Text of each pose, before and after.
    signed : bool
        Whether only |force| is known.

    """
    with styled():
        figure = new_figure(_HEIGHT_INCHES)
        figure.suptitle(title, x=0.02, ha='left', fontsize=10.5)
        panel = figure.subplots()
        panel.grid(visible=True, axis='y')
        for name, values, colour in (('before', before_mg, BEFORE), ('after', after_mg, AFTER)):
            panel.plot(rows, np.maximum(np.abs(values), _LEAST_MG), 'o', color=colour, gid=name,
                       label=name, markeredgecolor=PAPER, markeredgewidth=0.4,
                       markersize=float(np.clip(7.0 - len(values) / 60.0, 3.0, 7.0)))
        if floor_mg:
            panel.axhline(floor_mg, color=ACCENT, linestyle=(0, (5, 3)), label='noise floor')
        panel.set_yscale('log')
        panel.yaxis.set_major_formatter(lambda value, _: f'{value:g}')
        panel.locator_params(axis='x', integer=True)
        panel.margins(y=0.1)
        panel.set(xlabel='row of the pose', ylabel='size of |force| − 1 g [mg]' if signed else
                  residual_label(signed=False))
        legend_below(figure, 3)
    return Chart(figure, {'before': marks[0], 'after': marks[1]})
