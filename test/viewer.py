# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A host in a thread, and viewers of its page: clients of its WebSocket in their own threads."""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import json
from pathlib import Path
from threading import Event, Thread
from typing import Any

from accel_calib.session import CalibratorSettings, Log
import aiohttp
from inside import Host
from shared import wait


@contextmanager
def hosted(source: Any, **settings: Any) -> Iterator[tuple[Host, list[Log]]]:
    """Run a host with its page in a thread, and yield it with its log."""
    lines, over = list[Log](), Event()
    host = Host(source, CalibratorSettings(**settings), lines.append)
    thread = Thread(target=host.run, args=[over.is_set])
    thread.start()
    try:
        yield host, lines
    finally:
        over.set()
        thread.join()
        host.close()


def link_of(line: str) -> str:
    """Return the link with the token, from the file that a log line names."""
    return Path(line.strip().rpartition(' is in ')[2]).read_text(encoding='utf-8').strip()


class Viewer:
    """
    A viewer, which keeps what it gets.

    The fragment of the link is the token, and `seen` the last log line that the viewer has. It has
    got messages in their order, and the code with which the server closed the connection.

    """

    def __init__(self, link: str, *, seen: int = 0) -> None:
        self.base, _, self.token = link.partition('/#')
        self.got: list[dict[str, Any]] = []
        self.code: int | None = None
        self._seen, self._asked = seen, 0
        self._loop = asyncio.new_event_loop()
        self._socket: Any = None
        self._thread = Thread(target=lambda: self._loop.run_until_complete(self._run()))
        self._thread.start()
        wait(lambda: self.got or self.code)

    async def _run(self) -> None:
        async with aiohttp.ClientSession() as client, client.ws_connect(
                f'{self.base}/stream', max_msg_size=0) as self._socket:
            await self._socket.send_json({'hello': {'token': self.token, 'seen': self._seen}})
            async for message in self._socket:
                self.got.append(json.loads(message.data))
            self.code = self._socket.close_code

    def send(self, text: str) -> None:
        """Send a text."""
        asyncio.run_coroutine_threadsafe(self._socket.send_str(text), self._loop).result(120.0)

    def begin(self, command: str) -> int:
        """Ask for a command, and return the number of its answer."""
        self._asked += 1
        self.send(json.dumps({'ask': {'id': self._asked, 'command': command}}))
        return self._asked

    def answer(self, number: int) -> Any:
        """Return an answer; None if it has not come yet."""
        return next((each for each in self.of('answer') if each['id'] == number), None)

    def ask(self, command: str, spin: Callable[[Callable[[], Any]], None] | None = None) -> Any:
        """Ask for a command, and return its answer."""
        number = self.begin(command)
        (spin or wait)(lambda: self.answer(number))
        return self.answer(number)

    def of(self, kind: str) -> list[dict[str, Any]]:
        """Return the messages of a kind so far."""
        return [message for message in list(self.got) if message['kind'] == kind]

    @property
    def state(self) -> dict[str, Any]:
        """Return the newest state; wait for the first one."""
        wait(lambda: self.of('state'))
        return self.of('state')[-1]

    def close(self) -> None:
        """End the connection."""
        self._loop.call_soon_threadsafe(lambda: self._loop.create_task(self._socket.close()))
        self._thread.join()


def fetch(url: str, method: str = 'GET', **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of a page; underscores of header names become dashes."""
    async def run() -> tuple[int, dict[str, str], bytes]:
        given = {name.replace('_', '-'): value for name, value in headers.items()}
        async with aiohttp.ClientSession() as client, client.request(
                method, url, headers=given, allow_redirects=False) as found:
            return found.status, dict(found.headers), await found.read()

    return asyncio.run(run())
