# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The sections of a page: about a calibration, and about a refinement.

**Values.** Three figures by axis do not depend on the convention of the model: V, the sensitivity
of each sensing axis (the length of the rows of W), and the angles between the sensing axes. Their
standard deviations follow from the covariance of the calibration.

"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from .drawings import ladder, of_before_after, of_coverage, of_curve, of_remainder, of_step
from .residuals import milli, Residuals, residuals_of_refinement, since_first
from .sheet import (
    block,
    code,
    figures,
    HINT,
    listing,
    numbers,
    paragraph,
    scroll_table,
    section,
    snippets,
)
from ..calibrate import Calibration, mounting_figures, outlook
from ..effects import (
    AXES,
    effect_named,
    EMPIRICAL,
    empirical_parts,
    REFERENCE_TEMPERATURE,
    value_unit,
    VARIABLES,
    with_vector,
)
from ..estimate import coverage
from ..findings import effect_figures, Figure, residual_figures
from ..refine.words import chance, percent, values_of, verdict_words
from ..table import Floats
from ..text import counted, short, signed
from ..units import MG

if TYPE_CHECKING:
    from ..calibrate import Verification
    from ..findings import Rating
    from ..refine import Refinement, Step

_STEP = 1e-6
_SAME = 1e-9
_PAIRS = ((0, 1), (0, 2), (1, 2))

_USUAL_OFFSET_MG = {'x': 50.0, 'y': 50.0, 'z': 80.0}
_USUAL_GAIN_PERCENT = 3.0
_USUAL_CROSS_AXIS_PERCENT = 2.0
_USUAL_CROSS_AXIS = float(np.degrees(_USUAL_CROSS_AXIS_PERCENT / 100.0))
_SOURCE = (
    'Usual: the initial tolerances of a common part, the MPU-6050 (data sheet PS-MPU-6000A, '
    'revision 3.4, section 6.2). For other effects: the typical size in the catalogue of effects.')

_SMALL = 1e-3
"""Typical size below which a value is given in millionths."""

_LONG_TABLE = 25
"""Number of poses above which their table scrolls."""


def verdict_box(rating: Rating, more: str = '') -> str:
    """Return the verdict: its name and figures, the reason, and what to do next."""
    return (f'<div class="verdict {escape(rating.name)}" role="note">\n'
            f'<p><strong>{escape(rating.name)}</strong> '
            f'{escape(rating.figures.replace("->", "→"))}</p>\n'
            f'{paragraph(_sentence(rating.reason))}{paragraph(more)}'
            f'<p><b>Next:</b> {escape(_sentence(rating.next.text))}</p>\n</div>\n')


def _sentence(text: str) -> str:
    """Return text with a capital letter and a full stop."""
    return text and f'{text[0].upper()}{text[1:].rstrip(".")}.'


def key_numbers(calibration: Calibration, residuals: Residuals,
                verification: Verification | None) -> str:
    """Return the residual before and after, noise floor, number of poses and coverage."""
    pairs = [(figure.label, f'{short(figure.value)} {figure.unit}')
             for figure in residual_figures(verification or calibration.quality)
             if figure.key != 'max_before_mg']
    pairs.append(('poses used', str(len(residuals.poses_g))))
    if len(residuals.left_out):
        pairs.append(('poses left out', str(len(residuals.left_out))))
    pairs.append(('coverage', f'{coverage(residuals.force):.0%}'.replace('%', ' %')))
    return numbers(pairs)


def values(calibration: Calibration) -> str:
    """Return the section with the values of the calibration."""
    rows = [*_offsets(calibration), *_gains(calibration), *_angles(calibration),
            *_other_effects(calibration)]
    if calibration.is_levelled:
        found = mounting_figures(calibration.rotation, calibration.sensor)
        rows += [(f'mounting, {name}', f'{np.degrees(found[name]):+.2f}°'.replace('-', '−'), '')
                 for name in ('roll', 'pitch', 'yaw')]
    if not rows:
        return ''
    thermal = any('temperature' in name for name in calibration.model.effects)
    note = f'The values hold at {REFERENCE_TEMPERATURE:g} °C.' if thermal else ''
    words = f'{calibration.name}: {calibration.reason}'.replace('ideal: ideal', 'ideal')
    return section('The calibration', paragraph(f'Model {words}'),
                   scroll_table(('', 'value ± deviation', 'usual'), rows,
                                'whole-cells values', 'Values of the calibration'),
                   paragraph(note, 'soft'), paragraph(_SOURCE, 'soft'))


def linear_figures(vec: Floats, effects: tuple[str, ...]) -> Floats:
    """
    Return V [g], the sensitivities of the axes, and the angles between them, (9,).

    Parameters
    ----------
    vec : (p,) array
        Values of the model.
    effects : tuple of str
        Effects of the model.

    """
    mat_w, vec_v = with_vector(effects, vec).linear_part
    length = np.linalg.norm(mat_w, axis=1)
    rows = mat_w / length[:, np.newaxis]
    cosines = np.array([rows[i] @ rows[j] for i, j in _PAIRS])
    return np.concatenate([vec_v, length, np.degrees(np.arccos(cosines))])


def _linear(calibration: Calibration) -> tuple[Floats, Floats]:
    """Return `linear_figures` of a calibration and their standard deviations."""
    effects, vec = calibration.model.effects, calibration.model.vector
    slope = np.array([(linear_figures(vec + step, effects) - linear_figures(vec - step, effects))
                      / (2.0 * _STEP) for step in _STEP * np.eye(len(vec))]).reshape(-1, 9)
    variance = np.einsum('pi,pq,qi->i', slope, calibration.covariance, slope)
    deviation = np.sqrt(np.maximum(variance, 0.0))
    return linear_figures(vec, effects), np.where(deviation > _SAME, deviation, 0.0)


def _offsets(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    found, deviation = _linear(calibration)
    native = calibration.units.is_native
    scale, unit = (calibration.units.per_g, 'native') if native else (MG, 'mg')
    for k, axis in enumerate(AXES):
        if deviation[k] or found[k]:
            usual = '' if native else f'±{_USUAL_OFFSET_MG[axis]:g} mg'
            yield f'offset {axis}', signed(found[k] * scale, deviation[k] * scale, unit), usual


def _gains(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield the sensitivities of the axes; one row if they are equal."""
    found, deviation = (part[3:6] for part in _linear(calibration))
    native, per_g = calibration.units.is_native, calibration.units.per_g
    usual = '' if native else f'±{_USUAL_GAIN_PERCENT:g} %'
    equal = np.ptp(found) < _SAME
    for axis, value, sd in zip(AXES, found, deviation, strict=True):
        name = 'all axes' if equal else axis
        if native:
            yield f'gain {name}', signed(value * per_g, sd * per_g, 'native per g'), usual
        elif sd or abs(value - 1.0) > _SAME:
            yield f'gain {name}', signed((value - 1.0) * 100.0, sd * 100.0, '%'), usual
        if equal:
            return


def _angles(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    found, deviation = (part[6:] for part in _linear(calibration))
    for (i, j), value, sd in zip(_PAIRS, found, deviation, strict=True):
        if sd or abs(value - 90.0) > _SAME:
            name = f'angle {AXES[i]} to {AXES[j]}'
            words = signed(value - 90.0, sd)
            usual = f'±{_USUAL_CROSS_AXIS_PERCENT:g} %, {_USUAL_CROSS_AXIS:.1f}°'
            yield name, f'90° {words[0]} {words[1:]}°', usual


def _other_effects(calibration: Calibration) -> Iterator[tuple[str, str, str]]:
    """Yield the values of the other effects; a curve, which has many, is one row."""
    for name in calibration.model.effects:
        if name.startswith(f'{EMPIRICAL}-'):
            carrier, variable, modes = empirical_parts(name)
            yield f'curve of {carrier} over {VARIABLES[variable]}', counted(len(modes), 'wave'), ''
    for figure in effect_figures(calibration):
        name, _, part = figure.key.rpartition('.')
        if name.startswith(f'{EMPIRICAL}-') or not (figure.value or figure.sd):
            continue
        label = f'{name.replace("_", " ")} {part}'
        if part in effect_named(name).parameters:
            yield label, *_with_typical(figure, name, part)
        else:
            yield label, f'{figure.value:.5g} {figure.unit}'.rstrip(), ''


def _with_typical(figure: Figure, effect: str, parameter: str) -> tuple[str, str]:
    """Return the value of an effect, and its typical size; small ones in millionths."""
    unit, scale = value_unit(effect, parameter)
    typical = effect_named(effect).typical * scale
    factor = 1.0
    if unit.startswith('g') and 0.0 < typical < _SMALL:
        unit, factor = f'µ{unit}', MG ** 2
    return (signed(figure.value * factor, figure.sd * factor, unit),
            f'±{short(typical * factor)} {unit}' if typical else '')


def covered(calibration: Calibration, residuals: Residuals, *, plan: bool) -> str:
    """Return the section about coverage; with the next pose if `plan` is set."""
    direction, words = None, ''
    linear = all(effect_named(name).linear for name in calibration.model.effects)
    if plan and linear and calibration.model.effects:
        asked = outlook(calibration, 'auto').next_pose
        direction, words = asked.direction, f'Next pose: {asked.words}.'.replace('..', '.')
    return section('Coverage of the sphere', figures(
        [of_coverage(residuals, coverage(residuals.force), direction)], 'wide'),
        paragraph(words), HINT)


def before_after(residuals: Residuals, floor_mg: float | None) -> str:
    """Return the section with each pose before and after."""
    return section('Before and after', figures([of_before_after(residuals, floor_mg)], 'wide'))


def warnings(lines: tuple[str, ...], residuals: Residuals, advice: tuple[str, ...] = ()) -> str:
    """Return the sections with warnings, advice and the poses left out."""
    rows = [f'row {row}: {reason}' for row, reason in sorted(residuals.reasons.items())]
    return (section('Warnings', listing(lines)) + section('What to do', listing(advice))
            + section('Poses left out', listing(rows)))


def remainder(residuals: Residuals) -> str:
    """Return the section with the residuals by direction and by context."""
    return section('What remains', figures(of_remainder(residuals), 'pair'))


def poses(residuals: Residuals, calibration: Calibration) -> str:
    """Return the section with the table of all poses, in order of rows."""
    head, rows = _pose_rows(residuals, calibration)
    cells = ''.join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = ''.join(
        f'<tr data-row="{row}">' + ''.join(f'<td>{escape(cell)}</td>' for cell in line)
        + '</tr>\n' for row, line in rows)
    kind = 'scroll long' if len(rows) > _LONG_TABLE else 'scroll'
    return section('Poses', paragraph(counted(len(rows), 'pose') + ', with the residual before '
                                      'and after.'),
                   f'<div class="{kind}" tabindex="0" role="region" aria-label="Poses">'
                   f'<table class="whole-cells">\n<thead><tr>{cells}</tr></thead>\n'
                   f'<tbody>\n{lines}</tbody>\n</table>\n</div>\n')


def _pose_rows(residuals: Residuals, calibration: Calibration
               ) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the head of the table of poses, and each row with its number."""
    kept = residuals.poses_g
    optional = [key for key in ('label', 'time', 'temperature') if key in kept]
    names = {'label': 'label', 'time': 'time [s]', 'temperature': '°C'}
    head = ['row', *(names[key] for key in optional),
            *(f'{axis} [{calibration.units.symbol}]' for axis in AXES),
            'before [mg]', 'after [mg]', *(['note'] if residuals.reasons else [])]
    rows = []
    since = since_first(kept) if 'time' in kept else None
    for k, reading in enumerate(calibration.units.from_g(kept.reading)):
        context = [str(kept[key][k]) if key == 'label' else
                   f'{since[k]:.1f}' if key == 'time' and since is not None else
                   f'{kept[key][k]:.1f}' for key in optional]
        rows.append((int(kept.row[k]), [
            str(kept.row[k]), *context, *(f'{part:.6g}' for part in reading),
            milli(residuals.before_mg[k], signed=residuals.signed),
            milli(residuals.after_mg[k], signed=residuals.signed)]))
    for row, reading in zip(residuals.left_out.row, residuals.left_out.reading, strict=True):
        rows.append((int(row), [str(row), *('' for _ in optional),
                                *(f'{part:.6g}' for part in reading), '', '', 'left out: '
                                + residuals.reasons[int(row)]]))
    return head, sorted(rows, key=lambda each: each[0])


def use(calibration: Calibration, stored: str) -> str:
    """Return the section with lines of code that use the calibration."""
    return section('Use it', *(block(title, text) for title, text in
                               snippets(calibration, stored)))


_SAME_RESIDUAL = 0.01
_NOT_USED = 'The calibration of this page does not contain these effects.'


def steps(result: Refinement, *, used: bool) -> Iterator[str]:
    """
    Yield the ladder and one section per step; nothing if no effect is named.

    Parameters
    ----------
    result : Refinement
        The refinement.
    used : bool
        Whether the calibration of the page contains the effects.

    """
    if not result.steps:
        return
    note = '' if used else ' '.join((_NOT_USED, *refusal(result)))
    yield section('Effects that were found', paragraph(note), paragraph(verdict_words(result)),
                  figures([ladder(result)], 'wide'), _overview(result))
    for number, step in enumerate(result.steps, 1):
        values = values_of(step)
        table = '' if not values else scroll_table(
            [name for name, _ in values], [[value for _, value in values]], 'whole-cells',
            f'Values of step {number}')
        curve = figures([of_curve(result, number - 1)], 'wide') if step.curve else ''
        title = f'{number}. {effect_named(step.name).words.capitalize()}'
        yield section(title, f'<p>{_story(step)}</p>\n', table,
                      figures(of_step(result, number - 1), 'pair'), curve)


def refined_remainder(result: Refinement, residuals: Residuals) -> str:
    """
    Return what the refinement leaves, if that is not what the calibration of the page leaves.

    They differ for effects that a calibration cannot correct, such as a slow change of the offset,
    and for poses of known or shared orientation, whose residual is the vector error.

    """
    left = residuals_of_refinement(result)
    if np.isclose(left.rms_mg, residuals.rms_mg, rtol=_SAME_RESIDUAL):
        return ''
    return section('What remains after the refinement', figures(of_remainder(left, 'refined'),
                                                                'pair'))


def _overview(result: Refinement) -> str:
    """Return the table of steps."""
    head = ('step', 'effect', 'residual [mg]', 'held out [mg]', 'chance', 'rivals')
    rows = [(str(number), step.effect, _fall(step.gap_before_mg, step.gap_after_mg),
             _fall(step.held_out_before_mg, step.held_out_after_mg), chance(step.p_value),
             ', '.join(step.likely_rivals) or 'none')
            for number, step in enumerate(result.steps, 1)]
    return scroll_table(head, rows, 'whole-but-last', 'Steps')


def _story(step: Step) -> str:
    """Return a text about the location of the disagreement, and the effect on the residual."""
    rivals = f' These poses cannot distinguish it from {_rivals(step)}.' if (
        step.rivals) else ''
    return (f'{code(step.effect)} ({escape(effect_named(step.name).term)}). Found '
            f'{escape(step.where)}. With this effect the residual decreases from '
            f'{short(step.gap_before_mg)} to <strong>{short(step.gap_after_mg)} mg</strong>, '
            f'and the held-out residual from {short(step.held_out_before_mg)} to '
            f'{short(step.held_out_after_mg)} mg; '
            f'<span class="whole">{escape(chance(step.p_value))}</span>.{rivals}')


def _rivals(step: Step) -> str:
    """Return the rivals of a step with their probabilities."""
    return ', '.join(f'{code(name)} ({percent(step.probabilities[name])})'
                     for name in step.rivals)


def not_testable(result: Refinement) -> str:
    """Return the section about effects that these data cannot show."""
    rows = [(f'{effect_named(name).words} ({name})', needs)
            for name, needs in result.not_testable]
    return section('What these data cannot show', scroll_table(
        ('effect', 'to see it, record'), rows, '', 'Effects that cannot be tested')
        if rows else '')


def refusal(result: Refinement) -> tuple[str, ...]:
    """Return the reason why the calibration must not be used, if there is one."""
    if not result.refusal:
        return ()
    found, advice = result.refusal
    return (f'the refined calibration must not be used: {found}; {advice}',)


def _fall(before: float, after: float) -> str:
    return f'{short(before)} → {short(after)}'
