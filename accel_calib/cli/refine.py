# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib refine``: find what a calibration still lacks, name it, and add it."""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from . import options
from .story import in_a_line, refine_result, steps_table
from ..calibrate import Calibration
from ..capture import capture, CaptureSettings
from ..errors import AccelCalibError, InputError
from ..files import (
    check_sensor,
    is_bag,
    read_calibration,
    read_poses,
    read_recording,
    write_calibration,
)
from ..refine import BASES, refine, Refinement
from ..report import check_matplotlib, write_page
from ..report.words import gap_words, verdict_words
from ..table import Poses, Recording
from ..units import Units, units_of

_EXAMPLE = 'accel-calib refine poses.csv -o refined.yaml --report report.html'
_SAMPLES_APART_S = 0.5
_MANY_ROWS = 5000


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('poses', nargs='+', type=Path, metavar='POSES',
                      help='pose table (CSV), or a recording: bags, and tables of samples')
    made.add_argument('-o', '--output', type=Path, metavar='FILE',
                      help='where to store the refined calibration (YAML); a folder for several '
                      'POSES')
    made.add_argument('--report', type=Path, metavar='FILE',
                      help='page with figures to write (HTML); a folder for several POSES')
    made.add_argument('--jobs', type=int, default=1, metavar='N', help='N tables at a time')
    add_inputs(made)
    options.add_json(made)
    made.set_defaults(run=run)


def add_inputs(made: argparse.ArgumentParser) -> None:
    """Add the options that say what to refine, and from where."""
    base = made.add_mutually_exclusive_group()
    base.add_argument('-c', '--calibration', type=Path, metavar='FILE',
                      help='stored calibration to begin with; its units win')
    base.add_argument('--base', choices=BASES, default='auto',
                      help='model to begin with (default: what fit --model auto would take)')
    made.add_argument('--rows', metavar='A:B', help='use these rows alone, from 1, both ends held')
    made.add_argument('--sensor', default='', help='which sensor this is (frame_id of its Imu)')
    made.add_argument('--topic', default='', help='Imu topic, where a bag has several')
    made.add_argument('--max-dwell', type=options.positive, metavar='S',
                      help='of a recording: cut longer rests into poses that share their '
                      'orientation')
    options.add_units(made)


def run(args: argparse.Namespace) -> int:
    """Refine, store, and tell the story."""
    if args.report is not None:
        check_matplotlib()
    for option, path in (('-o', args.output), ('--report', args.report)):
        if path is not None:
            _check_target(option, path, len(args.poses))
    if len(args.poses) == 1:
        return _run_one(args)
    results = options.in_parallel(partial(_attempt, args), args.poses, args.jobs)
    options.write_json(args.json, results)
    console = options.say(args)
    for result in results:
        console.print(f'{result["file"]}: {in_a_line(result)}', markup=False)
    return 2 if any('error' in result for result in results) else 0


def _check_target(option: str, path: Path, count: int) -> None:
    """Make sure, before the work, that there is a folder to write into."""
    if count > 1 and not path.is_dir():
        raise InputError(f'{option} {path} is not a folder, and there are {count} tables',
                         'give a folder that is there')
    if count == 1 and not path.parent.is_dir():
        raise InputError(f'{option} {path}: {path.parent} is not a folder',
                         'give a name in a folder that is there')


def _run_one(args: argparse.Namespace) -> int:
    path = args.poses[0]
    try:
        result = refine_file(args, path)
    except AccelCalibError as err:
        options.write_json(args.json, {'file': path, 'error': err.message, 'advice': err.advice})
        raise
    _store(result, path, args.output, args.report)
    options.write_json(args.json, {'file': path, **refine_result(result)})
    _show(args, result)
    return 0


def _attempt(args: argparse.Namespace, path: Path) -> dict[str, Any]:
    """Refine with one of several tables; what is wrong with it becomes its result."""
    try:
        result = refine_file(args, path)
        _store(result, path, args.output and args.output / f'{path.stem}.yaml',
               args.report and args.report / f'{path.stem}.html')
    except AccelCalibError as err:
        return {'file': str(path), 'error': err.message, 'advice': err.advice}
    except OSError as err:
        return {'file': str(path), 'error': f'{path}: {err.strerror}', 'advice': 'check its name'}
    made: dict[str, Any] = options.plain({'file': path, **refine_result(result)})
    return made


def refine_file(args: argparse.Namespace, path: Path) -> Refinement:
    """Refine with one table or recording as the options say."""
    base: str | Calibration = args.base
    units = options.units_from(args)
    if args.calibration is not None:
        base = read_calibration(args.calibration)
        units = base.units
    poses, units, sensor = _poses_from(args, path, units)
    sensor = args.sensor or sensor
    if isinstance(base, Calibration):
        check_sensor(base, sensor)
    date = datetime.now(timezone.utc).isoformat(timespec='seconds')
    return refine(options.rows_between(poses, args.rows), units, base=base, sensor=sensor,
                  date=date)


def _poses_from(args: argparse.Namespace, path: Path, units: Units) -> tuple[Poses, Units, str]:
    """Give the poses of a table or of a recording, their unit and their sensor."""
    if not is_bag(path):
        table = read_poses(path)
        if not _are_samples(table):
            return table, units, ''
        return _captured(args, Recording(table.columns, table.row), units), units, ''
    source = read_recording(path, args.topic)
    if source.units and args.calibration is None:
        units = units_of(source.units, args.gravity)
    return _captured(args, source.recording, units), units, source.sensor


def _are_samples(table: Poses) -> bool:
    """Tell samples from poses: times, no count, and rows too close or too many for poses."""
    if 'time' not in table or 'count' in table or len(table) < 2:
        return False
    apart = float(np.median(np.diff(table['time'])))
    return apart < _SAMPLES_APART_S or len(table) > _MANY_ROWS


def _captured(args: argparse.Namespace, recording: Recording, units: Units) -> Poses:
    settings = CaptureSettings()
    if args.max_dwell is not None:
        try:
            settings = replace(settings, max_dwell=args.max_dwell)
        except ValueError as err:
            raise InputError(str(err), 'change --max-dwell') from err
    return capture(recording, units, settings).poses


def _store(result: Refinement, source: Path, output: Path | None, report: Path | None) -> None:
    if report is not None:
        write_page(report, result, str(source))
    if output is not None:
        write_calibration(output, result.calibration)


def _show(args: argparse.Namespace, result: Refinement) -> None:
    """Tell a person the story."""
    console = options.say(args)
    if result.steps:
        console.print(steps_table(result), soft_wrap=False)
    console.print(f'{verdict_words(result)}\n{gap_words(result)}', markup=False)
    if result.disturbed_poses:
        rows = ', '.join(str(row) for row in result.disturbed_poses)
        console.print(f'left out as disturbed: rows {rows}', markup=False)
    for line in result.advice:
        console.print(f'advice: {line}', markup=False)
    if result.not_testable:
        names = ', '.join(effect for effect, _ in result.not_testable)
        console.print(f'these data cannot show: {names}', markup=False)
    for path in (args.output, args.report):
        if path is not None:
            console.print(f'stored in {path}', markup=False)
