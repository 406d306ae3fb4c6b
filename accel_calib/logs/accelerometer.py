# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Unit of the readings of a text log, and whether gravity is in.

The user, a comment of the file, the maker's layout or the names of the columns state it, in this
order. Otherwise the readings at rest show it. They are also held against what the names state,
and a log without gravity is refused.

A sensor at rest reads 1 g plus its offset, in any direction. So the readings at rest lie on a
sphere whose radius is 1 g in the unit of the sensor. Without gravity they lie around 0, and no
sphere fits them.

"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import cast, Literal

import numpy as np

from .columns import Chosen, LogOptions
from .names import READING, record_instead, unit_of
from ..errors import InputError
from ..table import Floats
from ..units import STANDARD_GRAVITY, UnitName, Units, units_of

_WINDOWS = 400
"""Largest number of windows of a recording."""

_SHORTEST, _LONGEST = 8, 256
"""Shortest and longest window [samples]."""

_QUIET_SHARE = 0.3
"""Share of the windows that are taken for rests: those with the least scatter."""

_SPHERE_POINTS = 6
_SPREAD = 0.3
"""Smallest ratio of the standard deviations along the axes of the readings to fit a sphere."""

_OFF_SPHERE = 0.1
"""Largest RMS distance from the sphere, relative to its radius."""

_SMALL_G = 0.3
"""Readings at rest below this [g] have no gravity in them."""

_SMALL = 0.5
"""The same, in a unit that is not known: below half of the smallest common unit, g."""

_FACTOR = 1.4
"""Largest factor between the readings at rest and 1 g in their unit."""

_MG = (1000.0 / 1.3, 1012.0)
"""Range of whole numbers at rest that are mg; 1024 counts per g begin above it."""


@dataclass(frozen=True)
class Rests:
    """
    Readings at rest: median length, and radius of the sphere through them.

    The radius is NaN if they do not determine one. `whole`: all readings are whole numbers.

    """

    length: float
    radius: float
    whole: bool

    @property
    def per_g(self) -> float:
        """Value of 1 g, as far as the readings tell."""
        return self.length if math.isnan(self.radius) else self.radius

    def near(self, per_g: float, factor: float = _FACTOR) -> bool:
        """Return whether 1 g of the readings is within a factor of a value."""
        lengths = (self.length, self.per_g)
        return all(1.0 / factor <= length / per_g <= factor for length in lengths)

    @property
    def unit(self) -> tuple[UnitName, float] | None:
        """Return the common unit of the readings and the factor to it, or None."""
        if self.near(STANDARD_GRAVITY):
            return 'm/s2', 1.0
        if self.near(1.0):
            return 'g', 1.0
        if self.near(1000.0, 1.3) and (not self.whole or _MG[0] < self.per_g < _MG[1]):
            return 'g', 1e-3
        return None

    def lack_gravity(self, per_g: float | None) -> bool:
        """Return whether the readings are small and on no sphere; `per_g` is 1 g if stated."""
        small = _SMALL if per_g is None else _SMALL_G * per_g
        return self.length < small and self.unit is None and math.isnan(self.radius)


def rests_of(reading: Floats, *, samples: bool) -> Rests:
    """Return the rests in (n, 3) readings in the unit of the file; rows are samples or poses."""
    still = _quiet(reading) if samples else reading
    with np.errstate(over='ignore', invalid='ignore'):
        length = float(np.median(np.linalg.norm(still, axis=1)))
        radius = _radius(still)
    whole = bool(np.all(reading[:1000] == np.round(reading[:1000])))
    return Rests(length, radius, whole)


def _quiet(reading: Floats) -> Floats:
    size = int(np.clip(len(reading) // _WINDOWS, _SHORTEST, _LONGEST))
    count = len(reading) // size
    if count < 2:
        return reading
    windows = reading[:count * size].reshape(count, size, 3)
    with np.errstate(over='ignore', invalid='ignore'):
        scatter = np.linalg.norm(windows.std(axis=1), axis=1)
    quiet = np.argsort(scatter, kind='stable')[:max(2, int(_QUIET_SHARE * count))]
    means: Floats = windows[quiet].mean(axis=1)
    return means


def _radius(still: Floats) -> float:
    """Return the radius of the sphere through readings at rest; NaN if they determine none."""
    size = float(np.abs(still).max()) if len(still) else 0.0
    if len(still) < _SPHERE_POINTS or not 0.0 < size < 1e150:
        return math.nan
    scaled = still / size
    centred = scaled - scaled.mean(axis=0)
    scales = np.linalg.svd(centred, compute_uv=False)
    if scales[2] < _SPREAD * scales[0]:
        return math.nan
    # |m|² = 2 c·m + (r² - |c|²) is linear in the centre c.
    rows = np.column_stack([2.0 * centred, np.ones(len(centred))])
    found = np.linalg.lstsq(rows, np.sum(centred**2, axis=1), rcond=None)[0]
    square = float(found[3] + found[:3] @ found[:3])
    if square <= 0.0:
        return math.nan
    radius = math.sqrt(square)
    off = np.linalg.norm(centred - found[:3], axis=1) - radius
    on_sphere = float(np.sqrt(np.mean(off**2))) < _OFF_SPHERE * radius
    return radius * size if on_sphere else math.nan


_STATED_FACTOR = 2.0
"""Largest factor between the readings at rest and 1 g in a stated unit."""

_THOUSANDS = 1000.0


@dataclass(frozen=True)
class ReadingUnit:
    """
    Unit of the readings, the factor from the unit of the file, and how the readings are read.

    `assumed`: that is more than our own names and a stated unit.

    """

    units: Units
    factor: float
    words: tuple[str, ...]
    assumed: bool


def unit_of_reading(columns: Chosen, raw: Floats, options: LogOptions, *, samples: bool
                    ) -> ReadingUnit:
    """
    Return the unit of readings; `raw` are the first (n, 3), in the unit of the file.

    If not `samples`, each row is a pose at rest. Raise InputError if stated units contradict each
    other or the readings, or the readings lack gravity.

    """
    named, factor = _named(columns)
    stated = _stated(columns, options) or (not named and options.default_units) or ''
    if stated and stated != named:
        factor = 1.0
    rests = rests_of(raw * factor, samples=samples)
    name = stated or named
    _check_gravity(columns, rests, units_of(name, options.gravity) if name else None)
    if not name:
        name, factor = _at_rest(columns, rests)
    elif not stated:
        _check_named(columns, rests, units_of(name))
    units = units_of(name, options.gravity)
    words = _words(columns, rests, units, factor, stated=bool(stated))
    assumed = (columns.names(READING) != list(READING) or not (stated or units.is_si))
    return ReadingUnit(units, factor, words, assumed)


def _named(columns: Chosen) -> tuple[UnitName | Literal[''], float]:
    """Return the unit that the maker or the names state, and the factor to it."""
    if columns.maker is not None and columns.maker.units:
        return columns.maker.units, columns.maker.scales.get('ax', 1.0)
    found = {unit_of('reading', columns.sources[name].unit) for name in READING}
    if len(found) > 1:
        raise InputError(f'{columns.layout.path} has the columns '
                         f'{", ".join(columns.names(READING))} in several units, expected one '
                         'unit', 'correct the names, or convert the columns')
    name, factor = found.pop() or ('', 1.0)
    return cast(UnitName, name), factor


def _stated(columns: Chosen, options: LogOptions) -> UnitName | Literal['']:
    path, of_file = columns.layout.path, columns.layout.about.get('units', '')
    if options.units and of_file and options.units != of_file:
        raise InputError(f'{path} is in {of_file}, but --units is {options.units}',
                         'remove --units, or correct the file')
    return options.units or cast(UnitName, of_file)


def _check_gravity(columns: Chosen, rests: Rests, units: Units | None) -> None:
    """Check that gravity is in the readings; `units` is the stated unit, if any."""
    per_g = None if units is None else units.per_g
    if (units is not None and units.is_native) or not rests.lack_gravity(per_g):
        return
    layout = columns.layout
    instead = record_instead(layout.header, layout.path)
    raise InputError(f'{layout.path} holds linear acceleration, gravity removed: the readings at '
                     f'rest have a length of {rests.length:.3g}, expected 1 g',
                     instead or 'record the acceleration with gravity, often called raw or total '
                     'acceleration')


def _at_rest(columns: Chosen, rests: Rests) -> tuple[UnitName, float]:
    own = columns.sources['ax'].name == 'ax'
    if own and rests.unit is None and rests.near(STANDARD_GRAVITY, _STATED_FACTOR):
        return 'm/s2', 1.0
    return rests.unit or ('native', 1.0)


def _check_named(columns: Chosen, rests: Rests, units: Units) -> None:
    """Check that the readings at rest fit the unit in the names."""
    if units.is_native or (1.0 / _STATED_FACTOR <= rests.length / units.per_g
                           <= _STATED_FACTOR):
        return
    likely = rests.unit
    advice = (f'add --units {likely[0]}' if likely and likely[1] == 1.0 else
              'correct the name, or add --units native')
    maker = columns.maker
    what = (f'the format {maker.name}' if maker is not None and maker.units else
            f'the name {columns.sources["ax"].name!r}')
    raise InputError(f'{columns.layout.path}: {what} states readings in {units.name}, but at rest '
                     f'they have a length of {rests.length:.4g} {units.name}, expected about '
                     f'{units.per_g:.4g}', advice)


def _words(columns: Chosen, rests: Rests, units: Units, factor: float, *, stated: bool
           ) -> tuple[str, ...]:
    words, name = compact(columns.names(READING)), units.name
    if units.is_native and not stated:
        value = f'{_size(rests.per_g)}{" counts" if rests.whole else ""}'
        about = 'at rest' if math.isnan(rests.radius) else '= 1 g'
        return words, f'{value} {about} (native)'
    if factor == 1.0:
        return (f'{words} in {name}',)
    unit = columns.sources['ax'].unit or {1e-3: 'mg'}.get(factor, f'{factor:g} {name}')
    return (f'{words} in {unit} -> {name}' if columns.maker is None else f'{words} -> {name}',)


def _size(value: float) -> str:
    """Return a number with blanks between thousands."""
    return f'{value:,.0f}'.replace(',', ' ') if value >= _THOUSANDS else f'{value:.3g}'


def compact(parts: Sequence[str]) -> str:
    """Return names that differ in one place in a short form: ``accX/Y/Z``."""
    if all(part.isdecimal() for part in parts):
        return f'columns {", ".join(parts)}'
    start = next((k for k, letters in enumerate(zip(*parts)) if len(set(letters)) > 1), 0)
    ends = {part[start + 1:] for part in parts}
    if len(ends) > 1:
        return ', '.join(parts)
    return f'{parts[0][:start]}{"/".join(part[start] for part in parts)}{ends.pop()}'
