# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib simulate``: simulate poses or a recording with the forward model."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import options
from ..api import simulate
from ..effects import parse_effect
from ..errors import InputError
from ..logs import write_table
from ..text import counted

_EXAMPLE = ('accel-calib simulate -o poses.csv --effect offset=0.02,-0.01,0.03 '
            '--effect axis_gain=0.01')


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('-o', '--output', type=Path, required=True, metavar='OUT',
                      help='CSV table to write')
    made.add_argument('--effect', action='append', default=[], metavar='NAME=VALUE,...',
                      help='effect of the catalogue with its values, in g (offset), g/g (gains), '
                      'g/g2 (quadratic), ...; one value is used for all axes; can be repeated')
    made.add_argument('--recording', action='store_true',
                      help='write samples of a sensor that is turned, instead of pose means')
    made.add_argument('--poses', type=int, default=24, metavar='N',
                      help='number of poses (default: 24)')
    made.add_argument('--noise', type=float, default=0.003, metavar='G',
                      help='standard deviation of a sample [g] (default: 0.003)')
    made.add_argument('--samples', type=int, default=100, metavar='N',
                      help='samples per pose (default: 100)')
    made.add_argument('--rate', type=options.positive, default=100.0, metavar='HZ',
                      help='samples per second of a recording (default: 100)')
    made.add_argument('--dwell', type=options.positive, default=3.0, metavar='S',
                      help='duration of each rest of a recording (default: 3)')
    made.add_argument('--turn', type=options.positive, default=1.0, metavar='S',
                      help='duration of each turn of a recording (default: 1)')
    made.add_argument('--temperature', type=float, nargs=2, default=(), metavar=('FIRST', 'LAST'),
                      help='first and last temperature [degC]')
    made.add_argument('--mounting', type=float, nargs=3, default=(0.0, 0.0, 0.0),
                      metavar=('ROLL', 'PITCH', 'YAW'), help='attitude of the sensor on the robot '
                      '[deg]; the first pose is flat')
    made.add_argument('--reference', action='store_true',
                      help='write the true force, too (known orientation)')
    made.add_argument('--seed', type=int, default=0, help='seed of the noise (default: 0)')
    options.add_units(made, 'm/s2')
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate, and write the table."""
    if args.poses < 1 or args.samples < 1 or args.noise < 0.0:
        raise InputError(f'--poses is {args.poses}, --samples {args.samples} and --noise '
                         f'{args.noise}, expected at least 1, 1 and 0', 'correct these options')
    names = ('recording', 'poses', 'noise', 'samples', 'rate', 'dwell', 'turn', 'temperature',
             'mounting', 'reference', 'units', 'gravity', 'seed')
    table = simulate(dict(parse_effect(text) for text in args.effect),
                     **{name: getattr(args, name) for name in names})
    write_table(args.output, table)
    options.console(args).print(f'{counted(len(table), "row")}, stored in {args.output}')
    return 0
