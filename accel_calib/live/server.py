# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The server of the live page, on its own thread with its own event loop.

**Viewers.** Each viewer has a task that sends what is new for it: the newest progress, poses and
state, and the log lines that it does not have. Nothing is queued for a viewer. One that takes no
data misses progress, and is closed after `_STUCK_S`; a viewer that comes back gets the rest.

**Who may.** Everybody who reaches the server can look. Commands and exports need the token in the
fragment of the link, which browsers do not send. Host and Origin are checked, so that a page of
another site cannot use the server through the browser of a user. Files come from a fixed list.

"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections import deque
from concurrent.futures import Future
import errno
from hashlib import sha256
import hmac
from importlib.resources import files
import io
from ipaddress import ip_address
import math
import secrets
import socket
from threading import Thread
from typing import Any, Protocol, TYPE_CHECKING
from urllib.parse import urlsplit

from . import messages
from ..errors import InputError
from ..files.exports import Exported, FORMATS
from ..report.sheet import SCRIPT
from ..session.worker import Answer

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.resources.abc import Traversable

    from aiohttp import web

_VIEWERS = 16
"""Largest number of viewers, and of commands of a viewer that wait for their answers."""

_LINES = 500
"""Number of log lines that are kept."""

_RATE_HZ = 20
"""Largest rate of the messages of progress."""

_RARELY_S = 0.2
"""Interval at which the server looks for viewers while there is none [s]."""

_STUCK_S = 10.0
"""Time after which a viewer that takes no data, or does not answer, is closed [s]."""

_HELLO_S = 5.0
"""Time within which a new viewer must say hello [s]."""

_BUFFER = 65536
"""Size of the buffers of a viewer [bytes]; more waits in the viewer's task."""

_KINDS = {'.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript',
          '.svg': 'image/svg+xml', '.png': 'image/png'}
"""Types of the files of the page, by the end of their name."""

_HEADERS = {'Server': 'accel_calib', 'X-Content-Type-Options': 'nosniff',
            'Referrer-Policy': 'no-referrer', 'Cache-Control': 'no-store',
            'Cross-Origin-Resource-Policy': 'same-origin',
            'Content-Security-Policy': (
                "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
                "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; "
                "frame-ancestors 'none'")}


def policy_hash(script: str) -> str:
    """Return the source of an inline script for a Content-Security-Policy."""
    return f"'sha256-{b64encode(sha256(script.encode()).digest()).decode()}'"


_REPORT_POLICY = (
    f"default-src 'none'; script-src {policy_hash(SCRIPT)}; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'")
"""Policy of the calibration page: its own script alone, and styles inside of it."""

_NO_TOKEN = 'this link has no token, so it only shows; open the link with the token, which the ' \
            'program printed at its start'
_WRONG_TOKEN = 'the token of this link is of another start of the program, so it only shows; ' \
               'open the link that it printed at its last start'


class Desk(Protocol):
    """What the server asks for, in its own thread; `exchange.Exchange` is one."""

    def ask(self, command: str, answer: Answer) -> None:
        """Run a command, and call `answer`."""

    def page(self, answer: Answer) -> None:
        """Call `answer` with the calibration page, or why there is none."""

    def export(self, name: str, answer: Callable[[Exported | str], object]) -> None:
        """Call `answer` with an export, or why there is none."""


class PageServer:
    """
    The server of the live page.

    Parameters
    ----------
    desk : Desk
        What answers the viewers.
    host : str
        Address to bind to.
    port : int
        Port; 0: any free one.

    Attributes
    ----------
    token : str
        What commands and exports need.
    viewers : set of _Viewer
        The viewers.

    Raises
    ------
    InputError
        If a package that the page needs is not installed.

    """

    def __init__(self, desk: Desk, host: str, port: int) -> None:
        check_installed()
        self._desk, self._host, self._port = desk, host, port
        self.token = secrets.token_urlsafe(16)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._over: asyncio.Event | None = None
        self._thread: Thread | None = None
        self._newest: dict[str, tuple[messages.Message, str]] = {}
        self._lines: deque[tuple[int, str]] = deque(maxlen=_LINES)
        self._history: deque[messages.Message] = deque(
            maxlen=int(messages.HISTORY_S * _RATE_HZ))
        self.viewers: set[_Viewer] = set()
        self._hosts: frozenset[str] = frozenset()
        self._versions: frozenset[int] = frozenset()
        page = files(__package__) / 'page'
        self._files: dict[str, Traversable] = {
            f'/page/{each.name}': each for each in page.iterdir()
            if _kind_of(each.name) and each.is_file()}
        self._files['/'] = page / 'index.html'

    # In any thread

    def start(self) -> None:
        """
        Start serving.

        Raises
        ------
        InputError
            If the address or port cannot be used.

        """
        started: Future[None] = Future()
        self._thread = Thread(target=lambda: asyncio.run(self._serve(started)), daemon=True,
                              name='accel_calib_page')
        self._thread.start()
        try:
            started.result()
        except OSError as error:
            self._thread.join()
            raise _not_bound(error, self._host, self._port) from error

    def close(self) -> None:
        """Close all viewers, and stop serving."""
        if self._thread is not None and self._loop is not None and self._over is not None:
            self._call(self._over.set)
            self._thread.join()
            self._thread = None

    def show(self, message: messages.Message) -> None:
        """Show a message to all viewers, and keep it for those who come later."""
        if message['kind'] == 'progress':  # without waking the thread of the server
            self._history.append(message)
        else:
            self._call(lambda: self._take(message))

    @property
    def link(self) -> str:
        """Address of the page with the token, for a browser."""
        host = _reachable(self._host)
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
        """Serve until `close` is called."""
        from aiohttp import web
        app = web.Application(client_max_size=messages.LARGEST)
        app.router.add_route('*', '/{path:.*}', self._answer)
        app.on_response_prepare.append(_secure)
        runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=1.0)
        try:
            await runner.setup()
            site = web.TCPSite(runner, self._host, self._port)
            await site.start()
        except Exception as error:  # `start` raises it, in its own thread
            await runner.cleanup()
            started.set_exception(error)
            return
        self._know_names(runner.addresses)
        self._loop, self._over = asyncio.get_running_loop(), asyncio.Event()
        started.set_result(None)
        self._look()
        await self._over.wait()
        for viewer in list(self.viewers):
            viewer.abort()
        await runner.cleanup()

    def _know_names(self, addresses: list[Any]) -> None:
        """Note the port, and the names by which a browser may call this server."""
        self._port = addresses[0][1]
        self._versions = frozenset(ip_address(each[0].split('%')[0]).version
                                   for each in addresses)
        own = socket.gethostname().lower()
        names = {own, own.split('.')[0]}
        self._hosts = frozenset({'localhost', *names, *(f'{name}.local' for name in names)})

    def _look(self) -> None:
        """Show the newest progress, close stuck viewers, and look again."""
        loop = asyncio.get_running_loop()
        wait = _RARELY_S
        if self.viewers:
            wait = 1.0 / _RATE_HZ
            if self._history:
                self._take(self._history[-1])
            for viewer in list(self.viewers):
                viewer.abort_if_stuck(loop.time())
        loop.call_later(wait, self._look)

    def _take(self, message: messages.Message) -> None:
        """Keep a message, and wake the viewers."""
        kind = message['kind']
        if kind == 'log':
            self._lines.append((message['number'], messages.text_of(message)))
        else:
            before = self._newest.get(kind, ({}, ''))[0]
            if before is message or (kind != 'progress' and before == message):
                return
            self._newest[kind] = message, messages.text_of(message) if self.viewers else ''
        for viewer in self.viewers:
            viewer.wake()

    def newest(self, kind: str) -> tuple[messages.Message, str] | None:
        """Return the newest message of a kind, and its text."""
        found = self._newest.get(kind)
        if found is not None and not found[1]:
            found = self._newest[kind] = found[0], messages.text_of(found[0])
        return found

    def lines_after(self, number: int) -> list[tuple[int, str]]:
        """Return the log lines with larger numbers."""
        if not self._lines or self._lines[-1][0] <= number:
            return []
        return [line for line in self._lines if line[0] > number]

    def why_not(self, token: str) -> str:
        """Return why commands are not accepted with this token; empty if they are."""
        return '' if self._is_token(token) else _WRONG_TOKEN if token else _NO_TOKEN

    def welcome(self, why: str) -> str:
        """Return the answer to ``hello``; the parameter is as in `messages.welcome`."""
        return messages.text_of(messages.welcome(why, self._history.copy()))

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(errors='replace'), self.token.encode())

    async def _answer(self, request: web.Request) -> web.StreamResponse:
        """Answer a request."""
        from aiohttp import web
        refusal = self._refusal(request)
        if refusal:
            return web.Response(status=403, text=f'{refusal}\n')
        path = request.rel_url.raw_path if request.method == 'GET' else ''
        if path == '/stream':
            return await self._stream(request)
        if path == '/calibration.html':
            return await self._page()
        if path.startswith('/export/') and path.removeprefix('/export/') in FORMATS:
            return await self._export(request, path.removeprefix('/export/'))
        file = self._files.get(path)
        if file is None:
            return web.Response(status=404, text='there is no such page; open /\n')
        return web.Response(body=file.read_bytes(), content_type=_kind_of(file.name),
                            charset=None if file.name.endswith('.png') else 'utf-8')

    def _refusal(self, request: web.Request) -> str:
        """Return why a request is refused by its Host or Origin; empty if it is not."""
        hosts, origins = (request.headers.getall(name, []) for name in ('Host', 'Origin'))
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return 'the header Host is not an address of this server; open the link it printed'
        if origins and [each.lower() for each in origins] != [f'http://{hosts[0].lower()}']:
            return 'the header Origin is of another site; open the link that the server printed'
        return ''

    def _is_own(self, host: str) -> bool:
        """Return whether a Host is an address of this server, with its port."""
        try:
            parts = urlsplit(f'//{host}')
            name, port = (parts.hostname or '').removesuffix('.'), parts.port or 80
        except ValueError:
            return False
        if port != self._port or '@' in host or parts.path or parts.query or parts.fragment:
            return False
        try:
            return ip_address(name).version in self._versions
        except ValueError:
            return name in self._hosts

    async def _page(self) -> web.Response:
        """Return the calibration page."""
        from aiohttp import web
        success, text = await self._asked(self._desk.page)
        if not success:
            return web.Response(status=404, text=f'{text}\n')
        return web.Response(text=text, content_type='text/html',
                            headers={'Content-Security-Policy': _REPORT_POLICY})

    async def _export(self, request: web.Request, name: str) -> web.Response:
        """Return an export as a download."""
        from aiohttp import web
        kind, _, token = request.headers.get('Authorization', '').partition(' ')
        if kind.lower() != 'bearer' or not self._is_token(token.strip()):
            return web.Response(status=401, headers={'WWW-Authenticate': 'Bearer'}, text=(
                'the token is missing or wrong; open the link that the program printed\n'))
        found, = await self._asked(lambda answer: self._desk.export(name, answer))
        if isinstance(found, str):
            return web.Response(status=409, text=f'{found}\n')
        content = found.text_or_bytes
        return web.Response(
            body=content.encode() if isinstance(content, str) else content,
            content_type='application/octet-stream',
            headers={'Content-Disposition': f'attachment; filename="calibration{found.suffix}"'})

    async def _asked(self, ask: Callable[[Any], object]) -> Any:
        """Return what the desk answers, as a tuple."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[Any] = loop.create_future()

        def take(*found: Any) -> None:
            if not answered.done():
                answered.set_result(found)

        ask(lambda *found: self._call(lambda: take(*found)))
        return await answered

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        """Serve a viewer until it ends."""
        from aiohttp import web, WSCloseCode
        socket_ = web.WebSocketResponse(
            heartbeat=_STUCK_S / 1.5, max_msg_size=messages.LARGEST, compress=False)
        await socket_.prepare(request)
        if len(self.viewers) >= _VIEWERS:
            await socket_.close(code=WSCloseCode.TRY_AGAIN_LATER, message=(
                f'{_VIEWERS} viewers are connected already; close one of them').encode())
            return socket_
        viewer = _Viewer(self, socket_, request)
        self.viewers.add(viewer)
        try:
            await viewer.run()
        finally:
            self.viewers.discard(viewer)
        return socket_

    def ask(self, command: str, answer: Callable[[bool, str], object]) -> None:
        """Ask the desk, and call `answer` in this thread."""
        self._desk.ask(command, lambda success, words: self._call(
            lambda: answer(success, words)))


class _Viewer:
    """
    A viewer.

    Parameters
    ----------
    server : PageServer
        The server.
    websocket : WebSocketResponse
        Its connection.
    request : Request
        The request that opened it.

    """

    def __init__(self, server: PageServer, websocket: Any, request: web.Request) -> None:
        self._server, self._socket, self._transport = server, websocket, request.transport
        self._sent: dict[str, messages.Message] = {}
        self._answers: deque[str] = deque()
        self._seen = 0
        self._why, self._asking = _NO_TOKEN, 0
        self._news = asyncio.Event()
        self._sending_since = math.inf
        raw = None if self._transport is None else self._transport.get_extra_info('socket')
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)

    def wake(self) -> None:
        """Note that there is something new."""
        self._news.set()

    def abort_if_stuck(self, now: float) -> None:
        """End the connection if it has taken no data for too long; `now` is of the loop [s]."""
        if now - self._sending_since > _STUCK_S:
            self.abort()

    def abort(self) -> None:
        """End the connection without waiting."""
        if self._transport is not None:
            self._transport.abort()

    async def run(self) -> None:
        """Serve the viewer until it ends."""
        from aiohttp import WSCloseCode
        sending: asyncio.Task[None] | None = None
        try:
            hello = await self._next(_HELLO_S)
            if isinstance(hello, messages.Hello):
                sending = asyncio.create_task(self._send_all(hello))
                while request := await self._next(None):
                    if isinstance(request, messages.Ask):
                        self._ask(request)
        except InputError as error:
            await self._socket.close(code=WSCloseCode.POLICY_VIOLATION,
                                     message=str(error).encode())
        except asyncio.TimeoutError:
            await self._socket.close(code=WSCloseCode.POLICY_VIOLATION,
                                     message=b'no hello came; load the page again')
        finally:
            if sending is not None:
                sending.cancel()

    async def _next(self, timeout: float | None) -> messages.Hello | messages.Ask | None:
        """Return the next message of the viewer; None: it has ended."""
        from aiohttp import WSMsgType
        message = await self._socket.receive(timeout=timeout)
        return messages.request_of(message.data) if message.type is WSMsgType.TEXT else None

    def _ask(self, request: messages.Ask) -> None:
        """Run a command, if the viewer may."""
        def answer(success: bool, words: str) -> None:
            self._asking -= 1
            self._answers.append(messages.text_of(messages.answer(request.id, success, words)))
            self.wake()

        if self._asking + len(self._answers) >= _VIEWERS:
            raise InputError(f'{_VIEWERS} commands wait for their answers', 'load the page again')
        self._asking += 1
        if self._why:
            answer(False, self._why)
        elif request.command not in messages.COMMANDS:
            answer(False, f'the page asks for {request.command[:40]!r}, expected one of '
                   f'{", ".join(messages.COMMANDS)}; load the page again')
        else:
            self._server.ask(request.command, answer)

    async def _send_all(self, hello: messages.Hello) -> None:
        """Send what is new, until the viewer ends or takes no data."""
        self._why, self._seen = self._server.why_not(hello.token), hello.seen
        try:
            await self._send(self._server.welcome(self._why))
            while True:
                self._news.clear()
                await self._send_new()
                await self._news.wait()
        except ConnectionError:
            self.abort()

    async def _send_new(self) -> None:
        """Send the log lines, the newest message of each kind, and then the answers."""
        answers = len(self._answers)  # later ones may be about a state that is not sent yet
        for number, text in self._server.lines_after(self._seen):
            await self._send(text)
            self._seen = number
        for kind in ('state', 'poses', 'progress'):
            newest = self._server.newest(kind)
            if newest is not None and newest[0] is not self._sent.get(kind):
                self._sent[kind] = newest[0]
                await self._send(newest[1])
        for _ in range(answers):
            await self._send(self._answers.popleft())

    async def _send(self, text: str) -> None:
        self._sending_since = asyncio.get_running_loop().time()
        await self._socket.send_str(text)  # waits only if the buffers are full
        self._sending_since = math.inf


def check_installed() -> None:
    """
    Check that aiohttp is installed.

    Raises
    ------
    InputError
        If it is not.

    """
    try:
        import aiohttp  # noqa: F401
    except ImportError as error:
        raise InputError('aiohttp is not installed, but the live page needs it',
                         "run pip install 'accel_calib[live]'") from error


def qr_code(link: str) -> str:
    """Return a link as a QR code for a terminal; empty if segno is not installed."""
    try:
        import segno
    except ImportError:
        return ''
    drawn = io.StringIO()
    segno.make(link, micro=False).terminal(out=drawn, compact=True)
    return drawn.getvalue()


async def _secure(request: web.Request, response: web.StreamResponse) -> None:
    """Add the headers of security; a response can have its own policy."""
    for name, value in _HEADERS.items():
        response.headers.setdefault(name, value)


def _kind_of(name: str) -> str:
    """Return the type of a file of the page; empty for other files."""
    return _KINDS.get(f'.{name.rpartition(".")[2]}', '')


def _not_bound(error: OSError, host: str, port: int) -> InputError:
    """Return the error for an address that cannot be used."""
    if error.errno == errno.EADDRINUSE:
        return InputError(f'the port {port} of {host} is in use, so there is no live page',
                          'stop the other program, or choose another port')
    return InputError(f'the live page cannot be served at {host}, port {port}: '
                      f'{error.strerror or error}', 'choose an address of this machine, and a '
                      'port above 1023')


def _reachable(host: str) -> str:
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
