# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib refine``: find effects that a calibration lacks, and add them."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from . import options
from .results import in_a_line, refine_result, steps_table
from .terminal import Output, working
from ..calibrate import Calibration
from ..errors import RefusedFitError
from ..rating import rate_refinement
from ..refine import BASES, refine, refine_with_fleet, Refinement
from ..refine.words import residual_words, verdict_words
from ..report import check_matplotlib, write_page
from ..stored import write_calibration
from ..stored.plan_table import write_plan
from ..text import listed, now

_EXAMPLE = 'accel-calib refine poses.csv -o refined.yaml --report report.html'


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
    options.add_prior(made, base)
    made.add_argument('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive')
    options.add_log(made)
    options.add_max_dwell(made)


def run(args: argparse.Namespace) -> int:
    """Refine and store, and print the result."""
    if args.report is not None:
        check_matplotlib()
    if len(args.poses) == 1:
        return _run_one(args)
    results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
    options.write_json(args.json, results)
    console = options.console(args)
    for result in results:
        console.print(f'{result["file"]}: {in_a_line(result)}')
    return 2 if any('error' in result for result in results) else 0


def _run_one(args: argparse.Namespace) -> int:
    path = args.poses[0]
    with options.errors_in_json(args.json, file=path):
        result = refine_file(args, path)
    options.write_json(args.json, _result(path, result))
    stored = _store(result, path, args.output, args.report, args.plan)
    _show(args, result, stored)
    if args.output is not None and args.output not in stored:
        raise RefusedFitError(f'{args.output} is not written: {result.refusal[0]}',
                              result.refusal[1])
    return 0


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Refine with one of several tables; an error is returned as the result."""
    def work() -> dict[str, Any]:
        result = refine_file(args, path)
        _store(result, path, args.output and args.output / f'{path.stem}.yaml',
               args.report and args.report / f'{path.stem}.html',
               args.plan and args.plan / f'{path.stem}.csv')
        refused = dict(zip(('error', 'advice'), result.refusal or ())) if args.output else {}
        return {**_result(path, result), **refused}

    return options.attempted(work, path)


def _result(path: Path, result: Refinement) -> dict[str, Any]:
    """Return the result for JSON."""
    return {'file': path, **refine_result(result), **options.rated(rate_refinement(result))}


def refine_file(args: argparse.Namespace, path: Path) -> Refinement:
    """Refine with one log and the given options; print how it was read."""
    base: str | Calibration = args.base
    if args.calibration is not None:
        intake, base = options.intake_for(args, path, options.stored_calibration(args.calibration))
    else:
        intake = options.intake(args, path)
    for line in intake.lines:
        Output(stderr=True).print(line)
    poses = options.rows_between(intake.poses, args.rows)
    with working('refining'):
        fleet = options.prior(args)
        if fleet is not None:
            return refine_with_fleet(poses, intake.units, fleet, sensor=args.sensor, date=now())
        return refine(poses, intake.units, base=base, sensor=args.sensor, date=now())


def _store(result: Refinement, source: Path, output: Path | None, report: Path | None,
           plan: Path | None) -> list[Path]:
    """Write the report, the plan and a usable calibration; return the paths written."""
    written = []
    if report is not None:
        with working('drawing the page'):
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
        console.print(steps_table(result))
    console.print(f'{verdict_words(result)}\n{residual_words(result)}')
    if result.disturbed_poses:
        console.print(f'left out: {listed("row", result.disturbed_poses)}')
    for line in result.calibration.warnings:
        console.print(f'note: {line}')
    for line in result.advice:
        console.print(f'advice: {line}')
    if args.plan is not None:
        for line in result.plan.lines:
            console.print(f'plan: {line}')
    if result.not_testable:
        names = ', '.join(effect for effect, _ in result.not_testable)
        console.print(f'these data cannot show: {names}')
    for path in stored:
        console.print(f'stored in {path}')
    for line in rate_refinement(result).lines:
        console.print(line)
