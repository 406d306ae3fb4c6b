# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The pages of one calibration: of `fit`, `calibrate`, `verify`, `refine` and `thermal`.

All begin with the verdict and the calibration. Sections about effects follow if some were searched
for: the ladder, one section per step, and the effects that the data cannot show.

The ladder shows the residual of each step, from the base to the noise floor. An empirical curve is
shown relative to its mean over the poses, because offset and gain contain the mean. Its band is
1.96 standard deviations on both sides. Outside of the range of the poses, the curve is constant.

That of `thermal` has the curve by axis and what it leaves. The markers are the stretches of the
ramps. The bands are 95 % intervals of the curve, relative to its value at the reference
temperature.

**Values.** Three figures by axis do not depend on the convention of the model: V, the sensitivity
of each sensing axis (the length of the rows of W), and the angles between the sensing axes. Their
standard deviations follow from the covariance of the calibration.

"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .residuals import (
    against, limit_mg, of_before_after, of_coverage, of_remainder, Residuals, residuals_of,
    residuals_of_refinement, sphere_map, variable_of, variables_of, with_thermal)
from .sheet import (
    ACCENT, add_band, AFTER, AXIS_COLOURS, BAND, BEFORE, Drawing, drawn, EDGE, FAINT,
    HEIGHT_INCHES, INK, legend_below, Mark, Marks, page, PAPER, styled)
from ..calibration import Calibration, Curve, Verification
from ..disk import write_atomically
from ..effects import (
    AXES, EffectKey, EmpiricalCurve, entry_of, parameter_names, REFERENCE_TEMPERATURE, value_unit,
    variable_words, with_vector)
from ..findings import (
    base_words, chance_words, effect_figures, mounting_figures, odds_words, outlook, rate, Rating,
    request_words, residual_figures, value_words, verdict_words)
from ..geometry import coverage
from ..pipeline import ThermalOutcome
from ..refinement import named_entries, Refinement
from ..statistics import over_axes, rms
from ..table import Floats, Poses
from ..text import counted, milli, short, signed, with_minus
from ..units import MG

STORED = 'calibration.yaml'
"""Name of the file of the calibration in the lines that use it, if it is not known."""

_STEP = 1e-6
_SAME = 1e-9
_PAIRS = ((0, 1), (0, 2), (1, 2))

_USUAL = {'x': '±50 mg', 'y': '±50 mg', 'z': '±80 mg', 'gain': '±3 %', 'angle': '±2 %, 1.1°'}
"""Initial tolerances of a common part, the MPU-6050."""

_SMALL = 1e-3
"""Typical size below which a value is given in millionths."""


def refinement_page(result: Refinement, source: str) -> str:
    """Return the page of a refinement of the poses in the file `source`, as HTML."""
    rating = rate(result.calibration, refinement=result)
    return calibration_page(result.calibration, rating, source, refinement=result)


def calibration_page(calibration: Calibration, rating: Rating, source: str, *,
                     refinement: Refinement | None = None,
                     verification: tuple[Verification, Poses] | None = None,
                     stored: str = STORED, notes: Sequence[str] = ()) -> str:
    """
    Return the page of a calibration as HTML.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    rating : Rating
        The verdict.
    source : str
        Name of the file of the poses.
    refinement : Refinement, optional
        Search for effects on the same poses.
    verification : (Verification, Poses), optional
        Residuals on other poses, and these poses in the unit of the calibration.
    stored : str
        File of the calibration, for the lines that use it.
    notes : sequence of str
        How the log was read.

    """
    checked, poses = verification or (None, None)
    residuals = residuals_of(calibration, poses)
    own, refined = calibration.model, refinement and refinement.calibration.model
    used = refinement if (refined and own.effects == refined.effects  # perhaps levelled since
                          and np.array_equal(own.vector, refined.vector)) else None
    what = 'Calibration' if checked is None else 'Check of the calibration'
    name = calibration.sensor or Path(source).name
    covered, asked = coverage(residuals.force), None
    if (refinement is None and checked is None and own.effects
            and all(entry_of(each).linear for each in own.effects)):
        asked = outlook(calibration, 'auto').next_pose
    figures = [(each.label, f'{short(each.value)} {each.unit}')
               for each in residual_figures(checked or calibration.quality)
               if each.key != 'max_before_mg']
    refusal = '' if refinement is None or not refinement.refusal else (
        f'the refined calibration must not be used: {"; ".join(refinement.refusal)}')
    head, rows = _pose_table(residuals, calibration)
    sensor = calibration.sensor and f'sensor {calibration.sensor}'
    return page(
        'calibration', f'{what} of {name}' if name else what,
        (source, sensor, calibration.date and f'fitted {calibration.date}'), rating,
        more='' if used is None else verdict_words(used),
        shown_figures=figures, residuals=residuals, covered=covered, used=used, refusal=refusal,
        searched={} if refinement is None else search_values(refinement, residuals),
        coverage=of_coverage(residuals, covered, None if asked is None else asked.direction),
        next_pose='' if asked is None else request_words(asked),
        before_after=of_before_after(residuals, (checked or calibration.quality).noise_floor_mg),
        left_out=[f'row {row}: {reason}' for row, reason in sorted(residuals.reasons.items())],
        remainder=of_remainder(residuals), head=head, poses=rows, notes=notes,
        **_values(calibration, stored))


def thermal_page(outcome: ThermalOutcome, sources: Sequence[str], *, stored: str = STORED,
                 notes: Sequence[str] = ()) -> str:
    """
    Return the page of a calibration of the offset over temperature as HTML.

    Parameters
    ----------
    outcome : ThermalOutcome
        The calibration with its curve.
    sources : sequence of str
        Files of the logs.
    stored, notes
        As in `calibration_page`.

    """
    calibration, curve = outcome.calibration, outcome.curve
    names = ', '.join(Path(source).name or source for source in sources)
    return page(
        'thermal', f'Offset over temperature of {calibration.sensor or names}',
        (', '.join(sources), calibration.date and f'fitted {calibration.date}'), outcome.rating,
        curve=curve, drawings=(_draw_axis(curve, axis) for axis in range(3)),
        held_out=[(name or 'none', short(error)) for name, error in curve.held_out_mg.items()],
        notes=notes, **_values(calibration, stored))


def _draw_axis(curve: Curve, axis: int) -> Drawing:
    """Draw the change of the reading of one axis over the temperature, with the curve."""
    grid = np.linspace(*curve.range_c, 100)
    line = curve.at(grid)[:, axis] * MG
    band = BAND * curve.deviation_at(grid)[:, axis] * MG
    hover: dict[str, Marks] = {}
    with drawn(HEIGHT_INCHES, f'{AXES[axis]}: change of the offset') as (figure, (panel,)):
        panel.set(xlabel='temperature [°C]', ylabel='change [mg]')
        add_band(panel, grid, line - band, line + band, INK)
        warming = curve.stretches['temperature_rate'] >= 0.0
        for label, which, colour in (('warming', warming, ACCENT), ('cooling', ~warming, AFTER)):
            if np.any(which):
                warm = curve.stretches['temperature'][which]
                change_mg = curve.change[which, axis] * MG
                hover[label] = tuple(Mark(f'{at:.2f} °C: {change:+.2f} mg')
                                     for at, change in zip(warm, change_mg))
                panel.plot(warm, change_mg, 'o', color=colour, markersize=3.0, label=label,
                           gid=label, **EDGE)
        panel.plot(grid, line, color=INK, linewidth=1.2, label='curve', zorder=3.0)
        legend_below(figure, 3)
    ends = f'{short(float(line[0]))} to {short(float(line[-1]))} mg'
    return Drawing(f'thermal_{AXES[axis]}', f'Change of the offset {AXES[axis]} over the '
                   f'temperature: {ends}', figure, hover)


# ----------------------------------------------------------------------------- the calibration

def _values(calibration: Calibration, stored: str) -> dict[str, Any]:
    """Return what a page shows of the values of a calibration, and of its file `stored`."""
    rows, by_name = [*_linear_rows(calibration)], {
        str(effect): effect for effect in calibration.model.effects}
    for curve in by_name.values():  # a curve has many values
        if isinstance(curve, EmpiricalCurve):
            mode = 'degree' if curve.variable == 'direction' else 'wave'
            rows.append((f'curve of {curve.changed} over {variable_words(curve.variable)}',
                         counted(len(curve.modes), mode), ''))
    for figure in effect_figures(calibration):
        name, _, part = figure.key.rpartition('.')
        if isinstance(by_name[name], EmpiricalCurve) or not (figure.value or figure.sd):
            continue
        label, effect = f'{name.replace("_", " ")} {part}', entry_of(by_name[name])
        if part not in effect.parameters:
            rows.append((label, f'{figure.value:.5g} {figure.unit}'.rstrip(), ''))
            continue
        unit, scale = value_unit(by_name[name], part)
        typical, factor = effect.typical * scale, 1.0
        if unit.startswith('g') and 0.0 < typical < _SMALL:
            unit, factor = f'µ{unit}', MG ** 2
        rows.append((label, signed(figure.value * factor, figure.sd * factor, unit),
                     f'±{short(typical * factor)} {unit}' if 0.0 < typical < np.inf else ''))
    if calibration.is_levelled:
        found = mounting_figures(calibration.rotation, calibration.sensor)
        rows += [(f'mounting, {name}', with_minus(f'{np.degrees(found[name]):+.2f}°'), '')
                 for name in ('roll', 'pitch', 'yaw')]
    return {'calibration': calibration, 'units': calibration.units, 'value_rows': rows,
            'reference': REFERENCE_TEMPERATURE, 'stored': stored,
            'matrix': calibration.rotation.T @ calibration.matrix,
            'beyond': [each for each in calibration.model.effects if not entry_of(each).linear]}


def axis_figures(vec: Floats, effects: tuple[EffectKey, ...]) -> Floats:
    """Return V [g], the sensitivities of the axes, and their angles [°], (9,), of model values."""
    mat_w, vec_v = with_vector(effects, vec).linear_part
    length = np.linalg.norm(mat_w, axis=1)
    rows = mat_w / length[:, np.newaxis]
    cosines = np.array([rows[i] @ rows[j] for i, j in _PAIRS])
    return np.concatenate([vec_v, length, np.degrees(np.arccos(cosines))])


def _linear_rows(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield offsets, sensitivities (one row if they are equal) and angles with usual values."""
    effects, vec = calibration.model.effects, calibration.model.vector
    slope = np.array([(axis_figures(vec + step, effects) - axis_figures(vec - step, effects))
                      / (2.0 * _STEP) for step in _STEP * np.eye(len(vec))]).reshape(-1, 9)
    variance = np.einsum('pi,pq,qi->i', slope, calibration.covariance, slope)
    deviation = np.sqrt(np.maximum(variance, 0.0)).reshape(3, 3)
    deviation[deviation <= _SAME] = 0.0
    found = axis_figures(vec, effects).reshape(3, 3)
    native, per_g = calibration.units.is_native, calibration.units.per_g
    scale, unit = (per_g, 'native') if native else (MG, 'mg')
    for axis, value, sd in zip(AXES, found[0], deviation[0], strict=True):
        if sd or value:
            usual = '' if native else _USUAL[axis]
            yield f'offset {axis}', signed(value * scale, sd * scale, unit), usual
    equal = np.ptp(found[1]) < _SAME
    for axis, value, sd in zip(AXES[:1] if equal else AXES, found[1], deviation[1], strict=False):
        name = 'gain all axes' if equal else f'gain {axis}'
        if native:
            yield name, signed(value * per_g, sd * per_g, 'native per g'), ''
        elif sd or abs(value - 1.0) > _SAME:
            yield name, signed((value - 1.0) * 100.0, sd * 100.0, '%'), _USUAL['gain']
    for (i, j), value, sd in zip(_PAIRS, found[2], deviation[2], strict=True):
        if sd or abs(value - 90.0) > _SAME:
            words = signed(value - 90.0, sd)
            yield (f'angle {AXES[i]} to {AXES[j]}', f'90° {words[0]} {words[1:]}°',
                   _USUAL['angle'])


def _pose_table(residuals: Residuals, calibration: Calibration
                ) -> tuple[list[str], dict[int, tuple[str, ...]]]:
    """Return the head of the table of all poses, and its lines by row, in their order."""
    kept, out = residuals.poses_g, residuals.left_out
    context: dict[str, list[str]] = {}
    if 'label' in kept:
        context['label'] = [str(each) for each in kept['label']]
    if 'time' in kept:
        context['time [s]'] = [f'{each:.1f}' for each in kept['time'] - np.min(kept['time'])]
    if 'temperature' in kept:
        context['°C'] = [f'{each:.1f}' for each in kept['temperature']]
    sizes = ([milli(each, signed=residuals.signed) for each in values]
             for values in (residuals.before_mg, residuals.after_mg))
    used, left = ([[f'{each:.6g}' for each in column] for column in reading.T]
                  for reading in (calibration.units.from_g(kept.reading), out.reading))
    cells = {row: (str(row), *line) for row, *line in zip(
        kept.row.tolist(), *context.values(), *used, *sizes, strict=True)}
    cells |= {row: (str(row), *[''] * len(context), *reading, '', '',
                    f'left out: {residuals.reasons[row]}')
              for row, *reading in zip(out.row.tolist(), *left, strict=True)}
    head = ['row', *context, *(f'{axis} [{calibration.units.symbol}]' for axis in AXES),
            'before [mg]', 'after [mg]', *(['note'] if residuals.reasons else [])]
    return head, dict(sorted(cells.items()))


# ----------------------------------------------------------------------------- the search

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
                write_atomically(paths[-1], partial(_save, drawing, suffix))
    return paths


def _save(drawing: Drawing, suffix: str, file: TextIO) -> None:
    drawing.figure.savefig(file.buffer, format=suffix, dpi=160, facecolor='white')


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
        panel.set_ylabel(f'change from the mean [m{curve.entry.unit}]')
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
