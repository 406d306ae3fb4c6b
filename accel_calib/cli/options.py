# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Options that several commands have, and the output of results.

**Progress.** A progress bar on standard error, if it is a terminal.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
import json
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibrate import Calibration, EDITED
from ..errors import InputError
from ..files import read_calibration
from ..files.atomic import write_atomically
from ..table import Poses
from ..units import STANDARD_GRAVITY, UNIT_NAMES, Units, units_of

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


def add_example(made: argparse.ArgumentParser, example: str) -> None:
    """Add an example to the end of the help."""
    made.epilog = f'example:\n  {example}'
    made.formatter_class = argparse.RawDescriptionHelpFormatter


def positive(text: str) -> float:
    """Return a positive number from an argument."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}: expected a positive number')
    return value


def add_units(made: argparse.ArgumentParser, default: str = '') -> None:
    """Add ``--units`` and ``--gravity``; without a default, the file states the unit."""
    made.add_argument('--units', choices=UNIT_NAMES, default=default,
                      help='unit of ax,ay,az; native is counts or volts (default: '
                      f'{default or "the unit in the file, or m/s2"})')
    made.add_argument('--gravity', type=positive, default=STANDARD_GRAVITY, metavar='M/S2',
                      help='local gravity [m/s2] (default: %(default)s)')


def units_from(args: argparse.Namespace, stated: str, path: Path) -> Units:
    """
    Return the unit that the option or the file states.

    Raises
    ------
    InputError
        If both are stated and differ.

    """
    if args.units and stated and args.units != stated:
        raise InputError(f'{path} is in {stated}, but --units is {args.units}',
                         'remove --units, or correct the file')
    name: Any = args.units or stated or 'm/s2'
    return units_of(name, args.gravity)


def add_json(made: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    made.add_argument('--json', metavar='FILE', help='JSON file to write with the result; - for '
                      'standard output')


def write_json(target: str | None, result: object) -> None:
    """Write a result as JSON to a file, or to standard output for ``-``; None: do nothing."""
    if target is None:
        return
    text = json.dumps(plain(result), indent=2, allow_nan=False)
    if target == '-':
        print(text)
    else:
        write_atomically(Path(target), lambda file: file.write(f'{text}\n'))


def plain(value: object) -> Any:
    """Convert arrays to lists, numbers that are not finite to None, and paths to text."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def stored_calibration(path: Path) -> Calibration:
    """Read a stored calibration; report on standard error if it was edited by hand."""
    from rich.console import Console

    calibration = read_calibration(path)
    if EDITED in calibration.warnings:
        Console(stderr=True, highlight=False, soft_wrap=True).print(f'note: {path}: {EDITED}',
                                                                    markup=False)
    return calibration


def console(args: argparse.Namespace) -> Any:
    """Return the console for text output: standard error if JSON goes to standard output."""
    from rich.console import Console

    return Console(stderr=getattr(args, 'json', None) == '-', highlight=False, soft_wrap=True)


def rows_between(poses: Poses, text: str | None) -> Poses:
    """
    Return the rows ``A:B`` of a table, 1-based, inclusive; A and B are optional.

    Raises
    ------
    InputError
        If the text is not of this form, or the rows are not in the table.

    """
    if text is None:
        return poses
    first, colon, last = text.partition(':')
    try:
        start, stop = int(first or 1), int((last if colon else first) or len(poses))
    except ValueError:
        start, stop = 0, 0
    if not 1 <= start <= stop <= len(poses):
        raise InputError(f'--rows is {text}, expected A:B within 1:{len(poses)}',
                         'set A and B to the first and the last row, 1-based')
    return poses.take(slice(start - 1, stop))


def in_parallel(function: Any, items: Sequence[Any], jobs: int) -> list[Any]:
    """Return the results of a function for each item, in order; `jobs` processes are used."""
    if jobs <= 1 or len(items) <= 1:
        return [function(item) for item in items]
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # A fork of a process with threads, such as those of numpy, may hang.
    with ProcessPoolExecutor(min(jobs, len(items)), get_context('spawn')) as pool:
        return list(pool.map(function, items))
