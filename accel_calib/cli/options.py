# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Options of several commands, and the output of results."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.atomic import write_atomically
from ..table import Poses
from ..units import STANDARD_GRAVITY, UNIT_NAMES, Units, units_of


def add_example(made: argparse.ArgumentParser, example: str) -> None:
    """Add an example to the end of the help."""
    made.epilog = f'example:\n  {example}'
    made.formatter_class = argparse.RawDescriptionHelpFormatter


def positive(text: str) -> float:
    """Return a number above zero."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text} is not a positive number')
    return value


def add_units(made: argparse.ArgumentParser, default: str = '') -> None:
    """Add ``--units`` and ``--gravity``; without a default the unit is that of the file."""
    made.add_argument('--units', choices=UNIT_NAMES, default=default,
                      help='unit of ax,ay,az; native is counts or volts (default: '
                      f'{default or "what the file says, or m/s2"})')
    made.add_argument('--gravity', type=positive, default=STANDARD_GRAVITY, metavar='M/S2',
                      help='local gravity [m/s2] (default: %(default)s)')


def units_from(args: argparse.Namespace, stated: str, path: Path) -> Units:
    """
    Return the unit that was asked for, or that a file states.

    Raises
    ------
    InputError
        If the two differ.

    """
    if args.units and stated and args.units != stated:
        raise InputError(f'{path} is in {stated}, --units is {args.units}',
                         'leave --units out, or correct the file')
    name: Any = args.units or stated or 'm/s2'
    return units_of(name, args.gravity)


def add_json(made: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    made.add_argument('--json', metavar='FILE', help='write the result as JSON; - for standard '
                      'output')


def write_json(target: str | None, result: object) -> None:
    """Write a result as JSON to a file, to standard output for ``-``, or nowhere for None."""
    if target is None:
        return
    text = json.dumps(plain(result), indent=2, allow_nan=False)
    if target == '-':
        print(text)
    else:
        write_atomically(Path(target), lambda file: file.write(f'{text}\n'))


def plain(value: object) -> Any:
    """Return arrays as lists, numbers that are not finite as None, and paths as text."""
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def console(args: argparse.Namespace) -> Any:
    """Return the console for people: standard error if JSON goes to standard output."""
    from rich.console import Console

    return Console(stderr=getattr(args, 'json', None) == '-', highlight=False, soft_wrap=True)


def rows_between(poses: Poses, text: str | None) -> Poses:
    """
    Return the rows ``A:B`` of a table, 1-based, inclusive; an open end is that of the table.

    Raises
    ------
    InputError
        If the text is not of that form, or the rows are not in the table.

    """
    if text is None:
        return poses
    first, colon, last = text.partition(':')
    try:
        start, stop = int(first or 1), int((last if colon else first) or len(poses))
    except ValueError:
        start, stop = 0, 0
    if not 1 <= start <= stop <= len(poses):
        raise InputError(f'--rows {text} is not A:B within rows 1:{len(poses)} of the table',
                         'give the first and the last row, counted from 1')
    return poses.take(slice(start - 1, stop))


def in_parallel(function: Any, items: Sequence[Any], jobs: int) -> list[Any]:
    """Call a function for each item, in one process or several, in order."""
    if jobs <= 1 or len(items) <= 1:
        return [function(item) for item in items]
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # A fork of a process with threads, as numpy has, may hang.
    with ProcessPoolExecutor(min(jobs, len(items)), get_context('spawn')) as pool:
        return list(pool.map(function, items))
