# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Lines of a serial port, which are read as those of a text log.

The first lines are collected, because dialect, columns and units are recognised from several ones,
and the interval from their times. A port that is removed is opened again when it returns.

"""

from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager
import math
from pathlib import Path
import time
from typing import Any

import numpy as np

from .columns import LogOptions
from .text import LineReader
from ..errors import InputError, needing

_WAIT_S = 0.03
"""Longest wait for a line [s]."""

_HEAD_S = 2.0
"""Time over which the first lines of a port are collected [s]."""

_HEAD_LINES, _HEAD_CHARACTERS = 20, 1 << 18
"""Fewest first lines, and number of characters after which no more are collected: each takes some
150 bytes while the lines are recognised."""

_PATIENCE_S = 10.0
"""Time without a line that is understood after which a port is refused [s]."""

_LONGEST_LINE = 4096
"""Longest line of a port [bytes]."""

_AGAIN_S = 1.0
"""Interval between two attempts to open a port that was removed [s]."""

_RETURN = ('connect the sensor again; the page continues when it is back, and the poses are '
           'kept')


def is_port(name: str) -> bool:
    """Return whether a name is that of a serial port, and not of a recording."""
    return '://' in name or name.upper().startswith(('COM', '/DEV/')) or (
        Path(name).is_char_device())


@contextmanager
def open_port(name: str, options: LogOptions, baud: int
              ) -> Iterator[tuple[LineReader, Iterator[list[str]], Callable[[], str]]]:
    """
    Open a serial port, and yield the reader of its lines, its next lines, and its problem.

    The problem is a function that returns why no lines come at present. There may be no lines
    after a moment. InputError if the port cannot be opened, or its lines cannot be read.

    """
    port = _Port()
    with closing(port.lines(name, baud)) as lines:
        yield _understood(name, lines, options, baud), lines, lambda: port.problem


class _Port:
    """A serial port; `problem` is why it sends nothing at present, empty if it is open."""

    problem = ''

    def lines(self, name: str, baud: int) -> Generator[list[str], None, None]:
        """
        Yield complete lines, or none after a moment; the first one, maybe cut, is left out.

        The port is opened again when it returns after it was removed. InputError if it cannot be
        opened at the start.

        """
        with needing('pyserial', 'a serial port'):
            import serial
        port: Any = None
        rest, is_cut, tried = b'', True, -math.inf
        try:
            while True:
                found = b''
                if port is None and time.monotonic() - tried >= _AGAIN_S:
                    is_first, tried = tried < 0.0, time.monotonic()
                    try:
                        port = serial.serial_for_url(name, baudrate=baud, timeout=_WAIT_S)
                        self.problem = ''
                    except (OSError, ValueError) as err:  # SerialException is an OSError
                        problem = InputError(
                            f'{name} cannot be opened: {err}', 'check its name, whether another '
                            'program uses it, and your rights (on Linux: group dialout)')
                        if is_first:
                            raise problem from err
                        self.problem = f'{problem.message}: {_RETURN}'
                if port is None:
                    time.sleep(_WAIT_S)
                else:
                    try:
                        found = port.read(port.in_waiting or 1)
                    except OSError as err:
                        port.close()
                        port, rest, is_cut = None, b'', True
                        self.problem = f'{name} does not send any more ({err}): {_RETURN}'
                *lines, rest = (rest + found).split(b'\n')
                rest = rest[-_LONGEST_LINE:]
                if lines and is_cut:
                    lines, is_cut = lines[1:], False
                yield [line[:_LONGEST_LINE].decode('utf-8', errors='replace').rstrip('\r')
                       for line in lines]
        finally:
            if port is not None:
                port.close()


def _understood(name: str, lines: Iterator[list[str]], options: LogOptions, baud: int
                ) -> LineReader:
    """Return the reader of the lines, as soon as the first ones are understood."""
    head: list[str] = []
    count = size = 0
    arrived: list[tuple[int, float]] = []
    begin = tried = time.monotonic()
    problem = InputError(f'{name} sends no lines, expected one line for each sample',
                         'check the sensor and its program')
    for new in lines:
        now = time.monotonic()
        if new and not head:
            begin = tried = now
        if new:
            head += new if size < _HEAD_CHARACTERS else []
            count, size = count + len(new), size + sum(map(len, new))
            arrived.append((count, now))
        if now - tried >= _HEAD_S and len(head) >= _HEAD_LINES and (
                arrived[-1][1] - arrived[0][1] > _WAIT_S):
            tried = now
            try:
                return LineReader(name, head, _interval(arrived), options)
            except InputError as err:
                problem = err
        if now - begin > _PATIENCE_S:
            break
    raise InputError(problem.message, f'{problem.advice}; check the baud rate {baud}, too '
                     '(--baud)')


def _interval(arrived: list[tuple[int, float]]) -> float:
    """
    Return the time from line to line [s], from the number of lines at times [s].

    It is the median of the slopes between times half of the list apart (Theil 1950), which neither
    a backlog at the start nor lines that are late at the end change much. Of the times within
    each `_WAIT_S` the last one counts, because a backlog can take many short reads.

    """
    count, seconds = np.array([*{int(at / _WAIT_S): (n, at) for n, at in arrived}.values()]).T
    half = len(count) // 2
    return float(np.median((seconds[half:] - seconds[:-half]) / (count[half:] - count[:-half])))
