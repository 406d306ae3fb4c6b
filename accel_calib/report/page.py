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
import shlex
from typing import TYPE_CHECKING

import numpy as np

from .refinement import refusal_lines, search_sections
from .residuals import of_before_after, of_coverage, of_remainder, Residuals, residuals_of
from .sheet import (
    ACCENT, add_band, AFTER, BAND, block, Drawing, drawn, EDGE, figures, HEIGHT_INCHES, HINT,
    how_to_read, INK, legend_below, listing, Mark, Marks, numbers, paragraph, rated_sheet,
    scroll_table, section)
from ..calibration import Calibration, Curve
from ..effects import (
    AXES, EffectKey, EmpiricalCurve, entry_of, REFERENCE_TEMPERATURE, value_unit, variable_words,
    with_vector)
from ..findings import (
    effect_figures, mounting_figures, outlook, rate_refinement, request_words, residual_figures,
    verdict_words)
from ..geometry import coverage
from ..table import Floats
from ..text import counted, milli, percentage, short, signed, with_minus
from ..units import MG

if TYPE_CHECKING:
    from ..calibration import Verification
    from ..findings import Rating
    from ..pipeline import ThermalOutcome
    from ..refinement import Refinement
    from ..table import Poses

STORED = 'calibration.yaml'
"""Name of the file of the calibration in the lines that use it, if it is not known."""

_HOW_TO_READ = (
    'The residual is the RMS of |corrected| − 1 g over the poses, or of the vector error if the '
    'orientation is known or shared. The noise floor is the expected residual of a correct model.',
    'Of new poses (held out): each pose is predicted from a fit of other orientations.',
    'Maps have equal areas and show each hemisphere from above its pole: the direction of up in '
    'the sensor axes. A hollow square is a pose that was left out.')
_HOW_TO_READ_THERMAL = (
    'Each marker is the mean of a short stretch of the log, minus that of the board at the '
    'reference temperature. One orientation shows only this change, not the offset itself.',
    'An effect is added if parts of the log that were held out are predicted better with it.',
    'Deviations include a slow wander of the offset, whose size is estimated from what the '
    'effects leave. Bands are 95 % intervals.',
    'The curve is that of a steady temperature. Warming and cooling differ by a lag, or by the '
    'rate of the temperature.')
_HOW_TO_READ_STEPS = (
    'If the held-out residual decreases together with the residual, the effect is in the sensor '
    'and not an artefact of the fit.',
    'p is the probability that noise alone makes one of all candidates this good.',
    'Rivals are effects that these poses cannot distinguish from the named effect.')
_STEP = 1e-6
_SAME = 1e-9
_PAIRS = ((0, 1), (0, 2), (1, 2))

_USUAL = {'x': '±50 mg', 'y': '±50 mg', 'z': '±80 mg', 'gain': '±3 %', 'angle': '±2 %, 1.1°'}
_SOURCE = (
    'Usual: the initial tolerances of a common part, the MPU-6050 (data sheet PS-MPU-6000A, '
    'revision 3.4, section 6.2). For other effects: the typical size in the catalogue of effects.')

_SMALL = 1e-3
"""Typical size below which a value is given in millionths."""


def refinement_page(result: Refinement, source: str) -> str:
    """Return the page of a refinement of the poses in the file `source`, as HTML."""
    return calibration_page(result.calibration, rate_refinement(result), source, refinement=result)


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
    title = f'{what} of {name}' if name else what
    about = [source, f'sensor {calibration.sensor}' if calibration.sensor else '',
             f'fitted {calibration.date}' if calibration.date else '']
    searched = [] if refinement is None else [*search_sections(
        refinement, residuals, used=used is not None)]
    first = refinement is not None and bool(refinement.steps)
    body = [_key_numbers(calibration, residuals, checked), *(searched if first else ()),
            values_section(calibration),
            _covered(calibration, residuals, plan=refinement is None and checked is None),
            section('Before and after', figures([of_before_after(
                residuals, (checked or calibration.quality).noise_floor_mg)], 'wide'),
                kind='half'),
            section('Warnings', listing((
                *(() if used is None else refusal_lines(used)), *calibration.warnings))),
            section('What to do', listing(() if used is None else used.advice)),
            section('Poses left out', listing(
                f'row {row}: {reason}' for row, reason in sorted(residuals.reasons.items()))),
            section('What remains', figures(of_remainder(residuals))),
            *(() if first else searched),
            _pose_table(residuals, calibration),
            '' if used is not None and used.refusal else section('Use it', *(
                block(title, text) for title, text in snippets(calibration, stored))),
            section('How the log was read', listing(notes)),
            how_to_read(*_HOW_TO_READ, *(_HOW_TO_READ_STEPS if refinement else ()))]
    return rated_sheet(title, about, rating, body,
                       more='' if used is None else verdict_words(used))


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
    title = f'Offset over temperature of {calibration.sensor or names}'
    low, high = curve.range_c
    body = [numbers([('range', f'{low:.1f} to {high:.1f} °C'), ('degree', str(curve.degree)),
                     ('change', f'{short(curve.change_mg)} mg'),
                     ('residual', f'{short(curve.residual_mg)} mg'),
                     ('uncertainty up to', f'{short(curve.band_mg)} mg')]),
            section('Offset over temperature', figures(
                _of_axis(curve, axis) for axis in range(3)), HINT),
            values_section(calibration),
            section('Held out', scroll_table(
                'Error of held-out parts', ('effects', 'error of parts that were held out [mg]'),
                [(name or 'none', short(error)) for name, error in curve.held_out_mg.items()]),
                kind='half'),
            section('Warnings', listing(calibration.warnings)),
            section('Use it', *(block(name, text) for name, text in snippets(
                calibration, stored))),
            section('How the log was read', listing(notes)), how_to_read(*_HOW_TO_READ_THERMAL)]
    return rated_sheet(title, [
        ', '.join(sources), f'fitted {calibration.date}' if calibration.date else ''],
        outcome.rating, body)


def _of_axis(curve: Curve, axis: int) -> Drawing:
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

def _key_numbers(calibration: Calibration, residuals: Residuals, checked: Verification | None
                 ) -> str:
    """Return the residual before and after, noise floor, number of poses and coverage."""
    pairs = [(figure.label, f'{short(figure.value)} {figure.unit}')
             for figure in residual_figures(checked or calibration.quality)
             if figure.key != 'max_before_mg']
    pairs.append(('poses used', str(len(residuals.poses_g))))
    if len(residuals.left_out):
        pairs.append(('poses left out', str(len(residuals.left_out))))
    return numbers([*pairs, ('coverage', percentage(coverage(residuals.force)))])


def _covered(calibration: Calibration, residuals: Residuals, *, plan: bool) -> str:
    """Return the section about coverage; with the next pose if `plan` is set."""
    direction, words = None, ''
    linear = all(entry_of(name).linear for name in calibration.model.effects)
    if plan and linear and calibration.model.effects:
        asked = outlook(calibration, 'auto').next_pose
        direction = asked.direction
        words = f'Next pose: {request_words(asked)}.'.replace('..', '.')
    return section('Coverage of the sphere', figures(
        [of_coverage(residuals, coverage(residuals.force), direction)], 'wide'),
        paragraph(words), HINT, kind='half')


def values_section(calibration: Calibration) -> str:
    """Return the section with the values of the calibration."""
    rows = [*_linear_rows(calibration), *_effect_rows(calibration)]
    if calibration.is_levelled:
        found = mounting_figures(calibration.rotation, calibration.sensor)
        rows += [(f'mounting, {name}', with_minus(f'{np.degrees(found[name]):+.2f}°'), '')
                 for name in ('roll', 'pitch', 'yaw')]
    if not rows:
        return ''
    thermal = any('temperature' in str(effect) for effect in calibration.model.effects)
    note = f'The values hold at {REFERENCE_TEMPERATURE:g} °C.' if thermal else ''
    words = f'{calibration.name}: {calibration.reason}'.replace('ideal: ideal', 'ideal')
    return section('The calibration', paragraph(f'Model {words}'),
                   scroll_table('Values of the calibration', ('', 'value ± deviation', 'usual'),
                                rows, 'whole-cells values'),
                   paragraph(note, 'soft'), paragraph(_SOURCE, 'soft'), kind='half tall')


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


def _effect_rows(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield the values of the other effects; a curve, which has many, is one row."""
    by_name = {str(effect): effect for effect in calibration.model.effects}
    for curve in by_name.values():
        if isinstance(curve, EmpiricalCurve):
            mode = 'degree' if curve.variable == 'direction' else 'wave'
            yield (f'curve of {curve.changed} over {variable_words(curve.variable)}',
                   counted(len(curve.modes), mode), '')
    for figure in effect_figures(calibration):
        name, _, part = figure.key.rpartition('.')
        if isinstance(by_name[name], EmpiricalCurve) or not (figure.value or figure.sd):
            continue
        label, effect = f'{name.replace("_", " ")} {part}', entry_of(by_name[name])
        if part not in effect.parameters:
            yield label, f'{figure.value:.5g} {figure.unit}'.rstrip(), ''
            continue
        unit, scale = value_unit(by_name[name], part)
        typical, factor = effect.typical * scale, 1.0
        if unit.startswith('g') and 0.0 < typical < _SMALL:
            unit, factor = f'µ{unit}', MG ** 2
        yield (label, signed(figure.value * factor, figure.sd * factor, unit),
               f'±{short(typical * factor)} {unit}' if 0.0 < typical < np.inf else '')


def _pose_table(residuals: Residuals, calibration: Calibration) -> str:
    """Return the section with the table of all poses, in order of rows."""
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
    cells = zip(*context.values(), *_axis_cells(calibration.units.from_g(kept.reading)), *sizes,
                strict=True)
    rows = dict(zip(kept.row.tolist(), cells, strict=True))
    rows |= {row: (*[''] * len(context), *reading, '', '', f'left out: {residuals.reasons[row]}')
             for row, *reading in zip(out.row.tolist(), *_axis_cells(out.reading), strict=True)}
    head = ['row', *context, *(f'{axis} [{calibration.units.symbol}]' for axis in AXES),
            'before [mg]', 'after [mg]', *(['note'] if residuals.reasons else [])]
    return section('Poses', paragraph(
        f'{counted(len(rows), "pose")}, with the residual before and after.'),
        scroll_table('Poses', head, [(str(row), *rows[row]) for row in sorted(rows)],
                     long=len(rows) > 25, poses=sorted(rows)))


def _axis_cells(reading: Floats) -> list[list[str]]:
    """Return (n, 3) readings as a column of cells for each axis."""
    return [[f'{each:.6g}' for each in column] for column in reading.T]


# ----------------------------------------------------------------------------- lines of code

def snippets(calibration: Calibration, stored: str) -> tuple[tuple[str, str], ...]:
    """Return titles and lines of code that use the calibration in the file `stored`."""
    path = shlex.quote(stored) if Path(stored).is_absolute() else f'"$PWD"/{shlex.quote(stored)}'
    ros = ('ros2 launch accel_calib calibrator.launch.py imu:=imu/data_raw \\\n'
           f'  units:={calibration.units.name} calibration_file:={path}')
    launch = ("Node(package='accel_calib', executable='calibrator',\n"
              f"     parameters=[{{'calibration_file': {stored!r},\n"
              f"                  'units': {calibration.units.name!r}}}],\n"
              "     remappings=[('imu/data_raw', 'imu/data_raw')])")
    known = ''.join(f', {key}={key}' for key in calibration.model.needs
                    if key in ('time', 'temperature', 'supply_voltage', 'rate'))
    symbol = calibration.units.symbol
    units = 'native units -> g' if calibration.units.is_native else f'{symbol} -> {symbol}'
    python = ('import accel_calib as ac\n\n'
              f'calibration = ac.load({stored!r})\n'
              f'force = calibration.apply(readings{known})  # (n, 3), {units}')
    mat = calibration.rotation.T @ calibration.matrix
    rows = ',\n'.join(f'  {{{_floats(row)}}}' for row in mat)
    beyond = [str(name) for name in calibration.model.effects if not entry_of(name).linear]
    note = '' if not beyond else (
        f'/* Without {", ".join(beyond)}:\n'
        '   accel-calib export --to c writes the terms that C can hold. */\n')
    c99 = (f'{note}static const float B[3] = {{{_floats(calibration.offset)}}};\n'
           f'static const float M[3][3] = {{\n{rows}}};\n\n'
           'static void accel_correct(const float raw[3], float a[3])\n{\n'
           '  for (int i = 0; i < 3; ++i)\n'
           '    a[i] = M[i][0] * (raw[0] - B[0]) + M[i][1] * (raw[1] - B[1])\n'
           '         + M[i][2] * (raw[2] - B[2]);\n}')
    return (('ROS 2', ros), ('ROS 2 launch file', launch), ('Python', python), ('C', c99),
            ('C header, Arduino, PX4, ArduPilot and others',
             f'accel-calib export {shlex.quote(stored)} --to c -o calibration.h'))


def _floats(numbers: Floats) -> str:
    """Return float constants of C."""
    return ', '.join(f'{value:.8e}f' for value in numbers)
