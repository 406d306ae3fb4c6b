# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A board on a serial port, which is a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
import os
from threading import Event, Thread
import tty


@contextmanager
def board(lines: Iterable[str]) -> Iterator[str]:
    """
    Yield the port of a board that sends these lines; their iterator sets the pace.

    As on a real port, bytes that nobody reads in time are lost.

    """
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    over = Event()

    def send() -> None:
        for line in lines:
            if over.is_set():
                return
            with suppress(BlockingIOError):
                os.write(ours, line.encode('latin-1'))

    sender = Thread(target=send)
    sender.start()
    try:
        yield os.ttyname(theirs)
    finally:
        over.set()
        sender.join()
        os.close(ours)
        os.close(theirs)
