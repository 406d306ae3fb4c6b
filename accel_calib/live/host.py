# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A session without ROS behind the live page.

The host takes samples from a source, which is a recording or a serial port. One thread does all
that changes the session: it takes samples, runs commands, and finishes jobs. The source must
therefore yield a block, which can be empty, after a short time. After its end, the page and its
commands continue to work.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
import re
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from .exchange import Exchange
from .server import PAGE, PageServer
from .viewer import PERIOD
from ..errors import AccelCalibError, known_error
from ..session import (
    BATCH, CalibratorSettings, Event, Log, Session, Severity, Surroundings, Throttle, Worker)
from ..table import Floats

if TYPE_CHECKING:
    from .sources import Source

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
        self._tasks: SimpleQueue[Callable[[], object]] = SimpleQueue()
        self._waiting: list[Floats] = []
        self._due = Throttle()
        # Where no ROS runs, the labels of the buttons stand for the services.
        self._labels = {'preview': 'the preview', **dict(reversed(re.findall(
            r'data-command="(\w+)"[^>]*>([^<]+)<', PAGE.read_text(encoding='utf-8'))))}
        self.session = Session(settings, source.name, found=source.findings,
                               surroundings=Surroundings(publishers=None))
        self._worker = Worker(self.session.events, self._tasks.put, self._show, self._flush)
        self.exchange = Exchange(self.session, self._worker, self._tasks.put)
        try:
            self.server = PageServer(self.exchange, settings.web_host, settings.web_port)
            self.server.start()
        except AccelCalibError:
            self.close()
            raise

    def run(self, is_over: Callable[[], bool]) -> None:
        """Serve until `is_over`, which is called about 20 times per second, returns true."""
        self._worker.handle_events()
        for block in self._blocks():
            if is_over():
                return
            if len(block):
                self._waiting.append(block)
            problem, before = self._source.problem(), self.exchange.problem
            if bool(problem) != bool(before):
                self._show_problem(problem, 'warning' if problem else 'info', problem or (
                    f'{self._source.name} is back; continue with the next pose'))
            self.exchange.problem = problem
            self._work()
        self._flush()
        while not is_over():
            self._work(PERIOD)

    def close(self) -> None:
        """Stop serving, finish writing, and release the files."""
        self.server.close()
        self._worker.close()
        self.session.close()

    def _blocks(self) -> Iterator[Floats]:
        """Yield the blocks of the source; an error of it is logged and ends them."""
        severity: Severity = 'info'
        words = f'{self._source.name} has ended: fit and save, or end the program'
        try:
            yield from self._source.blocks
        except (AccelCalibError, OSError) as error:
            severity, words = 'error', str(known_error(error))
        self.session.change(surroundings=Surroundings(publishers=None, ended=True))
        self._show_problem(words, severity, words)

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
            self._print(replace(event, words=re.sub(
                r'(call )?~/(\w+)', lambda found: f'{"press " if found[1] else ""}'
                f'{self._labels.get(found[2], found[0])}', event.words)))
        self.exchange.show_event(event)
