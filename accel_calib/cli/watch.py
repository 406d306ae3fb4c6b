# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
``accel-calib watch``: the progress of a calibration in the terminal.

A terminal shows a screen that is drawn again, with a bell for each captured pose. Another output,
such as a pipe or ``ssh HOST COMMAND`` without ``-t``, gets a line for each change.

"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import os
import sys
from typing import TYPE_CHECKING

from . import options
from .terminal import ended, Output
from ..errors import InputError, NEEDS_ROS

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.live import Live

    from ..ros.watch import Show
    from ..session.guidance import Progress

_EXAMPLE = 'accel-calib watch --node left/calibrator'


def add_to(made: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_example(made, _EXAMPLE)
    made.epilog = (f'{made.epilog}\n\nCtrl-C ends it; all arguments after --ros-args are passed '
                   'to ROS')
    made.add_argument('--node', default='calibrator', metavar='NAME',
                      help='name of the calibrator node, with its namespace if it has one '
                      '(default: %(default)s)')
    made.add_argument('--once', action='store_true', help='print the progress once, and end')
    made.add_argument('--no-bell', dest='bell', action='store_false',
                      help='no terminal bell for captured poses')
    made.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Show the progress until the user ends it; return the exit status."""
    with ended() as is_over:
        try:
            from ..ros import watch
        except ImportError as err:
            raise InputError(f'ROS 2 is not installed ({err}), but the command needs it',
                             NEEDS_ROS) from err
        for_ros = [args.command, *args.for_ros]
        try:
            if args.once:
                _print(*watch.current(args.node, is_over, for_ros))
            else:
                with _output(args.bell) as show:
                    watch.watch(args.node, show, is_over, for_ros)
        except BrokenPipeError:
            # The reader of the pipe has ended. Python must not write the rest at its exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _print(node: str, progress: Progress | None) -> None:
    """Print a progress once."""
    from .watch_view import screen, state

    if progress is None:
        return
    if sys.stdout.isatty():
        Output().print(screen(node, progress))
    else:
        print(*state(node, progress), sep='\n', flush=True)


@contextmanager
def _output(bell: bool) -> Iterator[Show]:
    """Yield the function that shows the progress."""
    from rich.live import Live

    console = Output()
    if not sys.stdout.isatty() or console.is_dumb_terminal:
        yield _Lines().show
        return
    with Live(console=console, auto_refresh=False, screen=True) as live:
        shown = _Screen(live, bell)
        yield shown.show
    if shown.view is not None:
        console.print(shown.view)  # the terminal returns to what it showed before


class _Lines:
    """Output of a line for each change."""

    def __init__(self) -> None:
        self._last: Progress | None = None
        self._problem = ''

    def show(self, node: str, progress: Progress | None, problem: str) -> None:
        """Print what has changed."""
        from .watch_view import changes

        if problem != self._problem:
            print(problem or f'messages from {node} arrive again', flush=True)
        if progress is not None:
            for line in changes(node, self._last, progress):
                print(line, flush=True)
        self._last, self._problem = progress, problem


class _Screen:
    """
    A screen that is drawn again, with a bell for each captured pose.

    Attributes
    ----------
    view : rich renderable or None
        What it shows.

    """

    def __init__(self, live: Live, bell: bool) -> None:
        self._live, self._bell = live, bell
        self._last: Progress | None = None
        self.view: RenderableType | None = None

    def show(self, node: str, progress: Progress | None, problem: str) -> None:
        """Draw the screen."""
        from .watch_view import captured, screen

        if progress is not None and captured(self._last, progress) and self._bell:
            self._live.console.bell()
        self._last = progress
        self.view = screen(node, progress, problem)
        self._live.update(self.view, refresh=True)
