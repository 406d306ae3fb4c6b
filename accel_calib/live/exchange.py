# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the page shows of a session, and how it reaches the viewers: link, messages and answers.

All messages are JSON. A viewer sends ``hello`` first and then ``ask``. The server sends messages
with a ``kind``, such as the state, the poses, the progress, or a log line. Numbers that are not
known are null. Lengths of vectors and the accuracy are in g, temperatures in °C, and times in
seconds: of a log line since 1970, otherwise of a steady clock.

A task of the viewer sends what is new for it: the newest progress, poses and state, the log lines
that it does not have, and the answers to its commands. Nothing else is queued. A viewer that takes
no data misses progress, and is closed after `STUCK_S`; a viewer that comes back gets the rest.

"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
import io
from ipaddress import ip_address
import json
import math
import os
from pathlib import Path
import socket
import sys
from time import monotonic, time
from typing import Any, TypeVar

from aiohttp import web, WSCloseCode, WSMsgType
import numpy as np

from .. import __version__
from ..calibration import Calibration
from ..errors import InputError
from ..finding import LEVELS
from ..findings import angle_words, rate, residual_figures
from ..messages import Triple
from ..report import calibration_page, STORED
from ..session import (
    Answer, APART, BUTTONS, CallSoon, Compute, conditions, Event, Log, progress, Result, ros_home,
    run, Session, ShowPoses, Task, title, words_of_state, Worker)
from ..stored.exports import CALIBRATION_ALONE, export
from ..text import read_json

STUCK_S = 10.0
"""Time after which a viewer that takes no data, or does not answer, is closed [s]."""

_HELLO_S = 5.0
"""Time within which a new viewer must say hello [s]."""

_COMMANDS = 16
"""Largest number of commands of a viewer that wait for their answers."""

_HEADERS = {'Server': 'accel_calib', 'X-Content-Type-Options': 'nosniff',
            'Referrer-Policy': 'no-referrer', 'Cache-Control': 'no-store',
            'Cross-Origin-Resource-Policy': 'same-origin',
            'Content-Security-Policy': (
                "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
                "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; "
                "frame-ancestors 'none'")}

Message = Mapping[str, Any]

LARGEST = 4096
"""Largest message of a viewer [bytes]."""

Answered = TypeVar('Answered', bound=web.StreamResponse)

_BUFFER = 65536
"""Size of the buffers of a viewer [bytes]; more waits in the viewer's task."""

PERIOD = 0.05
"""Interval between two messages of progress [s]."""

_LINES = 500
"""Number of log lines that are kept."""

_HISTORY_S = 60.0
"""Time for which a new viewer gets the history [s]."""

_NOT_UNDERSTOOD = InputError(
    'the message is not understood, expected {"hello": {"token", "seen"}} or {"ask": {"id", '
    '"command"}}', 'load the page again')


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


# ----------------------------------------------------------------------------- viewers

def qr_code(link: str) -> str:
    """Return a link as a QR code for a terminal; empty if segno is not installed."""
    try:
        import segno
    except ImportError:
        return ''
    drawn = io.StringIO()
    segno.make(link, micro=False).terminal(out=drawn, compact=True)
    return drawn.getvalue()


def announce(link: str, name: str) -> tuple[str, Path | None]:
    """
    Show a link with its token to its owner alone; return a log line, and the file with the link.

    A terminal shows the link. Other output may be a log that others can read, so that the link is
    then written into the file `name` of mode 600 in ``accel_calib`` in `ros_home`.

    """
    words = f'live page: {link.partition("#")[0]}'
    if sys.stdout.isatty():
        sys.stdout.write(f'live page: {link}\n{qr_code(link)}\n')
        sys.stdout.flush()
        return f'{words}; its link with the token is on the terminal', None
    try:
        file = ros_home() / 'accel_calib' / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        with open(file, 'x', encoding='utf-8',
                  opener=lambda name, flags: os.open(name, flags, 0o600)) as opened:
            opened.write(f'{link}\n')
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no home folder
        return (f'{words}, which only shows, because the link with its token cannot be kept in a '
                f'file: {error}; set ROS_HOME to a folder that can be written'), None
    return f'{words}; its link with the token is in {file}', file


def reachable(host: str) -> str:
    """Return an address for a link: that of the network if the server listens everywhere."""
    try:
        address = ip_address(host)
    except ValueError:
        return host
    if not address.is_unspecified:
        return host
    family, outside = ((socket.AF_INET, '192.0.2.1') if address.version == 4
                       else (socket.AF_INET6, '2001:db8::1'))
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((outside, 9))  # sends nothing, but chooses the interface
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def secured(response: Answered) -> Answered:
    """Add the headers of security, and let the connection end; a response can have its policy."""
    for name, value in _HEADERS.items():
        response.headers.setdefault(name, value)
    response.force_close()
    return response


@dataclass(frozen=True)
class Board:
    """What viewers are shown: the newest message of each kind, log lines, and the history."""

    newest: dict[str, Message] = field(default_factory=dict)
    lines: deque[Message] = field(default_factory=lambda: deque(maxlen=_LINES))
    history: deque[Message] = field(default_factory=lambda: deque(maxlen=int(_HISTORY_S / PERIOD)))


class TooManyError(InputError):
    """There are too many viewers."""


class Viewer:
    """
    A viewer, which is shown what is on a board; `ask` answers its commands, and `abort` ends it.

    `why` it only looks is set when it is admitted, and empty if its commands are accepted. `news`
    is set when there is something new. It has been sending the same since `sending_since`, by the
    clock of the loop [s].

    """

    def __init__(self, board: Board, websocket: web.WebSocketResponse, abort: Callable[[], None],
                 ask: Callable[[str], Awaitable[tuple[bool, str]]]) -> None:
        self._board, self._socket, self.abort, self._ask = board, websocket, abort, ask
        self._sent: dict[str, Message] = {}
        self._answers: deque[Message] = deque()
        self._asking: set[asyncio.Task[None]] = set()
        self._seen = 0
        self.why, self.sending_since = '', math.inf
        self.news = asyncio.Event()
        raw = websocket.get_extra_info('socket')
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)

    async def run(self, admit: 'Callable[[Viewer, str], None]') -> None:
        """Serve the viewer until it ends; `admit` it with its token."""
        sending: asyncio.Task[None] | None = None
        try:
            while (request := await self._next(_HELLO_S if sending is None else None)) is not None:
                match request:
                    case {'hello': {'token': str(token), 'seen': int(seen)}} if sending is None:
                        self._seen = seen
                        admit(self, token)
                        sending = asyncio.create_task(self._send_all())
                    case {'ask': {'id': int(number), 'command': str(command)}} if sending:
                        if len(self._asking) + len(self._answers) >= _COMMANDS:
                            raise InputError(f'{_COMMANDS} commands wait for their answers',
                                             'load the page again')
                        asking = asyncio.create_task(self._run_command(number, command))
                        self._asking.add(asking)
                        asking.add_done_callback(self._asking.discard)
                    case _:
                        raise _NOT_UNDERSTOOD
        except InputError as error:
            code = (WSCloseCode.TRY_AGAIN_LATER if isinstance(error, TooManyError) else
                    WSCloseCode.POLICY_VIOLATION)
            await self._socket.close(code=code, message=str(error).encode())
        finally:
            if sending is not None:
                sending.cancel()

    async def _next(self, timeout: float | None) -> Any:
        """Return the next message of the viewer; None: it has ended."""
        try:
            message = await self._socket.receive(timeout=timeout)
            return read_json(message.data) if message.type is WSMsgType.TEXT else None
        except asyncio.TimeoutError:
            raise InputError('no hello came', 'load the page again') from None
        except ValueError:
            raise _NOT_UNDERSTOOD from None

    async def _run_command(self, number: int, command: str) -> None:
        """Run a command, if the viewer may."""
        success, words = False, self.why
        if not words and command not in BUTTONS:
            words = (f'the page asks for {command[:40]!r}, expected one of {", ".join(BUTTONS)}; '
                     'load the page again')
        if not words:
            success, words = await self._ask(command)
        self._answers.append({'kind': 'answer', 'id': number, 'success': success, 'words': words})
        self.news.set()

    async def _send_all(self) -> None:
        """Send what is new, until the viewer ends or takes no data."""
        try:
            kept = self._board.history.copy()
            await self._send({
                'kind': 'welcome', 'may': not self.why, 'why': self.why, 'version': __version__,
                'exports': CALIBRATION_ALONE, 'history': {
                    key: [each[key] for each in kept] for key in ('time', 'length', 'corrected')}})
            while True:
                self.news.clear()
                answers = len(self._answers)  # later ones may be about a state that is not sent
                for line in [each for each in self._board.lines if each['number'] > self._seen]:
                    await self._send(line)
                    self._seen = line['number']
                for kind in ('state', 'poses', 'progress'):
                    newest = self._board.newest.get(kind)
                    if newest is not None and newest is not self._sent.get(kind):
                        self._sent[kind] = newest
                        await self._send(newest)
                for _ in range(answers):
                    await self._send(self._answers.popleft())
                await self.news.wait()
        except ConnectionError:
            self.abort()

    async def _send(self, message: Message) -> None:
        text = json.dumps(message, ensure_ascii=False, allow_nan=False, separators=(',', ':'))
        self.sending_since = asyncio.get_running_loop().time()
        await self._socket.send_str(text)  # waits only if the buffers are full
        self.sending_since = math.inf
