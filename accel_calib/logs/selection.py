# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Selection of the columns of a text log, by the user, the maker's layout or their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from . import formats
from .clock import is_clock
from .columns import column, has_reading, MOST, Source, sources
from .dialect import Layout
from .names import READING
from .records import LogOptions
from .text import Cells
from ..table import Floats


@dataclass(frozen=True)
class Chosen:
    """
    The columns of a text log that are used.

    Parameters
    ----------
    layout : Layout
        The table.
    sources : mapping of str to Source
        Columns under our names.
    maker : LogFormat or None
        The maker's layout.
    numeric, text : tuple of int
        Columns of numbers and of text, as read.

    """

    layout: Layout
    sources: Mapping[str, Source]
    maker: formats.LogFormat | None
    numeric: tuple[int, ...]
    text: tuple[int, ...]

    @property
    def dates(self) -> tuple[int, ...]:
        """Columns of text that are dates, or times of the day: that of the times, or none."""
        which = [self.sources['time'].index] if 'time' in self.sources else []
        return tuple(set(which) & set(self.text))

    def numbers(self, cells: Cells, ours: str) -> Floats:
        """Return the numbers of a column as in the file; divided, if its maker says so."""
        values = cells.numbers[:, self.numeric.index(self.sources[ours].index)]
        divisor = self.sources.get(f'{ours}/')
        if divisor is None:
            return values
        with np.errstate(all='ignore'):  # a row divided by 0 is refused later, with its number
            return values / cells.numbers[:, self.numeric.index(divisor.index)]

    def texts(self, cells: Cells, ours: str) -> list[str]:
        """Return the texts of a column."""
        return cells.texts[self.text.index(self.sources[ours].index)]


def is_log_header(cells: Sequence[str], options: LogOptions) -> bool:
    """Return whether cells are the names of the columns of a log."""
    theirs = [each.casefold() for each in options.columns.values()
              if each and not each.isdecimal()]
    if theirs:
        return {each.casefold() for each in cells}.issuperset(theirs)
    return has_reading(cells) or formats.recognise(cells[:MOST]) is not None


def chosen(layout: Layout, options: LogOptions) -> Chosen:
    """
    Return the columns of a log that are used.

    Raises
    ------
    InputError
        If there is no accelerometer, or there are several, or a given column is not there.

    """
    path, header = layout.path, layout.header
    found = None
    if options.format:
        found = formats.named(options.format, header, str(path))
    elif not set(READING) <= set(header):
        found = formats.recognise(header[:MOST])
    given = dict(options.columns)
    if found is not None and not set(READING) & given.keys():
        formats.check_sensor(header, path)
        given = {**found.present(header), **given}
    else:
        found = None
    found_sources = sources(layout, given)
    if found is not None:
        for ours, theirs in found.divisors.items():
            found_sources[f'{ours}/'] = column(layout, theirs)
        if found.instance:
            found_sources['instance'] = column(layout, found.instance)
    return with_indices(layout, found_sources, found)


def with_indices(layout: Layout, sources: Mapping[str, Source],
                 found: formats.LogFormat | None = None) -> Chosen:
    """Return the columns with the indices of those of numbers and of text."""
    text = [sources['label'].index] if 'label' in sources else []
    if 'time' in sources and layout.sample:
        which = sources['time'].index
        cells = [row[which] for row in layout.sample if which < len(row)]
        if cells and all(map(is_clock, cells)):
            text.append(which)
    numeric = sorted({source.index for source in sources.values()} - set(text))
    return Chosen(layout, sources, found, tuple(numeric), tuple(text))
