# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The command ``accel-calib``.

Only the module of the requested command is imported, so that ``--help`` does not wait for numpy.

"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from importlib import import_module
import sys

from .. import __version__
from ..errors import AccelCalibError

BAD_INPUT = 2
INTERRUPTED = 130

COMMANDS = {
    'demo': 'demonstrate the calibration of a simulated Imu with the nodes, without hardware',
    'capture': 'find the still stretches of a recording and write the pose table',
    'fit': 'fit a calibration to still poses',
    'verify': 'evaluate a calibration on poses that it was not fitted to',
    'compare': 'test whether calibrations of one sensor agree within their uncertainties',
    'refine': 'find effects that a calibration lacks, and add them',
    'apply': 'correct a recording with a calibration',
    'simulate': 'simulate poses or a recording of a sensor with known effects',
    'report': 'write a report about effects that a calibration lacks, with figures (HTML)',
    'watch': 'show the progress of a calibrator node, and which pose is next',
    'node': 'run the calibrator node',
    'simulator': 'run the simulated Imu node',
}
"""Summary of each command."""

_MODULES = {'node': 'nodes', 'simulator': 'nodes'}


def parser(wanted: Collection[str] = tuple(COMMANDS)) -> argparse.ArgumentParser:
    """Return the parser of the command line, with the options of the wanted commands."""
    top = argparse.ArgumentParser(
        prog='accel-calib', description='Calibrate an accelerometer from still poses, with '
        'gravity as the reference.')
    top.add_argument('--version', action='version', version=__version__)
    commands = top.add_subparsers(title='commands', dest='command', metavar='COMMAND',
                                  required=True)
    for name, summary in COMMANDS.items():
        made = commands.add_parser(name, help=summary,
                                   description=f'{summary[0].upper()}{summary[1:]}.')
        if name in wanted:
            import_module(f'.{_MODULES.get(name, name)}', __package__).add_to(made)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Returns
    -------
    int
        Exit status: 0; 1 if a requested check fails; 2 for invalid input, with one line on
        standard error.

    """
    own, for_ros = _split(sys.argv[1:] if arguments is None else arguments)
    try:
        args = parser(own[:1]).parse_args(own)
    except KeyboardInterrupt:
        return INTERRUPTED
    args.for_ros = for_ros
    try:
        status: int = args.run(args)
    except AccelCalibError as err:
        return _refuse(args.command, str(err))
    except OSError as err:
        name = f'{err.filename}: ' if err.filename else ''
        reason = err.strerror or err
        return _refuse(args.command, f'{name}{reason}; check the name and the permissions')
    except KeyboardInterrupt:
        return INTERRUPTED
    return status


def _split(arguments: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Split the arguments into those of this program and those of ROS."""
    at = list(arguments).index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return arguments[:at], arguments[at:]


def _refuse(command: str, line: str) -> int:
    print(f'accel-calib {command}: {" ".join(line.split())}', file=sys.stderr)
    return BAD_INPUT


if __name__ == '__main__':
    sys.exit(main())
