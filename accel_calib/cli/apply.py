# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib apply``: correct a recording."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from . import options
from .terminal import progress
from ..calibrate import (
    Calibration,
    check_sensor,
    joined_ranges,
    of_samples,
    Outside,
    outside,
    thermal_stream,
)
from ..effects import Context
from ..logs import is_bag, open_log, write_blocks
from ..messages import correct_bag
from ..table import Poses, Recording
from ..text import counted
from ..units import UnitName

_EXAMPLE = 'accel-calib apply recording.mcap -c calibration.yaml -o corrected'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('recording', type=Path, metavar='RECORDING',
                      help='any log: CSV, rosbag2 folder, .mcap, .db3, ROS 1 .bag, …')
    made.add_argument('-c', '--calibration', type=Path, required=True, metavar='FILE',
                      help='stored calibration')
    made.add_argument('-o', '--output', type=Path, required=True, metavar='OUT',
                      help='CSV table or bag to write, of the same kind as the recording')
    made.add_argument('--no-rotate', action='store_true', help='correct offset and gain alone, '
                      'and stay in the frame of the sensor; otherwise a levelled calibration '
                      'turns everything in a message, and its frame_id ends with _levelled')
    options.add_log(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Correct the recording, and print the number of samples."""
    calibration = options.stored_calibration(args.calibration)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    left: list[Outside] = []
    lines: list[str] = []
    if is_bag(args.recording):
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, args.topic, moved,
                                left.append, note=lambda line: lines.append(f'note: {line}'),
                                temperature_topic=args.temperature_topic,
                                supply_topic=args.supply_topic, units=args.units or 'm/s2',
                                gravity=args.gravity)
    else:
        count = _correct_table(args, calibration, left.append, lines)
    console = options.console(args)
    for line in (*lines, *(f'note: {each.line}' for each in left)):
        console.print(line)
    console.print(f'corrected {counted(count, "sample")}, stored in {args.output}')
    return 0


def _correct_table(args: argparse.Namespace, calibration: Calibration,
                   report: Callable[[Outside], object], lines: list[str]) -> int:
    """Correct a log that is not a bag; how it was read is added to the lines."""
    path, out = args.recording, args.output
    with (open_log(path, options.log_options_for(args, calibration)) as log,
          progress('samples') as moved):
        calibration = calibration.in_units(log.units)
        check_sensor(calibration, log.sensor)
        correction = _Correction(calibration)
        blocks = log.watched(moved) if log.poses is None else (log.poses,)
        count = write_blocks(out, map(correction, blocks))
        lines += [f'read as: {log.read_as}'] if log.read_as else []
        lines += [f'note: {line}' for line in log.notes]
    for each in correction.outside.values():
        if each.count:
            report(each)
    return count


class _Correction:
    """The correction of the blocks of a log, in order."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._thermal = thermal_stream(calibration.model)
        self.outside: dict[str, Outside] = {}

    def __call__(self, block: Poses | Recording) -> Poses | Recording:
        """Return a corrected block."""
        calibration = self._calibration
        known = of_samples(block.columns, len(block), calibration.model, self._thermal)
        self.outside = joined_ranges(self.outside, outside(calibration, known))
        return _corrected(block, calibration, known)


def _corrected(table: Poses | Recording, calibration: Calibration, known: Context
               ) -> Poses | Recording:
    """Return a table with the corrected readings, in m/s² or g."""
    columns = {'reading': calibration.correct(table.reading, known)}
    units: UnitName = 'g' if calibration.units.name == 'native' else calibration.units.name
    if 'rate' in table:
        columns['rate'] = table['rate'] @ calibration.model.rotation
    if 'std' in table:
        columns['std'] = calibration.units.to_g(table['std']) * calibration.force_per_g
    return replace(table.with_columns(**columns), units=units)
