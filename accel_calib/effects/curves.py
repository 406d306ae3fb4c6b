# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Empirical curves: effects without a known cause, made from their name.

A part of the reading, the carrier, changes smoothly with a variable. `empirical_name` has the
equation.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .form import ALL_AXES, AXES, by_axis, Context, CROSS, Effect, FORCE, MODES, ONE, Term, WAVE
from ..table import Floats

EMPIRICAL = 'empirical'
"""Name of a smooth curve without a physical cause; see `empirical_name`."""

CARRIERS: dict[str, tuple[str, ...]] = {
    'offset': AXES, 'gain': AXES, 'cross_axis': ('xy', 'xz', 'yz'), 'force': ('all',)}
"""What an empirical curve can change, with the names of its parts. Each part alone is a carrier,
too, such as ``gain.z``. The carrier ``force`` is the common gain of all axes."""

VARIABLES: dict[str, str] = {
    'time': 'time', 'temperature': 'temperature', 'temperature_rate': 'rate of temperature',
    'supply_voltage': 'supply voltage', 'std': 'vibration', 'force': 'force along the axis'}
"""Quantities that an empirical curve can be a function of, by column, with their words."""

_CARRIED = {'offset': by_axis(ONE), 'gain': by_axis(FORCE), 'cross_axis': CROSS, 'force': ALL_AXES}


def empirical_name(carrier: str, variable: str, modes: Iterable[int]) -> str:
    """
    Return the name of an empirical curve.

    A part of the reading, the carrier, changes with a variable by Σ_k c_k cos(k π s), where s runs
    from 0 to 1 over the range of the variable in the poses. Outside of this range, the curve is
    constant.

    Parameters
    ----------
    carrier : str
        One of `CARRIERS`, or one part of it.
    variable : str
        One of `VARIABLES`.
    modes : iterable of int
        The k of the cosines, 1 to `MODES`.

    """
    return '-'.join([EMPIRICAL, carrier, variable, *map(str, modes)])


def empirical_parts(name: str) -> tuple[str, str, tuple[int, ...]]:
    """Return carrier, variable and modes of an empirical curve; `KeyError` for another name."""
    first, *rest = name.split('-')
    if first != EMPIRICAL or len(rest) < 3 or not all(part.isdecimal() for part in rest[2:]):
        raise KeyError(name)
    modes = tuple(int(part) for part in rest[2:])
    whole, dot, part = rest[0].partition('.')
    if (whole not in CARRIERS or (dot and part not in CARRIERS[whole])
            or rest[1] not in VARIABLES or (rest[1] == 'force' and whole != 'offset')
            or list(modes) != sorted(set(modes)) or not 1 <= modes[0] <= modes[-1] <= MODES):
        raise KeyError(name)
    return rest[0], rest[1], modes


@cache
def empirical(name: str) -> Effect:
    """Return the effect of an empirical curve, from its name."""
    carrier, variable, modes = empirical_parts(name)
    whole, _, part = carrier.partition('.')
    parts = CARRIERS[whole]
    terms = []
    for k, mode in enumerate(modes):
        for term in _CARRIED[whole]:
            if part in ('', parts[term.parameter]):
                own = 0 if part else term.parameter
                monomial = (WAVE + 3 * (mode - 1) + term.axis if variable == 'force'
                            else term.monomial)
                terms.append(Term(k * (1 if part else len(parts)) + own, term.axis, monomial,
                                  term.weight))
    each = len(terms) // len(modes)
    names = tuple(f'{own}_{mode}' for mode in modes for own in ((part,) if part else parts))
    words = f'{carrier.replace("_", "-")} as a smooth function of {VARIABLES[variable]}'
    if variable == 'force':
        return Effect(words, 'empirical curve', names, 'g', 0.001, 0.5, tuple(terms),
                      family='force')
    return Effect(words, 'empirical curve', names, 'g', 0.001, 0.5, tuple(terms),
                  partial(_cosines, variable, np.repeat(modes, each)), (variable,),
                  ('low', 'high'), partial(_ends, variable))


def _variable(variable: str, context: Mapping[str, Any]) -> Floats:
    """Return the variable of an empirical curve; for vectors, its RMS over the axes."""
    values = np.asarray(context[variable], float)
    found: Floats = np.sqrt(np.mean(values ** 2, axis=-1)) if variable == 'std' else values
    return found


def _ends(variable: str, context: Context) -> Iterator[Floats]:
    """Yield the range of a variable."""
    values = _variable(variable, context)
    known = values[np.isfinite(values)]
    if len(known) and np.ptp(known) > 0.0:
        yield np.array([np.min(known), np.max(known)])


def _cosines(variable: str, modes: NDArray[np.intp], context: Mapping[str, Any], shape: Floats
             ) -> Any:
    """Return the cosine of each term, (t, n)."""
    values = _variable(variable, context)
    share = np.clip((values - shape[0]) / max(shape[1] - shape[0], 1e-300), 0.0, 1.0)
    return np.cos(np.pi * np.multiply.outer(modes, share))
