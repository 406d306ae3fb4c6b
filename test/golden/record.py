# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Results as JSON: how they are rounded, stored and compared.

A stored result has two parts: ``figures``, with numbers, names and verdicts, and ``words``, with
the texts at the same places, so that a reworded text is seen as such. A long array is stored as a
summary: its shape, its first and last row, and for each column the sum of the magnitudes and a
weighted sum, which changes with every number.

A new effect of the catalogue changes the result of one case, the catalogue. The effects that data
cannot show are therefore left out, tables of effects compare the rows that are stored, and
scores do not contain the price of a choice among the candidates.

"""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
import json
import math
from pathlib import Path
import re
from typing import Any

import accel_calib as ac
from accel_calib.effects import EffectRecord
from accel_calib.errors import AccelCalibError
from accel_calib.finding import Finding, NextStep
from accel_calib.table import Table
import numpy as np

EXPECTED = Path(__file__).parent / 'expected'
DIGITS = 9
MOST = 30
"""Arrays of more numbers are stored as a summary."""

RELATIVE, OF_LARGEST, ABSOLUTE = 1e-6, 1e-7, 1e-13
"""Largest difference between equal numbers: relative, relative to the largest of an array, both
and absolute."""

LEAST_P = 1e-6
"""Smaller probabilities are stored as this one: they change with the number of candidates."""

BY_EFFECT = ('candidates', 'visible')
"""Tables with a row per effect of the catalogue; a new effect adds a row, and changes no other."""

OF_A_SESSION = ('about', 'command', 'direction')
"""Fields of findings and steps that have a value while messages arrive, and not of results."""

_WIDTH = 80
_CHANGING = re.compile(r'\d{4}-\d\d-\d\d([T ]\d\d:\d\d(:\d\d(\+00:00)?)?)?|'
                       + re.escape(ac.__version__))
_SIGN_OF_ZERO = re.compile(r'[+-](?=0(\.0+)?([^\d.]|$))')

_SPECIAL = ('nan', 'inf', '-inf')


def plain(value: Any) -> Any:
    """Return any result as JSON can hold it."""
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, str | Path | EffectRecord):
        here = str(Path.cwd())
        text = str(value).replace(f'{here}/', '').replace(here, '.')
        return _SIGN_OF_ZERO.sub('', _CHANGING.sub('…', text))
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else str(float(value))
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, np.ndarray | np.generic):
        return _of_array(np.asarray(value))
    if isinstance(value, AccelCalibError):
        return {'error': type(value).__name__, 'message': plain(str(value))}
    if isinstance(value, Table):
        return {'rows': len(value), 'units': value.units, **plain(value.columns)}
    if is_dataclass(value):
        live = OF_A_SESSION if isinstance(value, Finding | NextStep) else ()
        value = {each.name: getattr(value, each.name) for each in fields(value)
                 if each.name not in live}
    if isinstance(value, Mapping) or hasattr(value, '_asdict'):
        items = value if isinstance(value, Mapping) else value._asdict()
        return {str(key): plain(max(each, LEAST_P) if key == 'p_value' else each)
                for key, each in items.items() if key not in ('not_testable', 'formula')}
    listed = [plain(each) for each in value]
    return _of_array(np.array(listed, float)) if _is_numeric(listed) else listed


def _of_array(values: Any) -> Any:
    if values.size <= MOST or not values.ndim or values.dtype.kind not in 'fi':
        return _each(values.tolist())
    columns = values.reshape(len(values), -1).astype(float)
    columns = np.nan_to_num(columns, nan=0.5, posinf=0.25, neginf=-0.25)
    weights = np.cos(np.arange(len(columns)) ** 2)
    return {'shape': list(values.shape), 'first': _each(values[0].tolist()),
            'last': _each(values[-1].tolist()), 'sums': [
                [float(np.sum(np.abs(column))), float(weights @ column)] for column in columns.T]}


def _each(values: Any) -> Any:
    return [_each(each) for each in values] if isinstance(values, list) else plain(values)


def parted(value: Any) -> dict[str, Any]:
    """Return a plain result with its texts apart."""
    return dict(zip(('figures', 'words'), _parts(value), strict=True))


def _parts(value: Any) -> tuple[Any, Any]:
    if isinstance(value, str):
        return ('…', value) if ' ' in value else (value, None)
    if not isinstance(value, dict | list):
        return value, None
    keys = list(value) if isinstance(value, dict) else range(len(value))
    parts = {key: _parts(value[key]) for key in keys}
    words = {str(key): text for key, (_, text) in parts.items() if text is not None}
    figures = {key: own for key, (own, _) in parts.items()}
    return figures if isinstance(value, dict) else list(figures.values()), words or None


def text_of(value: Any, margin: str = '') -> str:
    """Return JSON with rounded numbers, in short lines and one row of numbers per line."""
    inner, name = f'{margin} ', ''
    if isinstance(value, float):
        value = float(f'{value:.{DIGITS}g}')
    if not isinstance(value, dict | list):
        return json.dumps(value, ensure_ascii=False)
    parts = []
    for each in value:
        if isinstance(value, dict):
            name, each = f'{json.dumps(each, ensure_ascii=False)}: ', value[each]
        parts.append(f'{name}{text_of(each, inner)}')
    begin, end = '{}' if isinstance(value, dict) else '[]'
    line = f'{begin}{", ".join(parts)}{end}'
    nested = isinstance(value, list) and any(isinstance(each, list | dict) for each in value)
    if '\n' not in line and not nested and (len(line) <= _WIDTH or isinstance(value, list)):
        return line
    return f'{begin}\n' + ',\n'.join(f'{inner}{part}' for part in parts) + f'\n{margin}{end}'


def differences(expected: Any, found: Any, place: str = '') -> Iterator[str]:
    """Yield the places where two results differ, with both values."""
    if isinstance(expected, dict) and isinstance(found, dict):
        new = () if place.endswith(BY_EFFECT) else (key for key in found if key not in expected)
        for key in [*expected, *new]:
            yield from differences(expected.get(key, 'missing'), found.get(key, 'missing'),
                                   f'{place}/{key}')
    elif (isinstance(expected, list) and isinstance(found, list) and len(expected) == len(found)
          and not (_is_numeric(expected) and _is_numeric(found))):
        for k, (one, other) in enumerate(zip(expected, found, strict=True)):
            yield from differences(one, other, f'{place}/{k}')
    elif not (_are_equal(expected, found) if _is_numeric([expected]) and _is_numeric([found])
              else expected == found):
        yield f'{place}: expected {expected!r}, found {found!r}'


def _is_numeric(values: list[Any]) -> bool:
    """Return whether a list, or list of equally long lists, holds numbers alone."""
    if all(isinstance(each, list) for each in values):
        return len({len(each) for each in values}) == 1 and all(map(_is_numeric, values))
    return all(each in _SPECIAL if isinstance(each, str) else
               isinstance(each, float | int) and not isinstance(each, bool) for each in values)


def _are_equal(expected: Any, found: Any) -> bool:
    one, other = np.array(expected, float), np.array(found, float)
    largest = np.max(np.abs(one), initial=0.0, where=np.isfinite(one))
    return one.shape == other.shape and np.allclose(
        other, one, RELATIVE, OF_LARGEST * largest + ABSOLUTE, equal_nan=True)
