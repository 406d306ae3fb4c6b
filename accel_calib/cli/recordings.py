# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib capture``, ``apply``, ``simulate``, ``export``: files to files."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from inspect import signature
from pathlib import Path

from .frame import (
    check_target, Done, given, log_options, read_lines, settings, stored_calibration, Target)
from .output import Output, progress
from ..disk import STANDARD_OUTPUT, write_atomically
from ..effects import parse_effect
from ..errors import InputError
from ..logs import is_bag, open_log, write_blocks, write_table
from ..pipeline import captured_from, Correction
from ..text import counted


def run_capture(args: argparse.Namespace) -> Done:
    """Find the still stretches of a recording, and write the poses."""
    with progress('samples') as moved:
        found, captured = captured_from(args.recording, log_options(args), settings(args), moved)
    write_table(args.output, found.poses)
    lines = [*found.lines, *(f'note: {each.words}' for each in found.poses.findings)]
    for item in captured.interruptions:
        what = {'gap': f'samples are missing for {item.seconds:.3g} s',
                'jump_back': f'the stamps jump back by {-item.seconds:.3g} s',
                'stopped': 'the stamps do not change'}[item.kind]
        lines.append(f'note: after {item.time:.3f} s {what}')
    return Done({
        'poses': len(captured.poses), 'samples': captured.recorded,
        'samples_in_poses': captured.samples,
        'threshold': captured.threshold, 'seconds': captured.seconds,
        'rests': [{'start': each.start, 'end': each.end, 'taken': not each.reason,
                   'reason': each.words} for each in captured.rests],
        'findings': [each.stated for each in found.poses.findings],
        'interruptions': [item._asdict() for item in captured.interruptions],
        'read_lines': replace(found, captured=found.captured[1:]).lines},
        lines, stored=[args.output])


def run_apply(args: argparse.Namespace) -> Done:
    """Correct a recording."""
    calibration = stored_calibration(args.calibration, args.own)
    if args.no_rotate:
        calibration = calibration.in_sensor_frame
    lines, notes = list[str](), list[str]()
    if isinstance(args.recording, Path) and is_bag(args.recording):
        from ..messages import correct_bag

        if str(args.output) == STANDARD_OUTPUT:
            raise InputError('a bag cannot be written to standard output, expected a file',
                             'name a file with -o')
        with progress('messages') as moved:
            count = correct_bag(args.recording, calibration, args.output, log_options(args),
                                moved, notes.append)
    else:
        with (open_log(args.recording, log_options(args, calibration)) as log,
              progress('samples') as moved):
            correction = Correction(calibration, log.units, log.sensor)
            blocks = log.watched(moved) if log.poses is None else (log.poses,)
            count = write_blocks(args.output, map(correction, blocks))
            lines += read_lines(log)
        notes += correction.notes
    return Done(shown=[*lines, *(f'note: {note}' for note in notes),
                       f'corrected {counted(count, "sample")}'], stored=[args.output])


def run_simulate(args: argparse.Namespace) -> Done:
    """Simulate poses or a recording, and write the table."""
    from ..api import simulate

    chosen = {name: getattr(args, name) for name in signature(simulate).parameters
              if hasattr(args, name) and name != 'also'}
    effects = dict(parse_effect(text, args.own) for text in args.effect)
    table = simulate(effects, also=args.own, **chosen)
    write_table(args.output, table)
    return Done(shown=[counted(len(table), 'row')], stored=[args.output])


def run_export(args: argparse.Namespace) -> Done:
    """Write the file, and print what it does not hold on standard error."""
    from ..stored.exports import export, identifier, Options, read_noise

    calibration = stored_calibration(args.calibration, args.own)
    is_file = args.output != STANDARD_OUTPUT
    named = args.output if is_file and args.output is not None else args.calibration
    chosen = Options(**{**given(Options, args), 'name': args.name or identifier(Path(named).stem)})
    noise = None if args.noise is None else read_noise(args.noise)
    made = export(calibration, args.to, noise, chosen)
    target = (args.calibration.with_name(f'{args.calibration.stem}{made.suffix}')
              if args.output is None else Path(args.output))
    if is_file:
        check_target(Target('output', target, 'export', '-o'), [args.calibration],
                     force=args.force)
    write_atomically(target, made.write)
    console = Output(stderr=True)
    for line in (*made.losses, *(f'note: {note}' for note in made.notes),
                 *([f'stored in {target}'] if is_file else [])):
        console.print(line)
    return Done({'format': args.to, 'file': target if is_file else None,
                 'calibration': args.calibration, 'leaves_mg': made.leaves_mg,
                 'losses': [asdict(loss) for loss in made.details], 'notes': made.notes})
