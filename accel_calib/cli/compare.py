# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib compare``: test whether calibrations of one sensor agree."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from . import options
from .terminal import working
from ..compare import compare, Comparison, LEVEL
from ..rating import rate_comparison
from ..stored import read_calibration
from ..units import MG

_EXAMPLE = ('accel-calib compare monday.yaml tuesday.yaml wednesday.yaml\n'
            'exit status:\n'
            '  0: they agree, 1: they do not agree, 2: they cannot be compared')

DISAGREE = 1


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('calibrations', nargs='+', type=Path, metavar='CALIBRATION',
                      help='two or more stored calibrations of one sensor')
    made.add_argument('--report', type=Path, metavar='FILE', help='page to write (HTML)')
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare the calibrations, and print the result."""
    if args.report is not None:
        from ..report import check_matplotlib

        check_matplotlib()
    with options.errors_in_json(args.json):
        calibrations = [read_calibration(path) for path in args.calibrations]
        comparison = compare(calibrations)
    models = [calibration.name for calibration in calibrations]
    rating = rate_comparison(comparison)
    if args.report is not None:
        from ..report import write_comparison_page

        with working('drawing the page'):
            write_comparison_page(args.report, comparison, rating, args.calibrations, calibrations)
    options.write_json(args.json, {**_result(args.calibrations, models, comparison),
                                   **options.rated(rating)})
    _show(args, models, comparison)
    for line in rating.lines:
        options.console(args).print(line)
    return 0 if comparison.agree else DISAGREE


def _result(paths: list[Path], models: list[str], comparison: Comparison) -> dict[str, Any]:
    """Return the result for JSON."""
    outlier = comparison.outlier
    return {**asdict(comparison), 'outlier': None if outlier is None else outlier + 1,
            'runs': [{'file': path, 'model': model, **asdict(run)} for path, model, run in
                     zip(paths, models, comparison.runs, strict=True)]}


def _show(args: argparse.Namespace, models: list[str], comparison: Comparison) -> None:
    """Print the result."""
    console = options.console(args)
    console.print(_runs_table(args.calibrations, models, comparison))
    console.print(_parameters_table(comparison))
    for note in comparison.notes:
        console.print(f'note: {note}')
    if comparison.tilt_deg is not None:
        console.print('the directions of up of levelled calibrations differ by up to '
                      f'{comparison.tilt_deg:.3g}°; the test does not use them')
    console.print(_answer(comparison))


def _answer(comparison: Comparison) -> str:
    """Return the result as one line."""
    test = f'p = {comparison.p_value:.2g}, limit {LEVEL:g}'
    if comparison.agree:
        return f'The calibrations agree within their uncertainties ({test}).'
    if comparison.outlier is None:
        more = '' if len(comparison.runs) > 2 else '; a third run would show which one differs'
        return f'The calibrations do not agree ({test}){more}.'
    return (f'The calibrations do not agree ({test}): run {comparison.outlier + 1} differs, the '
            'others agree.')


def _runs_table(paths: list[Path], models: list[str], comparison: Comparison) -> Any:
    """Return a table that compares each run with the others."""
    from rich.table import Table

    table = Table(title='Corrected |a| minus the mean of the others [mg]')
    table.add_column('run', overflow='fold')
    for name in ('model', 'RMS', 'expected', 'largest', 'p'):
        table.add_column(name, justify='right')
    for number, (path, model, run) in enumerate(zip(paths, models, comparison.runs,
                                                    strict=True), 1):
        table.add_row(f'{number} {path}', model, f'{run.rms_mg:.3g}', f'{run.expected_mg:.3g}',
                      f'{run.largest_mg:.3g}', f'{run.p_value:.2g}')
    return table


def _parameters_table(comparison: Comparison) -> Any:
    """Return a table of the spread of each parameter."""
    from rich.table import Table

    table = Table(title='Spread of the parameters over the runs [mg]')
    table.add_column('')
    for name in ('mean', 'spread', 'stated', 'ratio'):
        table.add_column(name, justify='right')
    for one in comparison.parameters:
        if not np.any(one.stated_sd):
            continue  # not in the model
        stated = float((one.stated_sd ** 2).mean() ** 0.5) * MG
        table.add_row(one.name, f'{one.values.mean() * MG:.2f}', f'{one.spread * MG:.3g}',
                      f'{stated:.3g}', '' if one.ratio is None else f'{one.ratio:.2f}')
    return table
