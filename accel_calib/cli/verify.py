# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib verify``: evaluate a calibration on poses that it was not fitted to."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from . import options
from .terminal import working
from ..calibrate import verify
from ..rating import rate_verification
from ..table import check_units
from ..text import short

_EXAMPLE = ('accel-calib verify other_log.csv -c calibration.yaml --max 5\n'
            'exit status:\n'
            '  0: within --max, 1: above --max, 2: bad input')

ABOVE_MAX = 1
"""Exit status if the residual is above ``--max``."""


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES',
                      help='pose table, or a recording, whose poses are captured first')
    made.add_argument('-c', '--calibration', type=Path, required=True, metavar='FILE',
                      help='stored calibration')
    made.add_argument('--max', type=options.positive, metavar='MG', help='largest residual (RMS) '
                      'of the corrected poses [mg]; exit status 1 above it')
    made.add_argument('--report', type=Path, metavar='FILE', help='page to write (HTML); a folder '
                      'for several POSES')
    made.add_argument('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive')
    made.add_argument('--jobs', type=int, default=1, metavar='N',
                      help='number of tables to process in parallel')
    options.add_log(made)
    options.add_max_dwell(made)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Verify, and print the result."""
    if args.report is not None:
        from ..report import check_matplotlib

        check_matplotlib()
    if len(args.poses) == 1:
        with options.errors_in_json(args.json):
            result = _verify(args, args.poses[0], args.report)
        options.write_json(args.json, result)
        results = [result]
    else:
        results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
        options.write_json(args.json, results)
    _show(args, results)
    return _status(args, results)


def _status(args: argparse.Namespace, results: list[dict[str, Any]]) -> int:
    """Return the exit status: bad input, above ``--max``, or 0."""
    if any('error' in result for result in results):
        return 2
    above = args.max is not None and any(not result['rms_after_mg'] <= args.max
                                         for result in results)
    return ABOVE_MAX if above else 0


def _verify(args: argparse.Namespace, path: Path, report: Path | None) -> dict[str, Any]:
    stored = options.stored_calibration(args.calibration)
    intake, calibration = options.intake_for(args, path, stored)
    poses = options.rows_between(intake.poses, args.rows)
    check_units(poses, calibration.units)
    found = verify(calibration, poses)
    rating = rate_verification(found, calibration, poses)
    if report is not None:
        from ..report import write_calibration_page

        with working('drawing the page'):
            write_calibration_page(report, calibration, rating, str(path),
                                   verification=(found, poses), stored=str(args.calibration),
                                   notes=intake.lines)
    return {'file': path, 'poses': len(poses), **asdict(found), **options.rated(rating),
            'read_lines': intake.lines, 'rating_lines': rating.lines}


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Verify on one of several tables; an error is returned as the result."""
    return options.attempted(
        lambda: _verify(args, path, args.report and args.report / f'{path.stem}.html'), path)


def _show(args: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    """Print how the logs were read, one row for each, and the ratings."""
    console = options.console(args)

    def name_of(result: dict[str, Any]) -> str:
        return '' if len(results) == 1 else f'{result["file"]}: '

    for result in results:
        if 'error' in result:
            console.print(f'{result["file"]}: {result["error"]}; {result["advice"]}')
            continue
        for line in result['read_lines']:
            console.print(f'{name_of(result)}{line}')
    sound = [result for result in results if 'error' not in result]
    console.print(_table(sound))
    for result in sound:
        for line in result['rating_lines']:
            console.print(f'{name_of(result)}{line}')


def _table(results: list[dict[str, Any]]) -> Any:
    from rich.table import Table

    table = Table(title='Residual of |force| over these poses [mg]')
    table.add_column('poses', overflow='fold')
    for name in ('before', 'after', 'largest after', 'noise floor'):
        table.add_column(name, justify='right')
    for result in results:
        floor = result['noise_floor_mg']
        table.add_row(str(result['file']), short(result['rms_before_mg']),
                      short(result['rms_after_mg']), short(result['max_after_percent'] * 10),
                      'not known' if floor is None else short(floor))
    return table
