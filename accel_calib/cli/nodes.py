# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
``accel-calib demo``, ``live``, ``node``, ``simulator`` and ``watch``: while messages arrive.

A terminal shows the screen of ``watch``, which is drawn again, with a bell for each captured pose.
Another output, such as a pipe or ``ssh HOST COMMAND`` without ``-t``, gets a line for each change.

**Large words.** The sides of the sensor to point up are drawn in letters of 5 rows of pixels, so
that they can be read from a distance. Two columns of the terminal, or half a row, are one pixel.

"""

import argparse
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass
import math
import signal
import sys
from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from .commands import HIDDEN
from .frame import console, Done, FAILED, given, log_options, Output, table
from ..errors import InputError, NEEDS_ROS
from ..geometry import words_of
from ..stillness import CaptureSettings
from ..units import MG

if TYPE_CHECKING:
    from ..ros.client import Show
    from ..session import Progress

_ERRORS = {'vector_mg': 'error of a, RMS [mg]', 'rms_mg': 'error of |a|, RMS [mg]',
           'max_mg': 'error of |a|, largest [mg]', 'tilt_deg': 'error of up, RMS [deg]'}


@contextmanager
def ended() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C or SIGTERM came."""
    came: list[int] = []
    before = {number: signal.signal(number, lambda number, frame: came.append(number))
              for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_node(args: argparse.Namespace) -> Done:
    """Run the calibrator or the simulator until it is ended."""
    from ..ros.run import calibrator, simulator

    start = simulator if args.command == 'simulator' else calibrator
    return Done(status=start([args.command, *args.for_ros]))


run_simulator = run_node


def run_live(args: argparse.Namespace) -> Done:
    """Serve the live page without ROS until the user ends it."""
    from ..live import check_installed
    check_installed()
    from ..live.host import Host, open_source
    from ..session import CalibratorSettings

    output = Output()
    with (open_source(args.source, log_options(args), baud=args.baud,
                      speed=args.speed) as source, ended() as is_over):
        if source.read_as:
            output.print(f'read as: {source.read_as}')
        for each in source.findings:
            output.print(f'note: {each.words}')
        capture = given(CaptureSettings, args)
        if 'still_std_max' in capture and not source.units.is_native:  # the parameter is in m/s²
            capture['still_std_max'] *= args.gravity / source.units.per_g
        host = Host(source, CalibratorSettings(
            units=source.units.name, gravity=args.gravity, calibration_file=str(args.output),
            web_host=args.host, web_port=args.port, also=str(args.also or ''), **capture),
            lambda line: output.print(line.words))
        try:
            print(host.server.announce(), flush=True)  # a file name is not wrapped
            host.run(is_over)
        finally:
            host.close()
    return Done()


def run_demo(args: argparse.Namespace) -> Done:
    """Run simulator and calibrator in separate processes."""
    try:
        from ..ros.client import demonstrate, demonstrate_page
    except ImportError as err:
        raise InputError(f'ROS 2 is not installed ({err}), but the demonstration needs it',
                         NEEDS_ROS) from err
    output = console(args)
    if args.web:
        from ..live import check_installed
        from ..session import WEB_PORT

        check_installed()
        with ended() as is_over:
            demonstrate_page(WEB_PORT, output.print, is_over)
        return Done()
    outcome = demonstrate(output.print, HIDDEN.get(args.hidden, ''))
    found = asdict(outcome)
    before, after = found.pop('before'), found.pop('after')
    for when, errors in (('before', before), ('after', after)):
        for name, value in errors.items():
            quantity, unit = name.split('_')
            found[f'{quantity}_{when}_{unit}'] = value
    columns = (('imu/data_calibrated', 'after ~/refine') if outcome.hidden else
               ('imu/data_raw', 'imu/data_calibrated'))
    shown: list[str | Table] = [table(
        f'Errors at {outcome.rests} rests in other poses, after {outcome.seconds:.0f} s',
        ('', *columns), ((words, f'{before[name]:.3g}', f'{after[name]:.3g}')
                         for name, words in _ERRORS.items()))]
    if outcome.hidden:
        named = ', '.join(outcome.found) or 'nothing'
        lag = f' with a lag of {outcome.lag_s:.1f} s' if outcome.lag_s else ''
        passed = 'found' if outcome.hidden in outcome.found else 'NOT found'
        shown.append(f'{passed}: hidden was {outcome.hidden}, ~/refine added {named}{lag}')
    return Done(found, shown, status=0 if outcome.succeeded else FAILED)


# ----------------------------------------------------------------------------- watch

GOOD, BAD, NEXT = 'green', 'red', 'bold yellow'

_SCALE = 2.0
"""Stillness at the end of its bar; the limit is at its middle."""

_WORDS = 30
"""Width of the words beside the bars, so that the bars keep their length."""

_OTHER_ROWS = 16
"""Rows of the screen besides the large words."""

_LETTERS = {
    'A': '.#. #.# ### #.# #.#', 'B': '##. #.# ##. #.# ##.', 'C': '### #.. #.. #.. ###',
    'D': '##. #.# #.# #.# ##.',
    'E': '### #.. ##. #.. ###', 'F': '### #.. ##. #.. #..', 'G': '### #.. #.# #.# ###',
    'H': '#.# #.# ### #.# #.#', 'I': '# # # # #', 'K': '#.# #.# ##. #.# #.#',
    'L': '#.. #.. #.. #.. ###', 'M': '#...# ##.## #.#.# #...# #...#',
    'N': '#..# ##.# #.## #..# #..#', 'O': '### #.# #.# #.# ###', 'P': '### #.# ### #.. #..',
    'R': '##. #.# ##. #.# #.#', 'S': '### #.. ### ..# ###', 'T': '### .#. .#. .#. .#.',
    'V': '#.# #.# #.# #.# .#.', ' ': '. . . . .',
}
"""Rows of pixels of each letter, from the top."""

_BLOCKS = {'..': ' ', '#.': '▀', '.#': '▄', '##': '█'}
"""Character for two pixels, the upper one first, each of half a row."""

_CALLS = {'fit': 'CALL FIT', 'refine': 'CALL REFINE', 'level': 'SET LEVEL', 'accept': 'ACCEPT',
          'save': 'SAVE', 'done': 'DONE'}
"""Large words for each kind of step that is not a pose."""

_SERVICE = 'ros2 service call {}/{} std_srvs/srv/Trigger'
"""Call of a service of a node."""

_SAME = math.cos(math.radians(10.0))
"""A direction within 10° of a side, an edge or a corner is named after it."""


class _Row(NamedTuple):
    """
    A row of the screen: what it shows, in words, and as the share of a bar (NaN: no bar).

    It is drawn as its bar, which fills the available width and has a line at the limit.

    """

    label: str
    words: str
    share: float = math.nan
    style: str = GOOD
    limit: float = math.nan

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        full, empty, line = '#-|' if options.ascii_only else '█░┃'
        width = options.max_width
        done = round(min(self.share, 1.0) * width)
        text = Text(full * done, style=self.style, no_wrap=True)
        text.append(empty * (width - done), style='dim')
        if not math.isnan(self.limit):
            at = min(round(self.limit * width), width - 1)
            text = Text.assemble(text[:at], (line, 'bold white'), text[at + 1:], no_wrap=True)
        yield text


def run_watch(args: argparse.Namespace) -> Done:
    """Show the progress until the user ends it."""
    with ended() as is_over:
        try:
            from ..ros import client
        except ImportError as err:
            raise InputError(f'ROS 2 is not installed ({err}), but the command needs it',
                             NEEDS_ROS) from err
        for_ros = [args.command, *args.for_ros]
        if not args.once:
            with _open_screen(args.bell) as show:
                client.watch(args.node, show, is_over, for_ros)
            return Done()
        node, progress = client.current(args.node, is_over, for_ros)
        if progress is not None and sys.stdout.isatty():
            Output().print(screen(node, progress))
        elif progress is not None:
            print(*state(node, progress), sep='\n', flush=True)
    return Done()


@contextmanager
def _open_screen(bell: bool) -> 'Iterator[Show]':
    """Yield the function that shows the progress: on the screen, or by a line for each change."""
    console, before = Output(), ''
    last: Progress | None = None
    view: RenderableType | None = None
    terminal: AbstractContextManager[Live | None] = nullcontext()
    if sys.stdout.isatty() and not console.is_dumb_terminal:
        terminal = Live(console=console, auto_refresh=False, screen=True)
    with terminal as live:
        def show(node: str, progress: 'Progress | None', problem: str) -> None:
            nonlocal last, before, view
            if live is not None:
                if bell and progress is not None and last is not None and (
                        progress.poses > last.poses):
                    console.bell()
                view = screen(node, progress, problem)
                live.update(view, refresh=True)
            else:
                if problem != before:
                    print(problem or f'messages from {node} arrive again', flush=True)
                if progress is not None:
                    for line in changes(node, last, progress):
                        print(line, flush=True)
            last, before = progress, problem

        yield show
    if view is not None:
        console.print(view)  # the terminal returns to what it showed before


def screen(node: str, progress: 'Progress | None', problem: str = '') -> RenderableType:
    """
    Return the screen of a calibrator by its full name; `progress` is None before any message.

    `problem` is why no messages arrive, and what to do.

    """
    parts: list[RenderableType] = [Text(problem, style=f'bold {BAD}')] if problem else []
    if progress is not None:
        rows = Table.grid(padding=(0, 2, 0, 0), expand=True)
        rows.add_column(no_wrap=True)
        rows.add_column(ratio=1)
        rows.add_column(no_wrap=True, min_width=_WORDS)
        for row in _rows(progress):
            rows.add_row(Text(row.label), '' if math.isnan(row.share) else row, Text(row.words))
        sides, (advice, *others) = _sides(progress), _next_lines(node, progress)
        large = (_Large(_CALLS[progress.step], f'bold {GOOD}') if progress.step in _CALLS else
                 _Large(sides, NEXT) if sides else None)
        parts += [rows, '', *([large, ''] if large else ()),
                  Text(advice, style='bold'), *(Text(each, style='dim') for each in others)]
    elif not problem:
        parts.append(Text('waiting for the first message'))
    return Panel(Group(*parts), title=Text(node), border_style=BAD if problem else 'dim')


def state(node: str, progress: 'Progress') -> Iterator[str]:
    """Yield the lines of a progress: its rows, the next step, and the call of its service."""
    for row in _rows(progress):
        yield f'{row.label}: {row.words}'
    advice, *others = _next_lines(node, progress)
    yield from (f'next: {advice}', *others)


def changes(node: str, before: 'Progress | None', now: 'Progress') -> Iterator[str]:
    """Yield a line for each change that the user must know; all is new if `before` is None."""
    if before is None or (before.poses, before.advice) != (now.poses, now.advice):
        what = 'captured pose' if before is not None and now.poses > before.poses else 'poses:'
        words = {row.label: row.words for row in _rows(now)}
        command = '' if now.step == 'poses' else now.command  # a pose comes first
        call = f': {_SERVICE.format(node, command)}' if command else ''
        yield (f'{what} {words["poses"]}; coverage {now.coverage:.0%}; accuracy '
               f'{words["accuracy"]}; next: {now.advice or "wait"}{call}')
    if before is None or before.still != now.still:
        yield f'still: hold it for {now.min_dwell:g} s' if now.still else 'moving'


def _rows(progress: 'Progress') -> list[_Row]:
    now, style = progress, GOOD if progress.still else BAD
    stillness = 'no Imu messages yet'
    if not math.isnan(now.stillness):
        stillness = (f'{"still" if now.still else "moving"}, '
                     f'{now.stillness:.{2 if now.stillness < 10.0 else 0}f} times the limit')
    lengths = [f'{words}{each:.4f} g' for words, each in (
        ('', now.length), ('corrected ', now.corrected)) if not math.isnan(each)]
    share = now.poses / max(now.poses, now.total, 1)
    count = f'{now.poses}' if now.poses >= now.total else f'{now.poses} of about {now.total}'
    accuracy = (f'{now.accuracy * MG:.2g} mg expected' if math.isfinite(now.accuracy) else
                'not known' if math.isnan(now.accuracy) else 'not determined by these poses')
    dwell = (f'{now.dwell:.1f} s of {now.min_dwell:g} s'
             f'{", long enough" if now.dwell >= now.min_dwell else ""}')
    return [
        _Row('stillness', stillness, now.stillness / _SCALE, style, 1.0 / _SCALE),
        _Row('dwell', dwell, now.dwell / now.min_dwell, style),
        _Row('poses', count, share),
        _Row('coverage', f'{now.coverage:.0%} of the sphere', now.coverage),
        _Row('accuracy', accuracy), _Row('|a|', ', '.join(lengths) or 'not known'),
        *([] if math.isnan(now.temperature) else [
            _Row('temperature', f'{now.temperature:.1f} °C')])]


def _next_lines(node: str, progress: 'Progress') -> list[str]:
    """Return the next step, its direction if that has a name, and the call of its service."""
    lines = [progress.advice or 'wait']
    if _sides(progress):
        parts = ' '.join(f'{part:+.2f}' for part in progress.direction)
        lines.append(f'direction in sensor axes: {parts}')
    if progress.command:
        lines.append(_SERVICE.format(node, progress.command))
    return lines


def _sides(progress: 'Progress') -> str:
    """Return the sides to point up, such as ``FRONT LEFT``; empty for another direction."""
    if not progress.direction:
        return ''
    signs = np.sign(np.round(np.array(progress.direction), 1))
    if signs @ progress.direction < _SAME * np.linalg.norm(signs):
        return ''
    return words_of(signs).removeprefix('the ').rsplit(' ', 1)[0].upper()


@dataclass(frozen=True)
class _Large:
    """Words in the largest letters that fit the terminal."""

    words: str
    style: str

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        letters = [_LETTERS[letter].split() for letter in self.words]
        rows = ['.'.join(parts) for parts in zip(*letters)]
        wide = [''.join('██' if pixel == '#' else '  ' for pixel in row) for row in rows]
        padded = [*rows, '.' * len(rows[0])]
        half = [''.join(_BLOCKS[upper + lower] for upper, lower in zip(above, below))
                for above, below in zip(padded[::2], padded[1::2])]
        fitting = [lines for lines in (wide, half) if len(lines[0]) <= options.max_width
                   and len(lines) <= console.height - _OTHER_ROWS]
        lines = fitting[0] if fitting and not options.ascii_only else [self.words]
        yield Text('\n'.join(lines), style=self.style)
