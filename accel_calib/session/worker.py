# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The commands of a session and their jobs, in an order.

Jobs that use files run in one thread, one after the other. Jobs that compute run in another one,
which waits for the worker process. Both finish in the thread of the session, so that only this
thread changes the session.

A command begins when no job uses the files, so that it sees what the commands before it did. It
does not wait for computations: a fit computes while other commands are answered, and is discarded
if one of them changed the calibration.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from traceback import format_exc
from typing import Any, TypeVar

from .events import Job
from .store import writing_advice
from .worker_process import WorkerProcess
from ..errors import AccelCalibError

Answer = Callable[[bool, str], object]
"""Function of the success of a command, and of a text about its result."""

Found = TypeVar('Found')

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
