# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Text about the result of a refinement, for the terminal and the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..effects import effect_named, EMPIRICAL, empirical_parts
from ..table import COLUMNS
from ..text import counted, short
from ..units import MG

if TYPE_CHECKING:
    from . import Refinement, Step

_LEAST_P = 1e-16
_IN_MILLI = ('g', 'g/g', 'g/g²', 'g/g³', 'g/°C', 'g/h')
_WITHOUT_UNIT = ('of_sensor', 'form')
"""Constants of a shape that select one of two forms."""

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond an empirical '
                 'curve, but no known effect has its form.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    words = _VERDICTS[result.verdict]
    if result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


def residual_words(result: Refinement) -> str:
    """Return the residual of the base and of the refined model, and the noise floor."""
    floor = ('not known' if result.noise_floor_mg is None
             else f'{short(result.noise_floor_mg)} mg')
    residual = f'{short(result.gap_mg)} mg'
    if result.steps:
        residual = f'{short(result.gap_mg)} -> {short(result.remaining_gap_mg)} mg'
    poses = result.poses_g
    count = int(np.sum(poses['new'] > 0.0)) if 'new' in poses else len(poses)
    return f'residual {residual} over {counted(count, "pose")}, noise floor {floor}'


def base_words(result: Refinement) -> str:
    """Return the name of the base model."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def chance(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def values_of(step: Step) -> list[tuple[str, str]]:
    """Return name and text of each value of a step; values in g are given in mg."""
    effect = effect_named(step.name)
    values = []
    for name, value in step.parameters.items():
        unit, scale = value_unit(step.name, name)
        words = (f'{value * scale:+.3g} {unit}'.replace('-', '−') if name in effect.parameters
                 else f'{value:.5g} {unit}'.rstrip())
        values.append((name, words))
    return values


def value_unit(effect_name: str, value_name: str) -> tuple[str, float]:
    """Return the unit of a value of an effect in reports, and the factor from the model's unit."""
    effect = effect_named(effect_name)
    curve = effect_name if effect_name.startswith(f'{EMPIRICAL}-') else ''
    if value_name not in effect.parameters:
        return _shape_unit(value_name, curve), 1.0
    unit = curve_unit(curve) if curve else effect.unit
    return (f'm{unit}', MG) if unit in _IN_MILLI else (unit, 1.0)


def curve_unit(name: str) -> str:
    """Return the unit of an empirical curve."""
    return 'g' if empirical_parts(name)[0].startswith('offset') else 'g/g'


def _shape_unit(name: str, curve: str) -> str:
    """Return the unit of a constant of the shape of an effect."""
    if name in _WITHOUT_UNIT:
        return ''
    return unit_of(empirical_parts(curve)[1]) if curve else 's'


def unit_of(column: str) -> str:
    """Return the unit of a quantity of the context, with readings in g."""
    return 'g' if column == 'std' else COLUMNS[column].unit
