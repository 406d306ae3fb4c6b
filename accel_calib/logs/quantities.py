# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Quantities of a text log: the conversion of its columns to our units.

`decide_quantities` decides the unit of each column from the first block of numbers: what the user,
a comment of the file, the maker's layout or the name states, in this order, or else what the
readings at rest and the rate of the samples show. Each assumption is in `Quantities.said`.

A sensor at rest reads 1 g plus its offset, in any direction. So the readings at rest lie on a
sphere whose radius is 1 g in the unit of the sensor. Without gravity they lie around 0, and no
sphere fits them. A log without gravity is refused, and so are readings at rest that contradict
their name.

"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any, cast, Literal

import numpy as np
from numpy.typing import NDArray

from .columns import Cells, Chosen, LogOptions, MOST, OF_POSES, shown
from .names import DEGREE_RAD, meaning, READING, record_instead, unit_of, ZEROS
from .times import Clock, clock_of
from ..errors import InputError, saying
from ..finding import Finding
from ..geometry import sphere_through
from ..table import check_values, COLUMNS, Floats
from ..text import one_line
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

_STEADY, _STEADIER = 5.0, 3.0
"""Smallest steadiness of gravity, and smallest ratio to that of rates."""

_BITS = (10, 12, 13, 14, 16, 18, 20, 24, 32)
_NEAR_TOP, _MIDDLE, _IN_MIDDLE, _SMOOTHER = 0.9, 0.1, 0.02, 0.7
"""Bits of numbers that can lose their sign; smallest largest number, and half of the empty middle,
relative to the range; largest share of numbers in it; largest ratio of the steps with the sign to
those without."""

_MG = (1000.0 / 1.3, 1012.0)
"""Range of whole numbers at rest that are mg; 1024 counts per g begin above it."""

_STATED_FACTOR = 2.0
"""Largest factor between the readings at rest and 1 g in a stated unit."""

_SAMPLES_APART_S = 0.9
"""Rows that are nearer in time are samples."""

_MOST_POSES = 1000
"""More rows than these are samples: no person takes as many poses."""

_FEW_POSES = 200
"""Fewer rows without times are poses."""

_SAME = 0.1
"""Successive samples at rest are nearer than this, relative to the spread of the readings."""

_ONE_SIDE = 0.3
"""Readings of a sensor that is not turned scatter by less, relative to their length."""

_LIKELY_RATE = 20.0
"""Angular rates [rad/s] of a sensor that is turned by hand stay below this; in °/s they do not."""

_LIKELY_RATE_DEG = 3000.0
_LARGEST_RATE = 40.0
"""Angular rates [rad/s] above those of common gyros, 2000 °/s."""

_SCATTER_AT_REST = 0.03
"""Largest scatter of readings at rest, relative to 1 g."""

_LARGEST_BIAS = math.radians(12.0)
_GYRO_NOISE = (math.radians(0.004), math.radians(2.0))
"""Largest bias of a gyro [rad/s], and range of the noise of one of its samples: of parts from
tactical grade to the cheapest."""

_LIKELY_TEMPERATURE_C = (-60.0, 150.0)


@dataclass
class Quantities:
    """
    The conversion of the columns of a log; `decide_quantities` makes it.

    `clock` converts the times; `rate_hz` is the rate of samples without times. By key of
    `COLUMNS`, `scales` are the factor to our unit and our value at 0, and `modulus` is 2ⁿ where
    numbers of n bits lost their sign. `instance` is the number of the sensor whose rows are read,
    where rows of several alternate. `said` is what is assumed, `notes` what is not used, and
    `findings` what the values contradict, and what is done about the times.

    """

    chosen: Chosen
    units: Units
    clock: Clock
    scales: dict[str, tuple[float, float]] = field(default_factory=dict)
    instance: float | None = None
    rate_hz: float | None = None
    modulus: dict[str, float] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    @property
    def all_notes(self) -> tuple[str, ...]:
        """Return what is not used, and whether the counter of the clock started again."""
        starts = self.clock.starts
        times = 'once' if starts == 1 else f'{starts} times'
        again = f'the clock starts again {times} at the end of its range; its times are continued'
        return (*self.notes, again) if starts else tuple(self.notes)

    def columns(self, cells: Cells, source: str
                ) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
        """
        Return the columns of a block in our units, and its row numbers; empty cells are NaN.

        See `check_values` for the errors.

        """
        cells, columns = self.of_instance(cells), dict[str, NDArray[Any]]()
        for key, own in self.chosen.sources.items():
            if key == 'label':
                columns[key] = np.array([*map(one_line, cells.texts[own[0]])], str)
            elif key == 'time':
                columns[key] = self.clock.continued(cells)
            elif key in COLUMNS:
                values = self.numbers(cells, key)
                factor, zero = self.scales.get(key, (1.0, 0.0))
                if (factor, zero) != (1.0, 0.0):
                    values = values * factor + zero
                columns[key] = values if len(own) > 1 else values[:, 0]
        columns |= {key: cells.numbers[k] for key, k in self.chosen.quantities.items()}
        if self.rate_hz is not None:
            columns['time'] = (cells.row - 1) / self.rate_hz
        check_values(columns, source, cells.row, partial=True)
        return columns, cells.row

    def of_instance(self, cells: Cells) -> Cells:
        """Return the rows of the sensor that is read."""
        if self.instance is None:
            return cells
        return cells.take(self.chosen.numbers(cells, 'instance')[:, 0] == self.instance)

    def numbers(self, cells: Cells, key: str) -> Floats:
        """Return the numbers of a key, (n, k), with their sign, in the unit of the file."""
        values = self.chosen.numbers(cells, key)
        if key in self.modulus:
            values[values >= self.modulus[key] / 2.0] -= self.modulus[key]
        return values


@np.errstate(over='ignore', invalid='ignore')  # numbers beyond any sensor are refused later
def decide_quantities(columns: Chosen, first: Cells, options: LogOptions) -> Quantities:
    """Return the conversion of the columns, from the first block of a log; see above."""
    made = Quantities(columns, units_of('m/s2', options.gravity), Clock(columns))
    if columns.maker is not None:
        made.said.append(f'{columns.maker.name} format')
        made.notes += [columns.maker.note] if columns.maker.note else []
    made.said += columns.layout.words
    if 'instance' in columns.sources:
        _choose_instance(made, columns.numbers(first, 'instance')[:, 0], options)
        first = made.of_instance(first)
    for key in ('reading', 'rate'):
        if key in columns.sources and (modulus := modulus_of(columns.numbers(first, key))):
            made.modulus[key] = modulus
            made.findings.append(Finding(
                'signs', f'{compact(columns.names(key))} are numbers of '
                f'{round(math.log2(modulus))} bits that lost their sign: they are read with it',
                'print them as signed numbers'))
    if not (columns.layout.header or options.columns):
        _find_gyro(made, first)
    columns = made.chosen
    rows = dict.fromkeys(columns.sources, made.numbers(first, 'reading'))
    if 'time' in rows:
        beside = {key: values for key, values in rows.items() if key != 'time'}
        made.clock = clock_of(columns, first, options,
                              of_poses=not are_samples(beside, _SPHERE_POINTS))
        made.notes += made.clock.doubts
        samples = are_samples({**rows, 'time': made.clock.seconds(first)})
    else:
        samples = bool(options.rate) or are_samples(rows)
        made.rate_hz = options.rate or (columns.layout.rate_hz if samples else None)
    made.clock.newest_first &= samples  # rows of poses keep their numbers
    if 'time' in rows and (samples or columns.names('time') != ['time']):
        made.said += [made.clock.words, *(each.text for each in made.clock.findings)]
    _decide_reading(made, first, options, samples=samples)
    _decide_rate(made, first)
    _decide_context(made, first)
    made.findings += made.clock.findings
    return made


def _choose_instance(made: Quantities, numbers: Floats, options: LogOptions) -> None:
    """Choose one of the sensors whose rows alternate, by their numbers; by default the lowest."""
    there = np.unique(numbers).tolist()
    names = [f'{each:g}' for each in there]
    if options.sensor and options.instance not in names:
        raise InputError(f'{made.chosen.layout.path} has the sensors {", ".join(names)}, expected '
                         f'{options.sensor}', 'choose one of them with --sensor')
    made.instance = float(options.instance) if options.sensor else there[0]
    if len(there) > 1 and not options.sensor:
        made.notes.append(f'the log has the sensors {", ".join(names)}; sensor {names[0]} is '
                          'read: choose another with --sensor')


def _find_gyro(made: Quantities, first: Cells) -> None:
    """Exchange readings and rates without names if the rates have the steady length of gravity."""
    if ('rate' not in made.chosen.sources
            or rests_of(made.numbers(first, 'reading'), samples=True).unit is not None):
        return
    steady = {}  # median length of the vectors, relative to its scatter
    for key in ('reading', 'rate'):
        length = np.linalg.norm(made.numbers(first, key), axis=1)
        middle = float(np.median(length))
        scatter = float(np.median(np.abs(length - middle)))
        steady[key] = middle / scatter if scatter > 0.0 else math.inf if middle > 0.0 else 0.0
    if steady['rate'] > max(_STEADY, _STEADIER * steady['reading']):
        swapped = {'reading': 'rate', 'rate': 'reading'}
        made.chosen = replace(made.chosen, sources={
            key: made.chosen.sources[swapped.get(key, key)] for key in made.chosen.sources})
        made.modulus = {swapped[key]: each for key, each in made.modulus.items()}
        words = f'{compact(made.chosen.names("rate"))} are a gyro by their values'
        made.said.append(words)
        made.findings.append(Finding('columns', words, 'name the columns in the first line'))


def modulus_of(values: Floats) -> float:
    """
    Return 2ⁿ if (n, 3) numbers of n bits lost their sign, else 0.

    Numbers below zero are then near the upper end of the range, hardly any are in its middle, and
    successive samples jump from one end to the other.

    """
    largest = float(np.max(values, initial=0.0))
    bits = next((each for each in _BITS if largest < 2.0**each), 0)
    if not bits or np.any(values < 0.0) or np.any(values != np.round(values)):
        return 0.0
    modulus = 2.0**bits
    apart = np.abs(values / modulus - 0.5)
    jumps = np.abs(np.diff(values, axis=0)).sum()
    signed = np.where(values >= modulus / 2.0, values - modulus, values)
    steps = np.abs(np.diff(signed, axis=0)).sum()
    empty = largest > _NEAR_TOP * modulus and np.mean(apart < _MIDDLE) < _IN_MIDDLE
    return modulus if empty and steps < _SMOOTHER * jumps else 0.0


# ---------------------------------------------------------------------------------- reading

def _decide_reading(made: Quantities, first: Cells, options: LogOptions, *, samples: bool
                    ) -> None:
    """Decide the unit of the readings; raise InputError if what states it is contradicted."""
    columns, maker = made.chosen, made.chosen.maker
    path, of_file = columns.layout.path, columns.layout.about.get('units', '')
    found = ({(maker.units, maker.scales.get('reading', 1.0))} if maker and maker.units else
             {unit_of('reading', columns.layout.unit(k)) for k in columns.sources['reading']})
    if len(found) > 1:
        raise InputError(f'{path} has the columns {", ".join(columns.names("reading"))} in '
                         'several units, expected one unit',
                         'correct the names, or convert the columns')
    named, factor = found.pop() or ('', 1.0)
    if options.units and of_file and options.units != of_file:
        raise InputError(f'{path} is in {of_file}, but --units is {options.units}',
                         'remove --units, or correct the file')
    stated = options.units or of_file or (not named and options.default_units) or ''
    if stated and stated != named:
        factor = 1.0
    rests = rests_of(made.numbers(first, 'reading') * factor, samples=samples)
    name = cast(UnitName | Literal[''], stated or named)
    words = compact(columns.names('reading'))
    with saying(', '.join([*made.said, f'{words} in {name}' if name else words])):
        _check_rests(columns, rests, units_of(name, options.gravity) if name else None,
                     stated=bool(stated))
    own = columns.names('reading')[0]
    if not name:
        is_si = own == 'ax' and not rests.unit and rests.near(STANDARD_GRAVITY, _STATED_FACTOR)
        name, factor = ('m/s2', 1.0) if is_si else rests.unit or ('native', 1.0)
    made.units = units_of(name, options.gravity)
    made.scales['reading'] = factor, 0.0
    for key in {'std', 'reference'} & columns.sources.keys():  # in their own unit, if it is stated
        stated_unit = columns.layout.unit(columns.sources[key][0])
        unit, scale = unit_of('reading', stated_unit) or (name, factor)
        if not made.units.is_native:
            scale *= made.units.per_g / units_of(cast(UnitName, unit), options.gravity).per_g
        made.scales[key] = scale, 0.0
    is_ours = columns.names('reading') == [*READING] and (stated or made.units.is_si)
    if made.said or not is_ours:
        made.said.append(_words(columns, rests, made.units, factor, stated=bool(stated)))
    are_accelerations = (options.units or columns.maker or meaning(own).quantity
                         or {*READING} & {*options.columns})
    if made.units.is_native and not are_accelerations:
        made.notes.append('nothing in the file says what the numbers are: they are taken for '
                          'those of an accelerometer in counts or volts; a magnetometer looks '
                          'alike')


def _check_rests(columns: Chosen, rests: 'Rests', units: Units | None, *, stated: bool) -> None:
    """Check that gravity is in the readings, and their unit, if the names or the maker tell it."""
    if units is not None and units.is_native:
        return
    layout, maker, likely = columns.layout, columns.maker, rests.unit
    small = _SMALL if units is None else _SMALL_G * units.per_g
    if rests.length < small and likely is None and math.isnan(rests.radius):
        instead = record_instead(layout.header, layout.path)
        raise InputError(f'{layout.path} holds linear acceleration, gravity removed: the readings '
                         f'at rest have a length of {rests.length:.3g}, expected 1 g',
                         instead or 'record the acceleration with gravity, often called raw or '
                         'total acceleration')
    if units is None or stated:
        return
    per_g = units_of(units.name).per_g
    if not 1.0 / _STATED_FACTOR <= rests.length / per_g <= _STATED_FACTOR:
        advice = (f'add --units {likely[0]}' if likely and likely[1] == 1.0 else
                  'correct the name, or add --units native')
        what = (f'the format {maker.name}' if maker is not None and maker.units else
                f'the name {columns.names("reading")[0]!r}')
        raise InputError(f'{layout.path}: {what} states readings in {units.name}, but at rest '
                         f'they have a length of {rests.length:.4g} {units.name}, expected about '
                         f'{per_g:.4g}', advice)


def _words(columns: Chosen, rests: 'Rests', units: Units, factor: float, *, stated: bool) -> str:
    words, name = compact(columns.names('reading')), units.name
    if units.is_native and not stated:
        size = rests.per_g
        value = f'{size:,.0f}'.replace(',', ' ') if size >= 1000.0 else f'{size:.3g}'
        counts = ' counts' if rests.whole else ''
        about = 'at rest' if math.isnan(rests.radius) else '= 1 g'
        return f'{words}, {value}{counts} {about} (native)'
    if factor == 1.0:
        return f'{words} in {name}'
    unit = columns.layout.unit(columns.sources['reading'][0]) or (
        'mg' if factor == 1e-3 else f'{factor:g} {name}')
    return f'{words} in {unit} -> {name}' if columns.maker is None else f'{words} -> {name}'


def compact(parts: Sequence[str]) -> str:
    """Return names that differ in one place in a short form: ``accX/Y/Z``."""
    if all(part.isdecimal() for part in parts):
        return f'columns {", ".join(parts)}'
    start = next((k for k, letters in enumerate(zip(*parts)) if len(set(letters)) > 1), 0)
    ends = {part[start + 1:] for part in parts}
    if len(ends) > 1:
        return ', '.join(parts)
    return f'{parts[0][:start]}{"/".join(part[start] for part in parts)}{ends.pop()}'


# --------------------------------------------------------------------- rests, samples or poses

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


def rests_of(reading: Floats, *, samples: bool) -> Rests:
    """Return the rests in (n, 3) readings in the unit of the file; rows are samples or poses."""
    windows, = _quiet_windows(reading) if samples else (reading[:0],)
    still = windows.mean(axis=1) if len(windows) else reading
    radius, size = math.nan, float(np.abs(still).max(initial=0.0))
    with np.errstate(over='ignore', invalid='ignore'):
        length = float(np.median(np.linalg.norm(still, axis=1)))
        if len(still) >= _SPHERE_POINTS and 0.0 < size < 1e150:
            centred = still / size
            centred = centred - centred.mean(axis=0)
            scales = np.linalg.svd(centred, compute_uv=False)
            if scales[2] >= _SPREAD * scales[0]:
                found, off = sphere_through(centred)
                radius = found * size if off < _OFF_SPHERE * found else math.nan
    whole = bool(np.all(reading[:1000] == np.round(reading[:1000])))
    return Rests(length, radius, whole)


def _quiet_windows(reading: Floats, *beside: Floats) -> list[Floats]:
    """
    Return the windows (m, k, 3) of (n, 3) readings with the least scatter, of others the same.

    They are empty if the readings are too few for two windows.

    """
    size = int(np.clip(len(reading) // _WINDOWS, _SHORTEST, _LONGEST))
    count = len(reading) // size
    windows = [values[:count * size].reshape(count, size, 3) for values in (reading, *beside)]
    with np.errstate(over='ignore', invalid='ignore'):
        scatter = np.linalg.norm(windows[0].std(axis=1), axis=1)
    most = max(2, int(_QUIET_SHARE * count)) if count >= 2 else 0
    quiet = np.argsort(scatter, kind='stable')[:most]
    return [values[quiet] for values in windows]


def are_samples(columns: Mapping[str, NDArray[Any]], fewest: int = _FEW_POSES) -> bool:
    """
    Return whether rows are samples: not marked as poses, and dense in time or many.

    Rows without times are if a person does not take as many poses, or if they are not few and have
    angular rates, are mostly like the row before, all have about the same direction, or are on no
    sphere.

    """
    readings = columns['reading']
    if OF_POSES & columns.keys() or len(readings) < (2 if 'time' in columns else fewest):
        return False
    if 'time' in columns:
        apart = abs(float(np.median(np.diff(columns['time']))))
        return apart < _SAMPLES_APART_S or len(readings) > _MOST_POSES
    step = np.linalg.norm(np.diff(readings, axis=0), axis=1)
    middle = np.median(readings, axis=0)
    spread = np.median(np.linalg.norm(readings - middle, axis=1))
    return bool(len(readings) > _MOST_POSES or 'rate' in columns
                or np.median(step) < _SAME * spread
                or spread < _ONE_SIDE * np.linalg.norm(middle)
                or math.isnan(rests_of(readings, samples=False).radius))


# ---------------------------------------------------------------------------------- context

def _leave_out(made: Quantities, key: str, why: str, advice: str) -> None:
    made.chosen = replace(made.chosen, sources={
        name: own for name, own in made.chosen.sources.items() if name != key})
    made.findings.append(Finding('not_used', f'{why} not used', advice, about=key))


def _decide_rate(made: Quantities, first: Cells) -> None:
    columns = made.chosen
    if 'rate' not in columns.sources:
        return
    words = compact(columns.names('rate'))
    if columns.maker is not None and 'gx' in columns.maker.columns:
        made.scales['rate'] = columns.maker.scales.get('rate', 1.0), 0.0
        return
    stated = unit_of('rate', columns.layout.unit(columns.sources['rate'][0]))
    rests = None if stated else _units_at_rest(made, first)
    largest = float(np.quantile(np.abs(made.numbers(first, 'rate')), 0.999))
    own = columns.names('rate')[0] == 'gx' and largest < _LARGEST_RATE
    if stated is None and own and columns.layout.header and (not rests or 'rad/s' in rests):
        return
    if stated is None and (largest >= _LIKELY_RATE_DEG or rests == {}):
        _leave_out(made, 'rate', f'the angular rates {words} at rest are those of no gyro in '
                   'rad/s or °/s, and are', 'state their unit in the names, such as gyroX_dps')
        return
    seen = next(iter(rests.items())) if rests and len(rests) == 1 else None
    unit, factor = stated or seen or (
        ('rad/s', 1.0) if largest < _LIKELY_RATE else ('°/s', DEGREE_RAD))
    made.scales |= dict.fromkeys(('rate', 'rate_std'), (factor, 0.0))
    read_as = f'{words} in {unit}{"" if unit == "rad/s" else " -> rad/s"}'
    made.said.append(read_as if stated else f'{read_as} (assumed)')
    if not stated:
        made.findings.append(Finding(
            'columns', f'{read_as}, by their values', 'state their unit in the names'))


def _units_at_rest(made: Quantities, first: Cells) -> dict[str, float] | None:
    """
    Return the units in which the rates at rest are those of a gyro, with their factors to rad/s.

    None without a rest: only where the accelerometer is still, nothing turns, and the rates are
    the bias and the noise of the gyro. Rates without noise are computed, and show no unit.

    """
    readings, rates = _quiet_windows(made.numbers(first, 'reading'), made.numbers(first, 'rate'))
    if not len(readings):
        return None
    length = np.median(np.linalg.norm(readings.mean(axis=1), axis=1))
    if np.median(np.max(readings.std(axis=1), axis=1)) > _SCATTER_AT_REST * length:
        return None
    bias = float(np.median(np.max(np.abs(rates.mean(axis=1)), axis=1)))
    noise = float(np.median(np.max(rates.std(axis=1), axis=1)))
    if noise <= _GYRO_NOISE[0]:
        return None
    return {unit: factor for unit, factor in (('rad/s', 1.0), ('°/s', DEGREE_RAD))
            if bias * factor < _LARGEST_BIAS
            and _GYRO_NOISE[0] < noise * factor < _GYRO_NOISE[1]}


def _decide_context(made: Quantities, first: Cells) -> None:
    columns, layout = made.chosen, made.chosen.layout
    for key, ours in (('temperature', '°C'), ('supply_voltage', 'V')):
        for k in columns.sources.get(key, ()):
            name, (unit, factor) = layout.name(k), unit_of(key, layout.unit(k)) or ('', 1.0)
            if unit not in ('', ours):
                made.scales[key] = factor, ZEROS.get(unit, 0.0)
                made.said.append(f'{name} in {unit} -> {ours}')
            values = columns.numbers(first, key)
            known = values[np.isfinite(values)]
            if unit or key != 'temperature' or columns.maker is not None or not len(known):
                continue
            middle, own = float(np.median(known)), name == key and layout.header
            if _LIKELY_TEMPERATURE_C[0] <= middle <= _LIKELY_TEMPERATURE_C[1]:
                made.said += [] if own else [f'{name} in °C (assumed)']
            else:
                _leave_out(made, key, f'the temperature in column {name} has values of about '
                           f'{middle:.4g} in a unit that is not known, and is',
                           'state its unit in the name, such as temperature_K')
    names = [name for name in layout.header[:MOST]
             if meaning(name).quantity == 'temperature']
    if names and 'temperature' not in columns.sources:
        made.notes.append(f'not used, though the names look like temperatures: {shown(names)}; '
                          f'choose one with --columns temperature={names[0]}')
