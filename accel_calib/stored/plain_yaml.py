# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Plain YAML, read within limits: mappings, lists, text, numbers, true, false and null.

A small file can describe more data than a memory holds (aliases), or more levels than a stack
holds (nesting). The text is therefore read event by event, and the first event beyond a limit ends
the reading. (The loader of PyYAML makes a node of each value first: 100,000 poses of three numbers
take 210 MB with it, and 16 MB here.) Anchors, aliases, tags, keys that are not text, a key that is
stated twice, dates, and numbers in other forms than the decimal one are refused.

Text becomes one printable line.

`value_at` and its siblings raise KeyError if a key is missing, and ValueError if its value is of
another type.

"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
import math
from pathlib import Path
import re
from typing import Any, TypeVar

import numpy as np
import yaml
from yaml.resolver import Resolver

from ..disk import check_regular
from ..table import Floats
from ..text import one_line, some

# The first is eight times as fast, but not in every build of PyYAML.
SafeLoader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)

Kind = TypeVar('Kind')

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
_NOT_FINITE = re.compile(r'[-+]?\.(?:nan|inf)', re.IGNORECASE)
_EXPECTED: Mapping[type, str] = {dict: 'names with values', list: 'a list', str: 'text',
                                 int: 'a whole number'}


def beginning_of(path: Path) -> bytes:
    """Return the content of a regular file, with one byte too many if it is too large."""
    check_regular(path)
    with path.open('rb') as file:
        return file.read(MOST_BYTES + 1)


def decoded(data: bytes) -> str:
    """Return the text of a file; ValueError if it is too large, or not in UTF-8."""
    if len(data) > MOST_BYTES:
        raise ValueError(f'it has more than {MOST_BYTES} bytes')
    try:
        return data.decode('utf-8-sig').replace('\r\n', '\n').replace('\r', '\n')
    except UnicodeDecodeError as err:
        line = 1 + data.count(b'\n', 0, err.start)
        raise ValueError(f'line {line} is not text in UTF-8') from err


def read_plain(text: str) -> Any:
    """
    Return the content of a text in plain YAML, which has at most `MOST_BYTES` bytes in UTF-8.

    A number is a float unless it is whole; all keys are text. ValueError, with one line, if the
    text is not YAML, is not plain, or exceeds a limit.

    """
    content, reader = None, _Reader(yaml.parse(text, Loader=SafeLoader))
    try:
        for event in reader.events:
            if isinstance(event, yaml.DocumentStartEvent):
                content = reader.value(next(reader.events), 0)
                break
        for event in reader.events:
            if isinstance(event, yaml.DocumentStartEvent):
                raise reader.refusal(event, 'a second document starts, expected one')
        return content
    except yaml.YAMLError as error:
        mark, problem = getattr(error, 'problem_mark', None), getattr(error, 'problem', None)
        where = '' if mark is None else f' in line {mark.line + 1}'
        words = problem or getattr(error, 'reason', '') or 'unreadable'
        raise ValueError(f'it is not YAML{where}: {words}') from error


@dataclass
class _Reader:
    """The events of a text, the keys of the present value, and the number of values so far."""

    events: Iterator[yaml.Event]
    keys: list[str] = field(default_factory=list)
    count: int = 0

    def value(self, event: yaml.Event, depth: int) -> Any:
        """Return the value that starts with an event below this number of levels."""
        self._check(event)
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event) if event.implicit[0] else _text_of(event)
        if depth == MOST_DEPTH:
            raise self.refusal(event, f'it has more than {MOST_DEPTH} levels')
        if not isinstance(event, yaml.MappingStartEvent):
            items = []
            while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
                items.append(self.value(event, depth + 1))
            return items
        content: dict[str, Any] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            self._check(event)
            if not isinstance(event, yaml.ScalarEvent):
                raise self.refusal(event, 'a key is a mapping or a list, expected a name')
            key = _text_of(event)
            if key in content:
                raise self.refusal(event, f'the key {shown(key)} is stated twice, expected once')
            self.keys.append(key)
            content[key] = self.value(next(self.events), depth + 1)
            self.keys.pop()
        return content

    def _check(self, event: yaml.Event) -> None:
        """Refuse aliases, anchors, tags, and too many values."""
        self.count += 1
        if isinstance(event, yaml.AliasEvent):
            raise self.refusal(event, f'there is the alias {shown(event.anchor)}, expected the '
                               'value itself')
        for mark in ('anchor', 'tag'):
            if getattr(event, mark) is not None:
                raise self.refusal(event, f'there is the {mark} {shown(getattr(event, mark))}, '
                                   'expected none')
        if self.count > MOST_VALUES:
            raise self.refusal(event, f'it has more than {MOST_VALUES} values')

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        """Return the value of unquoted text; refuse dates and numbers that are not decimal."""
        text = event.value
        if len(text) > _LONGEST_NUMBER:
            return _text_of(event)
        tag: str = _RESOLVER.resolve(  # type: ignore[no-untyped-call]
            yaml.ScalarNode, text, (True, False))
        kind = tag.rpartition(':')[2]
        if kind == 'float' and _DECIMAL.fullmatch(text):
            return float(text)
        if kind == 'int' and _WHOLE.fullmatch(text) and len(text) <= _MOST_DIGITS:
            return int(text)
        if kind == 'float' and _NOT_FINITE.fullmatch(text):
            return float(text.replace('.', ''))
        if kind in ('float', 'int', 'timestamp'):
            raise self.refusal(event, f'the value is {shown(text)}, expected a decimal number, '
                               'or text in quotes')
        if kind == 'bool':
            return SafeLoader.bool_values[text.lower()]
        return None if kind == 'null' else _text_of(event)

    def refusal(self, event: yaml.Event, words: str) -> ValueError:
        """Return the error for an event, with its key and line."""
        path = '.'.join(shown(key)[1:-1] for key in self.keys if key)
        line = 1 + (event.start_mark.line if event.start_mark is not None else 0)
        return ValueError(f'{f"at {path}, line" if path else "in line"} {line}, {words}')


_RESOLVER = Resolver()


def _text_of(event: yaml.ScalarEvent) -> str:
    """Return the text of an event as one printable line, which it nearly always is."""
    text: str = event.value
    return text if text.isprintable() else one_line(text)


def value_at(content: Mapping[str, Any], key: str, kind: type[Kind]) -> Kind:
    """Return the value of this type under a key: dict, list, str or int."""
    return _checked(content[key], f'{key} is', kind)


def values_at(content: Mapping[str, Any], key: str, kind: type[Kind]) -> list[Kind]:
    return [_checked(each, f'{key} contains', kind) for each in value_at(content, key, list)]


def _checked(value: Any, where: str, kind: type[Kind]) -> Kind:
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f'{where} {shown(value)}, expected {_EXPECTED[kind]}')
    return value


def choice_at(content: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> Any:
    """Return the text under a key, which must be one of the choices."""
    if content[key] not in choices:
        raise ValueError(f'{key} is {shown(content[key])}, expected one of {some(choices)}')
    return content[key]


def number_at(content: Mapping[str, Any], key: str, most: float = math.inf) -> float:
    """Return the number under a key, of at most this magnitude."""
    value = _number(content[key])
    if value is None or not math.isfinite(value):
        raise ValueError(f'{key} is {shown(content[key])}, expected a finite number')
    if abs(value) > most:
        raise ValueError(f'{key} is {shown(value)}, expected at most {most:g} in magnitude')
    return value


def array_at(content: Mapping[str, Any], key: str, shape: tuple[int, ...], *,
             finite: bool = True, most: float = math.inf) -> Floats:
    """Return nested lists of numbers under a key as an array; null is NaN unless finite."""
    cells = np.array(value_at(content, key, list), object)
    if cells.shape != shape and cells.size + math.prod(shape):
        raise ValueError(f'{key} has shape {cells.shape}, expected {shape}')
    numbers = [math.nan if each is None else _number(each) for each in cells.flat]
    if None in numbers:
        found = cells.flat[numbers.index(None)]
        raise ValueError(f'{key} contains {shown(found)}, expected numbers')
    array = np.array(numbers, float).reshape(shape)
    if finite and not np.all(np.isfinite(array)):
        raise ValueError(f'{key} contains a number that is not finite')
    if np.any(np.abs(array) > most):
        raise ValueError(f'{key} contains a number of more than {most:g} in magnitude')
    return array


def _number(value: Any) -> float | None:
    """Return a number, also one that YAML takes for text (1e-5), as a float; None for others."""
    if isinstance(value, str):
        is_number = len(value) <= _LONGEST_NUMBER and _DECIMAL.fullmatch(value)
        return float(value) if is_number else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)


def shown(value: Any) -> str:
    """Return a value as one short line."""
    if isinstance(value, dict):
        return 'a mapping'
    if isinstance(value, list):
        return 'a list'
    if value is None:
        return 'null'
    text = repr(value[:_SHOWN + 1] if isinstance(value, str) else value)
    return text if len(text) <= _SHOWN else f'{text[:_SHOWN]}…'
