# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A refinement on the page: its steps, its ladder and its curves.

The ladder shows the residual of each step, from the base to the noise floor. An empirical curve is
shown relative to its mean over the poses, because offset and gain contain the mean. Its band is
1.96 standard deviations on both sides. Outside of the range of the poses, the curve is constant.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .residuals import (
    against, limit_mg, of_remainder, Residuals, residuals_of_refinement, sphere_map, variable_of,
    variables_of, with_thermal)
from .sheet import (
    ACCENT, add_band, AFTER, AXIS_COLOURS, BAND, BEFORE, Drawing, drawn, FAINT, HEIGHT_INCHES, INK,
    PAPER, styled)
from ..effects import AXES, EmpiricalCurve, entry_of, parameter_names, variable_words
from ..findings import base_words, chance_words, odds_words, value_words, verdict_words
from ..refinement import named_entries, Refinement
from ..statistics import over_axes, rms
from ..table import Floats
from ..text import short
from ..units import MG


def search_values(result: Refinement, residuals: Residuals) -> dict[str, Any]:
    """
    Return what a page shows of a search for effects.

    What the refinement leaves is shown if the calibration of the page leaves something else. They
    differ for effects that a calibration cannot correct, such as a slow change of the offset, and
    for poses of known or shared orientation, whose residual is the vector error.

    """
    left, entries = residuals_of_refinement(result), named_entries(result.also)
    same = np.isclose(rms(left.after_mg), rms(residuals.after_mg), rtol=0.01)
    return {
        'verdict': verdict_words(result), 'ladder': ladder(result) if result.steps else None,
        'rows': [(str(number), step.effect,
                  f'{short(step.gap_before_mg)} → {short(step.gap_after_mg)}',
                  f'{short(step.held_out_before_mg)} → {short(step.held_out_after_mg)}',
                  chance_words(step.p_value)) for number, step in enumerate(result.steps, 1)],
        'steps': [{'step': step, 'effect': entry_of(step.name), 'rivals': odds_words(step),
                   'chance': chance_words(step.p_value),
                   'values': value_words(step), 'drawings': draw_step(result, left, k),
                   'curve': draw_curve(result, k)}
                  for k, step in enumerate(result.steps)],
        'left': None if same else of_remainder(left, 'refined'),
        'not_testable': [(f'{entries[name].words} ({name})', needs)
                         for name, needs in result.not_testable]}


# ----------------------------------------------------------------------------- figures

def all_drawings(result: Refinement) -> Iterator[Drawing]:
    """Yield all figures of the report."""
    kept = residuals_of_refinement(result)
    yield ladder(result)
    for step in range(len(result.steps)):
        yield from draw_step(result, kept, step)
        yield from draw_curve(result, step)
    yield from of_remainder(kept)


def write_figures(folder: Path, result: Refinement) -> list[Path]:
    """Write all figures as SVG and PNG, and return the paths; raise OSError if it fails."""
    folder.mkdir(exist_ok=True)
    paths = []
    for drawing in all_drawings(result):
        for suffix in ('svg', 'png'):
            paths.append(folder / f'{drawing.name}.{suffix}')
            with styled():
                drawing.figure.savefig(paths[-1], dpi=160, facecolor='white')
    return paths


def draw_step(result: Refinement, kept: Residuals, step: int) -> Iterator[Drawing]:
    """Yield the residuals of the kept poses before and after a step, with equal scales."""
    before, after = result.stages[step], result.stages[step + 1]
    first = base_words(result) if step == 0 else f'+ {before.name}'
    stages = [(when, replace(kept, after_mg=stage.residual_mg), colour,
               f'{when.capitalize()}: {words}, {short(rms(stage.residual_mg))} mg RMS')
              for when, words, stage, colour in (
                  ('before', first, before, BEFORE), ('after', f'+ {after.name}', after, AFTER))]
    limit = limit_mg(*(residuals for _, residuals, _, _ in stages))
    name, effect = f'step{step + 1}_{after.name}', result.steps[step].name
    values = result.calibration.model.values.get(effect)
    shape = None if values is None else entry_of(effect).split(values)[1]
    variables = variables_of(effect, result.poses_g, result.force, shape)
    for when, residuals, _, title in stages:
        yield from sphere_map(residuals, f'{name}_sphere_{when}', title, limit)
    for when, residuals, colour, title in stages:
        yield against(residuals, variables, f'{name}_variable_{when}', title, limit, colour=colour)


# ----------------------------------------------------------------------------- curves

@dataclass(frozen=True)
class CurvePart:
    """
    One part of an empirical curve: an axis, a pair of axes, or all.

    `at` are (g,) values of the variable. `change` and `deviation` are the (g,) change of the
    reading from the mean over the poses, and its standard deviation [g, g/g]. `poses` is the (n,)
    variable at each pose.

    """

    name: str
    at: Floats
    change: Floats
    deviation: Floats
    poses: Floats


def curve_parts(result: Refinement, curve: EmpiricalCurve) -> list[CurvePart]:
    """Return the parts of an empirical curve of the refined model."""
    variable, modes, names = curve.variable, curve.modes, curve.parts
    calibration = result.calibration
    count = len(names) * len(modes)
    first = parameter_names(calibration.model.effects).index(
        f'{curve}.{curve.entry.parameters[0]}')
    values = calibration.model.values[curve]
    low, high = values[count:] if variable != 'force' else (-1.0, 1.0)
    at = np.linspace(low, high, 201)
    parts = []
    for k, own in enumerate(names):
        poses = (result.force[:, AXES.index(own)] if variable == 'force'
                 else over_axes(with_thermal(result.poses_g, '', np.zeros(0))[variable]))
        # The cosines of the curve, which is constant outside of its range.
        share = np.clip((np.concatenate([at, poses]) - low) / (high - low), 0.0, 1.0)
        waves, at_poses = np.split(
            np.cos(np.pi * np.multiply.outer(np.array(modes), share)), [len(at)], axis=1)
        waves = waves - np.mean(at_poses, axis=1, keepdims=True)
        rows = first + k + len(names) * np.arange(len(modes))
        spread = calibration.covariance[np.ix_(rows, rows)]
        variance = np.einsum('kg,kl,lg->g', waves, spread, waves)
        parts.append(CurvePart(own, at, values[k:count:len(names)] @ waves,
                               np.sqrt(np.maximum(variance, 0.0)), poses))
    return parts


def draw_curve(result: Refinement, step: int) -> Iterator[Drawing]:
    """
    Yield the empirical curve of a step, with its 95 % band and ticks at the poses.

    A step is no such curve, or is on the sphere as one over directions.

    """
    curve = result.steps[step].name
    if not isinstance(curve, EmpiricalCurve) or curve.variable == 'direction':
        return
    variable = curve.variable
    words = 'gain of all axes' if curve.carrier == 'force' else curve.carrier.replace('_', '-')
    words += f' of {curve.part}' if curve.part else ''
    title = f'{words[0].upper()}{words[1:]} over {variable_words(variable)}, with 95 % band'
    parts = curve_parts(result, curve)
    with drawn(HEIGHT_INCHES, title) as (figure, (panel,)):
        for part, colour in zip(parts, AXIS_COLOURS):
            both = variable_of(variable, np.concatenate([part.at, part.poses]))
            at, poses = np.split(both.values, [len(part.at)])
            change, band = part.change * MG, BAND * part.deviation * MG
            panel.plot(at, change, color=colour, label=part.name)
            add_band(panel, at, change - band, change + band, colour)
            panel.plot(poses, np.full(len(poses), 0.02), '|', color=INK, markersize=7,
                       transform=panel.get_xaxis_transform())
        panel.set_xlabel(both.label)
        panel.set_ylabel(f'change from the mean [m{curve.unit}]')
        panel.legend(ncols=len(parts))
    yield Drawing(f'step{step + 1}_curve', title, figure)


# ----------------------------------------------------------------------------- the ladder

def ladder(result: Refinement) -> Drawing:
    """Draw the residual and the held-out residual of the base and after each step."""
    after = ', '.join(short(step.gap_after_mg) for step in result.steps)
    title = f'Residual of the base {short(result.gap_mg)} mg' + (
        f', then {after} mg' if after else '')
    of_base = (result.steps[0].held_out_before_mg if result.steps
               else result.calibration.quality.held_out_rms_mg)
    levels = [(base_words(result), result.gap_mg, of_base), *(
        (f'+ {step.effect}', step.gap_after_mg, step.held_out_after_mg) for step in result.steps)]
    floor_mg = result.noise_floor_mg
    with drawn(1.25 + 0.52 * len(levels), width_inches=4.9, grid='x') as (figure, (panel,)):
        height = np.arange(len(levels))
        residuals = np.array([residual for _, residual, _ in levels])
        held_out = np.array([np.nan if out is None else out for _, _, out in levels])
        panel.step(residuals, height, where='post', color=FAINT, linewidth=2.0, zorder=1)
        panel.plot(residuals, height, 'o', color=AFTER, markersize=9, label='all poses used',
                   zorder=3)
        if np.any(np.isfinite(held_out)):
            panel.plot(held_out, height, 'o', color=AFTER, markersize=9, fillstyle='none',
                       markeredgewidth=1.6, label='held out', zorder=3)
        white = {'facecolor': PAPER, 'edgecolor': 'none', 'pad': 1.0}
        for at, residual, out in zip(height, residuals, held_out, strict=True):
            words = short(residual) + ('' if np.isnan(out) else f', held out {short(out)}')
            panel.annotate(words, (np.nanmax([residual, out]), at), (9, 0), va='center',
                           textcoords='offset points', fontsize=9.0, bbox=white)
        for at, (name, _, _) in zip(height, levels, strict=True):
            panel.text(0.005, at - 0.36, name, transform=panel.get_yaxis_transform(), va='center',
                       fontweight='bold', fontsize=9.5, bbox=white)
        panel.set_ylim(len(levels) - 0.55, -0.65)
        panel.yaxis.set_visible(False)
        panel.spines['left'].set_visible(False)
        if floor_mg:
            panel.axvline(floor_mg, color=ACCENT, linewidth=1.6, linestyle=(0, (5, 3)),
                          label=f'noise floor {short(floor_mg)} mg', zorder=1)
        _scale(panel, [value for _, *numbers in levels for value in (*numbers, floor_mg) if value])
        panel.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=3, handletextpad=0.2,
                     columnspacing=0.9, handlelength=1.6, borderaxespad=0.0)
    return Drawing('ladder', title, figure)


def _scale(panel: Any, values: Sequence[float]) -> None:
    """Set a logarithmic axis of residuals with legible ticks, and space for the numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    least, largest = min(values, default=1.0), max(values, default=1.0)
    room = max(float(np.log10(largest / least)), 0.5)
    low, high = least / 10.0 ** (0.08 * room), largest * 10.0 ** (0.5 * room)
    panel.set(xscale='log', xlim=(low, high),
              xlabel='residual: RMS over the poses [mg], logarithmic')
    panel.xaxis.set_major_locator(LogLocator(
        subs=(1.0,) if high / low > 300.0 else (1.0, 2.0, 5.0)))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.xaxis.set_major_formatter(lambda value, _: f'{value:g}')
