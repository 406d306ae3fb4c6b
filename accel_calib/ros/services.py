# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Services that respond with the result of a command.

A command is a `Task`, which returns an answer or raises an error. For an error the response is
``success: false`` with the message of the error. The response is sent when the task is done, so
that no callback waits. This works with every executor. Coroutines as service callbacks, which
rclpy offers for this purpose, do not work with EventsExecutor.

"""

from __future__ import annotations

from collections.abc import Callable
from queue import SimpleQueue
from traceback import format_exc
from typing import Any, TYPE_CHECKING

from std_srvs.srv import Trigger

from ..session import Log, Task

if TYPE_CHECKING:
    from rclpy.node import Node

    from ..session.worker import CallSoon, Worker


def in_executor(node: Node) -> CallSoon:
    """Return a function that lets the executor of a node call functions, in their order."""
    waiting: SimpleQueue[Callable[[], None]] = SimpleQueue()

    def call_next() -> None:
        try:
            waiting.get()()
        except Exception:  # EventsExecutor crashes on an exception in a task (rclpy issue 1641)
            node.get_logger().error(f'unexpected error in accel_calib:\n{format_exc()}')

    def call_soon(function: Callable[[], None]) -> None:
        waiting.put(function)
        executor = node.executor
        if executor is not None:
            # The executor may run tasks in any order; the queue keeps their order.
            executor.create_task(call_next)

    return call_soon


class Services:
    """
    The services of a node.

    Parameters
    ----------
    node : Node
        The node.
    worker : Worker
        Worker that runs the commands.
    log : callable
        Function that logs the responses.

    """

    def __init__(self, node: Node, worker: Worker, log: Callable[[Log], None]) -> None:
        self._node, self._worker, self._log = node, worker, log

    def serve(self, name: str, command: Callable[[], Task]) -> None:
        """Create the service ``~/name``."""
        service = self._node.create_service(Trigger, f'~/{name}',
                                            lambda request, response: response)
        send = service.send_response

        def send_response(response: Any, header: Any) -> None:
            self._worker.do(name, command(), lambda success, words: send(
                self._response(success, words), header))

        service.send_response = send_response

    def _response(self, success: bool, words: str) -> Trigger.Response:
        """Log a response, and return it."""
        self._log(Log('info' if success else 'warning', words))
        return Trigger.Response(success=success, message=words)
