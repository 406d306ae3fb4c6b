# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The command ``accel-calib``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import sys

from . import apply, capture, demo, fit, nodes, refine, report, simulate, verify
from .. import __version__
from ..errors import AccelCalibError

BAD_INPUT = 2
INTERRUPTED = 130


def parser() -> argparse.ArgumentParser:
    """Make the parser of the whole command line."""
    top = argparse.ArgumentParser(
        prog='accel-calib', description='Calibrate an accelerometer from still poses: all that '
        'is needed is that gravity is 1 g.')
    top.add_argument('--version', action='version', version=__version__)
    commands = top.add_subparsers(title='commands', dest='command', metavar='COMMAND',
                                  required=True)
    for command in (demo, capture, fit, verify, refine, apply, simulate, report, nodes):
        command.add_to(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Returns
    -------
    int
        0, or 2 after bad input, with one line on standard error.

    """
    own, for_ros = nodes.split(sys.argv[1:] if arguments is None else arguments)
    args = parser().parse_args(own)
    args.for_ros = for_ros
    try:
        status: int = args.run(args)
    except AccelCalibError as err:
        return _refuse(args.command, str(err))
    except OSError as err:
        name = f'{err.filename}: ' if err.filename else ''
        return _refuse(args.command, f'{name}{err.strerror or err}; check name and permissions')
    except KeyboardInterrupt:
        return INTERRUPTED
    return status


def _refuse(command: str, line: str) -> int:
    print(f'accel-calib {command}: {" ".join(line.split())}', file=sys.stderr)
    return BAD_INPUT


if __name__ == '__main__':
    sys.exit(main())
