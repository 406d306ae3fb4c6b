# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A session without ROS behind the live page, and what the page shows of any session.

The host takes samples from a source, which is a recording or a serial port. One thread does all
that changes the session: it takes samples, runs commands, and finishes jobs. The source must
therefore yield a block, which can be empty, after a short time. After its end, the page and its
commands continue to work.

An `Exchange` belongs to the thread of the session. The server calls only `ask`, `page`, `export`
and `warn`, in its own thread, and they pass the work on.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from functools import cache
from queue import Empty, SimpleQueue
import re
from time import monotonic, time
from typing import TYPE_CHECKING

import numpy as np

from .server import PAGE, PageServer, PERIOD
from .viewer import Message
from ..calibration import Calibration
from ..errors import AccelCalibError, InputError, system_error
from ..findings import angle_words, rate, residual_figures
from ..messages.one_reading import Triple
from ..report import calibration_page, STORED
from ..session import (
    Answer, BATCH, CalibratorSettings, CallSoon, Commands, Compute, conditions, Event, Level, Log,
    Result, Session, Severity, ShowPoses, state, Surroundings, Task, Throttle, title,
    words_of_state, Worker)
from ..stored.exports import export, Exported
from ..table import Floats

if TYPE_CHECKING:
    from .sources import Source

Show = Callable[[Message], object]
"""Function that shows a message to all viewers."""

_NO_CALIBRATION = InputError('there is no calibration yet', 'capture poses and press Fit')


class Exchange:
    """
    The messages of a session, and its answers.

    `call_soon` lets the thread of the session call a function.

    Attributes
    ----------
    show : callable
        Function that shows a message to all viewers; set it before the first use.
    problem : str
        What the user must know before all else, such as the end of a recording; may be empty.

    """

    def __init__(self, session: Session, worker: Worker, call_soon: CallSoon) -> None:
        self._session, self._worker, self._call_soon = session, worker, call_soon
        self._commands = Commands(session, offers=True)
        self.show: Show = lambda message: None
        self.problem = ''
        self._shown: Calibration | None = None
        self._number = 0
        self._drawing: tuple[int, Future[tuple[bool, str]]] = -1, Future()
        self._line = int(time()) * 1000  # a viewer of an earlier server has smaller numbers

    # The session has news

    def show_progress(self, reading: Triple | None = None) -> None:
        """Show the progress; the parameter is as in `state.progress`."""
        now = state.progress(self._session.state, reading)
        self.show({'kind': 'progress', 'time': monotonic(), **vars(now)})

    def show_event(self, event: Event) -> None:
        """Show a log line, or the poses; and the state where it may have changed."""
        if isinstance(event, Log):
            self._line += 1
            self.show(log_line(self._line, event.severity, event.words, time()))
        elif isinstance(event, ShowPoses):
            self.show({'kind': 'poses', 'up': event.up})
        if isinstance(event, ShowPoses | Result):
            self.show_state()

    def show_state(self) -> None:
        """Show the state; the server sends it only if it has changed."""
        session = self._session
        if session.sensor.present is not self._shown:
            self._shown = session.sensor.present
            self._number += 1
        self.show(_state(
            session, self.problem, busy=next(iter(self._worker.running), ''), page=self._number))

    # The page asks; these are called in the thread of the server

    def ask(self, command: str, answer: Answer) -> None:
        """Run a command of `viewer.COMMANDS`, and call `answer`."""
        self._call_soon(lambda: self._ask(command, answer))

    def page(self, answer: Answer) -> None:
        """Call `answer` with the calibration page, or why there is none."""
        self._call_soon(lambda: self._draw(answer))

    def export(self, name: str, answer: Callable[[Exported | str], object]) -> None:
        """Call `answer` with an export of the calibration in use, or why there is none."""
        self._call_soon(lambda: self._worker.do(
            'export', self._exported(name), lambda success, found: answer(found)))

    def warn(self, words: str) -> None:
        """Log a warning of the server."""
        self._call_soon(lambda: self._worker.log('warning', words))

    def _ask(self, name: str, answer: Answer) -> None:
        if name in self._worker.running:
            answer(False, f'{name} is still running; wait for its answer')
            return

        def done(success: bool, words: str) -> None:
            self.show_state()  # a viewer knows what has changed when the answer comes
            answer(success, words)

        self._worker.do(name, self._command(name), done)
        if self._worker.running:
            self.show_state()

    def _command(self, name: str) -> Task:
        if name in ('enable', 'disable'):
            return self._commands.enable(name == 'enable')
        return (yield from self._commands.run(name))

    def _draw(self, answer: Answer) -> None:
        """Draw the calibration page, unless it is drawn already, or being drawn."""
        self.show_state()  # the calibration may have changed since
        if self._shown is None:
            answer(False, str(_NO_CALIBRATION))
            return
        number, page = self._drawing
        if number != self._number or (page.done() and not page.result()[0]):
            page = Future()
            self._drawing, store = (self._number, page), self._session.state.files.store
            self._worker.run(
                self._drawn(self._shown, store.calibration.name if store else STORED),
                lambda *found: page.set_result(found))
        page.add_done_callback(lambda done: answer(*done.result()))

    def _drawn(self, calibration: Calibration, stored: str) -> Task:
        return (yield Compute(drawn, calibration, self._session.state.topic, stored))

    def _exported(self, name: str) -> Task:
        session = self._session
        if session.sensor.offered is not None:
            raise InputError('a new calibration waits', 'accept it or take it back first')
        if session.sensor.calibration is None:
            raise _NO_CALIBRATION
        return (yield Compute(export, session.sensor.calibration, name))


def drawn(calibration: Calibration, source: str, stored: str) -> str:
    """Return the page of a calibration; `stored` is the name of its file."""
    return calibration_page(calibration, rate(calibration), source, stored=stored)


def log_line(number: int, severity: Severity, words: str, time: float) -> Message:
    """Return a log line with its number; `time` is that since 1970 [s]."""
    return {'kind': 'log', 'number': number, 'severity': severity, 'words': words,
            'time': round(time, 3)}


def _state(session: Session, problem: str, *, busy: str, page: int) -> Message:
    """
    Return the state of a session, with the calibration that is offered, or else the one in use.

    `problem` may be empty: then the most severe finding is shown. `busy` is the name of the
    command that runs, and `page` the number of the calibration page.

    """
    sensor = session.sensor
    in_use, shown, rating = sensor.calibration, sensor.present, sensor.rating
    return {
        'kind': 'state', 'sensor': session.state.name, 'source': session.state.topic,
        'state': words_of_state(session.state), 'problem': problem or _problem(session),
        'calibration': '' if in_use is None else title(in_use),
        'preview': sensor.offered is not None,
        'levelled': shown is not None and shown.is_levelled,
        'mounting': '' if shown is None or not shown.is_levelled else (
            f'the sensor is mounted with {angle_words(shown.rotation)}'),
        'file': session.state.files.path, 'busy': busy,
        'counts_per_g': None if shown is None or not shown.units.is_native else np.mean(
            np.linalg.norm(shown.gain, axis=0)),
        'rating': None if shown is None or rating is None else {
            'rating': rating.name, 'reason': rating.reason},
        'result': None if shown is None else _result(shown),
        'page': '' if shown is None else f'/calibration.html?{page}'}


def _problem(session: Session) -> str:
    """Return the most severe finding, other than that there is no calibration yet."""
    found = [each for each in conditions(session.state) if each.level and (
        each.name or each.level == Level.ERROR)]
    return max(found, key=lambda each: each.level).words if found else ''


def _result(calibration: Calibration) -> Message:
    quality, used = calibration.quality, len(calibration.used_poses)
    return {
        'unit': calibration.units.name, 'poses': used, 'left_out': len(calibration.poses) - used,
        'coverage': quality.coverage,
        'residuals': [(figure.label, figure.value, figure.unit)
                      for figure in residual_figures(quality)],
        'effects': [*map(str, calibration.model.effects)], 'warnings': calibration.warnings,
        'offset': calibration.offset, 'gain': np.diag(calibration.gain)}


@cache
def _buttons() -> dict[str, str]:
    """Return what stands for the services where no ROS runs: the labels of the buttons."""
    labels = re.findall(r'data-command="(\w+)"[^>]*>([^<]+)<', PAGE.read_text(encoding='utf-8'))
    return {'preview': 'the preview', **dict(reversed(labels))}


def _with_buttons(words: str) -> str:
    """Return words for a person at the page, as the page shows them."""
    return re.sub(r'(call )?~/(\w+)', lambda found: (
        f'{"press " if found[1] else ""}{_buttons().get(found[2], found[0])}'), words)


_TICK = 1.0
"""Interval between two checks of the stream [s]."""


class Host:
    """
    A session, its page, and the samples of a source; `log` prints a log line.

    InputError if the settings contradict each other, or the page cannot be served.

    """

    def __init__(self, source: Source, settings: CalibratorSettings,
                 log: Callable[[Log], None]) -> None:
        self._source, self._print = source, log
        self._tasks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._waiting: list[Floats] = []
        self._due = Throttle()
        self.session = Session(settings, source.name, found=source.findings,
                               surroundings=Surroundings(publishers=None))
        self._worker = Worker(self.session, self._tasks.put, self._show, self._flush)
        self.exchange = Exchange(self.session, self._worker, self._tasks.put)
        try:
            self.server = PageServer(self.exchange, settings.web_host, settings.web_port)
            self.server.start()
        except AccelCalibError:
            self._worker.close()
            raise

    def run(self, is_over: Callable[[], bool]) -> None:
        """Serve until `is_over`, which is called about 20 times per second, returns true."""
        self._worker.handle_events()
        for block in self._blocks():
            if is_over():
                return
            if len(block):
                self._waiting.append(block)
            self._report_source()
            self._work()
        self._flush()
        while not is_over():
            self._work(PERIOD)

    def close(self) -> None:
        """Stop serving, finish writing, and release the files."""
        self.server.close()
        self._worker.close()

    def _blocks(self) -> Iterator[Floats]:
        """Yield the blocks of the source; an error of it is logged and ends them."""
        try:
            yield from self._source.blocks
        except AccelCalibError as error:
            self._end('error', str(error))
        except OSError as error:
            self._end('error', str(system_error(error)))
        else:
            self._end('info', f'{self._source.name} has ended: fit and save, or end the program')

    def _end(self, severity: Severity, words: str) -> None:
        """Show why no more samples come."""
        self.session.change(surroundings=Surroundings(publishers=None, ended=True))
        self._show_problem(words, severity, words)

    def _report_source(self) -> None:
        """Show and log that the source is interrupted, or is back."""
        problem = self._source.problem()
        if bool(problem) != bool(self.exchange.problem):
            self._show_problem(problem, 'warning' if problem else 'info', problem or (
                f'{self._source.name} is back; continue with the next pose'))
        self.exchange.problem = problem

    def _show_problem(self, problem: str, severity: Severity, words: str) -> None:
        """Show what is wrong, or that nothing is, and log it."""
        self.exchange.problem = problem
        self.exchange.show_state()
        self._worker.log(severity, words)

    def _work(self, wait: float = 0.0) -> None:
        """Run the tasks so far, waiting for the first one [s], and do what is due."""
        with suppress(Empty):
            if wait:
                self._tasks.get(timeout=wait)()
            while True:
                self._tasks.get_nowait()()
        if self._due.passes('batch', BATCH):
            self._flush()
        if self._due.passes('tick', _TICK):
            if not self.exchange.problem:
                self.session.tick()
                self._worker.handle_events()
            self.exchange.show_state()
        if self._due.passes('progress', PERIOD):
            self.exchange.show_progress(
                tuple(self._waiting[-1][-1, 1:4].tolist()) if self._waiting else None)

    def _flush(self) -> None:
        if self._waiting:
            samples, self._waiting = np.concatenate(self._waiting), []
            if self.session.accepts(self._source.sensor):
                known = samples[np.isfinite(samples[:, 7]), 7]
                if len(known):
                    self.session.state.around.take('temperature', float(known[-1]))
                self.session.push(samples, monotonic())
        self._worker.handle_events()

    def _show(self, event: Event) -> None:
        if isinstance(event, Log):
            self._print(replace(event, words=_with_buttons(event.words)))
        self.exchange.show_event(event)
