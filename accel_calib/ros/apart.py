# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A process beside the node for what computes: fits with their files, refinements, the next pose.

In a thread of the node they would share its interpreter with the stream, and a message would wait
up to 5 ms for each piece of them. Here they have an interpreter of their own, and the processor
only where nobody else wants it: being nice is not enough, for the scheduler lets a nice process
that was asleep end its slice of 3 ms. Where others leave it too little it starts anew as one of
them.

Functions and what they take and give are pickled from process to process and never stored. The
process ends when the node does, however that ends, for then its standard input does; where it
cannot be started or dies, the node computes for itself.

"""

from __future__ import annotations

import os
import pickle
from queue import SimpleQueue
from select import select
import signal
import subprocess
import sys
from threading import Thread
from typing import Any, BinaryIO, TYPE_CHECKING, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

Found = TypeVar('Found')

_PATIENCE = 10.0
"""After so long without an answer the process is to have its share of a busy machine [s]."""

_LAST = 'last'
"""Argument of a process that has the processor last."""

_ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
"""Arrays here are small: more threads would only wait for each other."""


class Apart:
    """The process, seen from the node; to be used by one thread at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._last = True

    def start(self) -> None:
        """Start the process, if it is not there, and do not wait for it."""
        if self._closed or (self._process is not None and self._process.poll() is None):
            return
        command = [sys.executable, '-m', __name__, *([_LAST] if self._last else [])]
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, 'PYTHONPATH': path, **dict.fromkeys(_ONE_THREAD, '1')}
        try:
            # In a session of its own a Ctrl-C is not for it.
            self._process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True)
        except OSError:
            self._process = None

    def call(self, function: Callable[..., Found], *given: Any) -> Found:
        """
        Call a function there and wait for what it gives.

        Parameters
        ----------
        function : callable
            Of a module, so that it is found by its name.
        *given
            What it takes; can be pickled.

        Returns
        -------
        object
            What it gave; what it raises is raised here.

        Raises
        ------
        InputError
            If the node is ending.

        """
        self.start()
        try:
            good, found = self._ask(function, given)
        except (OSError, EOFError, pickle.UnpicklingError):
            if self._closed:
                raise InputError('the node is ending', 'start it again') from None
            self._end()
            return function(*given)
        if not good:
            raise found
        return found

    def _ask(self, function: Callable[..., Any], given: tuple[Any, ...]) -> tuple[bool, Any]:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            raise EOFError
        process.stdin.write(pickle.dumps((function, given)))
        process.stdin.flush()
        if self._last and not select([process.stdout], [], [], _PATIENCE)[0]:
            self._last = False  # without privileges it could not be changed while it runs
            self._end()
            self.start()
            return self._ask(function, given)
        answer: tuple[bool, Any] = pickle.load(process.stdout)
        return answer

    def close(self) -> None:
        """End the process; a call that waits for it is refused."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def main() -> None:
    """Answer calls until standard input ends, in the process itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _LAST in sys.argv:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what is printed is no answer
    calls: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_read, args=(sys.stdin.buffer, calls), daemon=True).start()
    from .fitting import warm_up
    warm_up()
    while True:
        answers.write(pickle.dumps(_answer(calls.get())))
        answers.flush()


def _read(stream: BinaryIO, calls: SimpleQueue[Any]) -> None:
    """Take calls; end the process with the node, be there a call to be answered or not."""
    try:
        while True:
            calls.put(pickle.load(stream))
    finally:
        os._exit(0)


def _answer(call: Any) -> tuple[bool, Any]:
    function, given = call
    try:
        return True, function(*given)
    except Exception as error:
        return False, error


if __name__ == '__main__':
    main()
