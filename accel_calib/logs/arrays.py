# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Arrays in files as tables: NumPy, MATLAB, HDF5.

Arrays of one length are the columns of one table if their names are those of an accelerometer.
Otherwise each array is a table, whose columns are read by their order. Structs and timetables of
MATLAB are refused: only MATLAB can convert all of them. No pickled object is read.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from itertools import chain
import math
from pathlib import Path
import re
from typing import Any
import zipfile

import numpy as np
import scipy

from .columns import is_log_header, LogOptions
from .containers import CELL_BYTES, csv_of, Member, most_numbers
from .dialect import shown
from ..errors import InputError

_BY_ORDER = (3, 4, 5, 7, 8)
"""Widths of arrays that are read by the order of their columns."""

_NUMBERS = re.compile(r'double|single|u?int\d+|float\d+|datetime64.*|void\d+')
_EXPORT = 'store arrays of numbers'
_EXPORT_MATLAB = ('write a CSV file in MATLAB: writetimetable(Acceleration, "log.csv"), or '
                  'writematrix for an array')

_Held = tuple[tuple[int, ...], str, Callable[[], Any]]
"""An array in a file: its shape, the kind of its elements, and the function that reads it."""


def matlab(path: Path, _: ExitStack) -> list[Member]:
    """Return the arrays of a MATLAB file up to version 7."""
    try:
        held = scipy.io.whosmat(path)
    except TypeError:  # of scipy, for tables, timetables and other objects
        held = []

    def load(name: str) -> Any:
        return scipy.io.loadmat(path, variable_names=[name])[name]

    return _tables(path, {name: (shape, kind, partial(load, name)) for name, shape, kind in held},
                   _EXPORT_MATLAB)


def hdf5(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of an HDF5 file, such as one of MATLAB 7.3; links are not followed."""
    import h5py

    held: dict[str, _Held] = {}

    def add(name: str, each: Any) -> None:
        if isinstance(each, h5py.Dataset) and name[0] != '#' and not each.external:
            held[name] = (each.shape or (), each.dtype.name, lambda: each[()])

    stack.enter_context(h5py.File(path)).visititems(add)
    return _tables(path, held, _EXPORT)


def of_numpy(path: Path, stack: ExitStack) -> list[Member]:
    """Return the arrays of a NumPy file (.npy, .npz)."""
    files: dict[str, Callable[[], Any]] = {'': partial(path.open, 'rb')}
    if zipfile.is_zipfile(path):
        archive = stack.enter_context(zipfile.ZipFile(path))
        files = {name.removesuffix('.npy'): partial(archive.open, name)
                 for name in archive.namelist()}

    def load(name: str) -> Any:
        with files[name]() as file:
            return np.lib.format.read_array(file, allow_pickle=False)

    held: dict[str, _Held] = {}
    for name, opened in files.items():
        with opened() as file:
            is_first = np.lib.format.read_magic(file) == (1, 0)
            shape, _, dtype = (np.lib.format.read_array_header_1_0 if is_first else
                               np.lib.format.read_array_header_2_0)(file)
        held[name] = (shape, dtype.name, partial(load, name))
    return _tables(path, held, _EXPORT)


def _tables(path: Path, held: Mapping[str, _Held], advice: str) -> list[Member]:
    """Return arrays as tables; InputError without plain arrays, or if they are too large."""
    plain = {name: (shape, load) for name, (shape, kind, load) in held.items()
             if _NUMBERS.fullmatch(kind) and 0 < len(shape) <= 2 and max(shape) > 1}
    most = most_numbers(path)
    if not 0 < sum(math.prod(shape) for shape, _ in plain.values()) <= most:
        kinds = shown([f'{kind} {name}' for name, (_, kind, _) in held.items()])
        raise InputError(f'{path} holds {kinds or "timetables or other objects"}, expected plain '
                         f'arrays of at most {most} numbers', advice)
    arrays = {}
    for name, (_, load) in plain.items():
        values = load()
        for field in values.dtype.names or ('',):  # of records
            column = _upright(values[field] if field else values)
            if column.dtype.kind in 'iuf':
                arrays['/'.join(filter(None, (name, field)))] = column
    return [_table(name, group) for name, group in _groups(arrays).items()]


def _upright(values: Any) -> Any:
    """Return an array of numbers with one row per sample; dates in s since 1970."""
    if values.dtype.kind == 'M':
        values = values.astype('M8[ns]').astype(np.int64) / 1e9
    values = values if values.ndim == 2 else values[:, np.newaxis]
    return values.T if values.shape[0] < values.shape[1] else values


def _groups(arrays: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return arrays of one length together, or each alone if their names tell no accelerometer."""
    groups: dict[str, dict[str, Any]] = {}
    by_length: dict[int, dict[str, Any]] = {}
    for name, values in arrays.items():
        by_length.setdefault(len(values), {})[name] = values
    for group in by_length.values():
        header = [cell for name, values in group.items() for cell in _names(name, values)]
        alone = len(group) == 1 and len(header) in _BY_ORDER
        if is_log_header(header, LogOptions()) and not alone:
            groups[', '.join(group)] = group
        else:
            groups |= {name: {'': values} for name, values in group.items()
                       if values.shape[1] in _BY_ORDER}
    return groups or {name: {name: values} for name, values in arrays.items()}


def _names(name: str, values: Any) -> list[str]:
    """Return the names of the columns of an array; none for a name that is empty."""
    width = values.shape[1] if name else 0
    ends = {1: [''], 3: ['_x', '_y', '_z']}.get(width, [f'_{k + 1}' for k in range(width)])
    return [f'{name}{end}' for end in ends]


def _table(name: str, group: Mapping[str, Any]) -> Member:
    header = [cell for each, values in group.items() for cell in _names(each, values)]
    table = np.hstack([values.astype(float) for values in group.values()])
    rows = [header] if header else []
    return Member(name, table.size * CELL_BYTES, lambda: csv_of(chain(rows, table.tolist())))
