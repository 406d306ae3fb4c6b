# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a refinement.

**Sphere map.** Figures of residuals over the sphere: two hemispheres in Lambert's equal-area
projection.

A direction u is at the radius √(1 - |u_z|) from the pole. Equal areas of the sphere have equal
areas on the map.

**Residual against a variable.** Figures of residuals against a variable, such as force along an
axis or time.

**Ladder.** Figure of the residual of each step, from the base to the noise floor.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from .curve import carrier_words, curve_parts, draw_curve
from .style import (
    ACCENT,
    AFTER,
    BEFORE,
    DIVERGING,
    FAINT,
    INK,
    new_figure,
    residual_label,
    save,
    SEQUENTIAL,
    styled,
)
from .variables import recorded, Variable, variables_of
from ..effects import effect_named, empirical_parts, VARIABLES
from ..table import Floats
from ..words import base_words, curve_unit, short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..refine import Refinement, Stage

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


_WIDTH_INCHES = 4.9
_LEVEL_INCHES = 0.52


def draw_ladder(result: Refinement) -> Figure:
    """Draw the residual and the held-out residual of the base and after each step."""
    levels = _levels(result)
    with styled():
        figure = new_figure(1.25 + _LEVEL_INCHES * len(levels), _WIDTH_INCHES)
        axes = figure.subplots()
        _draw_levels(axes, levels)
        if result.noise_floor_mg:
            axes.axvline(result.noise_floor_mg, color=ACCENT, linewidth=1.6, linestyle=(0, (5, 3)),
                         label=f'noise floor {short(result.noise_floor_mg)} mg', zorder=1)
        _scale(axes, *_limits(result, levels))
        axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=3, handletextpad=0.2,
                    columnspacing=0.9, handlelength=1.6, borderaxespad=0.0)
    return figure


def _scale(axes: Any, least: float, largest: float) -> None:
    """Set a logarithmic axis of residuals with legible ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    few = largest / least > 300.0
    axes.set_xscale('log')
    axes.set_xlim(least, largest)
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if few else (1.0, 2.0, 5.0)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel('residual: RMS over the poses [mg], logarithmic')
    axes.grid(visible=True, axis='x')


def _levels(result: Refinement) -> list[tuple[str, float, float | None]]:
    """Return name, residual and held-out residual [mg] of the base and after each step."""
    held_out = (result.steps[0].held_out_before_mg if result.steps
                else result.calibration.quality.held_out_rms_mg)
    levels = [(base_words(result), result.gap_mg, held_out)]
    levels += [(f'+ {step.effect}', step.gap_after_mg, step.held_out_after_mg)
               for step in result.steps]
    return levels


def _draw_levels(axes: Any, levels: list[tuple[str, float, float | None]]) -> None:
    height = np.arange(len(levels))
    residuals = np.array([residual for _, residual, _ in levels])
    axes.step(residuals, height, where='post', color=FAINT, linewidth=2.0, zorder=1)
    axes.plot(residuals, height, 'o', color=AFTER, markersize=9, label='all poses used', zorder=3)
    held_out = np.array([np.nan if out is None else out for _, _, out in levels])
    if np.any(np.isfinite(held_out)):
        axes.plot(held_out, height, 'o', color=AFTER, markersize=9, fillstyle='none',
                  markeredgewidth=1.6, label='held out', zorder=3)
    white = {'facecolor': 'white', 'edgecolor': 'none', 'pad': 1.0}
    for at, residual, out in zip(height, residuals, held_out, strict=True):
        words = short(residual) + ('' if np.isnan(out) else f', held out {short(out)}')
        axes.annotate(words, (np.nanmax([residual, out]), at), (9, 0), va='center',
                      textcoords='offset points', fontsize=9.0,
                      bbox=white)
    for at, (name, _, _) in zip(height, levels, strict=True):
        axes.text(0.005, at - 0.36, name, transform=axes.get_yaxis_transform(), va='center',
                  fontweight='bold', fontsize=9.5, bbox=white)
    axes.set_ylim(len(levels) - 0.55, -0.65)
    axes.yaxis.set_visible(False)
    axes.spines['left'].set_visible(False)


def _limits(result: Refinement, levels: list[tuple[str, float, float | None]]
            ) -> tuple[float, float]:
    """Return the limits of the axis, with space for the numbers."""
    values = [value for level in levels for value in level[1:] if value]
    values += [result.noise_floor_mg] if result.noise_floor_mg else []
    least, largest = min(values, default=1.0), max(values, default=1.0)
    room = max(float(np.log10(largest / least)), 0.5)
    return least / 10.0 ** (0.08 * room), largest * 10.0 ** (0.5 * room)


_ROOM = 1.08
_FEW_DIRECTIONS = 6
_SUFFIXES = ('.svg', '.png')


@dataclass(frozen=True)
class Drawing:
    """
    A figure of the report.

    Parameters
    ----------
    name : str
        Name of the file, without suffix.
    title : str
        Title.
    figure : Figure
        The figure.

    """

    name: str
    title: str
    figure: Figure


def ladder(result: Refinement) -> Drawing:
    """Draw the residual of the base and after each step."""
    after = ', '.join(short(step.gap_after_mg) for step in result.steps)
    title = f'Residual of the base {short(result.gap_mg)} mg' + (
        f', then {after} mg' if after else '')
    return Drawing('ladder', title, draw_ladder(result))


def of_step(result: Refinement, step: int) -> Iterator[Drawing]:
    """Yield figures of the residuals before and after a step, with equal scales."""
    before, after = result.stages[step], result.stages[step + 1]
    limit_mg = _limit_mg(before, after)
    name = f'step{step + 1}_{after.name}'
    first = base_words(result) if step == 0 else f'+ {before.name}'
    stages = ((before, first, 'before', BEFORE), (after, f'+ {after.name}', 'after', AFTER))
    for stage, words, when, _ in stages if _spread(result) else ():
        title = f'{when.capitalize()}: {words}, {_rms(stage)} mg RMS'
        yield _map(result, stage, f'{name}_sphere_{when}', title, limit_mg)
    variables = _variables_of_step(result, step)
    for stage, words, when, colour in stages:
        title = f'{when.capitalize()}: {words}, {_rms(stage)} mg RMS'
        yield _against(result, stage, variables, f'{name}_variable_{when}', title, limit_mg,
                       colour)


def _variables_of_step(result: Refinement, step: int) -> list[Variable]:
    """Return the variables of the effect of a step, with the shape of the refined model."""
    name = result.steps[step].name
    values = result.calibration.model.values.get(name)
    shape = None if values is None else effect_named(name).split(values)[1]
    return variables_of(name, result.poses_g, result.force, shape)


def of_curve(result: Refinement, step: int) -> Drawing:
    """Draw the empirical curve of a step."""
    name = result.steps[step].curve
    carrier, variable, _ = empirical_parts(name)
    words = carrier_words(carrier)
    title = f'{words[0].upper()}{words[1:]} over {VARIABLES[variable]}, with 95 % band'
    figure = draw_curve(title, variable, curve_parts(result, name), f'm{curve_unit(name)}')
    return Drawing(f'step{step + 1}_curve', title, figure)


def of_remainder(result: Refinement) -> Iterator[Drawing]:
    """Yield figures of the final residuals, over the sphere and against the context."""
    stage = result.stages[-1]
    limit_mg = _limit_mg(stage)
    if _spread(result):
        yield _map(result, stage, 'remaining_sphere', f'Remaining residual: {_rms(stage)} mg RMS',
                   limit_mg)
    variables = recorded(result.poses_g) or variables_of('quadratic', result.poses_g,
                                                         result.force)
    yield _against(result, stage, variables[:3], 'remaining_variables',
                   f'Remaining residual: {_rms(stage)} mg RMS', limit_mg, AFTER)


def all_drawings(result: Refinement) -> Iterator[Drawing]:
    """Yield all figures of the report."""
    yield ladder(result)
    for step in range(len(result.steps)):
        yield from of_step(result, step)
        if result.steps[step].curve:
            yield of_curve(result, step)
    yield from of_remainder(result)


def write_figures(folder: Path, result: Refinement) -> list[Path]:
    """
    Write all figures as SVG and PNG, and return the paths.

    Raises
    ------
    OSError
        If the folder cannot be written.

    """
    folder.mkdir(exist_ok=True)
    paths = []
    for drawing in all_drawings(result):
        for suffix in _SUFFIXES:
            paths.append(folder / f'{drawing.name}{suffix}')
            save(drawing.figure, paths[-1])
    return paths


def _signed(result: Refinement) -> bool:
    """Return whether the residuals are signed, because only |force| is known."""
    return any(bool(np.any(stage.residual_mg < 0.0)) for stage in result.stages)


def _spread(result: Refinement) -> bool:
    """Return whether the poses have enough different directions for a map."""
    return len(np.unique(np.round(result.force, 1), axis=0)) >= _FEW_DIRECTIONS


def _limit_mg(*stages: Stage) -> float:
    largest = max(float(np.max(np.abs(stage.residual_mg))) for stage in stages)
    return max(largest, 1e-9) * _ROOM


def _rms(stage: Stage) -> str:
    return short(float(np.sqrt(np.mean(stage.residual_mg ** 2))))


def _map(result: Refinement, stage: Stage, name: str, title: str, limit_mg: float) -> Drawing:
    directions, rows = _left_out(result)
    return Drawing(name, title, draw_map(title, result.force, stage.residual_mg, limit_mg,
                                         signed=_signed(result), left_out=directions, rows=rows))


def _against(result: Refinement, stage: Stage, variables: list[Variable], name: str, title: str,
             limit_mg: float, colour: str) -> Drawing:
    along = ' and '.join(variable.label for variable in variables)
    figure = draw_against(title, variables, stage.residual_mg, limit_mg, signed=_signed(result),
                          colour=colour)
    return Drawing(name, f'{title}, against {along}', figure)


def _left_out(result: Refinement) -> tuple[Floats, tuple[int, ...]]:
    """Return directions and rows of the poses left out."""
    calibration = result.calibration
    which = np.isin(calibration.poses.row, result.disturbed_poses)
    poses = calibration.poses.take(which)
    mat_w, vec_v = calibration.model.linear_part
    force = np.linalg.solve(mat_w, (calibration.units.to_g(poses.reading) - vec_v).T).T
    return (force / np.linalg.norm(force, axis=1, keepdims=True),
            tuple(int(row) for row in poses.row))
