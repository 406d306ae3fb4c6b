# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The figures of a refinement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .against import draw_against, recorded, Variable, variables_of
from .ladder import draw_ladder
from .sphere_map import draw_map
from .style import AFTER, BEFORE, save
from ..table import Floats
from ..words import base_words, short

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..refine import Refinement, Stage

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
    variables = variables_of(after.name, result.poses_g, result.force)
    for stage, words, when, colour in stages:
        title = f'{when.capitalize()}: {words}, {_rms(stage)} mg RMS'
        yield _against(result, stage, variables, f'{name}_variable_{when}', title, limit_mg,
                       colour)


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
