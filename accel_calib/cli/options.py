# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Options that several commands have, and the parser, whose errors are one line of plain characters.

Each option is stated once. Options that fill a record have the names, types and defaults of its
fields; `accel_calib.cli.frame.given` has their values.

"""

import argparse
import codecs
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
import re
import sys
from typing import Any, get_type_hints, NoReturn

BAD_INPUT = 2
"""Exit status for invalid input."""

STANDARD_INPUT = '-'

_PLAIN = {'±': '+-', '°': ' deg', '²': '2', '³': '3', '⁻': '-', '¹': '1', '−': '-',
          '–': '-', '·': '*', '×': 'x', '…': '...', '→': '->', '≤': '<=', '≥': '>=', '√': 'sqrt ',
          'Δ': 'D', 'σ': 'sigma', 'τ': 'tau', 'ω': 'omega', 'µ': 'u', 'μ': 'u', '█': '#', '│': '|',
          '─': '-', '✓': 'ok'}
"""Replacements for an output that has not these characters."""

_HANDLER = 'accel_calib.plain'


@cache
def plain_handler() -> str:
    """Return the name of the error handler that replaces characters an encoding lacks."""
    codecs.register_error(_HANDLER, _replace)
    return _HANDLER


def _replace(error: UnicodeError) -> tuple[str, int]:
    """Return the replacement for characters that the encoding lacks, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return ''.join(map(plain_character, error.object[error.start:error.end])), error.end


def plain_character(character: str) -> str:
    """Return the replacement of a character: ASCII without control characters."""
    return _PLAIN.get(character) or character.encode('unicode_escape').decode('ascii')


def in_one_line(text: str) -> str:
    """Return text as one line without control characters."""
    return ''.join(each if each.isprintable() else plain_character(each)
                   for each in ' '.join(text.split()))


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with the nearest known name."""

    def error(self, message: str) -> NoReturn:
        """Print one line, and exit with status 2."""
        known = [str(name) for action in self._actions
                 for name in (*action.option_strings, *(action.choices or ()))]
        given = message.partition(' (choose')[0]
        wrong = re.findall(r"'([^']+)'", given) or [
            word.rstrip(':') for word in given.split() if word.startswith('-')]
        near = [name for word in wrong if word not in known
                for name in get_close_matches(word, known, 1)]
        meant = f' (did you mean {near[0]}?)' if near else ''
        self.exit(BAD_INPUT, f'{self.prog}: {in_one_line(message)}{meant}; see {self.prog} '
                  '--help\n')

    def parse_command(self, arguments: Sequence[str], command: str) -> argparse.Namespace:
        """Parse arguments; the parser of the command reports unknown options."""
        if any('\0' in each for each in arguments):
            self.error('an argument has the character NUL, expected text')
        args, unknown = self.parse_known_args(arguments)
        if unknown:
            own = next((action.choices[command] for action in self._actions
                        if isinstance(action.choices, dict) and command in action.choices), self)
            own.error(f'unrecognized arguments: {" ".join(unknown)}')
        return args


def positive(text: str) -> float:
    """Return a positive number from an argument."""
    value = float(text)
    if not 0.0 < value < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}: expected a positive number')
    return value


def utf8(text: str) -> str:
    """Return an argument that can be stored: text in UTF-8."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f'{text!a}: expected text in UTF-8') from None
    return text


def log_path(text: str) -> Any:
    """Return the path of a log; for ``-``, what comes through standard input."""
    if text != STANDARD_INPUT:
        return Path(text)
    from ..logs import Piped

    if sys.stdin.isatty():
        raise argparse.ArgumentTypeError('- is standard input, which is a terminal, expected a '
                                         'log through a pipe')
    return Piped(sys.stdin.buffer.read())


def _columns(text: str) -> dict[str, str]:
    from ..table import COLUMNS

    pairs = [part.partition('=') for part in text.split(',')]
    names = [name for column in COLUMNS.values() for name in column.names if not column.made]
    for ours, equals, _ in pairs:
        if ours.strip() not in names or not equals:
            raise argparse.ArgumentTypeError(f'{text}: expected NAME=COLUMN with a name of '
                                             f'{", ".join(names)}')
    return {ours.strip(): theirs.strip() for ours, _, theirs in pairs}


_TYPES: dict[Any, Any] = {float: positive, float | None: positive, int | None: int}
"""Types of options by those of the fields of records; others are text."""

_SHARED: dict[str, dict[str, Any]] = {
    '--rows': {'metavar': 'A:B', 'help': 'rows A to B, 1-based, inclusive'},
    '--jobs': {'type': int, 'default': 1, 'metavar': 'N',
               'help': 'number of tables to process in parallel'},
    '--nose-down': {'type': int, 'metavar': 'ROW', 'help': 'row of a pose with the nose of the '
                    'robot tilted straight down, by 10° or more; it determines the heading of the '
                    'mounting (needs --flat)'},
    '--no-refine': {'dest': 'refined', 'action': 'store_false', 'help': 'do not look for effects '
                    'beyond offset, gain and cross-axis'},
    '--prior': {'type': Path, 'metavar': 'FLEET', 'help': 'typical values of a fleet (fleet.yaml '
                'of accel-calib fleet) for offset, gain and cross-axis, for few poses'},
    '--sensor-model': {'default': '', 'metavar': 'NAME', 'help': 'model of the sensor in the file '
                       'of --prior, if it has several'},
    '--keep-bad': {'action': 'store_true', 'help': 'store a calibration that is BAD, too'},
    '--also': {'type': Path, 'metavar': 'FILE.py', 'help': 'Python file with own effects '
               '(accel_calib.Effect), which are known beside the catalogue; it is executed'},
    '--verbose': {'action': 'store_true', 'help': 'print all notes and tables'},
    '--json': {'metavar': 'FILE', 'help': 'JSON file to write with the result; - for standard '
               'output'},
    '--force': {'action': 'store_true', 'help': 'replace files of other kinds, too'}}
"""Options of several commands."""


def share(made: Any, *names: str) -> None:
    """Add options of several commands to a parser or a group."""
    for name in names:
        made.add_argument(name, **_SHARED[name])


def add_fields(made: Any, record: Any, options: Mapping[str, Mapping[str, Any]],
               **usual: Any) -> None:
    """Add options for fields of a record to a parser or a group, with types and defaults."""
    types = get_type_hints(record)
    for name, about in options.items():
        kind = ({'action': 'store_true'} if types[name] is bool else
                {'default': record.__dataclass_fields__[name].default,
                 'type': _TYPES.get(types[name], utf8)})
        made.add_argument(f'--{name.replace("_", "-")}', **{**kind, **usual, **about})


def units(default: str = '') -> dict[str, dict[str, Any]]:
    """Return the options of the unit; without a default, the file states the unit."""
    from ..units import UNIT_NAMES

    return {
        'units': {'choices': UNIT_NAMES, 'default': default, 'help': 'unit of ax,ay,az; native '
                  'is counts or volts (default: '
                  f'{default or "the unit in the file, or recognised"})'},
        'gravity': {'metavar': 'M/S2', 'help': 'local gravity [m/s2] (default: %(default)s)'}}


def add_log(made: Parser) -> None:
    """Add the options for reading a log."""
    from ..logs import LogOptions, NAMES

    add_fields(made, LogOptions, {
        'format': {'choices': NAMES, 'help': 'layout of the log (default: it is recognised)'},
        'columns': {'type': _columns, 'action': 'append', 'default': [],
                    'metavar': 'OURS=THEIRS,...', 'help': 'columns by their name or number in the '
                    'log, such as time=t_ms,ax=accX,ay=accY,az=accZ'},
        'skip_bad': {'help': 'skip lines that cannot be read'},
        'rate': {'metavar': 'HZ', 'help': 'samples per second of a log without times'},
        'topic': {'help': 'Imu topic of a bag, message of a flight log, or table of an '
                  'archive or Excel file, if there are several'},
        'sensor': {'help': 'name of the sensor: frame_id of its messages, or its number in a '
                   'flight log (default: the name in the log)'},
        'context': {'action': 'append', 'default': [], 'metavar': 'COLUMN:=TOPIC[/FIELD]',
                    'help': 'topic of a bag with a number that may act on the sensor, such as '
                    'temperature:=/imu/temp; can be repeated'},
        **units()})


def add_capture(made: Parser) -> None:
    """Add the options of the capture of poses; none of them has a value by default."""
    from ..stillness import CaptureSettings, REPEATED

    group = made.add_argument_group('capture of poses from a recording')
    add_fields(group, CaptureSettings, {
        'still_window': {'metavar': 'S', 'help': 'length of the sliding window [s]'},
        'still_std_max': {'metavar': 'STD', 'help': 'largest standard deviation of a still '
                          'sensor, in the unit of ax (default: adapts to the noise of the '
                          'sensor)'},
        'still_gyro_max': {'metavar': 'RAD/S', 'help': 'largest mean angular rate (default: not '
                           'checked)'},
        'still_norm_tolerance': {'metavar': 'G', 'help': 'largest difference of |a| from '
                                 '1 g, beside what all rests have in common'},
        'min_dwell': {'metavar': 'S', 'help': 'shortest still stretch that becomes a pose'},
        'max_dwell': {'metavar': 'S', 'help': 'split longer rests into poses with the same '
                      'orientation'},
        'min_pose_angle': {'metavar': 'RAD', 'help': 'poses within this angle count as repeated'},
        'repeated': {'choices': REPEATED, 'help': 'keep, merge or refuse repeated poses'}},
        default=None)


def add_source(made: Parser, name: str, about: str, **more: Any) -> None:
    """Add the argument for a log, which can come through standard input."""
    made.add_argument(name, type=log_path, help=f'{about}; - for standard input',
                      **{'metavar': name.upper(), **more})


def add_poses(made: Parser, number: str | None = '+') -> None:
    """Add the options for reading the poses of one or several logs."""
    add_source(made, 'poses', 'pose table, or a recording, whose poses are captured first',
               nargs=number)
    share(made, '--rows')
    add_log(made)
    add_capture(made)


def add_outputs(made: Parser, output: str, page: str = 'page') -> None:
    """Add the options for the files that a command writes for one or several POSES."""
    made.add_argument('-o', '--output', type=Path, metavar='FILE',
                      help=f'{output} to write (YAML); - for standard output; a folder for '
                      'several POSES')
    add_page(made, f'{page} to write (HTML); a folder for several POSES')
    share(made, '--jobs', '--json')


def add_page(made: Parser, about: str = 'page to write (HTML)') -> None:
    """Add ``--report``."""
    made.add_argument('--report', type=Path, metavar='FILE', help=about)


def add_stored(made: Any, about: str = 'stored calibration', **needed: bool) -> None:
    """Add ``--calibration`` to a parser or a group."""
    made.add_argument('-c', '--calibration', type=Path, metavar='FILE',
                      help=f'{about}; - for standard input', **needed)


def add_mounting(made: Parser) -> None:
    """Add the options of the frame and of the mounting, without ``--flat``."""
    from ..units import FRAMES

    share(made, '--nose-down')
    made.add_argument('--frame', choices=FRAMES, default='ros',
                      help='levelled frame (default: ros, z up)')


def add_base(made: Parser) -> None:
    """Add the options for what a refinement starts from."""
    from ..units import BASES

    base = made.add_mutually_exclusive_group()
    add_stored(base, 'stored calibration to compare with and to start from')
    base.add_argument('--base', choices=BASES, default='auto', help='model to start from '
                      '(default: the model that fit --model auto selects)')
    share(base, '--prior')
    share(made, '--sensor-model')
