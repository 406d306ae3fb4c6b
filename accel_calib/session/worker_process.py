# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A separate process for computations: fits with their files, refinements and the next pose.

In a thread of the node, the computations would share the interpreter with the stream, and messages
would wait up to 5 ms. The process has its own interpreter and runs only while the processor is
idle. A nice value is not enough, because the scheduler lets a nice process that was asleep finish
its slice of 3 ms. If the process gets too little time, it is restarted with normal priority.

Functions, arguments and results are pickled between the processes and never stored. The process
ends with the node in all cases, because its standard input is then closed. If the process cannot
be started or dies, the node does the computation itself.

"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
import os
import pickle
from queue import SimpleQueue
from select import select
import signal
import subprocess
import sys
from threading import Lock, Thread
from typing import Any, BinaryIO, cast, TypeVar

from ..errors import InputError

Found = TypeVar('Found')

_PATIENCE = 10.0
"""Time without an answer after which the process is restarted with normal priority [s]."""

_IDLE = 'idle'
"""Command line argument for a process that runs only while the processor is idle."""

_ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
"""Limits of the number of threads: arrays are small, so more threads would only wait."""

_IMPORTED = ('accel_calib.refine', 'scipy.linalg', 'scipy.optimize', 'scipy.special')
"""Modules imported at the start, so that the first fit is as fast as later ones."""


_START = ('import sys; sys.path[:] = filter(None, sys.path); '
          f'from {__name__} import main; main()')
"""Code of the process. The current folder is not searched for modules: it may hold any file."""


class WorkerProcess:
    """
    The interface of the node to the process; other threads wait for their turn.

    Parameters
    ----------
    idle : bool
        Run only while the processor is idle.

    """

    def __init__(self, *, idle: bool = True) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._idle = idle
        self._turn = Lock()

    def start(self) -> None:
        """Start the process unless it is running, without waiting for it."""
        if self._closed or (self._process is not None and self._process.poll() is None):
            return
        command = [sys.executable, '-c', _START, *([_IDLE] if self._idle else [])]
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, 'PYTHONPATH': path, **dict.fromkeys(_ONE_THREAD, '1')}
        try:
            # In its own session it does not receive the Ctrl-C of a terminal.
            self._process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True)
        except OSError:
            self._process = None

    def call(self, function: Callable[..., Found], *given: Any) -> Found:
        """
        Call a function in the process and wait for its result.

        Parameters
        ----------
        function : callable
            A module-level function, which can be imported by name.
        *given
            Arguments that can be pickled.

        Returns
        -------
        object
            The result of the function. An error of the function is raised here, too.

        Raises
        ------
        InputError
            If the node is ending.

        """
        with self._turn:
            return self._call(function, given)

    def _call(self, function: Callable[..., Found], given: tuple[Any, ...]) -> Found:
        self.start()
        try:
            good, found = self._ask(function, given)
        except (OSError, EOFError, pickle.UnpicklingError):
            if self._closed:
                raise InputError('the node is shutting down', 'start it again') from None
            self._end()
            return function(*given)
        if not good:
            raise found
        return cast('Found', found)

    def _ask(self, function: Callable[..., Any], given: tuple[Any, ...]) -> tuple[bool, Any]:
        process = self._process
        if self._closed:  # perhaps while another thread started the process
            self._end()
        if process is None or process.stdin is None or process.stdout is None:
            raise EOFError
        process.stdin.write(pickle.dumps((function, given)))
        process.stdin.flush()
        if self._idle and not select([process.stdout], [], [], _PATIENCE)[0]:
            self._idle = False  # raising the priority needs privileges, so restart it
            self._end()
            self.start()
            return self._ask(function, given)
        answer: tuple[bool, Any] = pickle.load(process.stdout)
        return answer

    def close(self) -> None:
        """End the process; a waiting call raises InputError."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def main() -> None:
    """Answer calls until standard input is closed; the main function of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _IDLE in sys.argv:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # printed text must not mix with answers
    calls: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_read, args=(sys.stdin.buffer, calls), daemon=True).start()
    for name in _IMPORTED:
        import_module(name)
    while True:
        answers.write(pickle.dumps(_answer(calls.get())))
        answers.flush()


def _read(stream: BinaryIO, calls: SimpleQueue[Any]) -> None:
    """Read calls; end the process when the node ends, even during a computation."""
    try:
        while True:
            calls.put(pickle.load(stream))
    finally:
        os._exit(0)


def _answer(call: Any) -> tuple[bool, Any]:
    function, given = call
    try:
        return True, function(*given)
    except Exception as error:  # raised again in the node, by `call`
        return False, error
