# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a refinement came to, in words and short numbers, for terminal and page alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..effects import EFFECTS
from ..units import MG

if TYPE_CHECKING:
    from ..refine import Refinement, Step

WANDER = 'offset_wander'

_WANDER_WORDS = 'offset that wanders in no known form'
_LEAST_P = 1e-16
_IN_MILLI = ('g', 'g/g', 'g/g²', 'g/g³', 'g/°C', 'g/h')
_VERDICTS = {
    'no_gap': 'Nothing beyond the noise: these poses ask for no further effect.',
    'explained': 'The gap is explained: beyond the named effects only noise is left.',
    'unexplained': 'A gap remains that no effect of the catalogue accounts for.',
}


def effect_words(name: str) -> str:
    """Say what an effect is."""
    return EFFECTS[name].words if name in EFFECTS else _WANDER_WORDS


def verdict_words(result: Refinement) -> str:
    """Say what the verdict means."""
    words = _VERDICTS[result.verdict]
    if result.verdict == 'unexplained' and result.steps:
        words = f'{words[:-1]}, beyond those named.'
    if result.noise_floor_mg is None:
        words += ' The noise of the poses is not known (no std and count): they are judged by ' \
                 'their own scatter.'
    return words


def gap_words(result: Refinement) -> str:
    """Say how the gap went from the base to the end."""
    floor = ('not known' if result.noise_floor_mg is None
             else f'{short(result.noise_floor_mg)} mg')
    gap = f'{short(result.gap_mg)} mg'
    if result.steps:
        gap = f'{short(result.gap_mg)} -> {short(result.remaining_gap_mg)} mg'
    return f'gap {gap} over {len(result.poses_g)} poses, noise floor {floor}'


def base_words(result: Refinement) -> str:
    """Name the base."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def short(value: float) -> str:
    """Give a number with three digits."""
    return f'{value:.3g}'


def chance(p_value: float) -> str:
    """Give the probability that it is noise alone."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def values_of(step: Step) -> list[tuple[str, str]]:
    """Give each value of a step by name, with its unit: mg rather than g."""
    if step.effect not in EFFECTS:
        return []
    effect = EFFECTS[step.effect]
    milli = effect.unit in _IN_MILLI
    unit = f'm{effect.unit}' if milli else effect.unit
    values = []
    for name, value in step.parameters.items():
        if name in effect.parameters:
            values.append((name, f'{value * (MG if milli else 1.0):+.3g} {unit}'
                           .replace('-', '−')))
        else:
            values.append((name, f'{value:.5g} s'))
    return values
