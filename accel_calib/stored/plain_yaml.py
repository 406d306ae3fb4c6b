# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Bounded reading of plain YAML: mappings, lists, text, numbers, true, false and null.

A small file can describe more data than a memory holds (aliases), or more levels than a stack
holds (nesting). The text is therefore read event by event, without recursion, and the first event
beyond a limit ends the reading. Anchors, aliases, tags, keys that are not text, a key that is
stated twice, dates, and numbers in other forms than the decimal one are refused.

`mapping_at` and its siblings then check the type of the value under a key. They raise KeyError if
the key is missing, and ValueError if the value is of another type.

"""

from __future__ import annotations

from collections.abc import Mapping
import math
import re
from typing import Any

import numpy as np
import yaml
from yaml.resolver import Resolver

from ..table import Floats

try:  # eight times as fast, but not in every build of PyYAML
    from yaml import CSafeLoader as SafeLoader
except ImportError:
    from yaml import SafeLoader  # type: ignore[assignment]

MOST_BYTES = 32 * 2**20
"""Largest size of a file: 100,000 poses with readings and noise have a third of it [bytes]."""

MOST_DEPTH = 8
"""Largest number of levels of mappings and lists; a calibration has 4."""

MOST_VALUES = 2_000_000
"""Largest number of values and keys: 100,000 poses with readings and noise have half of them."""

_MOST_DIGITS = 18
"""Whole numbers have at most this number of digits, so that they fit into 64 bits."""

_LONGEST_NUMBER = 40
"""Longest text of a number; longer text is never taken for one."""

_SHOWN = 60
_DECIMAL = re.compile(r'[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?')
_WHOLE = re.compile(r'[-+]?(?:0|[1-9][0-9]*)')
_PREFIX = 'tag:yaml.org,2002:'


def read_plain(text: str) -> Any:
    """
    Return the content of a text in plain YAML.

    Parameters
    ----------
    text : str
        The text, of at most `MOST_BYTES` bytes in UTF-8.

    Returns
    -------
    dict, list, str, int, float, bool or None
        The content. A number is a float unless it is whole; all keys are text.

    Raises
    ------
    ValueError
        If the text is not YAML, is not plain, or exceeds a limit. The message has one line.

    """
    tree = _Tree()
    try:
        for event in yaml.parse(text, Loader=SafeLoader):
            tree.take(event)
    except yaml.YAMLError as error:
        raise ValueError(_syntax(error)) from error
    except UnicodeEncodeError as error:
        raise ValueError('it is not YAML: it holds a character that is not text') from error
    return tree.content


def mapping_at(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the mapping under a key."""
    if not isinstance(content[key], Mapping):
        raise ValueError(f'{key} is {shown(content[key])}, expected names with values')
    return content[key]


def list_at(content: Mapping[str, Any], key: str) -> list[Any]:
    """Return the list under a key."""
    if not isinstance(content[key], list):
        raise ValueError(f'{key} is {shown(content[key])}, expected a list')
    return content[key]


def text_at(content: Mapping[str, Any], key: str, most: int = MOST_BYTES) -> str:
    """Return the text under a key, of at most this number of characters."""
    text = content[key]
    if not isinstance(text, str):
        raise ValueError(f'{key} is {shown(text)}, expected text')
    if len(text) > most:
        raise ValueError(f'{key} has {len(text)} characters, expected at most {most}')
    return text


def choice_at(content: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> Any:
    """Return the text under a key, which must be one of the choices."""
    if content[key] not in choices:
        raise ValueError(f'{key} is {shown(content[key])}, expected one of {", ".join(choices)}')
    return content[key]


def number_at(content: Mapping[str, Any], key: str, most: float = math.inf) -> float:
    """Return the number under a key, of at most this magnitude."""
    value = as_number(content[key])
    if value is None or not math.isfinite(value):
        raise ValueError(f'{key} is {shown(content[key])}, expected a finite number')
    if abs(value) > most:
        raise ValueError(f'{key} is {shown(value)}, expected at most {most:g} in magnitude')
    return value


def whole_at(content: Mapping[str, Any], key: str) -> int:
    """Return the whole number under a key."""
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f'{key} is {shown(value)}, expected a whole number')
    return value


def array_at(content: Mapping[str, Any], key: str, shape: tuple[int, ...], *,
             finite: bool = True, most: float = math.inf) -> Floats:
    """Return nested lists of numbers under a key as an array; null is NaN unless finite."""
    array = np.array(_numbers(list_at(content, key), key, shape), float).reshape(shape)
    if finite and not np.all(np.isfinite(array)):
        raise ValueError(f'{key} contains a number that is not finite')
    if np.any(np.abs(array) > most):
        raise ValueError(f'{key} contains a number of more than {most:g} in magnitude')
    return array


def _numbers(value: Any, key: str, shape: tuple[int, ...]) -> list[float]:
    """Return the numbers of nested lists of this shape, in order."""
    if not shape:
        number = math.nan if value is None else as_number(value)
        if number is None:
            raise ValueError(f'{key} contains {shown(value)}, expected numbers')
        return [number]
    if not isinstance(value, list):
        raise ValueError(f'{key} contains {shown(value)}, expected a list of {shape[0]}')
    if len(value) != shape[0]:
        raise ValueError(f'{key} has shape ({len(value)}, …), expected {shape[0]} values')
    return [number for each in value for number in _numbers(each, key, shape[1:])]


def as_number(value: Any) -> float | None:
    """Return a number, also one that YAML takes for text (1e-5), as a float; None for others."""
    if isinstance(value, str):
        short = len(value) <= _LONGEST_NUMBER
        return float(value) if short and _DECIMAL.fullmatch(value) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)


def shown(value: Any) -> str:
    """Return a value as one short line for an error message."""
    if isinstance(value, dict):
        return 'a mapping'
    if isinstance(value, list):
        return 'a list'
    if value is None:
        return 'null'
    text = repr(value[:_SHOWN + 1] if isinstance(value, str) else value)
    return text if len(text) <= _SHOWN else f'{text[:_SHOWN]}…'


def _syntax(error: yaml.YAMLError) -> str:
    """Return a text about YAML that cannot be read, with its line."""
    mark, problem = getattr(error, 'problem_mark', None), getattr(error, 'problem', None)
    where = '' if mark is None else f' in line {mark.line + 1}'
    return f'it is not YAML{where}: {problem or getattr(error, "reason", "") or "unreadable"}'


class _Tree:
    """The content so far; `take` adds the next event."""

    def __init__(self) -> None:
        self._open: list[Any] = []
        self._keys: list[str | None] = []  # of each that is open: the key that waits for a value
        self._names: list[str] = []  # the key of each that is open; empty in a list
        self._count = self._documents = 0
        self.content: Any = None

    def take(self, event: yaml.Event) -> None:
        """Add an event; raise ValueError if it is not plain or exceeds a limit."""
        if isinstance(event, yaml.ScalarEvent):
            self._check(event)
            if self._awaits_key:
                self._add_key(event)
            else:
                self._add(_plain(event.value) if event.implicit[0] else event.value, event)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._check(event)
            self._begin({} if isinstance(event, yaml.MappingStartEvent) else [], event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._open.pop()
            self._keys.pop()
            self._names.pop()
        elif isinstance(event, yaml.AliasEvent):
            raise self._refusal(event, f'there is the alias {shown(event.anchor)}, expected '
                                'the value itself')
        elif isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise self._refusal(event, 'a second document starts, expected one')

    def _check(self, event: yaml.ScalarEvent | yaml.CollectionStartEvent) -> None:
        """Refuse anchors, tags, and too many values."""
        self._count += 1
        if event.anchor is not None:
            raise self._refusal(event, f'there is the anchor {shown(event.anchor)}, expected '
                                'none')
        if event.tag is not None:
            raise self._refusal(event, f'there is the tag {shown(event.tag)}, expected none')
        if self._count > MOST_VALUES:
            raise self._refusal(event, f'it has more than {MOST_VALUES} values')

    @property
    def _awaits_key(self) -> bool:
        return bool(self._open) and isinstance(self._open[-1], dict) and self._keys[-1] is None

    def _begin(self, container: Any, event: yaml.Event) -> None:
        """Add an empty mapping or list, and open it."""
        if self._awaits_key:
            raise self._refusal(event, 'a key is a mapping or a list, expected a name')
        if len(self._open) == MOST_DEPTH:
            raise self._refusal(event, f'it has more than {MOST_DEPTH} levels')
        self._names.append((self._keys[-1] if self._keys else None) or '')
        self._add(container, event)
        self._open.append(container)
        self._keys.append(None)

    def _add_key(self, event: yaml.ScalarEvent) -> None:
        key = str(event.value)
        if key in self._open[-1]:
            raise self._refusal(event, f'the key {shown(key)} is stated twice, expected once')
        self._keys[-1] = key

    def _add(self, value: Any, event: yaml.Event) -> None:
        """Add a value to the mapping or list that is open."""
        if isinstance(value, _Unclear):
            raise self._refusal(event, f'the value is {shown(value.text)}, expected a decimal '
                                'number, or text in quotes')
        if not self._open:
            self.content = value
        elif isinstance(self._open[-1], list):
            self._open[-1].append(value)
        else:
            self._open[-1][self._keys[-1]] = value
            self._keys[-1] = None

    def _refusal(self, event: yaml.Event, words: str) -> ValueError:
        """Return the error for an event, with its key and line."""
        path = '.'.join(shown(key)[1:-1] for key in (*self._names, *self._keys[-1:]) if key)
        line = 1 + (event.start_mark.line if event.start_mark is not None else 0)
        return ValueError(f'{f"at {path}, line" if path else "in line"} {line}, {words}')


class _Unclear:
    """Unquoted text that YAML takes for a date, or for a number that is not decimal."""

    def __init__(self, text: str) -> None:
        self.text = text


_CONSTANTS: dict[str, Any] = {
    **dict.fromkeys(('', '~', 'null', 'Null', 'NULL')),
    **{form: value for word, value in SafeLoader.bool_values.items()
       for form in (word, word.capitalize(), word.upper())},
    **{f'{sign}.{form}': float(f'{sign}{word}') for word in ('nan', 'inf')
       for form in (word, word.capitalize(), word.upper()) for sign in ('', '+', '-')}}
"""Values of the words of YAML 1.1."""


def _plain(text: str) -> Any:
    """Return the value of unquoted text."""
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if len(text) > _LONGEST_NUMBER:
        return text
    for tag, pattern in Resolver.yaml_implicit_resolvers.get(text[0], ()):
        if pattern.match(text):
            return _value(tag.removeprefix(_PREFIX), text)
    return text


def _value(kind: str, text: str) -> Any:
    """Return the value of unquoted text that YAML takes for this kind."""
    if kind == 'float' and _DECIMAL.fullmatch(text):
        return float(text)
    if kind == 'int' and _WHOLE.fullmatch(text) and len(text) <= _MOST_DIGITS:
        return int(text)
    return _Unclear(text) if kind in ('int', 'float', 'timestamp') else text
