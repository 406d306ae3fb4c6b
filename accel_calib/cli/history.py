# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib history``: the calibrations of one sensor over their dates."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TYPE_CHECKING

from . import options
from ..compare import History, history_of
from ..errors import AccelCalibError
from ..files import read_calibration
from ..rating import rate_comparison
from ..report import check_matplotlib, write_history_page
from ..report.repeat_charts import GAINS, in_words, OFFSETS
from ..report.repeat_pages import change_in_words

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
    try:
        calibrations = [read_calibration(path) for path in args.calibrations]
        history = history_of(calibrations)
    except AccelCalibError as err:
        options.write_json(args.json, {'error': err.message, 'advice': err.advice})
        raise
    options.write_json(args.json, _result(args.calibrations, history))
    if args.report is not None:
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
    for title, names in (('Zero-g offset [mg]', OFFSETS), ('Gain minus 1 [%]', GAINS)):
        console.print(_table(title, names, history))
        console.print('')
    for first, second, change in zip(history.labels, history.labels[1:], history.changes,
                                     strict=False):
        console.print(_line(first, second, change), markup=False)
    for note in history.notes:
        console.print(f'note: {note}', markup=False)
    if args.report is not None:
        console.print(f'stored in {args.report}', markup=False)


def _line(first: str, second: str, change: Any) -> str:
    """Return one step as a line of text."""
    comparison = change.comparison
    verdict = 'agree' if comparison.agree else 'differ'
    most = change_in_words(change.parameter, change.change, change.sd).replace('−', '-')
    return (f'{first} to {second}: {verdict} (p = {comparison.p_value:.2g}), '
            f'{rate_comparison(comparison).name}; largest change: '
            f'{change.parameter.replace(".", " ")} {most}')


def _table(title: str, names: Sequence[str], history: History) -> Table:
    """Return a table of parameters, one row per calibration."""
    from rich import box
    from rich.table import Table

    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False,
                  pad_edge=False)
    table.add_column('date', no_wrap=True)
    found = [each for each in history.parameters if each.name in names]
    for each in found:
        table.add_column(each.name.partition('.')[2], justify='right', overflow='fold')
    for k, (label, moment) in enumerate(zip(history.labels, history.moments, strict=True)):
        warm = '' if moment.temperature is None else f'\n{moment.temperature:.0f} °C'
        cells = (in_words(each.name, each.values[k], each.stated_sd[k]).rpartition(' ')[0]
                 for each in found)
        day = label.replace(' ', '\n')
        table.add_row(f'{day}{warm}', *(cell.replace('−', '-') for cell in cells))
    return table
