# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What a session reports and asks for, and the threads and the process that do it.

**Process.** In a thread of the node, fits, refinements and the next pose would share the
interpreter with the stream, and messages would wait up to 5 ms. The process has its own
interpreter and runs only while the processor is idle. A nice value is not enough, because the
scheduler lets a nice process that was asleep finish its slice of 3 ms. If the process gets too
little time, it is restarted with normal priority.

Functions, arguments and results are pickled between the processes and never stored. The process
ends with the node in all cases, because its standard input is then closed. If the process cannot
be started or dies, the node does the computation itself.

`concurrent.futures.ProcessPoolExecutor` cannot end a call that runs, which the end of a node and
the limit of a recording of a fleet need. pebble can, but rosdep has no key for it.

Calibrations are also formatted and parsed in the process, if it is free (`Parse`). Files are
written in the node, which holds their lock: the process may live a little longer than the node.

**Order.** A task is a generator of steps. Steps that use files run in one thread, one after the
other. Steps that compute run in another one, which waits for the worker process. Between its steps
a task runs in the thread of the session, so that only this thread changes the session.

A command begins when no step uses the files, so that it sees what the commands before it did. It
does not wait for computations: a fit computes while other commands are answered, and is discarded
if one of them changed the calibration.

"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
import math
import os
import pickle
from select import poll, select
import signal
import subprocess
import sys
from threading import RLock, Thread
from time import monotonic
from traceback import format_exc
from typing import Any, cast, Literal, NamedTuple, TypeVar

from .store import writing_advice
from ..errors import AccelCalibError, InputError, ONE_THREAD
from ..table import Floats

Found = TypeVar('Found')

_PATIENCE = 10.0
"""Time without an answer after which the process is restarted with normal priority [s]."""

_IDLE = 'idle'
"""Command line argument for a process that runs only while the processor is idle."""

_ENVIRONMENT = {**ONE_THREAD, 'MALLOC_TRIM_THRESHOLD_': '131072'}
"""A set threshold is not adapted by glibc, so that freed arrays do not stay in the process."""

_IMPORTED = ('accel_calib.refinement', 'scipy.linalg', 'scipy.special')
"""Modules imported at the start, so that the first fit is as fast as later ones."""

_START = ('import sys; sys.path[:] = filter(None, sys.path); '
          f'from {__name__} import main; main()')
"""Code of the process. The current folder is not searched for modules: it may hold any file."""


class ClosedError(InputError):
    """The node is ending."""


class WorkerProcess:
    """The interface of the node to the process, which can run only while the processor is idle."""

    def __init__(self, *, idle: bool = True) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._idle = idle
        self._turn = RLock()

    def start(self) -> None:
        """Start the process unless it is running, without waiting for it."""
        if self._closed or (self._process is not None and self._process.poll() is None):
            return
        command = [sys.executable, '-c', _START, *([_IDLE] if self._idle else [])]
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, 'PYTHONPATH': path, **_ENVIRONMENT}
        try:
            # In its own session it does not receive the Ctrl-C of a terminal.
            self._process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True)
        except OSError:
            self._process = None

    def call(self, function: Callable[..., Found], *given: Any, limit_s: float | None = None
             ) -> Found:
        """
        Return the result of a module-level function, called in the process.

        Arguments and result are pickled. An error of the function is raised here, too; InputError
        if the node is ending. Other threads wait for their turn. If the process dies, the function
        is called here. With `limit_s` [s] it is not, but EOFError is raised; after this time the
        process is ended, and TimeoutError is raised.

        """
        with self._turn:
            try:
                good, found = self._ask(pickle.dumps((function, given)), limit_s)
            except (OSError, EOFError, pickle.UnpicklingError) as err:
                if self._closed:
                    raise ClosedError('the node is shutting down', 'start it again') from None
                self._end()
                if limit_s is not None:
                    raise err if isinstance(err, TimeoutError) else EOFError from err
                return function(*given)
        if not good:
            raise found
        return cast('Found', found)

    def call_if_free(self, function: Callable[..., Found], *given: Any) -> Found:
        """Call a function as `call` does, or at once in this process if the other one is busy."""
        if not self._turn.acquire(blocking=False):
            return function(*given)
        try:
            is_running = self._process is not None and self._process.poll() is None
            return self.call(function, *given) if is_running else function(*given)
        except ClosedError:  # what the user has asked to store is stored
            return function(*given)
        finally:
            self._turn.release()

    def _ask(self, request: bytes, limit_s: float | None) -> tuple[bool, Any]:
        self.start()
        process = self._process
        if self._closed:  # perhaps while another thread started the process
            self._end()
        if process is None or process.stdin is None or process.stdout is None:
            raise EOFError
        process.stdin.write(request)
        process.stdin.flush()
        if self._idle and not select([process.stdout], [], [], _PATIENCE)[0]:
            self._idle = False  # raising the priority needs privileges, so restart it
            self._end()
            return self._ask(request, limit_s)
        if not select([process.stdout], [], [], limit_s)[0]:
            raise TimeoutError
        return pickle.load(process.stdout)

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
    Thread(target=_end_with_the_node, daemon=True).start()
    for name in _IMPORTED:
        import_module(name)
    try:
        while True:
            function, given = pickle.load(sys.stdin.buffer)
            try:
                answer = True, function(*given)
            except Exception as error:  # raised again in the node, by `call`
                answer = False, error
            answers.write(pickle.dumps(answer))
            answers.flush()
    except (BrokenPipeError, EOFError, pickle.UnpicklingError):  # the node has ended
        os._exit(0)


def _end_with_the_node() -> None:
    """End the process when its standard input is closed, even during a computation."""
    closed = poll()
    closed.register(sys.stdin.fileno(), 0)  # no other event than the end of all writers
    closed.poll()
    os._exit(0)


def nothing() -> None:
    """Do nothing: a task with such a step only waits until the steps before it are done."""


class Step(partial[Any]):
    """
    What a task waits for: the result of a function with these arguments.

    The function does not use the session, and can raise AccelCalibError or OSError, which are
    raised in the task. An argument that is a step is computed first.

    """

    def run(self, call: Callable[..., Any]) -> Any:
        """Return the result; `call` is `WorkerProcess.call`."""
        given = [each.run(call) if isinstance(each, Step) else each for each in self.args]
        if self.func is nothing:
            return None
        function = partial(self.func, **self.keywords)
        return function(*given) if isinstance(self, Files) else call(function, *given)


class Parse(Step):
    """
    A function that formats or reads files, in the worker process if that is free.

    Other functions that use files and commands wait for it.

    """


class Files(Parse):
    """A function that writes files, in this process, which holds their lock."""


class Compute(Step):
    """A function that computes, in the worker process; commands and files do not wait for it."""


def answered(task: Task, before: Callable[[], object] = nothing) -> Any:
    """Run the steps of a task now, in this thread, each after `before`; return its answer."""
    try:
        step = next(task)
        while True:
            before()
            try:
                found = step.run(lambda function, *given: function(*given))
            except Exception as error:  # the task can handle it
                step = task.throw(error)
            else:
                step = task.send(found)
    except StopIteration as end:
        return end.value


Task = Generator[Step, Any, Any]
"""
Steps whose results are sent back, in the thread of the session; the returned value is the answer.

An empty answer is not logged. A task can raise AccelCalibError.

"""

Part = Generator[Step, Any, Found]
"""A part of a task, for ``yield from``."""

Severity = Literal['info', 'warning', 'error']


class Log(NamedTuple):
    """A log line."""

    severity: Severity
    words: str


class Still(NamedTuple):
    """A change of whether the sensor is still."""

    still: bool


class ShowPoses(NamedTuple):
    """The poses to draw: (n, 3) directions of up in the sensor frame."""

    up: Floats


class Mounting(NamedTuple):
    """The mounting in use: ΔR, (3, 3), the frame of the sensor, and the levelled frame."""

    rotation: Floats
    frame_id: str
    levelled: str


class Result(NamedTuple):
    """The last fit, refinement or levelling, as JSON."""

    text: str


Event = Log | Mounting | Result | Still | ShowPoses | Task
"""What a session reports: log lines, what to publish, and tasks to run."""


@dataclass(frozen=True)
class Throttle:
    """Decide what is due, such as log lines: of each kind, at most one within a time."""

    clock: Callable[[], float] = monotonic
    last: dict[str, float] = field(default_factory=dict)

    def passes(self, kind: str, once_in: float) -> bool:
        """Return whether one of this kind is due, at most once in `once_in` [s]; note it."""
        now = self.clock()
        if now - self.last.get(kind, -math.inf) < once_in:
            return False
        self.last[kind] = now
        return True


Answer = Callable[[bool, Any], object]
"""Function of the success of a task, and of its answer or the words of its error."""

CallSoon = Callable[[Callable[[], object]], None]
"""Function that lets the thread of the session call a function, one after the other."""


class Worker:
    """
    The threads for the tasks of a session, which come with its `events`.

    `running` names the commands that are not answered, the oldest first. `call_soon` lets the
    thread of the session call a function. `show` is called with each event that is no task, in
    the thread of the session. `flush` passes all samples so far to the session, before a command
    begins.

    """

    def __init__(self, events: deque[Event], call_soon: CallSoon, show: Callable[[Any], object],
                 flush: Callable[[], object] = lambda: None) -> None:
        self._events, self._call_soon, self._show = events, call_soon, show
        self._flush = flush
        self._files = ThreadPoolExecutor(1, 'accel_calib_files')
        self._computation = ThreadPoolExecutor(1, 'accel_calib')
        self._process = WorkerProcess()
        self._steps: deque[tuple[Parse, Task, Answer]] = deque()
        self._computed: deque[tuple[Task, Answer, Future[Any] | None]] = deque()
        self._commands: deque[tuple[Task, Answer, Future[Any] | None]] = deque()
        self.running: list[str] = []
        self._is_busy = self._closed = False

    def handle_events(self) -> None:
        """Show the events of the session, run its tasks, and log their answers."""
        while self._events:
            event = self._events.popleft()
            if isinstance(event, Generator):
                self.run(event, lambda success, words: self.log(
                    'info' if success else 'warning', words))
            else:
                self._show(event)

    def log(self, severity: Severity, words: str) -> None:
        """Log a line, unless it is empty, and show it at once."""
        self._events += [Log(severity, words)] if words else []
        self.handle_events()

    def do(self, name: str, command: Task, answer: Answer) -> None:
        """Begin a command when no files are used, run its steps, log its words, and `answer`."""
        def done(success: bool, found: Any) -> None:
            self.running.remove(name)
            if isinstance(found, str):
                self.log('info' if success else 'warning', found)
            answer(success, found)

        def fresh() -> Task:
            self._flush()
            return (yield from command)

        self.running.append(name)
        self._commands.append((fresh(), done, None))
        self._advance()

    def run(self, task: Task, answer: Answer) -> None:
        """Begin a task now, run its steps, and call `answer`."""
        self._proceed(task, answer, self._outcome(task))

    def _advance(self) -> None:
        """Begin what waits, until a step uses the files; such steps come first, commands last."""
        while not self._is_busy and not self._closed:
            if self._steps:
                step, task, answer = self._steps.popleft()
                self._is_busy = True
                self._submit(self._files, step, self._process.call_if_free,
                             partial(self._resume, task, answer))
            elif waiting := self._computed or self._commands:
                self._resume(*waiting.popleft())
            else:
                return

    def _submit(self, pool: ThreadPoolExecutor, step: Step, call: Callable[..., Any],
                then: Callable[[Future[Any]], object]) -> None:
        """Run a step in a pool; what is `then` to be done, and what waits, is done here."""
        def finish(done: Future[Any]) -> None:
            then(done)
            self._advance()

        future = pool.submit(step.run, call)
        future.add_done_callback(lambda done: self._call_soon(partial(finish, done)))

    def _resume(self, task: Task, answer: Answer, done: Future[Any] | None) -> None:
        """Continue a task with the result of its step; nothing else begins meanwhile."""
        if self._closed:
            return  # rclpy may have destroyed the publishers
        self._is_busy = True
        try:
            outcome = self._outcome(task, done)
            self.handle_events()  # first, so that a command is answered after its poses are stored
            self._proceed(task, answer, outcome)
        finally:
            self._is_busy = False

    def _proceed(self, task: Task, answer: Answer, outcome: tuple[bool, Any]) -> None:
        success, found = outcome
        if isinstance(found, Parse):
            self._steps.append((found, task, answer))
            self._advance()
        elif isinstance(found, Step):
            self._submit(self._computation, found, self._process.call,
                         lambda done: self._computed.append((task, answer, done)))
        else:
            answer(success, found)

    def _outcome(self, task: Task, done: Future[Any] | None = None) -> tuple[bool, Any]:
        """Return success, and the next step, answer or words; unexpected errors are logged."""
        try:
            if done is None:
                return True, next(task)
            error = done.exception()
            return True, task.send(done.result()) if error is None else task.throw(error)
        except StopIteration as end:
            return True, end.value
        except AccelCalibError as error:
            return False, str(error)
        except OSError as error:
            return False, f'{error}; {writing_advice(error)}'
        except Exception as error:
            self.log('error', f'unexpected error in accel_calib:\n{format_exc()}')
            return False, (f'unexpected error in accel_calib ({error!r}); please report it with '
                           'the log')

    def close(self) -> None:
        """Stop the computation, and finish writing."""
        self._closed = True
        self._process.close()
        self._computation.shutdown(wait=True)
        for step, _, _ in self._steps:
            self._files.submit(step.run, self._process.call_if_free)
        self._files.shutdown(wait=True)
