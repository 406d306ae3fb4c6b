# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Whether readings at rest, and known forces, can be in the unit that they are said to be in."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..table import Table
from ..units import STANDARD_GRAVITY, Units

_LIKELY_G = (0.5, 2.0)
_ABOUT = 1.3
"""Factor within which a unit fits well enough to be named."""

_OTHERS = {'g': 1.0, 'm/s2': STANDARD_GRAVITY, 'ft/s2': 32.174, 'cm/s2': 100.0 * STANDARD_GRAVITY,
           'mg': 1e3, 'µg': 1e6}
"""What 1 g is in units that sensors are known to give."""

_TAKEN = ('g', 'm/s2')


def check_units(poses: Table, units: Units) -> None:
    """
    Make sure that still readings are about 1 g long, and known forces in the right unit.

    Raises
    ------
    InputError
        Says which unit they look like.

    """
    if len(poses) == 0:
        return
    if units.name != 'native':
        _check_readings(float(np.median(np.linalg.norm(poses.reading, axis=1))), units)
    if 'reference' in poses:
        _check_reference(float(np.median(np.linalg.norm(poses['reference'], axis=1))), units)


def _check_readings(length: float, units: Units) -> None:
    if _is_likely(length, units.per_g):
        return
    likely = _likely(length)
    taken = next((name for name in likely if name in _TAKEN), None)
    if taken:
        advice = f'give the units of the readings: {taken}'
    else:
        look = f'they look like {" or ".join(likely)}: ' if likely else ''
        advice = f'{look}give the units of the readings: native, and the fit finds their scale'
    raise InputError(f'the readings are about {length:.4g} long, expected about '
                     f'{units.per_g:.4g} at rest in {units.name}', advice)


def _check_reference(length: float, units: Units) -> None:
    per_g, words = ((1.0, 'in g, as known forces beside native readings are')
                    if units.name == 'native' else
                    (units.per_g, f'in {units.name}, the unit of the readings'))
    if _is_likely(length, per_g):
        return
    likely = _likely(length)
    look = f'they look like {" or ".join(likely)}: ' if likely else ''
    raise InputError(f'the known forces ref_x,ref_y,ref_z are about {length:.4g} long, expected '
                     f'about {per_g:.4g} {words}',
                     f'{look}multiply them by {per_g / max(length, 1e-12):.4g}'
                     if length > 0.0 else 'fill the columns, or leave them out')


def _is_likely(length: float, per_g: float) -> bool:
    return _LIKELY_G[0] <= length / per_g <= _LIKELY_G[1]


def _likely(length: float) -> list[str]:
    """Name the units in which that is about 1 g: those that fit well, or else the nearest."""
    fits = {name: max(length / per_g, per_g / max(length, 1e-300))
            for name, per_g in _OTHERS.items()}
    well = [name for name, factor in fits.items() if factor <= _ABOUT]
    nearest = min(fits, key=lambda name: fits[name])
    return well or ([nearest] if fits[nearest] <= _LIKELY_G[1] else [])
