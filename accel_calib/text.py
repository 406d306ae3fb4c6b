# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Numbers, counts, dates, tables and results as text; and text from outside.

Text that others wrote can hold line ends, control characters and halves of pairs (surrogates),
which no file in UTF-8 holds. `one_line` makes it one printable line, for names, comments, messages
and what is read from YAML. `read_json` is the only reader of JSON from outside.

"""

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timezone
from html import escape
from itertools import repeat
import json
import math
from pathlib import Path
from typing import Any

_ZERO = 1e-12
"""Values below are zero but for rounding."""

_LONGEST_ITEM, _LONGEST_REASON = 100, 400
"""Characters that a message shows of one item of a list, and of the reason of a library."""

_MOST_LEVELS = 32
"""Largest number of levels of lists and objects in JSON: less than a function that recurses can
take in any version of Python."""

_TOO_DEEP = f'it has more than {_MOST_LEVELS} levels'

LONGEST_NAME = 4096
"""Longest name of a sensor, a topic or an effect [characters]; messages repeat names."""


def short(value: float) -> str:
    """Return a number with three significant digits."""
    return f'{value:.3g}'


def with_sd(value: float, sd: float) -> str:
    """Return ``value ± sd`` to two significant digits of the sd; six digits if there is no sd."""
    if not sd > 0.0:
        return '0' if abs(value) < _ZERO else f'{value:.6g}'
    decimals = max(0, 1 - math.floor(math.log10(sd)))
    return f'{round(value, decimals) + 0.0:.{decimals}f} ± {sd:.{decimals}f}'


def milli(value: float, *, signed: bool) -> str:
    """Return a residual [mg] with as many decimals as a person compares."""
    size = abs(value)
    decimals = 0 if size >= 1000.0 else 1 if size >= 9.95 else 2 if size >= 0.0995 else 3
    return with_minus(f'{round(value, decimals) + 0.0:{"+" if signed else ""}.{decimals}f}')


def with_minus(text: str) -> str:
    """Return text with the minus sign of typography."""
    return text.replace('-', '−')


def signed(value: float, sd: float, unit: str = '') -> str:
    """Return ``+value ± sd unit``, with the minus sign of typography."""
    words = with_minus(with_sd(value, sd))
    return f'{"" if words.startswith("−") else "+"}{words} {unit}'.rstrip()


def table(head: Iterable[str], rows: Iterable[Iterable[str]], kind: str = '',
          poses: Sequence[int] = ()) -> str:
    """Return a table of the CSS class `kind`; `poses` are rows of poses, for a script."""
    cells = ''.join(f'<th scope="col">{escape(name)}</th>' for name in head)
    openings = [f'<tr data-row="{row}">' for row in poses] or repeat('<tr>')
    lines = ''.join(opening + ''.join(f'<td>{escape(value)}</td>' for value in row) + '</tr>\n'
                    for opening, row in zip(openings, rows))
    opening = f'<table class="{kind}">' if kind else '<table>'
    return f'{opening}\n<thead><tr>{cells}</tr></thead>\n<tbody>\n{lines}</tbody>\n</table>\n'


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 pose`` or ``2 poses``."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def enumerated(words: Sequence[str]) -> str:
    """Join words by commas and 'and'."""
    return ' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))


def some(items: Iterable[object], most: int = 12) -> str:
    """Return the first items of a list, each shortened, and how many more there are."""
    words = [word if len(word) <= _LONGEST_ITEM else f'{word[:_LONGEST_ITEM]}…'
             for word in map(str, items)]
    more = f' and {len(words) - most} more' if len(words) > most else ''
    return ', '.join(words[:most]) + more


def one_line(text: str) -> str:
    """Return text from outside as one printable line: a space replaces any other character."""
    if text.isprintable():
        return text
    return ''.join(each if each.isprintable() else ' ' for each in text)


def read_json(text: str) -> Any:
    """Return the content of JSON from outside; ValueError if it is none, or has many levels."""
    try:
        found = json.loads(text)
    except RecursionError as err:
        raise ValueError(_TOO_DEEP) from err
    level: list[Any] = [[found]]
    for _ in range(_MOST_LEVELS + 1):
        level = [each for part in level for each in (
            part.values() if isinstance(part, dict) else part) if isinstance(each, dict | list)]
        if not level:
            return found
    raise ValueError(_TOO_DEEP)


def reason(error: BaseException) -> str:
    """Return why foreign code raises an error, in one printable line of limited length."""
    said = ' '.join(one_line(str(error)[:_LONGEST_REASON]).split())
    return said if ' ' in said else f'{type(error).__name__} {said}'.strip()


def listed(noun: str, items: Sequence[object], most: int = 50) -> str:
    """Return the first items with their noun, such as ``row 1`` or ``rows 1, 2 and 3 more``."""
    return f'{noun}{"" if len(items) == 1 else "s"} {some(items, most)}'


def now() -> str:
    """Return the date of a result: ISO 8601, UTC, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def plain(value: Any) -> Any:
    """Convert a value for JSON: arrays to lists, numbers that are not finite to None."""
    if hasattr(value, 'tolist'):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
