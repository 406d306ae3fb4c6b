# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The server of the live page, on its own thread with its own event loop.

**Who may.** Everybody who reaches the server can look. Commands and exports need the token in the
fragment of the link, which browsers do not send. If there are too many viewers, one with the token
takes the place of one without it. If there are too many connections, one ends of the address that
has most of them: the oldest that has not said hello, before one that looks, and the owner last. A
newcomer is thus not ended before those that had longer, and nobody can keep the owner out. Host
and Origin are checked, so that a page of another site cannot use the server through the browser of
a user. Files come from a fixed list.

A connection is for one request. It is closed unless the request arrives within `_REQUEST_S`. A
viewer is a connection that has become a WebSocket and said hello.

"""

import asyncio
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
import errno
from functools import partial
import hmac
from http import HTTPStatus
from ipaddress import ip_address
from pathlib import Path
import secrets
import socket
from threading import Thread
from typing import Any, cast
from urllib.parse import urlsplit

from aiohttp import web

from .exchange import (
    announce, Board, Exchange, LARGEST, Message, PERIOD, reachable, secured, STUCK_S, TooManyError,
    Viewer)
from ..errors import InputError
from ..report import policy
from ..session import Answer, Throttle
from ..stored.exports import FORMATS
from ..text import plain

_REQUEST_S = 10.0
"""Time within which a connection must send its request [s]."""

VIEWER, OWNER = 2, 3
"""Stages of a connection that has said hello, without and with the token."""

PAGE = Path(__file__).with_name('page') / 'index.html'
"""The page; what it loads is in the same folder."""

_VIEWERS = 16
"""Largest number of viewers that have said hello."""

_CONNECTIONS = 128
"""Largest number of connections: of viewers, and of requests that arrive or are answered. It is
several times `_BACKLOG`, so that a request and the hello are read before others take the place."""

_BACKLOG = 16
"""Largest number of connections that are accepted at once; others wait in the system."""

_QUIET_S = 60.0
"""Shortest time between two log lines about the same misuse [s]."""

_ENDING_S = 1.0
"""Time in which answers are completed at the end [s]."""

_RARELY_S = 0.2
"""Interval at which the server looks for viewers while there is none [s]."""

_KINDS = {'.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript'}
"""Types of the files of the page, by the end of their name."""

_ITS_LINK = 'open the link with the token, which the program showed on its terminal at its last ' \
            'start, or wrote into the file that its log names'
_NO_TOKEN = f'this link has no token, so it only shows; {_ITS_LINK}'
_WRONG_TOKEN = 'the token of this link is of another start of the program, so it only shows; ' \
               f'{_ITS_LINK}'


class Connection(web.RequestHandler):
    """
    A connection from an `address`.

    `stage` 0: its request has not arrived; 1: it is answered; 2: a `VIEWER`; 3: the `OWNER`.

    """

    def __init__(self, server: 'PageServer', http: web.Server) -> None:
        super().__init__(http, loop=asyncio.get_running_loop(),
                         access_log=None)  # type: ignore[arg-type]
        self._owner, self.stage, self.address = server, 0, ''

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Close the connection later, unless its request arrives; at the limit, another one."""
        super().connection_made(transport)
        self.address = str((transport.get_extra_info('peername') or [''])[0])
        self._limit = asyncio.get_running_loop().call_later(_REQUEST_S, self.abort, 0)
        everyone = self._owner.connections
        if len(everyone) >= _CONNECTIONS:
            self._owner.report(f'ended a connection, because {_CONNECTIONS} were open')
            of = Counter(each.address for each in everyone)
            ended = max(everyone, key=lambda each: (
                each.stage < OWNER, of[each.address], each.stage < VIEWER))
            del everyone[ended]
            ended.abort()
        everyone[self] = None

    def connection_lost(self, exc: BaseException | None) -> None:
        """Forget the connection."""
        self._limit.cancel()
        self._owner.connections.pop(self, None)
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


class PageServer:
    """
    The server of the live page; the `exchange` answers the viewers, in its own thread.

    It listens at the address `host`; port 0 is any free one.

    Attributes
    ----------
    exchange : Exchange
        What the page shows, and its answers.
    token : str
        What commands and exports need.
    viewers : dict of Viewer to Connection
        The viewers that have said hello, the oldest first, and their connections.
    connections : dict of Connection to None
        All connections, the oldest first.

    """

    def __init__(self, exchange: Exchange, host: str, port: int) -> None:
        self.exchange, self._host, self._port = exchange, host, port
        self.token = secrets.token_urlsafe(16)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._over = asyncio.Event()
        self._thread: Thread | None = None
        self._link_file: Path | None = None
        self.board = Board()
        self.viewers: dict[Viewer, Connection] = {}
        self.connections: dict[Connection, None] = {}
        self._reported, self._filter = Counter[str](), Throttle()
        self._files = {f'/page/{each.name}': each for each in PAGE.parent.iterdir()
                       if each.suffix in _KINDS}
        self._files['/'] = PAGE

    # In any thread

    def start(self) -> None:
        """Start serving; raise InputError if the address or port cannot be used."""
        started: Future[None] = Future()
        self._thread = Thread(target=lambda: asyncio.run(self._serve(started)), daemon=True,
                              name='accel_calib_page')
        self._thread.start()
        try:
            started.result()
        except OSError as error:
            self._thread.join()
            if error.errno == errno.EADDRINUSE:
                raise InputError(
                    f'the port {self._port} of {self._host} is in use, so there is no live page',
                    'stop the other program, or choose another port') from error
            raise InputError(
                f'the live page cannot be served at {self._host}, port {self._port}: '
                f'{error.strerror or error}', 'choose an address of this machine, and a port '
                'above 1023') from error
        self.exchange.show = self.show

    def close(self) -> None:
        """Close all viewers, and stop serving."""
        if self._thread is not None:
            self._call(self._over.set)
            self._thread.join()
            self._thread = None
        if self._link_file is not None:
            self._link_file.unlink(missing_ok=True)

    def announce(self) -> str:
        """Show the link to its owner alone, and return a log line; see `exchange.announce`."""
        words, self._link_file = announce(self.link, f'live_page_{self._port}.txt')
        return words

    def show(self, message: Message) -> None:
        """Show a message to all viewers, and keep it for those who come later."""
        message = plain(message)
        if message['kind'] == 'progress':  # without waking the thread of the server
            self.board.history.append(message)
        else:
            self._call(lambda: self._take(message))

    @property
    def link(self) -> str:
        """Address of the page with the token, for a browser."""
        host = reachable(self._host)
        return f'http://{f"[{host}]" if ":" in host else host}:{self._port}/#{self.token}'

    def _call(self, function: Callable[[], object]) -> None:
        """Let the thread of the server call a function; nothing happens once it has ended."""
        if self._loop is not None:
            try:
                self._loop.call_soon_threadsafe(function)
            except RuntimeError:
                if not self._loop.is_closed():
                    raise

    # In the thread of the server

    async def _serve(self, started: Future[None]) -> None:
        """Serve until `close` is called: show the newest progress, and close stuck viewers."""
        self._loop = loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._on_error)
        http = web.Server(self._answer)
        try:
            listener = await loop.create_server(
                lambda: Connection(self, http), self._host, self._port, backlog=_BACKLOG)
        except Exception as error:  # `start` raises it, in its own thread
            started.set_exception(error)
            return
        bound, own = [each.getsockname() for each in listener.sockets], (
            socket.gethostname().lower())
        names = {own, own.split('.')[0]}
        # By these names and versions of IP a browser may call.
        self._hosts = {'localhost', *names, *(f'{name}.local' for name in names)}
        self._versions = {ip_address(each[0].split('%')[0]).version for each in bound}
        self._port = bound[0][1]
        started.set_result(None)
        while not self._over.is_set():
            if self.viewers and self.board.history:
                self._take(self.board.history[-1])
            for viewer in list(self.viewers):
                if loop.time() - viewer.sending_since > STUCK_S:
                    viewer.abort()
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._over.wait(), PERIOD if self.viewers else _RARELY_S)
        listener.close()
        for connection in list(self.connections):
            if connection.stage >= VIEWER:
                connection.abort()
        await http.shutdown(_ENDING_S)

    def _on_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Report that no file is left for a new connection; other errors are defects."""
        error = context.get('exception')
        if isinstance(error, OSError):
            self.report(f'cannot accept a connection: {error.strerror}')
        else:
            loop.default_exception_handler(context)

    def report(self, what: str) -> None:
        """Count what the page had to do, and log it at most once in `_QUIET_S`."""
        self._reported[what] += 1
        if self._filter.passes(what, _QUIET_S):
            words = f'the live page {what} ({self._reported[what]} so far)'
            self.exchange.call_soon(lambda: self.exchange.log('warning', words))

    def _take(self, message: Message) -> None:
        """Show a message, unless the newest one of its kind is equal."""
        kind, newest = message['kind'], self.board.newest
        if kind == 'log':
            self.board.lines.append(message)
        elif message == newest.get(kind):
            return
        else:
            newest[kind] = message
        for viewer in self.viewers:
            viewer.news.set()

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(errors='replace'), self.token.encode())

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        connection = cast('Connection', request.protocol)
        connection.stage = 1
        hosts, origins = (request.headers.getall(name, []) for name in ('Host', 'Origin'))
        host, is_own, refusal = hosts[0] if len(hosts) == 1 else '', False, ''
        with suppress(ValueError):  # the Host cannot be parsed
            parts = urlsplit(f'//{host}')
            name, port = (parts.hostname or '').removesuffix('.'), parts.port or 80
            is_own = name in self._hosts or ip_address(name).version in self._versions
            is_own &= port == self._port and not (
                '@' in host or parts.path or parts.query or parts.fragment)
        if not is_own:
            refusal = 'the header Host is not an address of this server; open its own link'
        elif origins and [each.lower() for each in origins] != [f'http://{host.lower()}']:
            refusal = 'the header Origin is of another site; open the link of this server'
        if refusal:
            return secured(web.Response(status=403, text=f'{refusal}\n'))
        path = request.rel_url.raw_path if request.method == 'GET' else ''
        if path == '/stream':
            return await self._stream(request, connection)
        return secured(await self._file(request, path))

    async def _file(self, request: web.BaseRequest, path: str) -> web.Response:
        """Return a file of the page, the calibration page, or an export."""
        export = path.removeprefix('/export/')
        if path == '/calibration.html':
            success, text = await self._ask(self.exchange.page)
            if not success:
                return web.Response(status=404, text=f'{text}\n')
            allowed = {'Content-Security-Policy': f"{policy()}; frame-ancestors 'self'"}
            return web.Response(text=text, content_type='text/html', headers=allowed)
        if path in self._files:
            file = self._files[path]
            return web.Response(body=file.read_bytes(), content_type=_KINDS[file.suffix],
                                charset='utf-8')
        if export == path or export not in FORMATS:
            return web.Response(status=404, text='there is no such page; open /\n')
        kind, _, token = request.headers.get('Authorization', '').partition(' ')
        if kind.lower() != 'bearer' or not self._is_token(token.strip()):
            return web.Response(status=401, headers={'WWW-Authenticate': 'Bearer'}, text=(
                f'the token is missing or wrong; {_ITS_LINK}\n'))
        _, found = await self._ask(partial(self.exchange.export, export))
        if isinstance(found, str):
            return web.Response(status=409, text=f'{found}\n')
        return web.Response(
            body=found.data, content_type='application/octet-stream',
            headers={'Content-Disposition': f'attachment; filename="calibration{found.suffix}"'})

    async def _ask(self, ask: Callable[[Answer], object]) -> Any:
        """Return success and answer of a function of the exchange."""
        answered: Future[Any] = Future()
        answered.set_running_or_notify_cancel()  # its answer comes even if nobody waits any more
        self.exchange.call_soon(lambda: ask(lambda *found: answered.set_result(found)))
        return await asyncio.wrap_future(answered)

    async def _stream(self, request: web.BaseRequest, connection: Connection
                      ) -> web.StreamResponse:
        """Serve a viewer until it ends."""
        socket_ = secured(web.WebSocketResponse(
            heartbeat=STUCK_S / 1.5, max_msg_size=LARGEST, compress=False))
        try:
            is_one = socket_.can_prepare(request).ok
        except ValueError:  # a key that is not ASCII
            is_one = False
        if not is_one:
            return secured(web.Response(status=400, text='expected a WebSocket; open /\n'))
        await socket_.prepare(request)
        viewer = Viewer(self.board, socket_, connection.abort,
                        lambda command: self._ask(partial(self.exchange.ask, command)))
        try:
            await viewer.run(partial(self._admit, connection))
        finally:
            self.viewers.pop(viewer, None)
        return socket_

    def _admit(self, connection: Connection, viewer: Viewer, token: str) -> None:
        """
        Admit a viewer that has said hello, and set why it only looks.

        TooManyError is raised if there are too many viewers, and none without the token if this
        one has it.

        """
        viewer.why = '' if self._is_token(token) else _WRONG_TOKEN if token else _NO_TOKEN
        if len(self.viewers) >= _VIEWERS:
            guests = [each for each in self.viewers if each.why]
            if viewer.why or not guests:
                raise TooManyError(f'{_VIEWERS} viewers are connected already', 'close one of '
                                   'them')
            guests[0].abort()
            del self.viewers[guests[0]]
        connection.stage = VIEWER if viewer.why else OWNER
        self.viewers[viewer] = connection
