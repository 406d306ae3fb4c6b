# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib history``: the calibrations of one sensor over their dates."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

from . import options
from .terminal import working
from ..compare import History, history_of
from ..rating import rate_comparison
from ..report import check_matplotlib, write_history_page
from ..report.repeat_charts import GAINS, in_words, OFFSETS
from ..report.repeat_pages import change_in_words
from ..stored import read_calibration

if TYPE_CHECKING:
    from rich.table import Table

_EXAMPLE = 'accel-calib history january.yaml april.yaml july.yaml --report history.html'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('calibrations', nargs='+', type=Path, metavar='CALIBRATION',
                      help='two or more stored calibrations of one sensor, in any order')
    made.add_argument('--report', type=Path, metavar='FILE', help='page to write (HTML)')
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Sort and compare the calibrations, and print the result."""
    if args.report is not None:
        check_matplotlib()
    with options.errors_in_json(args.json):
        calibrations = [read_calibration(path) for path in args.calibrations]
        history = history_of(calibrations)
    options.write_json(args.json, _result(args.calibrations, history))
    if args.report is not None:
        with working('drawing the page'):
            write_history_page(args.report, history, args.calibrations, calibrations)
    _show(args, history)
    return 0


def _result(paths: Sequence[Path], history: History) -> dict[str, Any]:
    """Return the result for JSON; runs are numbered from 1, in order of date."""
    changes = []
    for number, change in enumerate(history.changes, 1):
        rating, comparison = rate_comparison(change.comparison), change.comparison
        changes.append({
            'from': number, 'to': number + 1, 'agree': comparison.agree,
            'p_value': comparison.p_value, 'rms_mg': comparison.runs[1].rms_mg,
            'largest_mg': comparison.runs[1].largest_mg, 'parameter': change.parameter,
            'change': change.change, 'change_sd': change.sd, 'rating': rating.name,
            'rating_reason': rating.reason})
    return {
        'agree': history.whole.agree, 'p_value': history.whole.p_value,
        'runs': [{'file': paths[moment.index], 'date': moment.when and moment.when.isoformat(),
                  'model': moment.model, 'temperature': moment.temperature,
                  'residual_mg': moment.residual_mg} for moment in history.moments],
        'parameters': [{'name': each.name, 'values': each.values, 'stated_sd': each.stated_sd}
                       for each in history.parameters],
        'changes': changes, 'notes': history.notes}


def _show(args: argparse.Namespace, history: History) -> None:
    """Print the result."""
    console = options.console(args)
    console.print(_table(history))
    for first, second, change in zip(history.labels, history.labels[1:], history.changes,
                                     strict=False):
        console.print(_line(first, second, change))
    for note in history.notes:
        console.print(f'note: {note}')
    if args.report is not None:
        console.print(f'stored in {args.report}')


def _line(first: str, second: str, change: Any) -> str:
    """Return one step as a line of text."""
    comparison = change.comparison
    verdict = 'agree' if comparison.agree else 'differ'
    most = change_in_words(change.parameter, change.change, change.sd).replace('−', '-')
    return (f'{first} to {second}: {verdict} (p = {comparison.p_value:.2g}), '
            f'{rate_comparison(comparison).name}; largest change: '
            f'{change.parameter.replace(".", " ")} {most}')


def _table(history: History) -> Table:
    """Return a table of offset and gain, one row per calibration and axis."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False, pad_edge=False)
    for name in ('date', ''):
        table.add_column(name, no_wrap=True)
    for name in ('offset [mg]', 'gain - 1 [%]'):
        table.add_column(name, no_wrap=True, justify='right')
    found = {each.name: each for each in history.parameters}
    for k, (label, moment) in enumerate(zip(history.labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'{moment.temperature:.0f} °C'
        for begin, names in zip((label, warm, ''), zip(OFFSETS, GAINS, strict=True), strict=True):
            cells = (in_words(name, found[name].values[k], found[name].stated_sd[k])
                     for name in names)
            table.add_row(begin, names[0][-1], *(cell.rpartition(' ')[0].replace('−', '-')
                                                 for cell in cells))
    return table
