# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A progress bar on standard error, if it is a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..files import Progress


@contextmanager
def progress(what: str) -> Iterator[Progress]:
    """Show a progress bar, and yield the function that updates it."""
    if not sys.stderr.isatty():
        yield lambda done, count: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (BarColumn(), TextColumn('{task.completed:,.0f} of {task.total:,.0f} ' + what),
               TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task('', visible=False)
        yield lambda done, count: bar.update(task, completed=done, total=count, visible=True)
