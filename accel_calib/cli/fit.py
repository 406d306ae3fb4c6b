# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib fit``: from poses to a calibration."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from . import options
from .results import fit_result, gyro_line, parameter_table, quality_table
from ..calibrate import (
    Calibration,
    fit_poses,
    FRAMES,
    level_by_rows,
    METHODS,
    MODEL_NAMES,
    outlook,
)
from ..errors import AccelCalibError, InputError
from ..files import read_poses, write_calibration
from ..words import now

_EXAMPLE = 'accel-calib fit poses.csv -o calibration.yaml --flat 1'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES', help='pose table (CSV)')
    made.add_argument('-o', '--output', type=Path, metavar='FILE',
                      help='calibration to write (YAML); a folder for several POSES')
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
    made.add_argument('--sensor', default='',
                      help='name of the sensor (frame_id of its messages; default: the name in '
                      'the table)')
    made.add_argument('--jobs', type=int, default=1, metavar='N',
                      help='number of tables to process in parallel')
    options.add_units(made)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fit and store, and print the quality."""
    if len(args.poses) == 1:
        return _run_one(args)
    if args.output is not None and not args.output.is_dir():
        raise InputError(f'-o {args.output} is not a folder, expected a folder for '
                         f'{len(args.poses)} pose tables', 'use an existing folder')
    results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
    options.write_json(args.json, results)
    console = options.console(args)
    for result in results:
        console.print(result['file'], _in_a_line(result), markup=False)
    return 2 if any('error' in result for result in results) else 0


def _run_one(args: argparse.Namespace) -> int:
    try:
        calibration = fit_file(args, args.poses[0])
    except AccelCalibError as err:
        options.write_json(args.json, {'error': err.message, 'advice': err.advice})
        raise
    _store(calibration, args.output)
    options.write_json(args.json, {'file': args.poses[0], **fit_result(calibration, args.model)})
    _show(args, calibration)
    return 0


def fit_file(args: argparse.Namespace, path: Path) -> Calibration:
    """Fit one pose table with the given options."""
    table = read_poses(path)
    units = options.units_from(args, table.units, path)
    calibration = fit_poses(options.rows_between(table, args.rows), units, model=args.model,
                            method=args.method, sensor=args.sensor, date=now())
    return level_by_rows(calibration, table, args.frame, args.flat, args.nose_down)


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Fit one of several pose tables; an error is returned as the result."""
    try:
        calibration = fit_file(args, path)
        _store(calibration, args.output and args.output / f'{path.stem}.yaml')
    except AccelCalibError as err:
        return {'file': path, 'error': err.message, 'advice': err.advice}
    except OSError as err:
        return {'file': path, 'error': f'{path}: {err.strerror}',
                'advice': 'check the name and the permissions'}
    result: dict[str, Any] = options.plain({'file': path, **fit_result(calibration, args.model)})
    return result


def _store(calibration: Calibration, output: Path | None) -> None:
    if output is not None:
        write_calibration(output, calibration)


def _in_a_line(result: dict[str, Any]) -> str:
    if 'error' in result:
        return f'{result["error"]}; {result["advice"]}'
    return (f'model {result["model"]}: {result["rms_before_mg"]:.3g} -> '
            f'{result["rms_after_mg"]:.3g} mg')


def _show(args: argparse.Namespace, calibration: Calibration) -> None:
    """Print the result."""
    console = options.console(args)
    console.print(quality_table(calibration))
    console.print(parameter_table(calibration))
    console.print(f'model {calibration.name}: {calibration.reason}', markup=False)
    if calibration.gyro is not None:
        console.print(gyro_line(calibration.gyro), markup=False)
    for rejected in calibration.rejected:
        console.print(f'left out: row {rejected.row}: {rejected.reason}', markup=False)
    for warning in calibration.warnings:
        console.print(f'note: {warning}', markup=False)
    asked = outlook(calibration, args.model).next_pose
    console.print(f'next pose: {asked.words}', markup=False)
    if args.output is not None:
        console.print(f'stored in {args.output}', markup=False)
