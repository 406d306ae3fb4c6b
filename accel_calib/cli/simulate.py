# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib simulate``: poses or a recording from the forward model."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from . import options
from ..errors import InputError
from ..files import write_table
from ..model import Model
from ..simulate import model_with, parse_effect, simulate_poses, simulate_recording
from ..sphere import rotation_from_rpy, spread_directions
from ..table import Floats, Poses, Recording
from ..units import Units

_EXAMPLE = ('accel-calib simulate -o poses.csv --effect offset=0.02,-0.01,0.03 '
            '--effect axis_gain=0.01')


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.add_argument('-o', '--output', type=Path, required=True, metavar='OUT',
                      help='CSV table to write')
    made.add_argument('--effect', action='append', default=[], metavar='NAME=VALUE,...',
                      help='an effect of the catalogue with its values, in g (offset), g/g '
                      '(gains), g/g2 (quadratic), ...; one value serves all axes; may be given '
                      'again')
    made.add_argument('--recording', action='store_true',
                      help='write samples of a sensor that is turned, not pose means')
    made.add_argument('--poses', type=int, default=24, metavar='N', help='poses (default: 24)')
    made.add_argument('--noise', type=float, default=0.003, metavar='G',
                      help='standard deviation of a sample [g] (default: 0.003)')
    made.add_argument('--samples', type=int, default=100, metavar='N',
                      help='samples a pose (default: 100)')
    made.add_argument('--rate', type=options.positive, default=100.0, metavar='HZ',
                      help='samples a second of a recording (default: 100)')
    made.add_argument('--dwell', type=options.positive, default=3.0, metavar='S',
                      help='rest in each pose of a recording (default: 3)')
    made.add_argument('--turn', type=options.positive, default=1.0, metavar='S',
                      help='turn between poses of a recording (default: 1)')
    made.add_argument('--temperature', type=float, nargs=2, metavar=('FIRST', 'LAST'),
                      help='temperature, moving from the one to the other [degC]')
    made.add_argument('--mounting', type=float, nargs=3, default=(0.0, 0.0, 0.0),
                      metavar=('ROLL', 'PITCH', 'YAW'), help='of the sensor on the robot '
                      '[deg]; the first pose is flat')
    made.add_argument('--reference', action='store_true',
                      help='write the true force too (known orientation)')
    made.add_argument('--seed', type=int, default=0, help='of the noise (default: 0)')
    options.add_units(made)
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate and write."""
    if args.poses < 1 or args.samples < 1 or args.noise < 0.0:
        raise InputError(f'--poses {args.poses}, --samples {args.samples}, --noise {args.noise}',
                         'give at least one pose of one sample, and noise of 0 or more')
    table: Poses | Recording = _recording(args) if args.recording else _poses(args)
    write_table(args.output, _in_units(table, options.units_from(args)))
    options.say(args).print(f'{len(table)} rows, stored in {args.output}', markup=False)
    return 0


def _setting(args: argparse.Namespace) -> tuple[Model, Floats, np.random.Generator]:
    """Give the sensor, the directions of its poses, and the source of noise."""
    effects = dict(parse_effect(text) for text in args.effect)
    # ΔR takes the robot's axes to the sensor's; the attitude of the sensor is the way back.
    model = model_with(effects, rotation_from_rpy(*np.radians(args.mounting)).T)
    flat = np.array([[0.0, 0.0, 1.0]])
    directions = np.vstack([flat, spread_directions(args.poses)[1:]])
    return model, directions, np.random.default_rng(args.seed)


def _poses(args: argparse.Namespace) -> Poses:
    model, directions, rng = _setting(args)
    context = {'reference': directions} if args.reference else {}
    if args.temperature:
        context['temperature'] = np.linspace(args.temperature[0], args.temperature[1], args.poses)
    return simulate_poses(model, directions, rng, noise_g=args.noise, samples=args.samples,
                          context=context)


def _recording(args: argparse.Namespace) -> Recording:
    model, directions, rng = _setting(args)
    recording = simulate_recording(
        model, directions, rng, noise_g=args.noise, rate_hz=args.rate, dwell=args.dwell,
        turn=args.turn, temperatures=args.temperature or ())
    if args.reference:
        return recording
    columns = {key: values for key, values in recording.columns.items() if key != 'reference'}
    return type(recording)(columns, recording.row)


def _in_units(table: Poses | Recording, units: Units) -> Poses | Recording:
    """Give a table in g in the unit that was asked for."""
    scaled = {key: units.from_g(table[key]) for key in ('reading', 'std', 'reference')
              if key in table}
    return table.with_columns(**scaled)
