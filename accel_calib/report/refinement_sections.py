# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The sections of a page about a refinement: the ladder, the steps, and what is not testable."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from .drawings import ladder, of_curve, of_remainder, of_step
from .residuals import Residuals, residuals_of_refinement
from .sheet import code, figures, paragraph, scroll_table, section
from ..effects import effect_named
from ..refine.plan_words import percent
from ..refine.words import chance, values_of, verdict_words
from ..text import short

if TYPE_CHECKING:
    from ..refine import Refinement, Step

_SAME = 0.01
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


def remainder(result: Refinement, residuals: Residuals) -> str:
    """
    Return what the refinement leaves, if that is not what the calibration of the page leaves.

    They differ for effects that a calibration cannot correct, such as a slow change of the offset,
    and for poses of known or shared orientation, whose residual is the vector error.

    """
    left = residuals_of_refinement(result)
    if np.isclose(left.rms_mg, residuals.rms_mg, rtol=_SAME):
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
