# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Services that respond with the result of a command.

A command returns an answer or a `Job`, or raises an error. For an error the response is ``success:
false`` with the message of the error. For a job the response is sent when the job is done, so that
no callback waits. This works with every executor. Coroutines as service callbacks, which rclpy
offers for this purpose, do not work with EventsExecutor.

"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

from std_srvs.srv import Trigger

from .worker import Worker
from ..errors import AccelCalibError
from ..session import Job

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.service import Service


class Services:
    """
    The services of a node.

    Parameters
    ----------
    node : Node
        The node.
    worker : Worker
        Worker that runs the jobs.
    on_events : callable
        Function that is called after each command.

    """

    def __init__(self, node: Node, worker: Worker, on_events: Callable[[], None]) -> None:
        self._node, self._worker, self._on_events = node, worker, on_events

    def serve(self, name: str, command: Callable[[], str | Job]) -> None:
        """Create the service ``~/name``."""
        def callback(request: Trigger.Request, response: Trigger.Response) -> Any:
            try:
                found = command()
            except AccelCalibError as error:
                return self._response(False, str(error))
            finally:
                self._on_events()
            return self._response(True, found) if isinstance(found, str) else found

        self._answer_later(self._node.create_service(Trigger, f'~/{name}', callback))

    def _answer_later(self, service: Service) -> None:
        """Change this service so that its callback can return a job."""
        send = service.send_response

        def send_response(response: Any, header: Any) -> None:
            if isinstance(response, Job):
                self._worker.run(response, lambda success, words: send(
                    self._response(success, words), header))
            else:
                send(response, header)

        service.send_response = send_response

    def _response(self, success: bool, words: str) -> Trigger.Response:
        """Log a response, and return it."""
        log = self._node.get_logger()
        if success:
            log.info(words)
        else:
            log.warning(words)
        return Trigger.Response(success=success, message=words)
