# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Options that several commands have, and the parser, whose errors are one line of plain characters.

Each option is stated once: its names, and what ``add_argument`` takes. Beside these there are the
`group` that it is shown in, or of which one is allowed (`ONE_OF`), and the record that it is a
field `of`: it then has the type and the default of the field, and `accel_calib.cli.frame.given`
has the values. A value that is a ``partial`` is made when the option is added, so that ``--help``
does not wait for numpy.

"""

import argparse
import codecs
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache, partial
from importlib import import_module
from pathlib import Path
import re
import sys
from typing import Any, get_type_hints, NamedTuple, NoReturn

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


def count(text: str) -> int:
    """Return a number of 1 or more from an argument."""
    if int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text}: expected 1 or more')
    return int(text)


def flat_row(text: str) -> int | str:
    """Return a row from an argument, or first or last."""
    if text in ('first', 'last'):
        return text
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text}: expected a row, first or last') from None


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

ONE_OF = 'one of'


class Option(NamedTuple):
    """An option: its names, or that of an argument, and what is known about it."""

    names: tuple[str, ...]
    about: dict[str, Any]


Options = tuple[Option, ...]


def option(*names: str, **about: Any) -> Option:
    return Option(names, about)


def late(module: str, name: str) -> partial[Any]:
    """Return a name of another module of the package, to be imported when an option is added."""
    return partial(lambda: getattr(import_module(f'..{module}', __package__), name))


def add_options(made: Parser, options: Options) -> None:
    """Add options to the parser of a command."""
    groups: dict[str | None, Any] = {None: made}
    for names, stated in options:
        about = {key: each() if isinstance(each, partial) else each
                 for key, each in stated.items()}
        group, record = about.pop('group', None), about.pop('of', None)
        if group not in groups:
            groups[group] = (made.add_mutually_exclusive_group() if group == ONE_OF else
                             made.add_argument_group(group))
        if record is not None:
            name = names[-1].removeprefix('--').replace('-', '_')
            kind = get_type_hints(record)[name]
            about = ({'action': 'store_true'} if kind is bool else
                     {'default': record.__dataclass_fields__[name].default,
                      'type': _TYPES.get(kind, utf8)}) | about
        groups[group].add_argument(*names, **about)


def shared(*names: str) -> Options:
    """Return options of several commands."""
    return tuple(SHARED[name] for name in names)


def source(name: str, about: str | partial[str], **more: Any) -> Option:
    """Return the argument for a log, which can come through standard input."""
    return option(name, type=log_path, **{'metavar': name.upper(), **more}, help=partial(
        lambda: f'{about if isinstance(about, str) else about()}; - for standard input'))


def any_log(before: str = '') -> partial[str]:
    """Return what a log can be."""
    return partial(lambda: f'{before}text in any dialect, or a rosbag2 folder, '
                   f'{", ".join(late("logs", "SUFFIXES")())}')


def poses(number: str | None = '+') -> Options:
    """Return the options for reading the poses of one or several logs."""
    return (source('poses', 'pose table, or a recording, whose poses are captured first',
                   nargs=number), *shared('--rows'), *LOG, *CAPTURE)


def outputs(output: str, page: str = 'page') -> Options:
    """Return the options for the files that a command writes for one or several POSES."""
    return (option('-o', '--output', type=Path, metavar='FILE', help=f'{output} to write (YAML); '
                   '- for standard output; a folder for several POSES'),
            report(f'{page} to write (HTML); a folder for several POSES'),
            *shared('--jobs', '--json'))


def report(about: str = 'page to write (HTML)') -> Option:
    return option('--report', type=Path, metavar='FILE', help=about)


def stored(about: str = 'stored calibration', **more: Any) -> Option:
    return option('-c', '--calibration', type=Path, metavar='FILE',
                  help=f'{about}; - for standard input', **more)


SHARED = {each.names[-1]: each for each in (
    option('--rows', metavar='A:B', help='rows A to B, 1-based, inclusive'),
    option('--jobs', type=count, default=1, metavar='N', help='number of tables to process in '
           'parallel'),
    option('--flat', type=flat_row, metavar='ROW', help='pose with the robot level: its row, '
           '1-based, or first or last; it determines the mounting'),
    option('--nose-down', type=int, metavar='ROW', help='row of a pose with the nose of the robot '
           'tilted straight down, by 10° or more; it determines the heading of the mounting '
           '(needs --flat)'),
    option('--frame', choices=late('units', 'FRAMES'), default='ros',
           help='levelled frame (default: ros, z up)'),
    option('--no-refine', dest='refined', action='store_false', help='do not look for effects '
           'beyond offset, gain and cross-axis'),
    option('--prior', type=Path, metavar='FLEET', help='typical values of a fleet (fleet.yaml of '
           'accel-calib fleet) for offset, gain and cross-axis, for few poses'),
    option('--sensor-model', default='', metavar='NAME', help='model of the sensor in the file of '
           '--prior, if it has several'),
    option('--keep-bad', action='store_true', help='store a calibration that is BAD, too'),
    option('--also', type=Path, metavar='FILE.py', help='Python file with own effects '
           '(accel_calib.Effect), which are known beside the catalogue; it is executed'),
    option('--verbose', action='store_true', help='print all notes and tables'),
    option('--json', metavar='FILE', help='JSON file to write with the result; - for standard '
           'output'),
    option('--force', action='store_true', help='replace files of other kinds, too'))}
"""Options of several commands."""

_LOG = {'of': late('logs', 'LogOptions')}


def units(default: str = '') -> Options:
    """Return the options of the unit; without a default, the file states the unit."""
    return (option('--units', choices=late('units', 'UNIT_NAMES'), default=default,
                   help='unit of ax,ay,az; native is counts or volts (default: '
                   f'{default or "the unit in the file, or recognised"})', **_LOG),
            option('--gravity', metavar='M/S2', help='local gravity [m/s2] (default: '
                   '%(default)s)', **_LOG))


LOG: Options = (
    option('--format', choices=late('logs', 'NAMES'), help='layout of the log (default: it is '
           'recognised)', **_LOG),
    option('--columns', type=_columns, action='append', default=[], metavar='OURS=THEIRS,...',
           help='columns by their name or number in the log, such as '
           'time=t_ms,ax=accX,ay=accY,az=accZ'),
    option('--skip-bad', help='skip lines that cannot be read', **_LOG),
    option('--rate', metavar='HZ', help='samples per second of a log without times', **_LOG),
    option('--topic', help='Imu topic of a bag, message of a flight log, or table of an archive '
           'or Excel file, if there are several', **_LOG),
    option('--sensor', help='name of the sensor: frame_id of its messages, or its number in a '
           'flight log (default: the name in the log)', **_LOG),
    option('--context', type=utf8, action='append', default=[], metavar='COLUMN:=TOPIC[/FIELD]',
           help='topic of a bag with a number that may act on the sensor, such as '
           'temperature:=/imu/temp; can be repeated'),
    *units())
"""Options for reading a log."""

_CAPTURE = {'group': 'capture of poses from a recording', 'default': None,
            'of': late('stillness', 'CaptureSettings')}

CAPTURE: Options = (
    option('--still-window', metavar='S', help='length of the sliding window [s]', **_CAPTURE),
    option('--still-std-max', metavar='STD', help='largest standard deviation of a still sensor, '
           'in the unit of ax (default: adapts to the noise of the sensor)', **_CAPTURE),
    option('--still-gyro-max', metavar='RAD/S', help='largest mean angular rate (default: not '
           'checked)', **_CAPTURE),
    option('--still-norm-tolerance', metavar='G', help='largest difference of |a| from 1 g, '
           'beside what all rests have in common', **_CAPTURE),
    option('--min-dwell', metavar='S', help='shortest still stretch that becomes a pose',
           **_CAPTURE),
    option('--max-dwell', metavar='S', help='split longer rests into poses with the same '
           'orientation', **_CAPTURE),
    option('--min-pose-angle', metavar='RAD', help='poses within this angle count as repeated',
           **_CAPTURE),
    option('--repeated', choices=late('stillness', 'REPEATED'), help='keep, merge or refuse '
           'repeated poses', **_CAPTURE))
"""Options of the capture of poses; none of them has a value by default."""

BASE: Options = (
    stored('stored calibration to compare with and to start from', group=ONE_OF),
    option('--base', group=ONE_OF, choices=late('units', 'BASES'), default='auto',
           help='model to start from (default: the model that fit --model auto selects)'),
    option('--prior', group=ONE_OF, **SHARED['--prior'].about), *shared('--sensor-model'))
"""Options for what a refinement starts from."""
