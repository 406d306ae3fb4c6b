# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of a refinement and of a calibration, with their names and descriptions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .charts import draw_against, draw_before_after, draw_coverage, draw_map
from .curve import carrier_words, curve_parts, draw_curve
from .ladder import draw_ladder
from .residuals import marks_of, Residuals, residuals_of_refinement
from .style import AFTER, BEFORE, Chart, save
from .variables import recorded, Variable, variables_of
from ..effects import effect_named, empirical_parts, VARIABLES
from ..refine.words import base_words, curve_unit
from ..table import Floats
from ..text import short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..refine import Refinement, Stage

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
