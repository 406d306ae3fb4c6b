# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The live page of a node.

The server has its own thread. The executor of the node only makes the messages, and runs the
commands of the page as those of the services.

"""

from __future__ import annotations

from collections.abc import Callable
import sys
from typing import TYPE_CHECKING

from rclpy.clock import Clock, ClockType

from .stream import Stream
from ..errors import AccelCalibError
from ..session import Health, Log, Session, ShowPoses
from ..session.worker import CallSoon, Worker

if TYPE_CHECKING:
    from rclpy.node import Node

    from ..live.host import Exchange
    from ..live.server import PageServer


class Page:
    """
    The live page of a node; it does nothing if the parameter ``web_port`` is 0.

    Parameters
    ----------
    node : Node
        The node.
    session : Session
        Its session.
    stream : Stream
        Its messages.
    worker : Worker
        Its worker.
    call_soon : callable
        Function that lets the executor call a function.
    log : callable
        Function that logs a line, also with `show_line`.

    """

    def __init__(self, node: Node, session: Session, stream: Stream, worker: Worker,
                 call_soon: CallSoon, log: Callable[[Log], None]) -> None:
        self._node, self._session, self._stream = node, session, stream
        self._worker, self._call_soon, self._log = worker, call_soon, log
        self._exchange: Exchange | None = None
        self._server: PageServer | None = None

    def start(self) -> None:
        """Serve the page; if this is not possible, log why."""
        settings = self._session.settings
        if not settings.web_port:
            return
        from ..live.host import Exchange
        from ..live.link import qr_code
        from ..live.messages import PERIOD
        from ..live.server import PageServer
        exchange = Exchange(self._session, self._worker, self._call_soon, self._log,
                            self._stream.flush)
        try:
            self._server = PageServer(exchange, settings.web_host, settings.web_port)
            self._server.start()
        except AccelCalibError as error:
            self._log(Log('error', str(error)))
            return
        exchange.show, self._exchange = self._server.show, exchange
        self._node.get_logger().info(f'live page: {self._server.link}')  # not for all viewers
        if sys.stdout.isatty():
            print(qr_code(self._server.link), flush=True)
        self._node.create_timer(PERIOD, self._show_progress,
                                clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _show_progress(self) -> None:
        if self._exchange is not None:
            self._exchange.show_progress(self._stream.newest)

    def show_state(self, health: Health | None = None) -> None:
        """Show the state of the session."""
        if self._exchange is not None:
            self._exchange.show_state(health)

    def show_poses(self, event: ShowPoses) -> None:
        """Show the poses, and the state that may have changed with them."""
        if self._exchange is not None:
            self._exchange.show_poses(event)
            self._exchange.show_state()

    def show_line(self, line: Log) -> None:
        """Show a log line."""
        if self._exchange is not None:
            self._exchange.show_line(line)

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._exchange = None
            self._server.close()
