# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The link of the live page, its connections, its viewers, and the messages that they exchange.

All messages are JSON. A viewer sends ``hello`` first and then ``ask``. The server sends messages
with a ``kind``. Numbers that are not known are null. Lengths of vectors and the accuracy are in g,
temperatures in °C, and times in seconds: of a log line since 1970, otherwise of a steady clock.

A connection is for one request. It is closed unless the request arrives within `_REQUEST_S`. A
viewer is a connection that has become a WebSocket.

A task of the viewer sends what is new for it: the newest progress, poses and state, the log lines
that it does not have, and the answers to its commands. Nothing else is queued. A viewer that takes
no data misses progress, and is closed after `STUCK_S`; a viewer that comes back gets the rest.

"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
import errno
from http import HTTPStatus
import io
from ipaddress import ip_address
import json
import math
import os
from pathlib import Path
import socket
import sys
from typing import Any, Protocol, TypeVar

from aiohttp import web, WSCloseCode, WSMsgType

from ..errors import InputError
from ..session import COMMANDS as COMMANDS_OF_A_SESSION, ros_home
from ..text import read_json

STUCK_S = 10.0
"""Time after which a viewer that takes no data, or does not answer, is closed [s]."""

_REQUEST_S = 10.0
"""Time within which a connection must send its request [s]."""

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

COMMANDS = (*COMMANDS_OF_A_SESSION, 'enable', 'disable')
"""Commands of the page."""

LARGEST = 4096
"""Largest message of a viewer [bytes]."""

OWNER = 3
"""Stage of a connection whose viewer has the token."""

Answered = TypeVar('Answered', bound=web.StreamResponse)

_BUFFER = 65536
"""Size of the buffers of a viewer [bytes]; more waits in the viewer's task."""


class Serving(Protocol):
    """What connections and viewers need of their server."""

    board: Any

    def add(self, connection: Connection) -> None: ...

    def remove(self, connection: Connection) -> None: ...

    def report(self, what: str) -> None: ...

    def admit(self, viewer: Viewer, token: str) -> None: ...

    def ask(self, command: str, answer: Callable[[bool, str], object]) -> None: ...


@dataclass(frozen=True)
class Hello:
    """The first message: the token, and the number of the last log line that the viewer has."""

    token: str
    seen: int


@dataclass(frozen=True)
class Ask:
    """A command, with a number for its answer."""

    id: int  # noqa: A003, the name in the message
    command: str


def request_of(text: str) -> Hello | Ask:
    """Return the message of a viewer; InputError if the text is none."""
    wrong = InputError('the message is not understood, expected {"hello": {"token", "seen"}} or '
                       '{"ask": {"id", "command"}}', 'load the page again')
    try:
        found = read_json(text)
    except ValueError:
        raise wrong from None
    match found:
        case {'hello': {'token': str(token), 'seen': int(seen)}}:
            return Hello(token, seen)
        case {'ask': {'id': int(number), 'command': str(command)}}:
            return Ask(number, command)
    raise wrong


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


def not_bound(error: OSError, host: str, port: int) -> InputError:
    """Return the error for an address that cannot be used."""
    if error.errno == errno.EADDRINUSE:
        return InputError(f'the port {port} of {host} is in use, so there is no live page',
                          'stop the other program, or choose another port')
    return InputError(f'the live page cannot be served at {host}, port {port}: '
                      f'{error.strerror or error}', 'choose an address of this machine, and a '
                      'port above 1023')


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


class Connection(web.RequestHandler):
    """
    A connection from an `address`.

    `stage` 0: its request has not arrived; 1: it is answered; 2: a viewer; 3: the `OWNER`.

    """

    def __init__(self, server: Serving, http: web.Server) -> None:
        super().__init__(http, loop=asyncio.get_running_loop(),
                         access_log=None)  # type: ignore[arg-type]
        self._owner, self.stage, self.address = server, 0, ''

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Close the connection later, unless its request arrives."""
        super().connection_made(transport)
        self.address = str((transport.get_extra_info('peername') or [''])[0])
        self._limit = asyncio.get_running_loop().call_later(_REQUEST_S, self.abort, 0)
        self._owner.add(self)

    def connection_lost(self, exc: BaseException | None) -> None:
        """Forget the connection."""
        self._limit.cancel()
        self._owner.remove(self)
        super().connection_lost(exc)

    def abort(self, most: int = OWNER) -> None:
        """End the connection without waiting, unless its stage is above `most`."""
        if self.transport is not None and self.stage <= most:
            self.transport.abort()

    def handle_error(self, request: web.BaseRequest, status: int = 500,
                     exc: BaseException | None = None, message: str | None = None
                     ) -> web.StreamResponse:
        """Return the answer to a request that is not HTTP, or to an unexpected error."""
        has_left = isinstance(exc, ConnectionError)
        if status != HTTPStatus.BAD_REQUEST and not has_left:
            return secured(super().handle_error(request, status, exc, message))
        self.stage = 1
        self._owner.report('lost a visitor before its answer' if has_left else
                           'refused a request that is not HTTP')
        return secured(web.Response(
            status=status, text='the request is not HTTP; open the link in a browser\n'))


class TooManyError(InputError):
    """There are too many viewers."""


class Viewer:
    """
    A viewer.

    `why` it only looks is set when it is admitted, and empty if its commands are accepted.

    """

    def __init__(self, server: Serving, websocket: web.WebSocketResponse,
                 connection: Connection) -> None:
        self._server, self._socket, self.connection = server, websocket, connection
        self._sent: dict[str, Message] = {}
        self._answers: deque[Message] = deque()
        self._seen = 0
        self.why, self._asking = '', 0
        self._news = asyncio.Event()
        self._sending_since = math.inf
        raw = websocket.get_extra_info('socket')
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)

    def wake(self) -> None:
        """Note that there is something new."""
        self._news.set()

    def abort_if_stuck(self, now: float) -> None:
        """End the connection if it has taken no data for too long; `now` is of the loop [s]."""
        if now - self._sending_since > STUCK_S:
            self.connection.abort()

    async def run(self) -> None:
        """Serve the viewer until it ends."""
        sending: asyncio.Task[None] | None = None
        try:
            hello = await self._next(_HELLO_S)
            if isinstance(hello, Hello):
                self._seen = hello.seen
                self._server.admit(self, hello.token)
                sending = asyncio.create_task(self._send_all())
                while request := await self._next(None):
                    if isinstance(request, Ask):
                        self._ask(request)
        except InputError as error:
            code = (WSCloseCode.TRY_AGAIN_LATER if isinstance(error, TooManyError) else
                    WSCloseCode.POLICY_VIOLATION)
            await self._socket.close(code=code, message=str(error).encode())
        finally:
            if sending is not None:
                sending.cancel()

    async def _next(self, timeout: float | None) -> Hello | Ask | None:
        """Return the next message of the viewer; None: it has ended."""
        try:
            message = await self._socket.receive(timeout=timeout)
        except asyncio.TimeoutError:
            raise InputError('no hello came', 'load the page again') from None
        return request_of(message.data) if message.type is WSMsgType.TEXT else None

    def _ask(self, request: Ask) -> None:
        """Run a command, if the viewer may."""
        def answer(success: bool, words: str) -> None:
            self._asking -= 1
            self._answers.append({'kind': 'answer', 'id': request.id, 'success': success,
                                  'words': words})
            self.wake()

        if self._asking + len(self._answers) >= _COMMANDS:
            raise InputError(f'{_COMMANDS} commands wait for their answers', 'load the page again')
        self._asking += 1
        if self.why:
            answer(False, self.why)
        elif request.command not in COMMANDS:
            answer(False, f'the page asks for {request.command[:40]!r}, expected one of '
                   f'{", ".join(COMMANDS)}; load the page again')
        else:
            self._server.ask(request.command, answer)

    async def _send_all(self) -> None:
        """Send what is new, until the viewer ends or takes no data."""
        try:
            await self._send(self._server.board.welcome(self.why))
            while True:
                self._news.clear()
                await self._send_new()
                await self._news.wait()
        except ConnectionError:
            self.connection.abort()

    async def _send_new(self) -> None:
        """Send the log lines, the newest message of each kind, and then the answers."""
        answers = len(self._answers)  # later ones may be about a state that is not sent yet
        for line in reversed(self._server.board.lines_after(self._seen)):
            await self._send(line)
            self._seen = line['number']
        for kind in ('state', 'poses', 'progress'):
            newest = self._server.board.newest.get(kind)
            if newest is not None and newest is not self._sent.get(kind):
                self._sent[kind] = newest
                await self._send(newest)
        for _ in range(answers):
            await self._send(self._answers.popleft())

    async def _send(self, message: Message) -> None:
        text = json.dumps(message, ensure_ascii=False, allow_nan=False, separators=(',', ':'))
        self._sending_since = asyncio.get_running_loop().time()
        await self._socket.send_str(text)  # waits only if the buffers are full
        self._sending_since = math.inf
