# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib export``: write a calibration in the format of where it is used."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
import sys
from typing import Any

from . import options
from .targets import check_one, Target
from .terminal import Output
from ..disk import write_atomically
from ..errors import InputError
from ..stored.exports import export, Exported, FORMATS, identifier, Options, read_noise

_STANDARD_OUTPUT = '-'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    formats = '\n'.join(f'  {name:<11}{each.what}' for name, each in FORMATS.items())
    options.add_example(made, 'accel-calib export calibration.yaml --to c -o imu.h\n'
                        f'formats:\n{formats}')
    made.add_argument('calibration', type=Path, metavar='CALIBRATION', help='stored calibration')
    made.add_argument('--to', required=True, choices=tuple(FORMATS), metavar='FORMAT',
                      help='format, see below')
    made.add_argument('-o', '--output', metavar='FILE', help='file to write; - for standard '
                      'output (default: beside the calibration, named after it)')
    made.add_argument('--name', default='', help='c, arduino: first part of the names in the '
                      'header (default: from the name of the calibration)')
    made.add_argument('--noise', type=Path, metavar='FILE', help='kalibr, vins: result of '
                      'accel-calib noise --json')
    made.add_argument('--instance', type=int, metavar='N', help='px4, ardupilot: number of the '
                      'accelerometer (default: px4 0, ardupilot 1)')
    made.add_argument('--device-id', type=int, metavar='ID', help='px4, ardupilot: device id of '
                      'the accelerometer')
    made.add_argument('--axes', choices=('same', 'flu'), default='same', help='px4, ardupilot, '
                      'betaflight: axes of the readings; same: of the flight controller; flu: x '
                      'forward, y left, z up, for readings from ROS (default: %(default)s)')
    made.add_argument('--counts-per-g', type=options.positive, metavar='COUNTS', help='betaflight:'
                      ' acc_1G of the driver (default: 2048, or the power of two nearest to the '
                      'native units)')
    options.add_json(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Write the file, and print what it does not hold."""
    if args.output == _STANDARD_OUTPUT == args.json:
        raise InputError('-o and --json are both -, expected one of them on standard output',
                         'give one of them the name of a file')
    calibration = options.stored_calibration(args.calibration)
    chosen = Options(args.name or _name(args), args.instance, args.device_id, args.axes,
                     args.counts_per_g)
    noise = None if args.noise is None else read_noise(args.noise)
    made = export(calibration, args.to, noise, chosen)
    target = _target(args, made)
    _write(target, made)
    options.write_json(args.json, _result(args, target, made))
    _show(made, target)
    return 0


def _name(args: argparse.Namespace) -> str:
    """Return the name of the functions, from the name of the file to write."""
    named = args.output if args.output not in (None, _STANDARD_OUTPUT) else args.calibration
    return identifier(Path(named).stem)


def _target(args: argparse.Namespace, made: Exported) -> Path | None:
    """
    Return the file to write; None: standard output.

    Raises
    ------
    InputError
        If it is the calibration itself.

    """
    if args.output == _STANDARD_OUTPUT:
        return None
    if args.output is None:
        target = args.calibration.with_name(f'{args.calibration.stem}{made.suffix}')
    else:
        target = Path(args.output)
    check_one(Target('-o', target, 'export'), [args.calibration], force=args.force)
    return target


def _write(target: Path | None, made: Exported) -> None:
    """Write the content to a file, or to standard output."""
    if target is None:
        sys.stdout.flush()
        made.write(sys.stdout)
        sys.stdout.flush()
    else:
        write_atomically(target, made.write)


def _result(args: argparse.Namespace, target: Path | None, made: Exported) -> dict[str, Any]:
    """Return the result for JSON."""
    return {'format': args.to, 'file': target, 'calibration': args.calibration,
            'leaves_mg': made.leaves_mg, 'losses': [asdict(loss) for loss in made.details],
            'notes': made.notes}


def _show(made: Exported, target: Path | None) -> None:
    """Print what the file does not hold, and its name, on standard error."""
    console = Output(stderr=True)
    for line in made.losses:
        console.print(line)
    for note in made.notes:
        console.print(f'note: {note}')
    if target is not None:
        console.print(f'stored in {target}')
