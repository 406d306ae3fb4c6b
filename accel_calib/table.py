# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables of readings with their context: poses and recordings.

`COLUMNS` is the only list of columns. Files, simulation, effects and documentation read names,
units and meanings there. Any other column of numbers is a quantity, such as ``pressure``: a cause
that `accel_calib.refinement` tries. Its key is its name, with one ``_`` for other characters than
letters and digits.

"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
import math
import re
from typing import Any, get_args, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import InputError, needing
from .finding import Finding
from .text import counted, LONGEST_NAME, one_line, table
from .units import Floats as Floats, STANDARD_GRAVITY, UnitName, Units

ABOUT = ('units', 'sensor', 'autopilot')
"""What a table states beside its columns."""

LARGEST = 1e30
"""Larger numbers are damage. The products of smaller ones do not overflow."""

_LIMITS = {'temperature': (-100.0, 250.0, 'from -100 to 250 °C'),
           'count': (0.0, LARGEST, 'above 0, the number of samples of each pose'),
           **dict.fromkeys(('std', 'rate_std'), (
               -math.ulp(0.0), LARGEST, 'of 0 or more, standard deviations'))}
"""Limits that values are between, and their words: no sensor works at temperatures beyond, and
-999 or -127 mean no value."""

_NUMBERS = range(-2**31, 2**32)
"""Numbers of an autopilot: those of 32 bits, with or without a sign."""


@dataclass(frozen=True)
class Column:
    """
    One quantity of a table: its names in a file, its unit and its meaning.

    A column with three names is an (n, 3) array, with one name an (n,) array. Columns with `made`
    set are computed and never stored in a file.

    """

    names: tuple[str, ...]
    unit: str
    meaning: str
    made: bool = False


COLUMNS: dict[str, Column] = {
    'time': Column(('time',), 's', 'header stamp'),
    'reading': Column(('ax', 'ay', 'az'), 'unit of the reading', 'reading of the sensor'),
    'std': Column(('std_x', 'std_y', 'std_z'), 'unit of the reading',
                  'standard deviation of the samples of a pose'),
    'count': Column(('count',), '', 'independent samples of a pose: std/√count is the noise '
                                    'of its mean'),
    'temperature': Column(('temperature',), '°C', 'temperature of the sensor'),
    'supply_voltage': Column(('supply_voltage',), 'V', 'supply of the sensor'),
    'rate': Column(('gx', 'gy', 'gz'), 'rad/s', 'angular rate'),
    'rate_std': Column(('gstd_x', 'gstd_y', 'gstd_z'), 'rad/s',
                       'standard deviation of the samples of the angular rate of a pose'),
    'reference': Column(('ref_x', 'ref_y', 'ref_z'), 'unit of the reading',
                        'true specific force (known orientation); in g for native units'),
    'previous': Column(('from_x', 'from_y', 'from_z'), '', 'unit vector towards the previous '
                       'pose; computed from the order of the poses'),
    'earlier': Column(('earlier_x', 'earlier_y', 'earlier_z'), '', 'unit vector towards the '
                      'previous pose, at the turn before the last one', made=True),
    'duration': Column(('duration',), 's', 'time from the first to the last sample of a pose'),
    'since_turn': Column(('since_turn',), 's', 'time from the last turn to the start of a pose; '
                         'computed from the times'),
    'temperature_rate': Column(('temperature_rate',), '°C/s', 'rate of the temperature',
                               made=True),
    'temperature_of_offset': Column(('temperature_of_offset',), '°C', 'temperature that acts on '
                                    'the offset, after a lag', made=True),
    'temperature_of_gain': Column(('temperature_of_gain',), '°C', 'temperature that acts on the '
                                  'gain, after a lag', made=True),
    'orientation': Column(('orientation',), '',
                          'rows with the same number have the same orientation'),
    'label': Column(('label',), '', 'free text'),
    'doubtful': Column(('doubtful',), '',
                       '1: the sensor may have moved, according to later rests'),
    'at_limit': Column(('at_limit',), '', '1: the samples end at the limit of the sensor'),
    'own_scatter': Column(('own_scatter_x', 'own_scatter_y', 'own_scatter_z'),
                          'unit of the reading', 'standard deviation of a pose beyond the noise '
                          'of its mean', made=True),
    'new': Column(('new',), '', '1 for poses taken since a stored calibration, 0 for its own',
                  made=True),
}

_NAMES = {*COLUMNS, 'force', *(name for column in COLUMNS.values() for name in column.names)}
_KEY = re.compile(r'[^\W\d]\w{0,63}')


CONTEXT = ('temperature', 'supply_voltage')
"""Numbers beside the readings that the catalogue knows; others are quantities of the user."""


def quantity_key(name: str) -> str:
    """Return the key of a column that is not in `COLUMNS`; empty if its name has none."""
    key = re.sub(r'[\W_]+', '_', name).strip('_')
    return key if is_quantity(key) and name not in _NAMES else ''


def is_quantity(key: str) -> bool:
    """Return whether a key is that of a quantity, which is not in `COLUMNS`."""
    return key not in _NAMES and _KEY.fullmatch(key) is not None


def column_of(key: str) -> Column:
    """Return the column of a key: of `COLUMNS`, or a quantity, whose unit is not known."""
    return COLUMNS.get(key) or Column((key,), '', key.replace('_', ' '))


def read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array through which it cannot be changed."""
    found = values.view()
    found.setflags(write=False)
    return found


class Record:
    """
    Base of frozen records with arrays, which are equal if all values that they compare are.

    Arrays can be changed, so that such a record has no hash, as they have none.

    """

    def __eq__(self, other: object) -> bool:
        return _same(self, other)

    __hash__ = None  # type: ignore[assignment]

    def __getstate__(self) -> dict[str, Any]:
        """Return a copy of all values, to which another thread may be adding cached properties."""
        return vars(self).copy()


def _same(one: Any, other: Any) -> bool:
    """Return whether two values are equal; NaN is equal to NaN."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == 'f')
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    related = type(one) is type(other) or (isinstance(one, Record) and (
        isinstance(other, type(one)) or isinstance(one, type(other))))
    if is_dataclass(one):
        return related and all(_same(getattr(one, each.name), getattr(other, each.name))
                               for each in fields(one) if each.compare)
    return bool(one == other or (one != one and other != other))


Firmware = Literal['px4', 'ardupilot']


@dataclass(frozen=True)
class Autopilot:
    """
    The accelerometer of an autopilot that readings come from.

    ValueError is raised for other values, and InputError for a long text.

    Parameters
    ----------
    firmware : {'px4', 'ardupilot'}
        The firmware, as the formats of an export are named.
    instance : int or None
        Number in the names of its parameters; None if it has none yet.
    device_id : int or None
        Its device id; None if the log does not state it.
    thermal : int or None
        Number in the names of its thermal calibration; None if the vehicle has none in use.
    corrected : str
        Why the readings are still those that old parameters correct; empty: they are raw.

    """

    firmware: Firmware
    instance: int | None = None
    device_id: int | None = None
    thermal: int | None = None
    corrected: str = ''

    def __post_init__(self) -> None:
        numbers = (self.instance, self.device_id, self.thermal)
        if (self.firmware not in get_args(Firmware) or not isinstance(self.corrected, str)
                or any(each is not None and (type(each) is not int or each not in _NUMBERS)
                       for each in numbers)):
            raise ValueError('the autopilot is not known, expected px4 or ardupilot, and whole '
                             'numbers of 32 bits')
        object.__setattr__(self, 'corrected', name_from(self.corrected, 'the text of autopilot'))


def name_from(text: str, what: str) -> str:
    """Return a name or a text from outside as one line; InputError if it is too long."""
    name = text and one_line(text).strip()
    if len(name) > LONGEST_NAME:
        raise InputError(f'{what} has {len(name)} characters, expected at most {LONGEST_NAME}',
                         'shorten it')
    return name


_Self = TypeVar('_Self', bound='Table')

_PREVIEW_ROWS = 20
"""Number of rows in the preview of a notebook."""


@dataclass(frozen=True, repr=False, eq=False)
class Table(Record):
    """
    Rows of readings and context, in order.

    Parameters
    ----------
    columns : mapping of str to array
        Keys of `COLUMNS`, and quantities: read-only arrays of n rows, always with ``reading``.
    row : (n,) array of int
        Row numbers in the source, from 1.
    units : {'m/s2', 'g', 'native', ''}
        Unit of the readings; empty if the source does not state it.
    sensor : str
        Name of the sensor; empty if the source does not state it.
    autopilot : Autopilot or None
        Its place in an autopilot, for readings of a flight log.
    findings : tuple of Finding
        What was found in the samples and the rests that they come from.

    """

    columns: Mapping[str, NDArray[Any]]
    row: NDArray[np.int64]
    units: UnitName | Literal[''] = ''
    sensor: str = ''
    autopilot: Autopilot | None = None
    findings: tuple[Finding, ...] = ()

    def __post_init__(self) -> None:
        if 'reading' not in self.columns:
            raise ValueError('the table has no readings, expected the column reading')
        object.__setattr__(self, 'sensor', name_from(self.sensor, 'the name of the sensor'))
        object.__setattr__(self, 'columns', {key: read_only(values)
                                             for key, values in self.columns.items()})
        for key, values in self.columns.items():
            width = len(column_of(key).names)
            shape = (len(self.row),) if width == 1 else (len(self.row), width)
            if values.shape != shape:
                raise ValueError(f'column {key} has shape {values.shape}, expected {shape}')

    def __len__(self) -> int:
        return len(self.row)

    def __contains__(self, key: str) -> bool:
        return key in self.columns

    def __getitem__(self, key: str) -> NDArray[Any]:
        return self.columns[key]

    def __repr__(self) -> str:
        about = [', '.join(self.columns), self.units, self.sensor]
        rows = counted(len(self), 'row')
        return f'{type(self).__name__}({rows}: {"; ".join(filter(None, about))})'

    def _repr_html_(self) -> str:
        """Return the first rows as a table, for notebooks."""
        first = self.take(slice(_PREVIEW_ROWS))
        columns = first._by_name()
        texts = [[f'{each:.6g}' if values.dtype.kind in 'fi' else str(each) for each in values]
                 for values in columns.values()]
        more = f'<p>{self!r}</p>' if len(self) > _PREVIEW_ROWS else ''
        return table(['row', *columns], zip(map(str, first.row), *texts)) + more

    def _by_name(self) -> dict[str, NDArray[Any]]:
        """Return the columns with the names and in the order of a file, (n,) each."""
        keys = [*(key for key in COLUMNS if key in self), *self.quantities]
        return {name: values for key in keys for name, values in zip(
            column_of(key).names, np.atleast_2d(self[key].T), strict=True)}

    def to_dataframe(self) -> Any:
        """
        Return the rows as a pandas DataFrame, with the column names of a file.

        The index is `row`; ``attrs`` holds `about`: the unit of the readings, the sensor.

        Raises
        ------
        InputError
            If pandas is not installed.

        """
        made = data_frame(self._by_name(), self.row)
        made.attrs |= self.about
        return made

    @property
    def about(self) -> dict[str, Any]:
        """Return what the table states beside its columns, as plain values by name."""
        stated = {name: getattr(self, name) for name in ABOUT}
        return {name: value if isinstance(value, str) else asdict(value)
                for name, value in stated.items() if value}

    @property
    def reading(self) -> Floats:
        """(n, 3) array, the readings in the unit `units`."""
        return self.columns['reading']

    @property
    def quantities(self) -> tuple[str, ...]:
        """Keys of the columns that are not in `COLUMNS`."""
        return tuple(key for key in self.columns if key not in COLUMNS)

    def take(self: _Self, which: NDArray[Any] | slice) -> _Self:
        """Return the rows at these indices, or where this mask is true."""
        columns = {key: values[which] for key, values in self.columns.items()}
        return replace(self, columns=columns, row=self.row[which])

    def with_columns(self: _Self, **columns: NDArray[Any]) -> _Self:
        """Return the same rows with these columns added or replaced."""
        return replace(self, columns={**self.columns, **columns})

    def without_columns(self: _Self, *keys: str) -> _Self:
        """Return the same rows without these columns."""
        return replace(self, columns={key: values for key, values in self.columns.items()
                                      if key not in keys})


class Poses(Table):
    """Averages of still stretches, one row per pose."""

    @property
    def noise(self) -> Floats | None:
        """(n, 3) array, standard deviation of each mean in the unit of the reading, if known."""
        if 'std' not in self or 'count' not in self:
            return None
        noise: Floats = self['std'] / np.sqrt(self['count'])[:, np.newaxis]
        return np.hypot(noise, self['own_scatter']) if 'own_scatter' in self else noise


class Recording(Table):
    """Samples in the order of time, one row per sample."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 'time' not in self.columns:
            raise ValueError('the recording has no times, expected the column time')


def range_of(table: Table, key: str) -> tuple[float, float]:
    """Return the lowest and the highest known number of a column; NaN if none is known."""
    values = table[key] if key in table else np.zeros(0)
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


def in_unit(table: _Self, convert: Callable[[Floats], Floats], *, native: bool = False) -> _Self:
    """Return a table in another unit; known forces beside native readings are in g."""
    keys = ('reading', 'std') if native else ('reading', 'std', 'reference')
    own = table.columns
    return table.with_columns(**{key: convert(own[key]) for key in keys if key in own})


def concatenated(parts: Sequence[_Self]) -> _Self:
    """Return one or more tables as one, with the columns that all have."""
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0].columns
               if all(key in part for part in parts)}
    return replace(parts[0], columns=columns, row=np.concatenate([part.row for part in parts]))


def data_frame(columns: Mapping[str, Any], index: Any) -> Any:
    """Return columns as a DataFrame; raise InputError if pandas is not installed."""
    with needing('pandas', 'a DataFrame'):
        import pandas
    return pandas.DataFrame(columns, index=index)


def numbered(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Return row numbers from 1 for these columns."""
    return np.arange(1, len(columns['reading']) + 1)


def check_values(columns: Mapping[str, NDArray[Any]], source: str,
                 rows: NDArray[np.int64] | None = None, *, partial: bool = False) -> None:
    """
    Check values; InputError if one is not finite, or none that its column can hold.

    `rows` are the numbers of the rows, by default from 1; `partial`: those of `CONTEXT` can be
    NaN.

    """
    for key, values in columns.items():
        if key not in COLUMNS or key == 'label':
            continue
        by_row = values[:, np.newaxis] if values.ndim == 1 else values
        low, high, words = _LIMITS.get(key, (-LARGEST, LARGEST, f'below {LARGEST:g}'))
        sound = (low < by_row) & (by_row < high) | (partial and key in CONTEXT) & np.isnan(by_row)
        if not np.all(sound):
            row = int(np.argmin(sound.all(axis=1)))
            number = float(by_row[row][~sound[row]][0])
            what = (f'the number {number:.3g}' if np.isfinite(number) else
                    'a number that is not finite')
            raise InputError(f'{source}: row {row + 1 if rows is None else rows[row]} of '
                             f'{", ".join(COLUMNS[key].names)} holds {what}, expected finite '
                             f'numbers {words}', 'correct the row or remove it')
    if 'orientation' in columns and np.any(columns['orientation'] % 1.0):
        raise InputError(f'{source}: column orientation holds fractions, expected whole numbers: '
                         'rows with the same number have the same orientation', 'number the '
                         'orientations, or leave out the column: --columns orientation=')


_LIKELY_G = (0.5, 2.0)
"""Range of the median |reading| at rest [g]."""

_ABOUT = 1.3
"""Factor within which a unit is suggested."""

_OTHERS = {'g': 1.0, 'm/s2': STANDARD_GRAVITY, 'ft/s2': 32.174, 'cm/s2': 100.0 * STANDARD_GRAVITY,
           'mg': 1e3, 'µg': 1e6}
"""1 g in common units of sensors."""

_SUPPORTED = ('g', 'm/s2')


def check_units(poses: Table, units: Units, source: str = '') -> None:
    """
    Check that readings at rest and known forces have a length of about 1 g.

    Raise InputError otherwise; its advice names the likely unit, and its message the `source`.

    """
    if len(poses) == 0:
        return
    least, most = _LIKELY_G
    length = median_length(poses.reading)
    if not units.is_native and not least <= length / units.per_g <= most:
        names, look = _likely_units(length)
        supported = next((name for name in names if name in _SUPPORTED), None)
        advice = (f'set the units of the readings to {supported} (--units {supported})'
                  if supported else
                  f'{look}set the units of the readings to native; the fit estimates their scale')
        raise InputError(f'{source and f"{source}: "}the length of the readings is about '
                         f'{length:.4g}, expected about {units.per_g:.4g} at rest in '
                         f'{units.name}', advice)
    if 'reference' in poses:
        per_g, words = ((1.0, 'in g, the unit of known forces for native readings')
                        if units.is_native else
                        (units.per_g, f'in {units.name}, the unit of the readings'))
        length = median_length(poses['reference'])
        if not least <= length / per_g <= most:
            _, look = _likely_units(length)
            raise InputError(f'the length of the known forces ref_x,ref_y,ref_z is about '
                             f'{length:.4g}, expected about {per_g:.4g} {words}',
                             f'{look}multiply them by {per_g / max(length, 1e-12):.4g}'
                             if length > 0.0 else 'fill the columns, or remove them')


def median_length(vectors: Floats) -> float:
    """Return the median length of (n, 3) vectors."""
    with np.errstate(over='ignore'):
        return float(np.median(np.linalg.norm(vectors, axis=1)))


def _likely_units(length: float) -> tuple[list[str], str]:
    """Return the units in which this length is about 1 g, or else the nearest, and in words."""
    fits = {name: max(length / per_g, per_g / max(length, 1e-300))
            for name, per_g in _OTHERS.items()}
    well = [name for name, factor in fits.items() if factor <= _ABOUT]
    nearest = min(fits, key=lambda name: fits[name])
    names = well or ([nearest] if fits[nearest] <= _LIKELY_G[1] else [])
    return names, f'they look like {" or ".join(names)}: ' if names else ''
