# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# PYTHON_ARGCOMPLETE_OK
"""
The command ``accel-calib``.

Only what the requested command needs is imported, so that ``--help`` does not wait for numpy.

"""

from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
from difflib import get_close_matches
import os
import re
import sys
from typing import NoReturn

from .commands import add_options, BAD_INPUT, COMMANDS
from .terminal import in_one_line, use_plain_characters
from .. import __version__
from ..errors import AccelCalibError, crash_words, system_error

INTERRUPTED = 130


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with the nearest known name."""

    def error(self, message: str) -> NoReturn:
        """Print one line, and exit with status 2."""
        known = self._known()
        given = message.partition(' (choose')[0]
        wrong = re.findall(r"'([^']+)'", given) or given.split()
        near = [name for word in wrong if word not in known
                for name in get_close_matches(word, known, 1)]
        meant = f' (did you mean {near[0]}?)' if near else ''
        self.exit(BAD_INPUT, f'{self.prog}: {in_one_line(message)}{meant}; see {self.prog} '
                  '--help\n')

    def parse_command(self, arguments: Sequence[str], command: str) -> argparse.Namespace:
        """Parse arguments; the parser of the command reports unknown options."""
        args, unknown = self.parse_known_args(arguments)
        if unknown:
            own = next((action.choices[command] for action in self._actions
                        if isinstance(action.choices, dict) and command in action.choices), self)
            own.error(f'unrecognized arguments: {" ".join(unknown)}')
        return args

    def _known(self) -> list[str]:
        """Return the options and the choices of this parser."""
        return [str(name) for action in self._actions
                for name in (*action.option_strings, *(action.choices or ()))]


def parser(wanted: Collection[str] = tuple(COMMANDS)) -> _Parser:
    """Return the parser of the command line, with the options of the wanted commands."""
    top = _Parser(
        prog='accel-calib', description='Calibrate an accelerometer from still poses, with '
        'gravity as the reference.')
    top.add_argument('--version', action='version', version=__version__)
    commands = top.add_subparsers(title='commands', dest='command', metavar='COMMAND')
    for name, command in COMMANDS.items():
        what = command.summary
        made = commands.add_parser(name, help=what, description=f'{what[0].upper()}{what[1:]}.')
        if name in wanted:
            add_options(made, command)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    Returns
    -------
    int
        Exit status: 0; 1 if a requested check fails; 2 for invalid input or an internal error,
        with one line on standard error.

    """
    use_plain_characters()
    if '_ARGCOMPLETE' in os.environ:
        _complete()
    own, for_ros = _split(sys.argv[1:] if arguments is None else arguments)
    try:
        top = parser(own[:1])
        args = top.parse_command(own, own[0] if own else '')
    except KeyboardInterrupt:
        return INTERRUPTED
    if not args.command:
        top.print_help()
        return 0
    args.for_ros = for_ros
    try:
        from .frame import run  # imports numpy and rich

        return run(args)
    except AccelCalibError as err:
        return _refuse(args.command, str(err))
    except OSError as err:
        return _refuse(args.command, str(system_error(err)))
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as err:  # a defect of this program, which no user should see as a traceback
        return _refuse(args.command, crash_words(err))


def _complete() -> None:
    """Print the completions that the shell asks for, and exit."""
    try:
        import argcomplete
    except ImportError:
        return  # the shell then shows no completions
    argcomplete.autocomplete(parser())


def _split(arguments: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Split the arguments into those of this program and those of ROS."""
    at = list(arguments).index('--ros-args') if '--ros-args' in arguments else len(arguments)
    return arguments[:at], arguments[at:]


def _refuse(command: str, line: str) -> int:
    print(f'accel-calib {command}: {in_one_line(line)}', file=sys.stderr)
    return BAD_INPUT


if __name__ == '__main__':
    sys.exit(main())
