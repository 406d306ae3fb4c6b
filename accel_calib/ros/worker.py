# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The one thread for all that takes longer than a message: files, and waiting for `apart`.

A job runs in that thread, in the order given, and what it found comes back as a callback in the
thread of the executor, so that only callbacks change the state of the node. A service whose
answer waits for a job returns a `Promise` in place of the response; it is sent when kept. That
way callbacks never wait, and it works with every executor: coroutines as service callbacks,
which rclpy has for this, do not work with EventsExecutor, nor do guard conditions.

"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from traceback import format_exc
from typing import Any, TYPE_CHECKING, TypeVar

from .apart import Apart

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.service import Service

Found = TypeVar('Found')


class Promise:
    """A response that comes later."""

    def __init__(self) -> None:
        self._response: Future[Any] = Future()

    def keep(self, response: Any) -> None:
        """Send this response."""
        self._response.set_result(response)

    def when_kept(self, send: Callable[[Any], None]) -> None:
        """Have `send` called with the response."""
        self._response.add_done_callback(lambda kept: send(kept.result()))


class Worker:
    """
    A thread beside the executor of a node.

    What computes is for ``apart.call`` in a job.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._pool = ThreadPoolExecutor(1, 'accel_calib')
        self._done: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.apart = Apart()

    def run(self, job: Callable[[], Found], then: Callable[[Future[Found]], None]) -> None:
        """
        Do a job in the thread, then call back in the executor.

        Parameters
        ----------
        job : callable
            Takes and changes nothing of the node.
        then : callable
            Takes the future of what the job gave or raised.

        """
        self._pool.submit(job).add_done_callback(lambda done: self._call_back(then, done))

    def _call_back(self, then: Callable[[Future[Found]], None], done: Future[Found]) -> None:
        self._done.put(lambda: self._finish(then, done))
        executor = self._node.executor
        if executor is not None:
            # The executor may run tasks in any order; the queue keeps that of the jobs.
            executor.create_task(lambda: self._done.get()())

    def _finish(self, then: Callable[[Future[Found]], None], done: Future[Found]) -> None:
        """Call back; a fault of the program is told of, and does not stop the stream."""
        try:
            then(done)
        except Exception:
            self._node.get_logger().error(f'a fault in accel_calib:\n{format_exc()}')

    def close(self) -> None:
        """Give up what is being computed and kept, and finish what else is being written."""
        self.apart.close()
        self._pool.shutdown(wait=True)


def answer_later(service: Service) -> None:
    """Let the callback of this service return a `Promise`."""
    send = service.send_response

    def send_response(response: Any, header: Any) -> None:
        if isinstance(response, Promise):
            response.when_kept(lambda kept: send(kept, header))
        else:
            send(response, header)

    service.send_response = send_response
