# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Text on the terminal: lines, tables, ratings in colour, progress.

Lines break at words, at the width of the terminal or of ``COLUMNS``. A word that is longer, such
as the name of a file, stays whole. An output whose encoding lacks a character gets a plain
replacement, such as ``+-`` for ±, and control characters from files never reach the terminal.
Progress is shown on standard error if it is a terminal.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
import re
import sys
from textwrap import wrap
from typing import Any, NamedTuple

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from .options import plain_character, plain_handler
from ..logs import Progress
from ..text import short

_NO_BREAK = '\N{NO-BREAK SPACE}'

_COLOURS = {'GOOD': 'bold green', 'USABLE': 'bold yellow', 'BAD': 'bold red'}

_TIED = r'(?<=±) | (?=±)|(?<==) | (?==)|(?<=\d) (?=(mg|g|s|h|Hz|%|°|°C|m/s²|poses?)\b)'
"""Spaces at which a line does not break: ``value ± sd``, ``p = 0.1``, ``3 mg``."""


class Verdict(NamedTuple):
    """A line of text with a rating from a character on, which a terminal shows in colour."""

    line: str
    rating: str
    start: int = 0


class Output(Console):
    """A console that breaks lines at words, and takes text as it is, without markup."""

    def __init__(self, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return text with the replacements, so that tables have the right width."""
        return super().render_str(shown(text, self.encoding), **options)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: A003
        """Print; lines of text break at words, and the rest of a line is indented."""
        if len(objects) != 1 or not isinstance(given := objects[0], str | Verdict):
            super().print(*objects, **options)
            return
        line, rating, start = given if isinstance(given, Verdict) else (given, '', 0)
        text = self._break_lines(line)
        if rating:
            end = len(self._break_lines(line[:start + len(rating)]))
            text.stylize(_COLOURS[rating], end - len(rating), end)
        super().print(text, soft_wrap=True, **options)

    def _break_lines(self, text: str) -> Text:
        lines = []
        for line in text.split('\n'):
            parts = wrap(re.sub(_TIED, _NO_BREAK, line), self.width, subsequent_indent='  ',
                         break_long_words=False, break_on_hyphens=False)
            lines.append('\n'.join(parts).replace(_NO_BREAK, ' ') or line)
        return self.render_str('\n'.join(lines))


def shown(text: str, encoding: str) -> str:
    """Return text in the characters of an encoding, without control characters."""
    safe = ''.join(each if each.isprintable() or each == '\n' else plain_character(each)
                   for each in text)
    return safe.encode(encoding, plain_handler()).decode(encoding)


NARROW: Any = {'box': box.SIMPLE_HEAD, 'padding': (0, 1, 0, 0), 'pad_edge': False}
"""Style of a table whose cells are long."""


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], **style: Any
          ) -> Table:
    """Return a table whose first column holds names, and the others numbers."""
    made = Table(title=title, **style)
    made.add_column(columns[0], overflow='fold')
    for name in columns[1:]:
        made.add_column(name, justify='right')
    for row in rows:
        made.add_row(*row)
    return made


def short_if_known(value: float | None) -> str:
    """Return a number in three digits, or that it is not known."""
    return 'not known' if value is None else short(value)


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show a progress bar, and yield the function that updates it."""
    if not sys.stderr.isatty():
        yield lambda done, count: None
        return
    from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), TextColumn('{task.description}'), TimeRemainingColumn())
    with Bar(*columns, console=Output(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)  # the bar moves to and fro until a number is known
        yield lambda done, count: bar.update(task, completed=done, total=count,
                                             description=f'{done:,} of {count:,} {what}')


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that work of unknown length goes on."""
    if not sys.stderr.isatty():
        yield
        return
    with Output(stderr=True).status(what):
        yield
