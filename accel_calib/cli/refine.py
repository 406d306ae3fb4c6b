# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib refine``: find effects that a calibration lacks, and add them."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from . import options
from .results import in_a_line, refine_result, steps_table
from ..calibrate import Calibration
from ..capture import capture, settings_from
from ..errors import AccelCalibError, InputError, listed, RefusedFitError
from ..files import is_bag, read_poses, read_recording, write_calibration
from ..files.plan_table import write_plan
from ..refine import BASES, refine, Refinement
from ..report import check_matplotlib, write_page
from ..table import Poses, Recording
from ..units import Units
from ..words import now, residual_words, verdict_words

_EXAMPLE = 'accel-calib refine poses.csv -o refined.yaml --report report.html'
_SAMPLES_APART_S = 0.5
_MANY_ROWS = 5000


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES',
                      help='pose table (CSV), or recording (bag, or table of samples)')
    made.add_argument('-o', '--output', type=Path, metavar='FILE',
                      help='refined calibration to write (YAML); a folder for several POSES')
    made.add_argument('--report', type=Path, metavar='FILE',
                      help='report to write (HTML); a folder for several POSES')
    made.add_argument('--plan', type=Path, metavar='FILE',
                      help='poses to take next, which separate the named effects from their '
                      'rivals (CSV); not written if there is nothing to separate; a folder for '
                      'several POSES')
    made.add_argument('--jobs', type=int, default=1, metavar='N',
                      help='number of tables to process in parallel')
    add_inputs(made)
    options.add_json(made)
    made.set_defaults(run=run)


def add_inputs(made: argparse.ArgumentParser) -> None:
    """Add the options of the input."""
    base = made.add_mutually_exclusive_group()
    base.add_argument('-c', '--calibration', type=Path, metavar='FILE',
                      help='stored calibration to compare with and to start from')
    base.add_argument('--base', choices=BASES, default='auto',
                      help='model to start from (default: the model that fit --model auto '
                      'selects)')
    made.add_argument('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive')
    made.add_argument('--sensor', default='',
                      help='name of the sensor (frame_id of its messages; default: the name in '
                      'the file)')
    made.add_argument('--topic', default='', help='Imu topic, for a bag with several Imu topics')
    made.add_argument('--max-dwell', type=options.positive, metavar='S',
                      help='for a recording: split longer rests into poses with the same '
                      'orientation')
    options.add_units(made)


def run(args: argparse.Namespace) -> int:
    """Refine and store, and print the result."""
    if args.report is not None:
        check_matplotlib()
    for option, path in (('-o', args.output), ('--report', args.report),
                         ('--plan', args.plan)):
        if path is not None:
            _check_target(option, path, len(args.poses))
    if len(args.poses) == 1:
        return _run_one(args)
    results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
    options.write_json(args.json, results)
    console = options.console(args)
    for result in results:
        console.print(f'{result["file"]}: {in_a_line(result)}', markup=False)
    return 2 if any('error' in result for result in results) else 0


def _check_target(option: str, path: Path, count: int) -> None:
    """Check before the work that the folder of an output exists."""
    if count > 1 and not path.is_dir():
        raise InputError(f'{option} {path} is not a folder, expected a folder for {count} tables',
                         'use an existing folder')
    if count == 1 and not path.parent.is_dir():
        raise InputError(f'{option} {path}: {path.parent} is not a folder, expected a folder',
                         'choose a file in an existing folder')


def _run_one(args: argparse.Namespace) -> int:
    path = args.poses[0]
    try:
        result = refine_file(args, path)
    except AccelCalibError as err:
        options.write_json(args.json, {'file': path, 'error': err.message, 'advice': err.advice})
        raise
    options.write_json(args.json, {'file': path, **refine_result(result)})
    stored = _store(result, path, args.output, args.report, args.plan)
    _show(args, result, stored)
    if args.output is not None and args.output not in stored:
        raise RefusedFitError(f'{args.output} is not written: {result.refusal[0]}',
                              result.refusal[1])
    return 0


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Refine with one of several tables; an error is returned as the result."""
    try:
        result = refine_file(args, path)
        _store(result, path, args.output and args.output / f'{path.stem}.yaml',
               args.report and args.report / f'{path.stem}.html',
               args.plan and args.plan / f'{path.stem}.csv')
        if args.output and result.refusal:
            return options.plain({'file': path, **refine_result(result),
                                  'error': result.refusal[0], 'advice': result.refusal[1]})
    except AccelCalibError as err:
        return {'file': str(path), 'error': err.message, 'advice': err.advice}
    except OSError as err:
        return {'file': str(path), 'error': f'{path}: {err.strerror}',
                'advice': 'check the name and the permissions'}
    made: dict[str, Any] = options.plain({'file': path, **refine_result(result)})
    return made


def refine_file(args: argparse.Namespace, path: Path) -> Refinement:
    """Refine with one table or recording, with the given options."""
    base: str | Calibration = args.base
    if args.calibration is not None:
        base = options.stored_calibration(args.calibration)
    poses, units = _poses_from(args, path, base.units if isinstance(base, Calibration) else None)
    return refine(options.rows_between(poses, args.rows), units, base=base,
                  sensor=args.sensor, date=now())


def _poses_from(args: argparse.Namespace, path: Path, units: Units | None) -> tuple[Poses, Units]:
    """Return the poses of a table or of a recording, and their unit."""
    table: Poses | Recording = (read_recording(path, args.topic, args.sensor) if is_bag(path)
                                else read_poses(path))
    if units is not None and table.units not in ('', units.name):
        raise InputError(f'{path} is in {table.units}, but the calibration is for readings in '
                         f'{units.name}', 'use poses in that unit')
    units = units or options.units_from(args, table.units, path)
    if isinstance(table, Poses) and not _are_samples(table):
        return table, units
    recording = Recording(table.columns, table.row, table.units, table.sensor)
    given = {} if args.max_dwell is None else {'max_dwell': args.max_dwell}
    return capture(recording, units, settings_from(given, units)).poses, units


def _are_samples(table: Poses) -> bool:
    """Return whether rows are samples: with time, without count, and dense or many."""
    if 'time' not in table or 'count' in table or len(table) < 2:
        return False
    apart = float(np.median(np.diff(table['time'])))
    return apart < _SAMPLES_APART_S or len(table) > _MANY_ROWS


def _store(result: Refinement, source: Path, output: Path | None, report: Path | None,
           plan: Path | None) -> list[Path]:
    """Write the report, the plan and a usable calibration; return the paths written."""
    written = []
    if report is not None:
        write_page(report, result, str(source))
        written.append(report)
    if output is not None and not result.refusal:
        write_calibration(output, result.calibration)
        written.append(output)
    if plan is not None and result.plan.poses:
        write_plan(plan, result.plan)
        written.append(plan)
    return written


def _show(args: argparse.Namespace, result: Refinement, stored: list[Path]) -> None:
    """Print the result."""
    console = options.console(args)
    if result.steps:
        console.print(steps_table(result), soft_wrap=False)
    console.print(f'{verdict_words(result)}\n{residual_words(result)}', markup=False)
    if result.disturbed_poses:
        console.print(f'left out: {listed("row", result.disturbed_poses)}', markup=False)
    for line in result.calibration.warnings:
        console.print(f'note: {line}', markup=False)
    for line in result.advice:
        console.print(f'advice: {line}', markup=False)
    if args.plan is not None:
        for line in result.plan.lines:
            console.print(f'plan: {line}', markup=False)
    if result.not_testable:
        names = ', '.join(effect for effect, _ in result.not_testable)
        console.print(f'these data cannot show: {names}', markup=False)
    for path in stored:
        console.print(f'stored in {path}', markup=False)
