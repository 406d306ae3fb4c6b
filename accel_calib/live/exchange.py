# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the live page shows of a session, and what it can ask for.

An `Exchange` belongs to the thread of the session. Only `ask`, `page` and `export` are called by
the server in its thread, and they pass the work on.

"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, time

from . import messages
from ..calibrate import Calibration
from ..errors import InputError
from ..messages.one_reading import Triple
from ..rating import rate, Rating
from ..report.page import calibration_page, STORED
from ..session import Health, Job, Log, Session, ShowPoses
from ..session.worker import Answer, CallSoon, Worker
from ..stored.exports import export, Exported

Show = Callable[[messages.Message], object]
"""Function that shows a message to all viewers."""

_NO_CALIBRATION = InputError('there is no calibration yet', 'capture poses and press Fit')


class Exchange:
    """
    The messages of a session, and its answers.

    Parameters
    ----------
    session : Session
        The session.
    worker : Worker
        Its worker.
    call_soon : callable
        Function that lets the thread of the session call a function.
    log : callable
        Function that logs the answers to commands.
    flush : callable
        Function that passes all messages so far to the session.

    Attributes
    ----------
    show : callable
        Function that shows a message to all viewers; set it before the first use.
    problem : str
        What the user must know before all else, such as the end of a recording; may be empty.

    """

    def __init__(self, session: Session, worker: Worker, call_soon: CallSoon,
                 log: Callable[[Log], object], flush: Callable[[], object]) -> None:
        self._session, self._worker, self._call_soon = session, worker, call_soon
        self._log, self._flush = log, flush
        self.show: Show = lambda message: None
        self.problem = ''
        self._shown: Calibration | None = None
        self._rating: Rating | None = None
        self._number = 0
        self._page: tuple[int, str] = (-1, '')
        self._drawing = -1
        self._waiting: list[Answer] = []
        self._line = int(time()) * 1000  # a viewer of an earlier server has smaller numbers

    # The session has news

    def show_progress(self, reading: Triple | None = None) -> None:
        """Show the progress; the parameter is as in `Session.progress`."""
        self.show(messages.progress(monotonic(), self._session.progress(reading)))

    def show_poses(self, event: ShowPoses) -> None:
        """Show the poses."""
        self.show(messages.poses(event.up))

    def show_line(self, line: Log) -> None:
        """Show a log line."""
        self._line += 1
        self.show(messages.log(self._line, line.severity, line.words, time()))

    def show_state(self, health: Health | None = None) -> None:
        """Show the state; the server sends it only if it has changed."""
        session = self._session
        if session.commands.present is not self._shown:
            self._take(session.commands.present)
        self.show(messages.state(
            session.health() if health is None else health, self.problem, shown=self._shown,
            preview=session.preview is not None, busy=next(iter(self._worker.running), ''),
            rating=self._rating, page=self._number))

    def _take(self, calibration: Calibration | None) -> None:
        """Show another calibration, and rate it in the worker process."""
        self._shown, self._rating = calibration, None
        self._number += 1
        if calibration is None:
            return

        def finish(found: Rating) -> str:
            if self._shown is calibration:
                self._rating = found
                self.show_state()
            return ''

        self._worker.run(
            Job(lambda compute: compute(rate, calibration), finish, computes=True),
            lambda success, words: success or self._log(Log('warning', words)))

    # The page asks; these are called in the thread of the server

    def ask(self, command: str, answer: Answer) -> None:
        """Run a command of `messages.COMMANDS`, and call `answer`."""
        self._call_soon(lambda: self._ask(command, answer))

    def page(self, answer: Answer) -> None:
        """Call `answer` with the calibration page, or why there is none."""
        self._call_soon(lambda: self._draw(answer))

    def export(self, name: str, answer: Callable[[Exported | str], object]) -> None:
        """Call `answer` with an export of the calibration in use, or why there is none."""
        self._call_soon(lambda: self._export(name, answer))

    def _ask(self, name: str, answer: Answer) -> None:
        if name in self._worker.running:
            answer(False, f'{name} is still running; wait for its answer')
            return

        def command() -> str | Job:
            self._flush()
            return _command(self._session, name)

        def done(success: bool, words: str) -> None:
            self._log(Log('info' if success else 'warning', words))
            self.show_state()  # a viewer knows what has changed when the answer comes
            answer(success, words)

        self._worker.do(name, command, done)
        if self._worker.running:
            self.show_state()

    def _draw(self, answer: Answer) -> None:
        """Draw the calibration page, unless it is drawn already."""
        self.show_state()  # the calibration may have changed since
        calibration, number = self._shown, self._number
        if calibration is None:
            answer(False, str(_NO_CALIBRATION))
            return
        if self._page[0] == number:
            answer(True, self._page[1])
            return
        self._waiting.append(answer)
        if self._drawing == number:
            return
        self._drawing = number
        store = self._session.files.store
        given = calibration, self._session.topic, store.calibration.name if store else STORED

        def answer_all(success: bool, words: str) -> None:
            self._page, self._drawing = (number if success else -1, words), -1
            waiting, self._waiting = self._waiting, []
            for each in waiting:
                each(success, words)

        self._worker.run(Job(lambda compute: compute(drawn, *given), str, computes=True),
                         answer_all)

    def _export(self, name: str, answer: Callable[[Exported | str], object]) -> None:
        session, made = self._session, list[Exported]()
        calibration = session.active.calibration

        def command() -> Job:
            if session.preview is not None:
                raise InputError('a new calibration waits', 'accept it or take it back first')
            if calibration is None:
                raise _NO_CALIBRATION
            return Job(lambda compute: compute(export, calibration, name), finish, computes=True)

        def finish(found: Exported) -> str:
            made.append(found)
            return ''

        self._worker.do('export', command,
                        lambda success, words: answer(made[0] if success else words))


def _command(session: Session, name: str) -> str | Job:
    """Call a command of the page."""
    if name in ('enable', 'disable'):
        return session.commands.enable(name == 'enable')
    command = getattr(session.commands, name)
    found: str | Job = command(offered=True) if name in messages.OFFERED else command()
    return found


def drawn(calibration: Calibration, source: str, stored: str) -> str:
    """Return the page of a calibration; `stored` is the name of its file."""
    return calibration_page(calibration, rate(calibration), source, stored=stored)
