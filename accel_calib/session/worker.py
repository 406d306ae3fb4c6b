# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A separate process for computations, and the order of the jobs of a session.

**Process.** In a thread of the node, fits, refinements and the next pose would share the
interpreter with the stream, and messages would wait up to 5 ms. The process has its own
interpreter and runs only while the processor is idle. A nice value is not enough, because the
scheduler lets a nice process that was asleep finish its slice of 3 ms. If the process gets too
little time, it is restarted with normal priority.

Functions, arguments and results are pickled between the processes and never stored. The process
ends with the node in all cases, because its standard input is then closed. If the process cannot
be started or dies, the node does the computation itself.

**Order.** Jobs that use files run in one thread, one after the other. Jobs that compute run in
another one, which waits for the worker process. Both finish in the thread of the session, so that
only this thread changes the session.

A command begins when no job uses the files, so that it sees what the commands before it did. It
does not wait for computations: a fit computes while other commands are answered, and is discarded
if one of them changed the calibration.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module
import os
import pickle
from queue import SimpleQueue
from select import select
import signal
import subprocess
import sys
from threading import Lock, Thread
from traceback import format_exc
from typing import Any, BinaryIO, cast, TypeVar

from .store import writing_advice
from .work import Job
from ..errors import AccelCalibError, InputError

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


Answer = Callable[[bool, str], object]
"""Function of the success of a command, and of a text about its result."""

CallSoon = Callable[[Callable[[], None]], None]
"""Function that lets the thread of the session call a function, one after the other."""


class Worker:
    """
    The threads for the jobs of a session.

    Parameters
    ----------
    call_soon : callable
        Function that lets the thread of the session call a function.
    on_events : callable
        Function that is called after each job, in the thread of the session.
    report : callable
        Function that logs an unexpected error.

    Attributes
    ----------
    running : list of str
        Names of the commands that are not answered, the oldest first.

    """

    def __init__(self, call_soon: CallSoon, on_events: Callable[[], None],
                 report: Callable[[str], object]) -> None:
        self._call_soon, self._on_events, self._report = call_soon, on_events, report
        self._files = ThreadPoolExecutor(1, 'accel_calib_files')
        self._computation = ThreadPoolExecutor(1, 'accel_calib')
        self._process = WorkerProcess()
        self._computed: deque[Callable[[], None]] = deque()
        self._jobs: deque[tuple[Job, Answer]] = deque()
        self._commands: deque[tuple[Callable[[], str | Job], Answer]] = deque()
        self.running: list[str] = []
        self._is_busy = self._closed = False

    def do(self, name: str, command: Callable[[], str | Job], answer: Answer) -> None:
        """Call a command when the jobs before it are done, run its job, and call `answer`."""
        def done(success: bool, words: str) -> None:
            self.running.remove(name)
            answer(success, words)

        self.running.append(name)
        self._commands.append((command, done))
        self._advance()

    def run(self, job: Job, answer: Answer) -> None:
        """Run a job in a thread, finish it in that of the session, and call `answer`."""
        if job.computes:
            self._submit(self._computation, job, lambda done: self._later(
                lambda: self._finish(job, answer, done)))
        else:
            self._jobs.append((job, answer))
            self._advance()

    def _later(self, finish: Callable[[], None]) -> None:
        """Finish a computation when no files are used."""
        self._computed.append(finish)
        self._advance()

    def _submit(self, pool: ThreadPoolExecutor, job: Job,
                then: Callable[[Future[Any]], None]) -> None:
        future = pool.submit(job.run, self._process.call)
        future.add_done_callback(lambda done: self._call_soon(lambda: then(done)))

    def _advance(self) -> None:
        """Begin what waits, until a job uses the files; jobs come first, commands last."""
        while not self._is_busy and not self._closed:
            if self._jobs:
                self._store(*self._jobs.popleft())
            elif self._computed:
                self._in_turn(self._computed.popleft())
            elif self._commands:
                command, answer = self._commands.popleft()
                self._in_turn(lambda command=command, answer=answer:  # type: ignore[misc]
                              self._settle(command, answer))
            else:
                return

    def _in_turn(self, function: Callable[[], None]) -> None:
        """Call a function during which nothing else begins."""
        self._is_busy = True
        try:
            function()
        finally:
            self._is_busy = False

    def _store(self, job: Job, answer: Answer) -> None:
        """Run a job that uses files."""
        def stored(done: Future[Any]) -> None:
            self._in_turn(lambda: self._finish(job, answer, done))
            self._advance()

        self._is_busy = True
        self._submit(self._files, job, stored)

    def _finish(self, job: Job, answer: Answer, done: Future[Any]) -> None:
        """Finish a job and call `answer`, or run the job that continues."""
        if not self._closed:  # otherwise rclpy may have destroyed the publishers
            self._settle(lambda: job.finish(done.result()), answer)

    def _settle(self, function: Callable[[], str | Job], answer: Answer) -> None:
        """Call a function, and run its job or call `answer`."""
        success, found = self._outcome(function)
        self._on_events()  # first, so that a command is answered after its poses are stored
        if isinstance(found, Job):
            self.run(found, answer)
        else:
            answer(success, found)

    def _outcome(self, function: Callable[[], Found]) -> tuple[bool, Found | str]:
        """Return success, and a result or words; unexpected errors are logged."""
        try:
            return True, function()
        except AccelCalibError as error:
            return False, str(error)
        except OSError as error:
            return False, f'{error}; {writing_advice(error)}'
        except Exception as error:
            self._report(f'unexpected error in accel_calib:\n{format_exc()}')
            return False, (f'unexpected error in accel_calib ({error!r}); please report it with '
                           'the log')

    def close(self) -> None:
        """Stop the computation, and finish writing."""
        self._closed = True
        self._process.close()
        self._computation.shutdown(wait=True)
        for job, _ in self._jobs:
            self._files.submit(job.run, self._process.call)
        self._files.shutdown(wait=True)
