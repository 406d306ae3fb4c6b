# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The pages of one calibration: of `fit`, `calibrate`, `verify`, `refine` and `thermal`.

All begin with the verdict and the calibration. Sections about effects follow if some were searched
for: the ladder, one section per step, and the effects that the data cannot show.

That of `thermal` has the curve by axis and what it leaves. The markers are the stretches of the
ramps. The bands are 95 % intervals of the curve, relative to its value at the reference
temperature.

**Values.** Three figures by axis do not depend on the convention of the model: V, the sensitivity
of each sensing axis (the length of the rows of W), and the angles between the sensing axes. Their
standard deviations follow from the covariance of the calibration.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .refinement import search_values
from .residuals import of_before_after, of_coverage, of_remainder, Residuals, residuals_of
from .sheet import (
    ACCENT, add_band, AFTER, BAND, Drawing, drawn, EDGE, HEIGHT_INCHES, INK, legend_below, Mark,
    Marks, page)
from ..calibration import Calibration, Curve, Verification
from ..effects import (
    AXES, EffectKey, EmpiricalCurve, entry_of, REFERENCE_TEMPERATURE, value_unit, variable_words,
    with_vector)
from ..findings import (
    effect_figures, mounting_figures, outlook, rate, Rating, request_words, residual_figures,
    verdict_words)
from ..geometry import coverage
from ..pipeline import ThermalOutcome
from ..refinement import Refinement
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
    left_out = len(residuals.left_out)
    refusal = '' if refinement is None or not refinement.refusal else (
        'the refined calibration must not be used: '
        f'{refinement.refusal[0]}; {refinement.refusal[1]}')
    refused = refusal if used is not None else ''
    head, rows = _pose_table(residuals, calibration)
    sensor = calibration.sensor and f'sensor {calibration.sensor}'
    return page(
        'calibration', f'{what} of {name}' if name else what,
        (source, sensor, calibration.date and f'fitted {calibration.date}'), rating,
        more='' if used is None else verdict_words(used),
        key_numbers=[*figures, ('poses used', str(len(residuals.poses_g))),
                     *([('poses left out', str(left_out))] if left_out else ()),
                     ('coverage', f'{100.0 * covered:.0f} %')],
        searched={} if refinement is None else search_values(refinement, residuals),
        used=used is not None, refusal=refusal, refused=bool(refused),
        coverage=of_coverage(residuals, covered, None if asked is None else asked.direction),
        next_pose='' if asked is None else (
            f'Next pose: {request_words(asked)}.'.replace('..', '.')),
        before_after=of_before_after(residuals, (checked or calibration.quality).noise_floor_mg),
        warnings=[*filter(None, [refused]), *calibration.warnings],
        advice=() if used is None else used.advice,
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
    low, high = curve.range_c
    return page(
        'thermal', f'Offset over temperature of {calibration.sensor or names}',
        (', '.join(sources), calibration.date and f'fitted {calibration.date}'), outcome.rating,
        key_numbers=[('range', f'{low:.1f} to {high:.1f} °C'), ('degree', str(curve.degree)),
                     ('change', f'{short(curve.change_mg)} mg'),
                     ('residual', f'{short(curve.residual_mg)} mg'),
                     ('uncertainty up to', f'{short(curve.band_mg)} mg')],
        drawings=(_draw_axis(curve, axis) for axis in range(3)),
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
