# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands, with the options of each.

Each has its options as entries, as `accel_calib.cli.options` describes them.

"""

import argparse
from collections.abc import Collection
from functools import partial
from pathlib import Path
import re
import shlex
from typing import NamedTuple, TYPE_CHECKING

from .options import (
    add_options, any_log, BASE, CAPTURE, count, late, LOG, option, Options, outputs, Parser, poses,
    positive, report, shared, source, STANDARD_INPUT, stored, units)
from .. import __version__

if TYPE_CHECKING:
    from ..finding import NextStep


class Command(NamedTuple):
    """
    A command.

    `module` of this folder has the function ``run_NAME``. `example` is the end of the help; its
    first line is an example, without ``accel-calib NAME``. `writes` is the kind of the file that
    ``-o`` names, empty for any, and `about` the argument that an error in JSON is about.

    """

    summary: str
    module: str
    example: str
    options: Options = ()
    writes: str = ''
    about: str = ''

    def add_to(self, made: Parser) -> None:
        """Add the options and the example to a parser."""
        add_options(made, self.options)
        known = {action.dest for action in made._actions}
        add_options(made, shared(
            *(['--force'] if known & {'output', 'json'} else ()),
            *(['--also'] if known & {'calibration', 'calibrations', 'effect', 'refined'} else ())))
        made.epilog = f'example:\n  {made.prog} {self.example}'
        made.formatter_class = argparse.RawDescriptionHelpFormatter
        if 'to' in known:
            from ..stored.exports import FORMATS

            made.epilog = '\n'.join([f'{made.epilog}\nformats:', *(
                f'  {name:<11}{each.what}' for name, each in FORMATS.items())])


_NOT_CARRIED = ('json', 'jobs', 'report', 'plan', 'figures', 'force', 'verbose')
"""Options of one run, which a following command does not take over."""


def command_line(name: str, args: argparse.Namespace, **changed: object) -> str:
    """Return the line of a command with the options of another one, where it has them."""
    made = Parser(add_help=False)
    COMMANDS[name].add_to(made)
    values = {**vars(args), **changed}
    words = ['accel-calib', name]
    for action in made._actions:
        value = values.get(action.dest)
        if action.dest not in _NOT_CARRIED and value not in (None, action.default):
            words += [*action.option_strings[:1], *([] if action.nargs == 0 else _words(value))]
    return shlex.join(words)


def _words(value: object) -> list[str]:
    """Return the value of an option as words of a command line."""
    from ..logs import Piped

    if not isinstance(value, list):
        return [STANDARD_INPUT if isinstance(value, Piped) else str(value)]
    columns = [f'{ours}={theirs}' for each in value if isinstance(each, dict)
               for ours, theirs in each.items()]
    return [','.join(columns)] if columns else [word for each in value for word in _words(each)]


def next_command(step: 'NextStep', args: argparse.Namespace) -> str:
    """Return the command of the next step after a command; empty if hands are needed."""
    log = getattr(args, 'log', None) or getattr(args, 'poses', None)
    written, base = getattr(args, 'output', None), getattr(args, 'calibration', None)
    # A calibration that was only read is not replaced.
    beside = Path('calibration.yaml') if base is None else base.with_stem(f'{base.stem}_new')
    files = {'poses': log, 'log': log, 'output': written or beside}
    match step.kind:
        case 'fit' | 'refine' if log:
            return command_line(step.kind, args, **files)
        # No command levels a calibration and keeps what it has from other poses or of some rows.
        case 'level' if base is None and args.command in ('fit', 'calibrate', 'refine', 'thermal'):
            name = 'calibrate' if args.command == 'refine' else args.command
            if name == 'calibrate' and getattr(args, 'rows', None):
                return ''
            return command_line(name, args, **files, flat=next(iter(step.rows), 'ROW'))
        case 'verify' if written or base:
            return command_line('verify', args, poses='NEW_POSES', calibration=written or base)
    return ''


def _regex(text: str) -> str:
    try:
        re.compile(text)
    except re.error as err:
        raise argparse.ArgumentTypeError(f'{text}: {err}, expected a regular expression') from None
    return text


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port <= 65535:
        raise argparse.ArgumentTypeError(f'{text}: expected a number from 0 to 65535')
    return port


_FROM_LOGS: Options = (
    option('-o', '--output', type=Path, default=Path('calibration.yaml'), metavar='FILE',
           help='calibration to write (default: %(default)s); the page has the same name with '
           '.html'),
    *shared('--flat', '--nose-down', '--frame', '--keep-bad'))
"""Options of a command from logs to a calibration and a page beside it."""

_CALIBRATIONS: Options = (
    option('calibrations', nargs='+', type=Path, metavar='CALIBRATION',
           help='two or more stored calibrations of one sensor, in any order'),
    report(), *shared('--json'))

_FLEET = ('--prior', '--sensor-model')
_OUTPUT = {'type': Path, 'required': True}
_EXPORT = {'of': late('stored.exports', 'Options')}

HIDDEN = {
    'temperature': 'offset_temperature=4e-4,-3e-4,5e-4',
    'temperature-lag': 'offset_temperature=8e-4,-6e-4,1e-3,12,0',
    'gain-temperature': 'gain_temperature=5e-4,-4e-4,6e-4',
    'quadratic': 'quadratic=0.004,-0.003,0.005'}
"""What the sensor can hide, as effects of the simulator. The lag is that of the die, 12 s."""

_PORT = late('session', 'WEB_PORT')
_ALONE = late('stored.exports', 'CALIBRATION_ALONE')
_FOR_ROS = 'all arguments after --ros-args are passed to ROS'

COMMANDS = {
    'demo': Command(
        'demonstrate the calibration of a simulated Imu with the nodes, without hardware',
        'nodes', '--hidden temperature', (
            option('--hidden', choices=HIDDEN, help='let the sensor hide this effect, and show '
                   'that ~/refine finds it and that the corrected topic gets better'),
            option('--web', action='store_true',
                   help=partial(lambda: 'calibrate on the live page instead, at port '
                                f'{_PORT()}, until Ctrl-C')),
            *shared('--json'))),
    'calibrate': Command(
        'make a calibration, a page and a verdict from any log', 'fit', 'log.csv --flat last', (
            source('log', any_log('recording or pose table: ')),
            *_FROM_LOGS, *shared(*_FLEET, '--no-refine', '--verbose', '--json'), *LOG, *CAPTURE),
        writes='calibration', about='log'),
    'thermal': Command(
        'fit the offset over temperature to logs of a still board that warms up', 'fit',
        'warm_up.ulg poses.ulg -o calibration.yaml', (
            source('logs', 'log of a still board whose temperature changes; several are fitted '
                   'together, and one of them may be of poses in many directions', nargs='+',
                   metavar='LOG'),
            *_FROM_LOGS, *shared('--verbose', '--json'), *LOG, *CAPTURE),
        writes='calibration', about='logs'),
    'capture': Command(
        'find the still stretches of a recording and write the pose table', 'fit',
        'recording.mcap -o poses.csv', (
            source('recording', any_log()),
            option('-o', '--output', metavar='FILE', help='pose table to write; - for standard '
                   'output', **_OUTPUT),
            *CAPTURE, *LOG, *shared('--json')), writes='table'),
    'fit': Command(
        'fit a calibration to still poses', 'fit', 'poses.csv -o calibration.yaml --flat 1', (
            *poses(), *outputs('calibration'),
            option('--model', choices=late('units', 'MODEL_NAMES'), default='auto',
                   help='4: offset, gain; 7: gain by axis; 9: angles of the axes; 10: cross-axis; '
                   '12: known orientation; auto (default): the smallest that the data support'),
            option('--method', choices=late('units', 'METHODS'), default='ml',
                   help='ml (default) weights poses by their noise and leaves out outliers; '
                   "algebraic minimises the cost functions of AN5286 and the ESGI'95 report, with "
                   'every row'),
            *shared('--flat', '--nose-down', '--frame', '--keep-bad', *_FLEET, '--verbose')),
        writes='calibration'),
    'verify': Command(
        'evaluate a calibration on poses that it was not fitted to', 'compare',
        'other_log.csv -c calibration.yaml --max 5\n'
        'exit status:\n  0: within --max, 1: above --max or BAD, 2: bad input', (
            *poses(), stored(required=True),
            option('--max', type=positive, metavar='MG', help='largest residual (RMS) of the '
                   'corrected poses [mg]; exit status 1 above it'),
            report('page to write (HTML); a folder for several POSES'),
            *shared('--jobs', '--json'))),
    'compare': Command(
        'test whether calibrations of one sensor agree within their uncertainties', 'compare',
        'monday.yaml tuesday.yaml wednesday.yaml\n'
        'exit status:\n  0: they agree, 1: they do not agree, 2: they cannot be compared',
        _CALIBRATIONS),
    'history': Command(
        'show offset and gain over the dates of calibrations of one sensor', 'compare',
        'january.yaml april.yaml july.yaml --report history.html', _CALIBRATIONS),
    'refine': Command(
        'find effects that a calibration lacks, and add them', 'fit',
        'poses.csv -o refined.yaml --report report.html', (
            *poses(), *BASE, *outputs('refined calibration', 'report'),
            *shared('--keep-bad', '--verbose'),
            option('--plan', type=Path, metavar='FILE', help='poses to take next, which separate '
                   'the named effects from their rivals (CSV); not written if there is nothing to '
                   'separate; a folder for several POSES')),
        writes='calibration', about='poses'),
    'fleet': Command(
        'calibrate the recordings of many sensors in parallel, on Dask', 'fit',
        'recordings/ -o results/\n'
        "  accel-calib fleet 's3://fleet/*.mcap' -o results/ --scheduler tcp://10.0.0.1:8786", (
            option('recordings', nargs='+', metavar='RECORDINGS', help='recordings, pose tables, '
                   'folders, globs in quotes, lists (@list.txt), or addresses such as '
                   's3://bucket/folder'),
            option('-o', '--output', metavar='FOLDER', help='folder of the results; all workers '
                   'must see it', **_OUTPUT),
            option('--scheduler', default='', metavar='ADDRESS', help='address of a Dask '
                   'scheduler (default: a cluster on this machine)'),
            option('--workers', type=count, metavar='N', help='workers on this machine (default: '
                   'one per core)'),
            option('--sensor-from', type=_regex, default='', metavar='REGEX',
                   help='take the name of the sensor from the path: the groups, or the whole '
                   'match (default: the folder and the name in the file)'),
            option('--model-from', type=_regex, default='', metavar='REGEX',
                   help='take the model of the sensor from its name'),
            option('--time-limit', type=positive, metavar='S', help='longest time of one '
                   'recording; one that takes longer is a row with an error, and is tried again '
                   'by the next run (default: 900 s)'),
            option('--export', action='append', default=[], metavar='FORMAT', choices=_ALONE,
                   help=partial(lambda: 'write each calibration in this format, too; can be '
                                f'repeated: {", ".join(_ALONE())}')),
            *LOG, *CAPTURE, *shared('--no-refine', '--json'))),
    'apply': Command(
        'correct a recording with a calibration', 'fit',
        'recording.mcap -c calibration.yaml -o corrected', (
            source('recording', any_log()), stored(required=True),
            option('-o', '--output', metavar='OUT', help='CSV table or bag to write, of the same '
                   'kind as the recording; - for a table on standard output', **_OUTPUT),
            option('--no-rotate', action='store_true', help='correct offset and gain alone, and '
                   'stay in the frame of the sensor; otherwise a levelled calibration turns '
                   'everything in a message, and its frame_id ends with _levelled'),
            *LOG), writes='table'),
    'export': Command(
        'write a calibration in the format of a firmware, an autopilot or another tool',
        'fit', 'calibration.yaml --to c -o imu.h', (
            option('calibration', type=Path, metavar='CALIBRATION', help='stored calibration; - '
                   'for standard input'),
            option('--to', required=True, choices=late('stored.exports', 'FORMATS'),
                   metavar='FORMAT', help='format, see below'),
            option('-o', '--output', metavar='FILE', help='file to write; - for standard output '
                   '(default: beside the calibration, named after it)'),
            option('--noise', type=Path, metavar='FILE', help='kalibr, vins, openvins: result of '
                   'accel-calib noise --json'),
            option('--name', help='c, arduino, mpu6050: first part of the names in the header '
                   '(default: from the name of the calibration)', **_EXPORT),
            option('--instance', metavar='N', help='px4, ardupilot: number of the accelerometer '
                   '(default: px4 0, ardupilot 1)', **_EXPORT),
            option('--device-id', metavar='ID', help='px4, ardupilot: device id of the '
                   'accelerometer', **_EXPORT),
            option('--axes', choices=('same', 'flu'), help='px4, ardupilot, betaflight, inav, '
                   'mpu6050: axes of the readings; same: of the flight controller; flu: x '
                   'forward, y left, z up, for readings from ROS (default: %(default)s)',
                   **_EXPORT),
            option('--counts-per-g', metavar='COUNTS', help='betaflight, inav: acc_1G of the '
                   'driver; mpu6050: counts per g of native readings (default: 2048, or the power '
                   'of two nearest to the native units)', **_EXPORT),
            *shared('--json')), writes='export'),
    'noise': Command(
        'find noise density, bias instability and random walk from a long rest', 'compare',
        'rest.mcap --json noise.json --report noise.html', (
            source('recording', any_log('recording with a long rest: ')),
            stored('stored calibration to apply first, for readings in counts or volts'),
            report('page to write with the Allan deviation and the figures (HTML)'), *LOG,
            *shared('--json'))),
    'simulate': Command(
        'simulate poses or a recording of a sensor with known effects', 'fit',
        '-o poses.csv --effect offset=0.02,-0.01,0.03 --effect axis_gain=0.01', (
            option('-o', '--output', metavar='OUT', help='CSV table to write; - for standard '
                   'output', **_OUTPUT),
            option('--effect', action='append', default=[], metavar='NAME=VALUE,...',
                   help='effect of the catalogue with its values, in g (offset), g/g (gains), '
                   'g/g2 (quadratic), ...; one value is used for all axes; can be repeated'),
            option('--recording', action='store_true', help='write samples of a sensor that is '
                   'turned, instead of pose means'),
            *(option(f'--{name}', type=kind, default=default, metavar=metavar,
                     help=f'{about} (default: {default:g})')
              for name, kind, default, metavar, about in (
                  ('poses', int, 24, 'N', 'number of poses'),
                  ('noise', float, 0.003, 'G', 'standard deviation of a sample [g]'),
                  ('samples', int, 100, 'N', 'samples per pose'),
                  ('rate', positive, 100.0, 'HZ', 'samples per second of a recording'),
                  ('dwell', positive, 3.0, 'S', 'duration of each rest of a recording'),
                  ('turn', positive, 1.0, 'S', 'duration of each turn of a recording'),
                  ('seed', int, 0, None, 'seed of the noise'))),
            option('--temperature', type=float, nargs=2, default=(), metavar=('FIRST', 'LAST'),
                   help='first and last temperature [degC]'),
            option('--mounting', type=float, nargs=3, default=(0.0, 0.0, 0.0),
                   metavar=('ROLL', 'PITCH', 'YAW'), help='attitude of the sensor on the robot '
                   '[deg]; the first pose is flat'),
            option('--reference', action='store_true', help='write the true force, too (known '
                   'orientation)'),
            *units('m/s2')), writes='table'),
    'report': Command(
        'write a report about effects that a calibration lacks, with figures (HTML)', 'fit',
        'poses.csv -o report.html --figures figures', (
            *poses(None), *BASE,
            option('-o', '--output', metavar='FILE', help='report to write (HTML)', **_OUTPUT),
            option('--figures', type=Path, metavar='FOLDER', help='folder for the figures as SVG '
                   'and PNG')), writes='page'),
    'watch': Command(
        'show the progress of a calibrator node, and which pose is next', 'nodes',
        f'--node left/calibrator\n\nCtrl-C ends it; {_FOR_ROS}', (
            option('--node', default='calibrator', metavar='NAME', help='name of the calibrator '
                   'node, with its namespace if it has one (default: %(default)s)'),
            option('--once', action='store_true', help='print the progress once, and end'),
            option('--no-bell', dest='bell', action='store_false', help='no terminal bell for '
                   'captured poses'))),
    'live': Command(
        'calibrate on a page in the browser, from a serial port or a recording', 'nodes',
        '/dev/ttyUSB0 --baud 115200 -o calibration.yaml\n\n'
        'open the link that it prints in a browser; Ctrl-C ends it', (
            option('source', metavar='LOG-OR-PORT', help='recording to play in real time; or '
                   'serial port that sends one line for each sample, such as t,ax,ay,az'),
            option('-o', '--output', type=Path, default=Path('calibration.yaml'), metavar='FILE',
                   help='calibration to continue and to store (default: %(default)s)'),
            option('--port', type=_port, default=_PORT, help='port of the page; 0: any free port '
                   '(default: %(default)s)'),
            option('--host', default='127.0.0.1', metavar='ADDRESS', help='address at which the '
                   'page is served; 0.0.0.0: to the whole network, without encryption (default: '
                   '%(default)s)'),
            option('--baud', type=count, default=115200, help='baud rate of the serial port '
                   '(default: %(default)s)'),
            option('--speed', type=positive, default=1.0, help='speed of a recording, relative to '
                   'real time (default: %(default)s)'),
            *LOG, *CAPTURE, *shared('--also')), writes='calibration'),
    'node': Command(
        'run the calibrator node', 'nodes', f'--ros-args -r imu/data_raw:=/imu/raw\n\n{_FOR_ROS}'),
    'simulator': Command(
        'run the simulated Imu node', 'nodes', f'--ros-args -p poses:=12\n\n{_FOR_ROS}'),
}


def parser(wanted: Collection[str] = tuple(COMMANDS)) -> Parser:
    """Return the parser of the command line, with the options of the wanted commands."""
    top = Parser(
        prog='accel-calib', description='Calibrate an accelerometer from still poses, with '
        'gravity as the reference.')
    top.add_argument('--version', action='version', version=__version__)
    commands = top.add_subparsers(title='commands', dest='command', metavar='COMMAND')
    for name, command in COMMANDS.items():
        what = command.summary
        made = commands.add_parser(name, help=what, description=f'{what[0].upper()}{what[1:]}.')
        if name in wanted:
            command.add_to(made)
    return top
