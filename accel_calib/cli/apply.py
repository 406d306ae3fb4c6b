# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib apply``: correct a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from . import options
from .options import progress
from ..calibrate import (
    Calibration,
    check_sensor,
    check_units,
    of_samples,
    Outside,
    outside,
)
from ..errors import counted, InputError
from ..files import correct_bag, is_bag, read_samples, write_table
from ..units import UnitName

_EXAMPLE = 'accel-calib apply recording.mcap -c calibration.yaml -o corrected'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recording', type=Path, metavar='RECORDING',
                      help='CSV, rosbag2 folder, .mcap, .db3 or ROS 1 .bag')
    made.add_argument('-c', '--calibration', type=Path, required=True, metavar='FILE',
                      help='stored calibration')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='OUT',
                      help='CSV table or bag to write, of the same kind as the recording')
    made.add_argument('--no-rotate', action='store_true', help='correct offset and gain alone, '
                      'and stay in the frame of the sensor; otherwise a levelled calibration '
                      'turns everything in a message, and its frame_id ends with _levelled')
    made.add_argument('--topic', default='', help='Imu topic, for a bag with several Imu topics')
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Correct the recording, and print the number of samples."""
    calibration = options.stored_calibration(args.calibration)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    left: list[Outside] = []
    if is_bag(args.recording):
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, args.topic, moved,
                                left.append)
    else:
        count = _correct_table(args.recording, calibration, args.output, left.append)
    console = options.console(args)
    for each in left:
        console.print(f'note: {each.line}', markup=False)
    console.print(f'corrected {counted(count, "sample")}, stored in {args.output}', markup=False)
    return 0


def _correct_table(path: Path, calibration: Calibration, out: Path,
                   report: Callable[[Outside], object]) -> int:
    if out.exists() and out.samefile(path):
        raise InputError(f'{out} is the recording itself, expected another file',
                         'choose another name')
    recording = read_samples(path)
    check_units(recording, calibration.units)
    check_sensor(calibration, recording.sensor)
    if recording.units not in ('', calibration.units.name):
        raise InputError(f'{path} is in {recording.units}, but the calibration is for readings in '
                         f'{calibration.units.name}', 'use a recording in that unit')
    known = of_samples(recording.columns, len(recording), calibration.model)
    for each in outside(calibration, known).values():
        if each.count:
            report(each)
    columns = {'reading': calibration.correct(recording.reading, known)}
    units: UnitName = 'g' if calibration.units.name == 'native' else calibration.units.name
    if 'rate' in recording:
        columns['rate'] = recording['rate'] @ calibration.model.rotation
    write_table(out, replace(recording.with_columns(**columns), units=units))
    return len(recording)
