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
from ..api import verify
from ..errors import AccelCalibError
from ..files import read_poses

_EXAMPLE = 'accel-calib verify other_poses.csv -c calibration.yaml'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES',
                      help='pose table (CSV), in the unit of the calibration')
    made.add_argument('-c', '--calibration', type=Path, required=True, metavar='FILE',
                      help='stored calibration')
    made.add_argument('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive')
    made.add_argument('--jobs', type=int, default=1, metavar='N',
                      help='number of tables to process in parallel')
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Verify, and print the result."""
    if len(args.poses) == 1:
        result = _verify(args, args.poses[0])
        options.write_json(args.json, result)
        results = [result]
    else:
        results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
        options.write_json(args.json, results)
    _show(args, results)
    return 2 if any('error' in result for result in results) else 0


def _verify(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    calibration = options.stored_calibration(args.calibration)
    poses = options.rows_between(read_poses(path), args.rows)
    return {'file': path, 'poses': len(poses), **asdict(verify(poses, calibration))}


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Verify on one of several tables; an error is returned as the result."""
    try:
        return _verify(args, path)
    except AccelCalibError as err:
        return {'file': path, 'error': err.message, 'advice': err.advice}
    except OSError as err:
        return {'file': path, 'error': f'{err.filename}: {err.strerror}',
                'advice': 'check the name and the permissions'}


def _show(args: argparse.Namespace, results: list[dict[str, Any]]) -> None:
    from rich.table import Table

    table = Table(title='Residual of |force| over these poses')
    for name in ('poses', 'before, mg', 'after, mg', 'largest after, mg',
                 'noise floor, mg'):
        table.add_column(name, justify='right')
    console = options.console(args)
    for result in results:
        if 'error' in result:
            console.print(f'{result["file"]}: {result["error"]}; {result["advice"]}',
                          markup=False)
            continue
        floor = result['noise_floor_mg']
        table.add_row(str(result['file']), f'{result["rms_before_mg"]:.3g}',
                      f'{result["rms_after_mg"]:.3g}', f'{result["max_after_percent"] * 10:.3g}',
                      'not known' if floor is None else f'{floor:.3g}')
    console.print(table)
