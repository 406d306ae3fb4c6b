# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib fit``: from poses to a calibration."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from . import options
from .results import calibration_result, show_calibration
from .terminal import working
from ..calibrate import (
    Calibration,
    fit_poses,
    fit_with_fleet,
    FRAMES,
    level_by_rows,
    METHODS,
    MODEL_NAMES,
    outlook,
)
from ..errors import InputError
from ..intake import Intake
from ..rating import rate, Rating
from ..stored import write_calibration
from ..text import now

_EXAMPLE = 'accel-calib fit poses.csv -o calibration.yaml --flat 1'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES',
                      help='pose table, or a recording, whose poses are captured first')
    made.add_argument('-o', '--output', type=Path, metavar='FILE',
                      help='calibration to write (YAML); a folder for several POSES')
    made.add_argument('--report', type=Path, metavar='FILE',
                      help='page to write (HTML); a folder for several POSES')
    made.add_argument('--model', choices=MODEL_NAMES, default='auto',
                      help='4: offset, gain; 7: gain by axis; 9: angles of the axes; 10: '
                      'cross-axis; 12: known orientation; auto (default): the smallest that the '
                      'data support')
    made.add_argument('--method', choices=METHODS, default='ml',
                      help='ml (default) weights poses by their noise and leaves out outliers; '
                      "algebraic minimises the cost functions of AN5286 and the ESGI'95 report, "
                      'with every row')
    made.add_argument('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive')
    made.add_argument('--flat', type=int, metavar='ROW', help='row of a pose with the robot '
                      'level, 1-based; it determines the mounting')
    made.add_argument('--nose-down', type=int, metavar='ROW', help='row of a pose with the nose '
                      'of the robot tilted straight down, by 10° or more; it determines the '
                      'heading of the mounting (needs --flat)')
    made.add_argument('--frame', choices=FRAMES, default='ros',
                      help='levelled frame (default: ros, z up)')
    options.add_prior(made)
    made.add_argument('--jobs', type=int, default=1, metavar='N',
                      help='number of tables to process in parallel')
    options.add_log(made)
    options.add_max_dwell(made)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fit and store, and print the quality and the rating."""
    if args.report is not None:
        from ..report import check_matplotlib

        check_matplotlib()
    if len(args.poses) == 1:
        return _run_one(args)
    results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
    options.write_json(args.json, results)
    console = options.console(args)
    for result in results:
        console.print(f'{result["file"]} {_in_a_line(result)}')
    return 2 if any('error' in result for result in results) else 0


def _run_one(args: argparse.Namespace) -> int:
    with options.errors_in_json(args.json):
        fitted = _fit(args, args.poses[0])
    _store(fitted, args.output, args.report)
    options.write_json(args.json, _result(args, fitted))
    _show(args, fitted)
    return 0


@dataclass(frozen=True)
class _Fitted:
    """A calibration of one log, with its rating."""

    path: Path
    intake: Intake
    calibration: Calibration
    rating: Rating


def _fit(args: argparse.Namespace, path: Path) -> _Fitted:
    """Fit one log with the given options."""
    intake = options.intake(args, path)
    poses = intake.poses
    with working('fitting'):
        chosen = options.rows_between(poses, args.rows)
        fleet = options.prior(args)
        if fleet is not None and (args.model not in ('auto', '10') or args.method != 'ml'):
            raise InputError(f'--prior with --model {args.model} --method {args.method}, expected '
                             'model 10 by maximum likelihood', 'leave out these options')
        if fleet is None:
            calibration = fit_poses(chosen, intake.units, model=args.model, method=args.method,
                                    sensor=args.sensor, date=now())
        else:
            calibration = fit_with_fleet(chosen, intake.units, fleet, sensor=args.sensor,
                                         date=now())
        calibration = level_by_rows(calibration, poses, args.frame, args.flat, args.nose_down)
    return _Fitted(path, intake, calibration, rate(calibration))


def _result(args: argparse.Namespace, fitted: _Fitted) -> dict[str, Any]:
    """Return the result for JSON."""
    return {'file': fitted.path, **calibration_result(fitted.calibration, args.model),
            **options.rated(fitted.rating), 'read_lines': fitted.intake.lines}


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Fit one of several logs; an error is returned as the result."""
    def work() -> dict[str, Any]:
        fitted = _fit(args, path)
        _store(fitted, args.output and args.output / f'{path.stem}.yaml',
               args.report and args.report / f'{path.stem}.html')
        return _result(args, fitted)

    return options.attempted(work, path)


def _store(fitted: _Fitted, output: Path | None, report: Path | None) -> None:
    if output is not None:
        write_calibration(output, fitted.calibration)
    if report is not None:
        from ..report import write_calibration_page

        with working('drawing the page'):
            write_calibration_page(report, fitted.calibration, fitted.rating, str(fitted.path),
                                   stored=str(output or 'calibration.yaml'),
                                   notes=fitted.intake.lines)


def _in_a_line(result: dict[str, Any]) -> str:
    if 'error' in result:
        return f'{result["error"]}; {result["advice"]}'
    return (f'model {result["model"]}: {result["rms_before_mg"]:.3g} -> '
            f'{result["rms_after_mg"]:.3g} mg, {result["rating"]}')


def _show(args: argparse.Namespace, fitted: _Fitted) -> None:
    """Print the result."""
    console, calibration = options.console(args), fitted.calibration
    for line in fitted.intake.lines:
        console.print(line)
    show_calibration(console, calibration)
    console.print(f'model {calibration.name}: {calibration.reason}')
    asked = outlook(calibration, args.model).next_pose
    console.print(f'next pose: {asked.words}')
    for path in filter(None, (args.output, args.report)):
        console.print(f'stored in {path}')
    for line in fitted.rating.lines:
        console.print(line)
