# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The link of the live page, its viewers, and the messages that they exchange.

All messages are JSON. A viewer sends ``hello`` first and then ``ask``. The server sends messages
with a ``kind``. Numbers that are not known are null. Lengths of vectors and the accuracy are in g,
temperatures in °C, and times in seconds: of a log line since 1970, otherwise of a steady clock.

A task of the viewer sends what is new for it: the newest progress, poses and state, the log lines
that it does not have, and the answers to its commands. Nothing else is queued. A viewer that takes
no data misses progress, and is closed after `STUCK_S`; a viewer that comes back gets the rest.

"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
import io
from ipaddress import ip_address
import json
import math
import os
from pathlib import Path
import socket
import sys
from typing import Any, TypeVar

from aiohttp import web, WSCloseCode, WSMsgType

from .. import __version__
from ..errors import InputError
from ..session import BUTTONS, ros_home
from ..stored.exports import CALIBRATION_ALONE
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
    history: deque[Message] = field(
        default_factory=lambda: deque(maxlen=int(_HISTORY_S / PERIOD)))


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

    async def run(self, admit: Callable[[Viewer, str], None]) -> None:
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
