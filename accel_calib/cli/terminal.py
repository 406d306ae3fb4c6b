# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The characters of a terminal, and its end by the user.

An output whose encoding lacks a character gets a plain replacement, such as ``+-`` for ±. Control
characters from files never reach the terminal.

"""

from __future__ import annotations

import codecs
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import os
import signal
import sys

_PLAIN = {'±': '+-', '°': ' deg', '²': '2', '³': '3', '⁻': '-', '¹': '1', '−': '-',
          '–': '-', '·': '*', '×': 'x', '…': '...', '→': '->', '≤': '<=', '≥': '>=', '√': 'sqrt ',
          'Δ': 'D', 'σ': 'sigma', 'τ': 'tau', 'ω': 'omega', 'µ': 'u', 'μ': 'u', '█': '#', '│': '|',
          '─': '-', '✓': 'ok'}
"""Replacements for an output that has not these characters."""

_HANDLER = 'accel_calib.plain'
_STANDARD_ERROR = 2


def open_streams() -> None:
    """Open what is closed of the standard streams, so that no other file gets its number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= _STANDARD_ERROR:
        pass
    os.close(number)
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding='utf-8'))  # noqa: SIM115


def use_plain_characters() -> None:
    """Let standard output and error replace the characters that their encoding lacks."""
    codecs.register_error(_HANDLER, _replace)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors=_HANDLER)


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
