# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib capture``, ``apply`` and ``simulate``: commands that write a table or a bag."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from inspect import signature

from .frame import Done, progress
from .inputs import log_options, settings, stored_calibration
from ..calibrate import (
    Calibration,
    check_sensor,
    joined_ranges,
    of_samples,
    Outside,
    outside,
    thermal_stream,
)
from ..capture import capture, Captured, settings_from
from ..effects import Context, parse_effect
from ..errors import InputError
from ..intake import Intake, nothing_still
from ..logs import is_bag, open_log, write_blocks, write_table
from ..table import Poses, Recording
from ..text import counted
from ..units import UnitName


def run_capture(args: argparse.Namespace) -> Done:
    """Find the still stretches of a recording, and write the poses."""
    with open_log(args.recording, log_options(args)) as log, progress('samples') as moved:
        captured = capture(log.watched(moved), log.units, settings_from(settings(args), log.units))
        lines = Intake(captured.poses, log.units, log.read_as, log.notes).lines
    if len(captured.poses) == 0:
        raise nothing_still(str(args.recording), captured.recorded)
    write_table(args.output, replace(captured.poses, units=log.units.name))
    return Done({
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'interruptions': [item._asdict() for item in captured.interruptions],
        'read_lines': lines}, [*lines, *_captured_lines(args, captured)])


def _captured_lines(args: argparse.Namespace, captured: Captured) -> Iterator[str]:
    yield (f'{counted(len(captured.poses), "pose")} in {captured.seconds:.0f} s of '
           f'{args.recording}, stored in {args.output}')
    for item in captured.interruptions:
        what = {'gap': f'samples are missing for {item.seconds:.3g} s',
                'jump_back': f'the stamps jump back by {-item.seconds:.3g} s',
                'stopped': 'the stamps do not change'}[item.kind]
        yield f'note: after {item.time:.3f} s {what}'


def run_apply(args: argparse.Namespace) -> Done:
    """Correct a recording."""
    calibration = stored_calibration(args.calibration)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    left: list[Outside] = []
    lines: list[str] = []
    if is_bag(args.recording):
        from ..messages import correct_bag

        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, args.topic, moved,
                                left.append, note=lambda line: lines.append(f'note: {line}'),
                                temperature_topic=args.temperature_topic,
                                supply_topic=args.supply_topic, units=args.units or 'm/s2',
                                gravity=args.gravity)
    else:
        count = _correct_table(args, calibration, left.append, lines)
    return Done(shown=[*lines, *(f'note: {each.line}' for each in left),
                       f'corrected {counted(count, "sample")}, stored in {args.output}'])


def _correct_table(args: argparse.Namespace, calibration: Calibration,
                   report: Callable[[Outside], object], lines: list[str]) -> int:
    """Correct a log that is not a bag; how it was read is added to the lines."""
    path, out = args.recording, args.output
    with (open_log(path, log_options(args, calibration)) as log,
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


def run_simulate(args: argparse.Namespace) -> Done:
    """Simulate poses or a recording, and write the table."""
    from ..api import simulate

    if args.poses < 1 or args.samples < 1 or args.noise < 0.0:
        raise InputError(f'--poses is {args.poses}, --samples {args.samples} and --noise '
                         f'{args.noise}, expected at least 1, 1 and 0', 'correct these options')
    chosen = {name: getattr(args, name) for name in signature(simulate).parameters
              if hasattr(args, name)}
    table = simulate(dict(parse_effect(text) for text in args.effect), **chosen)
    write_table(args.output, table)
    return Done(shown=[f'{counted(len(table), "row")}, stored in {args.output}'])
