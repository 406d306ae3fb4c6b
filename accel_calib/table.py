# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Readings with what is known beside them: poses and recordings.

`COLUMNS` is the one list of columns: the files, the simulation, the effects and the help all
take names, units and meanings from it.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Column:
    """
    One quantity of a table: its names in a file, its unit and its meaning.

    Three names make an (n, 3) array, one name an (n,) array.

    """

    names: tuple[str, ...]
    unit: str
    meaning: str


COLUMNS: dict[str, Column] = {
    'time': Column(('time',), 's', 'header stamp'),
    'reading': Column(('ax', 'ay', 'az'), 'unit of the reading', 'what the sensor gave'),
    'std': Column(('std_x', 'std_y', 'std_z'), 'unit of the reading',
                  'standard deviation of the samples of a pose'),
    'count': Column(('count',), '', 'independent samples of a pose: std/√count is the noise '
                                    'of its mean'),
    'temperature': Column(('temperature',), '°C', 'temperature of the sensor'),
    'supply_voltage': Column(('supply_voltage',), 'V', 'supply of the sensor'),
    'rate': Column(('gx', 'gy', 'gz'), 'rad/s', 'angular rate'),
    'reference': Column(('ref_x', 'ref_y', 'ref_z'), 'unit of the reading',
                        'true specific force (known orientation); in g for native units'),
    'approach': Column(('from_x', 'from_y', 'from_z'), '', 'unit vector towards the pose before; '
                       'made from the order of the poses'),
    'orientation': Column(('orientation',), '', 'rows that share it had the same orientation'),
    'label': Column(('label',), '', 'a word of the user'),
}

_Self = TypeVar('_Self', bound='Table')


@dataclass(frozen=True)
class Table:
    """
    Rows of readings and context, in order.

    Parameters
    ----------
    columns : mapping of str to array
        Keys of `COLUMNS`; each array has n rows. ``reading`` is always there.
    row : (n,) array of int
        Row numbers in the source, from 1.

    """

    columns: Mapping[str, NDArray[Any]]
    row: NDArray[np.int64]

    def __post_init__(self) -> None:
        if 'reading' not in self.columns:
            raise ValueError('a table needs readings')
        for key, values in self.columns.items():
            width = len(COLUMNS[key].names)
            shape = (len(self.row),) if width == 1 else (len(self.row), width)
            if values.shape != shape:
                raise ValueError(f'column {key} has shape {values.shape}, expected {shape}')

    def __len__(self) -> int:
        return len(self.row)

    def __contains__(self, key: str) -> bool:
        return key in self.columns

    def __getitem__(self, key: str) -> NDArray[Any]:
        return self.columns[key]

    @property
    def reading(self) -> Floats:
        """(n, 3) array, the readings in their own unit."""
        return self.columns['reading']

    def take(self: _Self, which: NDArray[Any] | slice) -> _Self:
        """Give the rows at these indices, or where this mask is true."""
        columns = {key: values[which] for key, values in self.columns.items()}
        return type(self)(columns, self.row[which])

    def with_columns(self: _Self, **columns: NDArray[Any]) -> _Self:
        """Give the same rows with these columns added or replaced."""
        return type(self)({**self.columns, **columns}, self.row)


class Poses(Table):
    """Averages of still stretches, one row a pose."""

    @property
    def noise(self) -> Floats | None:
        """(n, 3) array, standard deviation of each mean in the unit of the reading, if known."""
        if 'std' not in self or 'count' not in self:
            return None
        return self['std'] / np.sqrt(self['count'])[:, np.newaxis]


class Recording(Table):
    """Samples in the order of time, one row a sample."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 'time' not in self.columns:
            raise ValueError('a recording needs times')


def numbered(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Give row numbers from 1 for these columns."""
    return np.arange(1, len(columns['reading']) + 1)
