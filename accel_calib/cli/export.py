# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib export``: write a calibration in the format of where it is used."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from .frame import check_target, Done, Output, Target
from .inputs import given, stored_calibration
from ..disk import STANDARD_OUTPUT, write_atomically
from ..stored.exports import export, Exported, identifier, Options, read_noise


def run_export(args: argparse.Namespace) -> Done:
    """Write the file, and print what it does not hold on standard error."""
    calibration = stored_calibration(args.calibration)
    chosen = Options(**{**given(Options, args), 'name': args.name or _name(args)})
    noise = None if args.noise is None else read_noise(args.noise)
    made = export(calibration, args.to, noise, chosen)
    target = _target(args, made)
    write_atomically(target, made.write)
    console, is_file = Output(stderr=True), args.output != STANDARD_OUTPUT
    for line in (*made.losses, *(f'note: {note}' for note in made.notes),
                 *([f'stored in {target}'] if is_file else [])):
        console.print(line)
    return Done({'format': args.to, 'file': target if is_file else None,
                 'calibration': args.calibration, 'leaves_mg': made.leaves_mg,
                 'losses': [asdict(loss) for loss in made.details], 'notes': made.notes})


def _name(args: argparse.Namespace) -> str:
    """Return the name of the functions, from the name of the file to write."""
    named = args.output if args.output not in (None, STANDARD_OUTPUT) else args.calibration
    return identifier(Path(named).stem)


def _target(args: argparse.Namespace, made: Exported) -> Path:
    """Return the file to write."""
    if args.output == STANDARD_OUTPUT:
        return Path(args.output)
    target = (args.calibration.with_name(f'{args.calibration.stem}{made.suffix}')
              if args.output is None else Path(args.output))
    check_target(Target('-o', target, 'export'), [args.calibration], force=args.force)
    return target
