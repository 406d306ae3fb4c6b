# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Formulas of empirical curves, for a paper or for firmware.

A curve is a sum of cosines. Its formula is the best of the first of these groups whose error, RMS
over the range, is below `_EXACT` of the size of the curve, or half of its standard deviation: a
line; a parabola, an exponential, a power; a polynomial of degree 3, a sine; polynomials of degree
4, 5, 6; the cosines themselves. The constant of a form is that of all axes. Expressions are valid
in C and in Python.

"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from .form import EffectKey, MODES
from .records import EmpiricalCurve, unit_of, variable_words
from ..statistics import rms_of_rows
from ..table import Floats
from ..units import MG

_EXACT = 0.04
"""Largest error of a form, RMS, relative to the difference of the extremes of the curve."""

_CONSTANTS = np.geomspace(0.05, 5.0, 93)
"""Constants of a form that are tried, relative to the range of the variable, or as a power."""

_WAVES = np.arange(0.5, MODES + 1.0, 0.025)
"""Half waves of a sine that are tried in the range of the variable."""

_Expression = Callable[[Sequence[float]], str]
_Form = tuple[Floats, _Expression]
"""The (k, g) functions of a form, and the expression of their k factors."""


def formula_of(effect: EffectKey, values: Floats, deviations: Mapping[str, float]) -> str:
    """
    Return the formula of an empirical curve; empty for others and over directions of the force.

    `values` (p,) are those of the curve in a model [g, or 1 for a gain], `deviations` the standard
    deviations of the parameters of the model. The formula is in mg or mg/g, and readings are in g
    in its variable.

    """
    if not isinstance(effect, EmpiricalCurve) or effect.variable == 'direction':
        return ''
    variable, modes, names = effect.variable, effect.modes, effect.parts
    spread = np.array([deviations.get(f'{effect}.{part}', 0.0) for part in effect.entry.values])
    low, high = (-1.0, 1.0) if variable == 'force' else values[-2:].tolist()
    share = np.linspace(0.0, 1.0, 201)
    waves = np.cos(np.pi * np.multiply.outer(np.array(modes), share))
    factors, sizes = (each[:len(names) * len(modes)].reshape(len(modes), len(names)).T * MG
                      for each in (values, spread))
    curves = factors @ waves
    noise = np.sqrt(np.mean(sizes ** 2 @ waves ** 2, axis=1))
    most = np.maximum(_EXACT * np.max(np.ptp(curves, axis=1)), 0.5 * noise) + 1e-12
    for group in _forms(share, high - low, modes):
        fits = [np.linalg.lstsq(functions.T, curves.T, rcond=None)[0].T for functions, _ in group]
        errors = [np.max(rms_of_rows(fit @ functions - curves) / most)
                  for fit, (functions, _) in zip(fits, group, strict=True)]
        best = int(np.argmin(errors))
        if errors[best] <= 1.0:
            break
    expression = group[best][1]
    unit = 'g' if variable == 'force' else unit_of(variable)
    each = ', '.join(f'{own} = {expression(row)}'
                     for own, row in zip(names, fits[best].tolist(), strict=True))
    return (f'{effect.carrier.replace("_", "-")} [m{effect.unit}]: {each}; t = '
            f'{variable_words(variable)}{f" {_signed(-low)}" if low else ""}, from 0 to '
            f'{high - low:.6g} {unit}').rstrip()


def _forms(share: Floats, span: float, modes: Sequence[int]) -> Iterator[list[_Form]]:
    """Yield groups of forms over shares of a span; at last the cosines of the modes."""
    one = np.ones_like(share)
    yield [_polynomial(share, 1, span)]
    yield [_polynomial(share, 2, span),
           *((np.stack([one, np.exp(sign * share / shape)]),
              partial(_one_term, f'exp({words}/{shape * span:.5g})'))
             for shape in _CONSTANTS.tolist() for sign, words in ((-1.0, '-t'), (1.0, 't'))),
           *((np.stack([one, share ** power]),
              partial(_one_term, f'pow(t/{span:.5g}, {power:.5g})'))
             for power in _CONSTANTS.tolist())]
    angles = [(np.pi * waves, np.pi * waves * share) for waves in _WAVES.tolist()]
    yield [_polynomial(share, 3, span),
           *((np.stack([one, np.sin(angle), np.cos(angle)]), partial(_sine, rate / span))
             for rate, angle in angles)]
    for degree in (4, 5, 6):
        yield [_polynomial(share, degree, span)]
    yield [(np.cos(np.pi * np.multiply.outer(np.array(modes), share)), lambda row: ' '.join(
        f'{_signed(value)}*cos({np.pi * mode / span:.6g}*t)' for mode, value in zip(modes, row)))]


def _polynomial(share: Floats, degree: int, span: float) -> _Form:
    def expression(row: Sequence[float]) -> str:
        words = f'{row[-1] / span ** degree:.5g}'
        for power in range(degree - 1, -1, -1):
            words = f'{row[power] / span ** power:.5g} + t*({words})'
        return words

    return np.vander(share, degree + 1, increasing=True).T, expression


def _one_term(term: str, row: Sequence[float]) -> str:
    return f'{row[0]:.5g} {_signed(row[1])}*{term}'


def _sine(rate: float, row: Sequence[float]) -> str:
    size, angle = float(np.hypot(row[1], row[2])), float(np.arctan2(row[2], row[1]))
    return f'{row[0]:.5g} {_signed(size)}*sin({rate:.5g}*t {_signed(angle)})'


def _signed(value: float) -> str:
    return f'{"-" if value < 0.0 else "+"} {abs(value):.5g}'
