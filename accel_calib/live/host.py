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

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
import math
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Protocol

import numpy as np

from .exchange import Exchange
from .messages import PERIOD
from .server import PageServer
from ..errors import AccelCalibError, system_error
from ..session import BATCH, CalibratorSettings, Job, Log, LogFilter, Session, ShowPoses
from ..session.events import Severity
from ..session.worker import Worker
from ..table import Floats

_TICK = 1.0
"""Interval between two checks of the stream [s]."""


class Samples(Protocol):
    """
    Where the samples come from; `sources.open_source` makes it.

    Attributes
    ----------
    name : str
        The port or the recording.
    sensor : str
        Name of the sensor, as a frame_id; empty if it is not known.
    blocks : iterable of (n, 9) array
        The samples as they arrive, as in `accel_calib.capture.StillDetector.push`. A block can be
        empty, and comes after a short time at the latest, because the page waits meanwhile.
    problem : callable
        Function that returns why no samples come at present; empty if nothing is wrong.

    """

    @property
    def name(self) -> str:
        """Return the port or the recording."""

    @property
    def sensor(self) -> str:
        """Return the name of the sensor, as a frame_id; empty if it is not known."""

    @property
    def blocks(self) -> Iterable[Floats]:
        """Return the samples as they arrive."""

    @property
    def problem(self) -> Callable[[], str]:
        """Return the function that returns why no samples come at present."""


class Host:
    """
    A session, its page, and the samples of a source.

    Parameters
    ----------
    source : Samples
        Where the samples come from.
    settings : CalibratorSettings
        The parameters; ``web_host`` and ``web_port`` are those of the page.
    log : callable
        Function that prints a log line.

    Attributes
    ----------
    server : PageServer
        The server of the page.
    session : Session
        The session.
    exchange : Exchange
        What the page shows of it.

    Raises
    ------
    InputError
        If the settings contradict each other, or the page cannot be served.

    """

    def __init__(self, source: Samples, settings: CalibratorSettings,
                 log: Callable[[Log], object]) -> None:
        self._source, self._print, self._filter = source, log, LogFilter()
        self._tasks: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._waiting: list[Floats] = []
        self._passed = self._ticked = self._shown = -math.inf
        self.session = Session(settings, source.name)
        self.session.publishers = None
        self._worker = Worker(self._tasks.put, self._handle_events,
                              lambda words: self._log(Log('error', words)))
        self.exchange = Exchange(self.session, self._worker, self._tasks.put, self._log,
                                 self._flush)
        try:
            self.server = PageServer(self.exchange, settings.web_host, settings.web_port)
            self.server.start()
        except AccelCalibError:
            self._end_session()
            raise
        self.exchange.show = self.server.show

    def run(self, is_over: Callable[[], bool]) -> None:
        """
        Serve until it is over.

        Parameters
        ----------
        is_over : callable
            Function that returns whether to end; it is called about 20 times per second.

        """
        self._handle_events()
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
        self._end_session()

    def _end_session(self) -> None:
        self._worker.close()
        self.session.close()

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
        self._show_problem(words, Log(severity, words))

    def _report_source(self) -> None:
        """Show and log that the source is interrupted, or is back."""
        problem = self._source.problem()
        if bool(problem) != bool(self.exchange.problem):
            self._show_problem(problem, Log('warning', problem) if problem else Log(
                'info', f'{self._source.name} is back; continue with the next pose'))
        self.exchange.problem = problem

    def _show_problem(self, problem: str, line: Log) -> None:
        """Show what is wrong, or that nothing is, and log it."""
        self.exchange.problem = problem
        self.exchange.show_state()
        self._log(line)

    def _work(self, wait: float = 0.0) -> None:
        """Run the tasks so far, waiting for the first one [s], and do what is due."""
        with suppress(Empty):
            if wait:
                self._tasks.get(timeout=wait)()
            while True:
                self._tasks.get_nowait()()
        now = monotonic()
        if now - self._passed >= BATCH:
            self._passed = now
            self._flush()
        if now - self._ticked >= _TICK:
            self._ticked = now
            if not self.exchange.problem:
                self.session.tick()
                self._handle_events()
            self.exchange.show_state()
        if now - self._shown >= PERIOD:
            self._shown = now
            self.exchange.show_progress(self._newest())

    def _newest(self) -> tuple[float, float, float] | None:
        """Return the newest reading that the session does not have yet."""
        if not self._waiting:
            return None
        x, y, z = self._waiting[-1][-1, 1:4].tolist()
        return x, y, z

    def _flush(self) -> None:
        """Pass the waiting samples to the session."""
        if self._waiting:
            samples, self._waiting = np.concatenate(self._waiting), []
            if self.session.accepts(self._source.sensor):
                self._set_temperature(samples[:, 7])
                self.session.push(samples, monotonic())
        self._handle_events()

    def _set_temperature(self, temperatures: Floats) -> None:
        """Pass the last known temperature to the session."""
        known = temperatures[np.isfinite(temperatures)]
        if len(known):
            self.session.set_temperature(float(known[-1]))

    def _handle_events(self) -> None:
        """Show and log what the session reports."""
        for event in self.session.events():
            if isinstance(event, Log):
                self._log(event)
            elif isinstance(event, ShowPoses):
                self.exchange.show_poses(event)
                self.exchange.show_state()
            elif isinstance(event, Job):
                self._worker.run(event, lambda success, words: self._log(
                    Log('info' if success else 'warning', words)))

    def _log(self, line: Log) -> None:
        if self._filter.passes(line):
            self._print(line)
            self.exchange.show_line(line)
