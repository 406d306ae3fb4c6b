# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The result of a refinement in words and short numbers, for terminal and page."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .effects import effect_named
from .units import MG

if TYPE_CHECKING:
    from .refine import Refinement, Step

_LEAST_P = 1e-16
_IN_MILLI = ('g', 'g/g', 'g/g²', 'g/g³', 'g/°C', 'g/h')
_VERDICTS = {
    'no_gap': 'Nothing beyond the noise: these poses call for no further effect.',
    'explained': 'The gap is explained: beyond the named effects only noise is left.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}


def verdict_words(result: Refinement) -> str:
    """Return what the verdict means."""
    words = _VERDICTS[result.verdict]
    if result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so they are judged by '
                  'their own scatter.')
    return words


def residual_words(result: Refinement) -> str:
    """Return how the residual went from the base to the end."""
    floor = ('not known' if result.noise_floor_mg is None
             else f'{short(result.noise_floor_mg)} mg')
    residual = f'{short(result.gap_mg)} mg'
    if result.steps:
        residual = f'{short(result.gap_mg)} -> {short(result.remaining_gap_mg)} mg'
    return f'residual {residual} over {len(result.poses_g)} poses, noise floor {floor}'


def base_words(result: Refinement) -> str:
    """Return the name of the base."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def short(value: float) -> str:
    """Return a number with three digits."""
    return f'{value:.3g}'


def chance(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def values_of(step: Step) -> list[tuple[str, str]]:
    """Return each value of a step by name, with its unit: mg rather than g."""
    effect = effect_named(step.effect)
    milli = effect.unit in _IN_MILLI
    unit, scale = (f'm{effect.unit}', MG) if milli else (effect.unit, 1.0)
    values = []
    for name, value in step.parameters.items():
        words = (f'{value * scale:+.3g} {unit}'.replace('-', '−') if name in effect.parameters
                 else f'{value:.5g} s')
        values.append((name, words))
    return values
