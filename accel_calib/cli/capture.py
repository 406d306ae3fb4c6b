# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib capture``: from a recording to a pose table."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from . import options
from .terminal import progress
from ..capture import capture, Captured, CaptureSettings, REPEATED, settings_from
from ..intake import Intake, nothing_still
from ..logs import open_log, write_table
from ..text import counted
from ..units import Units

_EXAMPLE = 'accel-calib capture recording.mcap -o poses.csv'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recording', type=Path, metavar='RECORDING',
                      help='CSV in any dialect, rosbag2 folder, .mcap, .db3, ROS 1 .bag, PX4 '
                      '.ulg or ArduPilot .bin')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='FILE',
                      help='pose table to write')
    made.add_argument('--still-window', type=options.positive, metavar='S',
                      help='length of the sliding window [s]')
    made.add_argument('--still-std-max', type=options.positive, metavar='STD',
                      help='largest standard deviation of a still sensor, in the unit of ax '
                      '(default: adapts to the noise of the sensor)')
    made.add_argument('--still-gyro-max', type=options.positive, metavar='RAD/S',
                      help='largest mean angular rate (default: not checked)')
    made.add_argument('--still-norm-tolerance', type=options.positive, metavar='G',
                      help='largest difference of |mean| from 1 g')
    made.add_argument('--min-dwell', type=options.positive, metavar='S',
                      help='shortest still stretch that becomes a pose')
    made.add_argument('--min-pose-angle', type=options.positive, metavar='RAD',
                      help='poses within this angle count as repeated')
    made.add_argument('--repeated', choices=REPEATED,
                      help='keep, merge or refuse repeated poses (default: keep)')
    options.add_log(made)
    options.add_max_dwell(made)
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Capture and write the poses, and print their number."""
    with (open_log(args.recording, options.log_options(args)) as log,
          progress('samples') as moved):
        captured = capture(log.watched(moved), log.units, _settings(args, log.units))
        lines = Intake(captured.poses, log.units, log.read_as, log.notes).lines
    if len(captured.poses) == 0:
        raise nothing_still(str(args.recording), captured.recorded)
    write_table(args.output, replace(captured.poses, units=log.units.name))
    options.write_json(args.json, {
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'interruptions': [item._asdict() for item in captured.interruptions],
        'read_lines': lines})
    _show(args, captured, lines)
    return 0


def _show(args: argparse.Namespace, captured: Captured, lines: tuple[str, ...]) -> None:
    """Print the result."""
    console = options.console(args)
    for line in lines:
        console.print(line)
    console.print(f'{counted(len(captured.poses), "pose")} in {captured.seconds:.0f} s of '
                  f'{args.recording}, stored in {args.output}')
    for item in captured.interruptions:
        what = {'gap': f'samples are missing for {item.seconds:.3g} s',
                'jump_back': f'the stamps jump back by {-item.seconds:.3g} s',
                'stopped': 'the stamps do not change'}[item.kind]
        console.print(f'note: after {item.time:.3f} s {what}')


def _settings(args: argparse.Namespace, units: Units) -> CaptureSettings:
    """Return the settings from the options; other settings have their defaults."""
    names = ('still_window', 'still_std_max', 'still_gyro_max', 'still_norm_tolerance',
             'min_dwell', 'max_dwell', 'min_pose_angle', 'repeated')
    return settings_from({name: getattr(args, name) for name in names
                          if getattr(args, name) is not None}, units)
