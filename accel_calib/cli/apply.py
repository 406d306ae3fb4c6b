# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib apply``: correct a recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import options
from .progress import progress
from ..calibrate import Calibration, check_units, of_samples
from ..errors import InputError
from ..files import (
    check_sensor,
    correct_bag,
    is_bag,
    read_calibration,
    read_samples,
    write_table,
)

_EXAMPLE = 'accel-calib apply recording.mcap -c calibration.yaml -o corrected'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recording', type=Path, metavar='RECORDING',
                      help='CSV, rosbag2 folder, .mcap, .db3 or ROS 1 .bag')
    made.add_argument('-c', '--calibration', type=Path, required=True, metavar='FILE',
                      help='stored calibration')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='OUT',
                      help='a CSV table, or a new bag of the kind of the recording')
    made.add_argument('--topic', default='', help='Imu topic, for a bag with several')
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Correct, and report the number of samples."""
    calibration = read_calibration(args.calibration)
    if is_bag(args.recording):
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, args.topic, moved)
    else:
        count = _correct_table(args.recording, calibration, args.output)
    options.console(args).print(f'{count} samples corrected, stored in {args.output}',
                                markup=False)
    return 0


def _correct_table(path: Path, calibration: Calibration, out: Path) -> int:
    if out.exists() and out.samefile(path):
        raise InputError(f'{out} is the recording itself', 'give a new name')
    recording = read_samples(path)
    check_units(recording, calibration.units)
    check_sensor(calibration, recording.sensor)
    if recording.units not in ('', calibration.units.name):
        raise InputError(f'{path} is in {recording.units}, the calibration is for readings in '
                         f'{calibration.units.name}', 'give a recording in that unit')
    known = of_samples(recording.columns, len(recording))
    columns = {'reading': calibration.correct(recording.reading, known)}
    if 'rate' in recording:
        columns['rate'] = recording['rate'] @ calibration.model.rotation
    write_table(out, recording.with_columns(**columns))
    return len(recording)
