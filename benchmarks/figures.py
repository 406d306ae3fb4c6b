# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The tables that the benchmarks print and write into the docs: asked beside measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Line:
    """A line of a table: what, measured, asked, over how many sets, and whether it is met."""

    what: str
    measured: str
    asked: str
    sets: int
    met: bool | None


def table(lines: Sequence[Line]) -> str:
    """Give the table as Markdown; `met` is empty where nothing was asked."""
    rows = ['| | measured | asked | sets | met |', '|---|---|---|---|---|']
    words = {True: 'yes', False: '**no**', None: ''}
    rows += [f'| {x.what} | {x.measured} | {x.asked} | {x.sets} | {words[x.met]} |' for x in lines]
    return '\n'.join(rows)


def publish(page: str, path: Path | None) -> None:
    """Print a page, and write it where that is asked for."""
    print(page)
    if path is not None:
        path.write_text(page, encoding='utf-8')
