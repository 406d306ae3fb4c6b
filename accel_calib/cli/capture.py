# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib capture``: recording to pose table."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from . import options
from .progress import progress
from ..calibrate import check_units
from ..capture import capture, CaptureSettings
from ..capture.settings import REPEATED
from ..errors import InputError
from ..files import open_recording, Progress, Stream, write_table
from ..table import Recording
from ..units import Units, units_of

_EXAMPLE = 'accel-calib capture recording.mcap -o poses.csv'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recording', type=Path, metavar='RECORDING',
                      help='CSV, rosbag2 folder, .mcap, .db3 or ROS 1 .bag')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='FILE',
                      help='pose table to write')
    made.add_argument('--topic', default='', help='Imu topic, where a bag has several')
    made.add_argument('--still-window', type=options.positive, metavar='S',
                      help='length of the sliding window [s]')
    made.add_argument('--still-std-max', type=options.positive, metavar='STD',
                      help='largest standard deviation of a still sensor, in the unit of ax '
                      '(default: adapts to the noise of the sensor)')
    made.add_argument('--still-gyro-max', type=options.positive, metavar='RAD/S',
                      help='largest mean angular rate (default: not looked at)')
    made.add_argument('--still-norm-tolerance', type=options.positive, metavar='G',
                      help='largest distance of |mean| from 1 g')
    made.add_argument('--min-dwell', type=options.positive, metavar='S',
                      help='shortest still stretch that makes a pose')
    made.add_argument('--max-dwell', type=options.positive, metavar='S',
                      help='cut a longer stretch into poses that share their orientation')
    made.add_argument('--min-pose-angle', type=options.positive, metavar='RAD',
                      help='poses within this angle count as repeated')
    made.add_argument('--repeated', choices=REPEATED,
                      help='what becomes of a repeated pose (default: keep)')
    options.add_units(made)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Capture, write the poses, and say how many there are."""
    with open_recording(args.recording, args.topic) as stream, progress('samples') as told:
        units = units_of(stream.units or args.units, args.gravity)
        captured = capture(_blocks(stream, units, told), units, _settings(args, units))
    if len(captured.poses) == 0:
        raise InputError(f'{args.recording} has no still stretch in {captured.recorded} samples',
                         'hold the sensor still in each pose for some seconds, or give '
                         '--still-std-max and --min-dwell')
    write_table(args.output, captured.poses)
    options.write_json(args.json, {
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'interruptions': [item._asdict() for item in captured.interruptions]})
    console = options.say(args)
    console.print(f'{len(captured.poses)} poses in {captured.seconds:.0f} s of '
                  f'{args.recording}, stored in {args.output}', markup=False)
    for item in captured.interruptions:
        console.print(f'note: at {item.time:.3f} s the stamps have a {item.kind} of '
                      f'{item.seconds:.3g} s', markup=False)
    return 0


def _blocks(stream: Stream, units: Units, told: Progress) -> Iterator[Recording]:
    """Hand on the blocks, check the unit by the first, and tell how far it is."""
    done = 0
    for block in stream.blocks:
        if not done:
            check_units(block, units)
        yield block
        done += len(block)
        told(done, stream.samples)


def _settings(args: argparse.Namespace, units: Units) -> CaptureSettings:
    """Give the settings that were asked for, the others as they are by default."""
    names = ('still_window', 'still_std_max', 'still_gyro_max', 'still_norm_tolerance',
             'min_dwell', 'max_dwell', 'min_pose_angle', 'repeated')
    asked = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    if 'still_std_max' in asked:
        asked['still_std_max'] = units.to_g(asked['still_std_max'])
    try:
        return CaptureSettings(**asked)
    except ValueError as err:
        raise InputError(str(err), 'change that option') from err
