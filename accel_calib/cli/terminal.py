# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Output on a terminal: width, progress, and its end by the user.

Lines break at words, at the width of the terminal or of ``COLUMNS``. A word that is longer, such
as the name of a file, stays whole. Progress is shown on standard error
if it is a terminal.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import re
import signal
import sys
from textwrap import wrap
from typing import Any, TYPE_CHECKING

from rich.console import Console

from .characters import shown

if TYPE_CHECKING:
    from rich.text import Text

    from ..logs import Progress


_NO_BREAK = '\N{NO-BREAK SPACE}'
_TIED = r'(?<=±) | (?=±)|(?<==) | (?==)|(?<=\d) (?=(mg|g|s|h|Hz|%|°|°C|m/s²|poses?)\b)'
"""Spaces at which a line does not break: ``value ± sd``, ``p = 0.1``, ``3 mg``."""


class Output(Console):
    """A console that breaks lines at words, and takes text as it is, without markup."""

    def __init__(self, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return text with the replacements, so that tables have the right width."""
        return super().render_str(shown(text, self.encoding), **options)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: A003
        """Print; lines of text break at words, and the rest of a line is indented."""
        if len(objects) == 1 and isinstance(objects[0], str):
            super().print('\n'.join(map(self._broken, objects[0].split('\n'))), soft_wrap=True,
                          **options)
        else:
            super().print(*objects, **options)

    def _broken(self, line: str) -> str:
        tied = re.sub(_TIED, _NO_BREAK, line)
        parts = wrap(tied, self.width, subsequent_indent='  ', break_long_words=False,
                     break_on_hyphens=False)
        return '\n'.join(parts).replace(_NO_BREAK, ' ') or line


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show a progress bar, and yield the function that updates it."""
    if not sys.stderr.isatty():
        yield lambda done, count: None
        return
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (BarColumn(), TextColumn('{task.completed:,.0f} of {task.total:,.0f} ' + what),
               TimeRemainingColumn())
    with Bar(*columns, console=Output(stderr=True), transient=True) as bar:
        task = bar.add_task('', visible=False)
        yield lambda done, count: bar.update(task, completed=done, total=count, visible=True)


@contextmanager
def working(what: str) -> Iterator[None]:
    """Show that work of unknown length goes on."""
    if not sys.stderr.isatty():
        yield
        return
    with Output(stderr=True).status(what):
        yield


@contextmanager
def ended() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C or SIGTERM came."""
    came: list[int] = []
    before = {number: signal.signal(number, lambda number, frame: came.append(number))
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
