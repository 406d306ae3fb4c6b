# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The figures of a refinement and of a calibration, with their names and descriptions.

An empirical curve is shown relative to its mean over the poses, because offset and gain contain
the mean. The band is 1.96 standard deviations on both sides. Outside of the range of the poses,
the curve is constant. The ladder shows the residual of each step of a refinement, from the base to
the noise floor.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TYPE_CHECKING

import numpy as np

from .charts import draw_against, draw_before_after, draw_coverage, draw_map
from .residuals import (
    marks_of,
    recorded,
    Residuals,
    residuals_of_refinement,
    Variable,
    variable_of,
    variables_of,
    with_thermal,
)
from .style import ACCENT, AFTER, BEFORE, Chart, FAINT, INK, new_figure, PAPER, save, styled, THIRD
from ..effects import (
    AXES,
    CARRIERS,
    curve_unit,
    effect_named,
    empirical_parts,
    parameter_names,
    VARIABLES,
)
from ..refine.words import base_words
from ..table import Floats, Poses
from ..text import short
from ..units import MG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..refine import Refinement, Stage

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


_WIDTH_INCHES = 4.9
_LEVEL_INCHES = 0.52


def draw_ladder(result: Refinement) -> Chart:
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
    return Chart(figure)


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
    white = {'facecolor': PAPER, 'edgecolor': 'none', 'pad': 1.0}
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
_LEAST_LIMIT_MG = 1e-9
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
    chart : Chart
        The figure, and the texts of its markers.

    """

    name: str
    title: str
    chart: Chart

    @property
    def figure(self) -> Figure:
        """Return the figure."""
        return self.chart.figure


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
    for stage, words, when, _ in stages if _spread(result.force) else ():
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
    chart = draw_curve(title, variable, curve_parts(result, name), f'm{curve_unit(name)}')
    return Drawing(f'step{step + 1}_curve', title, chart)


def of_remainder(residuals: Residuals, prefix: str = 'remaining') -> Iterator[Drawing]:
    """Yield figures of the final residuals, over the sphere and against the context."""
    limit_mg = max(float(np.max(np.abs(residuals.after_mg))), _LEAST_LIMIT_MG) * _ROOM
    title = f'Remaining residual: {short(residuals.rms_mg)} mg RMS'
    signed, marks = residuals.signed, residuals.marks(residuals.after_mg)
    if _spread(residuals.force):
        yield Drawing(f'{prefix}_sphere', f'{title}, by direction', draw_map(
            title, residuals.force, residuals.after_mg, limit_mg, signed=signed,
            left_out=residuals.left_out_force, marks=marks,
            rows=tuple(int(row) for row in residuals.left_out.row)))
    poses_g = residuals.poses_g
    variables = (recorded(poses_g) or variables_of('quadratic', poses_g, residuals.force))[:3]
    along = ' and '.join(variable.label for variable in variables)
    yield Drawing(f'{prefix}_variables', f'{title}, against {along}', draw_against(
        title, variables, residuals.after_mg, limit_mg, signed=signed, colour=AFTER,
        marks=marks))


def of_coverage(residuals: Residuals, share: float, next_pose: Floats | None) -> Drawing:
    """Draw the poses over the sphere, and the directions that they do not cover."""
    title = f'{share:.0%} of the sphere is within 45° of a pose'.replace('%', ' %')
    return Drawing('coverage', title, draw_coverage(title, residuals.force, next_pose,
                                                    residuals.marks(residuals.after_mg)))


def of_before_after(residuals: Residuals, floor_mg: float | None) -> Drawing:
    """Draw the residual of each pose without and with the calibration."""
    before = float(np.sqrt(np.mean(residuals.before_mg ** 2)))
    title = f'Each pose before and after: {short(before)} and {short(residuals.rms_mg)} mg RMS'
    marks = residuals.marks(residuals.before_mg), residuals.marks(residuals.after_mg)
    return Drawing('before_after', title, draw_before_after(
        title, residuals.poses_g.row.tolist(), residuals.before_mg, residuals.after_mg, floor_mg,
        marks, signed=residuals.signed))


def all_drawings(result: Refinement) -> Iterator[Drawing]:
    """Yield all figures of the report."""
    yield ladder(result)
    for step in range(len(result.steps)):
        yield from of_step(result, step)
        if result.steps[step].curve:
            yield of_curve(result, step)
    yield from of_remainder(residuals_of_refinement(result))


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


def _spread(force: Floats) -> bool:
    """Return whether the poses have enough different directions for a map."""
    return len(np.unique(np.round(force, 1), axis=0)) >= _FEW_DIRECTIONS


def _limit_mg(*stages: Stage) -> float:
    largest = max(float(np.max(np.abs(stage.residual_mg))) for stage in stages)
    return max(largest, _LEAST_LIMIT_MG) * _ROOM


def _rms(stage: Stage) -> str:
    return short(float(np.sqrt(np.mean(stage.residual_mg ** 2))))


def _map(result: Refinement, stage: Stage, name: str, title: str, limit_mg: float) -> Drawing:
    left, signed = residuals_of_refinement(result), _signed(result)
    return Drawing(name, title, draw_map(
        title, result.force, stage.residual_mg, limit_mg, signed=signed,
        left_out=left.left_out_force, rows=tuple(int(row) for row in left.left_out.row),
        marks=marks_of(result.poses_g, stage.residual_mg, signed=signed)))


def _against(result: Refinement, stage: Stage, variables: list[Variable], name: str, title: str,
             limit_mg: float, colour: str) -> Drawing:
    along = ' and '.join(variable.label for variable in variables)
    signed = _signed(result)
    chart = draw_against(title, variables, stage.residual_mg, limit_mg, signed=signed,
                         colour=colour,
                         marks=marks_of(result.poses_g, stage.residual_mg, signed=signed))
    return Drawing(name, f'{title}, against {along}', chart)
