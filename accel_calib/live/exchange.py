# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the page shows of a session, and the answers to what it asks.

A message has a ``kind``: the state, the poses, the progress, or a log line.

"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from time import monotonic, time

import numpy as np

from .viewer import Message
from ..calibration import Calibration
from ..errors import InputError
from ..finding import LEVELS
from ..findings import angle_words, rate, residual_figures
from ..messages import Triple
from ..report import calibration_page, STORED
from ..session import (
    Answer, APART, CallSoon, Compute, conditions, Event, Log, progress, Result, run, Session,
    ShowPoses, Task, title, words_of_state, Worker)
from ..stored.exports import export

Show = Callable[[Message], object]
"""Function that shows a message to all viewers."""

_NO_CALIBRATION = InputError('there is no calibration yet', 'capture poses and press Fit')


class Exchange:
    """
    The messages of a session, and its answers; all in the thread of the session.

    Attributes
    ----------
    call_soon : callable
        Function that lets this thread call another one; the server uses it for all that it asks.
    log : callable
        Function that logs words of a severity.
    show : callable
        Function that shows a message to all viewers; set it before the first use.
    problem : str
        What the user must know before all else, such as the end of a recording; may be empty.

    """

    def __init__(self, session: Session, worker: Worker, call_soon: CallSoon) -> None:
        self._session, self._worker, self.call_soon = session, worker, call_soon
        self.log = worker.log
        self.show: Show = lambda message: None
        self.problem = ''
        self._shown: Calibration | None = None
        self._number = 0
        self._page: Future[tuple[bool, str]] | None = None
        self._line = int(time()) * 1000  # a viewer of an earlier server has smaller numbers

    # The session has news

    def show_progress(self, reading: Triple | None = None) -> None:
        """Show the progress; the parameter is as in `session.progress`."""
        now = progress(self._session.state, reading)
        self.show({'kind': 'progress', 'time': monotonic(), **vars(now)})

    def show_event(self, event: Event) -> None:
        """Show a log line, or the poses; and the state where it may have changed."""
        if isinstance(event, Log):
            self._line += 1
            self.show({'kind': 'log', 'number': self._line, 'severity': event.severity,
                       'words': event.words, 'time': round(time(), 3)})  # since 1970 [s]
        elif isinstance(event, ShowPoses):
            self.show({'kind': 'poses', 'up': event.up})
        if isinstance(event, ShowPoses | Result):
            self.show_state()

    def show_state(self) -> None:
        """
        Show the state, with the offered calibration, or otherwise the one in use.

        Without a `problem`, it has the most severe finding, other than that there is no
        calibration yet. The server sends it only if it has changed.

        """
        state, sensor = self._session.state, self._session.sensor
        in_use, shown, rating = sensor.calibration, sensor.present, sensor.rating
        if shown is not self._shown:
            self._shown, self._page, self._number = shown, None, self._number + 1
        found = [each for each in conditions(state) if each.level == 'BAD' or (
            each.level == 'USABLE' and each.kind not in APART)]
        worst = max(found, key=lambda each: LEVELS.index(each.level), default=None)
        self.show({
            'kind': 'state', 'sensor': state.name, 'source': state.topic,
            'state': words_of_state(state),
            'problem': self.problem or (worst.text if worst else ''),
            'calibration': '' if in_use is None else title(in_use),
            'preview': sensor.offered is not None,
            'levelled': shown is not None and shown.is_levelled,
            'mounting': '' if shown is None or not shown.is_levelled else (
                f'the sensor is mounted with {angle_words(shown.rotation)}'),
            'file': state.files.path, 'busy': next(iter(self._worker.running), ''),
            'counts_per_g': None if shown is None or not shown.units.is_native else np.mean(
                np.linalg.norm(shown.gain, axis=0)),
            'rating': None if shown is None or rating is None else {
                'rating': rating.name, 'reason': rating.reason},
            'result': None if shown is None else {
                'unit': shown.units.name, 'poses': len(shown.used_poses),
                'left_out': len(shown.poses) - len(shown.used_poses),
                'coverage': shown.quality.coverage,
                'residuals': [(figure.label, figure.value, figure.unit)
                              for figure in residual_figures(shown.quality)],
                'effects': [*map(str, shown.model.effects)], 'warnings': shown.warnings,
                'offset': shown.offset, 'gain': np.diag(shown.gain)},
            'page': '' if shown is None else f'/calibration.html?{self._number}'})

    # The page asks

    def ask(self, name: str, answer: Answer) -> None:
        """Run one of `BUTTONS`, and call `answer`."""
        if name in self._worker.running:
            answer(False, f'{name} is still running; wait for its answer')
            return

        def done(success: bool, words: str) -> None:
            self.show_state()  # a viewer knows what has changed when the answer comes
            answer(success, words)

        self._worker.do(name, run(self._session, name, offers=True), done)
        if self._worker.running:
            self.show_state()

    def page(self, answer: Answer) -> None:
        """Call `answer` with the calibration page, which is drawn once, or why there is none."""
        self.show_state()  # the calibration may have changed since
        if self._shown is None:
            answer(False, str(_NO_CALIBRATION))
            return
        page = self._page
        if page is None or (page.done() and not page.result()[0]):
            page = self._page = Future()
            self._worker.run(self._drawn(self._shown), lambda *found: page.set_result(found))
        page.add_done_callback(lambda done: answer(*done.result()))

    def _drawn(self, calibration: Calibration) -> Task:
        state = self._session.state
        stored = state.files.store.calibration.name if state.files.store else STORED
        return (yield Compute(calibration_page, calibration, Compute(rate, calibration),
                              state.topic, stored=stored))

    def export(self, name: str, answer: Answer) -> None:
        """Call `answer` with an export of the calibration in use, or why there is none."""
        self._worker.do('export', self._exported(name), answer)

    def _exported(self, name: str) -> Task:
        sensor = self._session.sensor
        if sensor.offered is not None:
            raise InputError('a new calibration waits', 'accept it or take it back first')
        if sensor.calibration is None:
            raise _NO_CALIBRATION
        return (yield Compute(export, sensor.calibration, name))
