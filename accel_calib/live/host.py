# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A session without ROS behind the live page, with samples of a serial port or a recording.

A source yields blocks of samples without waiting for long: a block can be empty. So the one thread
of the host does all that changes the session: it takes samples, runs commands, and finishes jobs.
After the end of the source, the page and its commands continue to work.

"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from queue import Empty, SimpleQueue
import re
import time
from time import monotonic

import numpy as np

from .exchange import Exchange, PERIOD
from .server import PAGE, PageServer
from ..errors import AccelCalibError, InputError, known_error
from ..finding import Finding
from ..logs import is_port, LineReader, LogOptions, open_log, open_port
from ..session import (
    BATCH, CalibratorSettings, Event, Log, Session, Severity, Surroundings, Throttle, Worker)
from ..stillness import samples_of
from ..table import Floats, Recording
from ..units import Units

_TICK = 1.0
"""Interval between two checks of the stream [s]."""

_WAIT_S = 0.03
"""Interval between two blocks of a recording [s]."""

_LONGEST_GAP_S = 5.0
"""Longer gaps in a recording are not waited for [s]."""


@dataclass(frozen=True)
class Source:
    """
    Samples as they arrive; `open_source` makes it.

    Parameters
    ----------
    name : str
        The port or the recording.
    sensor : str
        Name of the sensor; empty if it is not known.
    units : Units
        Unit of the readings.
    read_as : str
        How they are read, in one line; empty if nothing is assumed.
    blocks : iterator of (n, 9) array
        The samples, as for `accel_calib.stillness.StillDetector.push`. A block can be empty.
    findings : tuple of Finding
        What was decided by the first values, against what they seem to be.
    problem : callable
        Function that returns why no samples come at present; empty if nothing is wrong.

    """

    name: str
    sensor: str
    units: Units
    read_as: str
    blocks: Iterator[Floats]
    findings: tuple[Finding, ...] = ()
    problem: Callable[[], str] = str


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
            self._print(event._replace(words=re.sub(
                r'(call )?~/(\w+)', lambda found: f'{"press " if found[1] else ""}'
                f'{self._labels.get(found[2], found[0])}', event.words)))
        self.exchange.show_event(event)


# ----------------------------------------------------------------------------- sources

@contextmanager
def open_source(name: str, options: LogOptions, *, baud: int, speed: float = 1.0
                ) -> Iterator[Source]:
    """
    Open a serial port, or a recording.

    Parameters
    ----------
    name : str
        Device of the port or its URL (``socket://HOST:PORT``), or file of the recording.
    options : LogOptions
        How to read it; by default it is recognised.
    baud : int
        Baud rate of the port.
    speed : float
        Speed of the recording, relative to real time.

    Raises
    ------
    InputError
        If it cannot be opened or read, or sends no samples; also while it is read.
    OSError
        If the file cannot be read.

    """
    if is_port(name):
        with open_port(name, options, baud) as (reader, arriving, problem):
            first = [] if reader.first is None else [_rows(reader.first)]
            blocks = (rows for lines in arriving for rows in _rows_of(reader, lines))
            yield Source(name, sensor='', units=reader.units, read_as=reader.read_as,
                         blocks=_in_order(chain(first, blocks)), findings=reader.findings,
                         problem=problem)
        return
    with open_log(Path(name), options) as log:
        yield Source(name, log.sensor, log.units, log.read_as,
                     blocks=_played(log.blocks, speed), findings=log.findings)


# ----------------------------------------------------------------------------- a recording

def _played(blocks: Iterator[Recording], speed: float) -> Iterator[Floats]:
    """Yield the samples of a recording when they are due."""
    shift = last = -np.inf
    for block in blocks:
        rows = _rows(block)
        due, done = np.maximum.accumulate(rows[:, 0]) / speed, 0
        while done < len(rows):
            now = time.monotonic()
            if due[done] - last > _LONGEST_GAP_S / speed:
                shift = due[done] - now
            ready = int(np.searchsorted(due, now + shift, side='right'))
            gaps = np.flatnonzero(np.diff(due[done:ready]) > _LONGEST_GAP_S / speed)
            ready = max(done, done + int(gaps[0]) + 1 if len(gaps) else ready)
            yield rows[done:ready]
            if ready > done:
                last, done = due[ready - 1], ready
            time.sleep(_WAIT_S)


def _rows(recording: Recording) -> Floats:
    rows = np.full((len(recording), 9), np.nan)
    columns = samples_of(recording, 0, len(recording))
    rows[:, :len(columns)] = columns.T
    return rows


# ----------------------------------------------------------------------------- a serial port

def _in_order(blocks: Iterable[Floats]) -> Iterator[Floats]:
    """
    Leave out single samples whose time is not between those before and after.

    Lost characters make such times. If a board starts again, its times stay smaller, and all
    samples are kept. The last sample waits for the next one.

    """
    held = np.full((1, 9), np.nan)  # a sample that was yielded, and the one that waits
    for block in blocks:
        rows = np.concatenate([held, block])
        before, time, after = rows[:-2, 0], rows[1:-1, 0], rows[2:, 0]
        is_wrong = (before <= after) & ((time < before) | (time > after))
        yield rows[1:-1][~is_wrong]
        held = rows[-2:]


def _rows_of(reader: LineReader, lines: list[str]) -> Iterator[Floats]:
    """Yield the samples of lines; a line whose numbers are impossible is left out."""
    try:
        recording = reader.samples(lines) if lines else None
        yield np.empty((0, 9)) if recording is None else _rows(recording)
    except InputError:
        if len(lines) > 1:  # a lost character can make a number too large
            for line in lines:
                yield from _rows_of(reader, [line])
