# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Services that answer with what came of a command.

A command gives a line, or a `Promise` of one, or refuses by an error: then the answer is
``success: false`` with what was found and what to do.

"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from std_srvs.srv import Trigger

from .worker import answer_later, Promise
from ..errors import AccelCalibError

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from rclpy.node import Node

    from .worker import Worker


class Answers:
    """
    Answers of a node.

    Parameters
    ----------
    node : Node
        Whose services these are.
    worker : Worker
        Of that node.

    """

    def __init__(self, node: Node, worker: Worker) -> None:
        self._node = node
        self._worker = worker

    def serve(self, name: str, command: Callable[[], str | Promise]) -> None:
        """Make the service ``~/name``."""
        def callback(request: Trigger.Request, response: Trigger.Response) -> Any:
            try:
                found = command()
            except AccelCalibError as error:
                return self._answer(False, str(error))
            return self._answer(True, found) if isinstance(found, str) else found

        answer_later(self._node.create_service(Trigger, f'~/{name}', callback))

    def later(self, job: Callable[[], Any], finish: Callable[[Any], str]) -> Promise:
        """Do a job in the worker; what `finish` makes of it is the answer."""
        promise = Promise()

        def then(done: Future[Any]) -> None:
            try:
                promise.keep(self._answer(True, finish(done.result())))
            except AccelCalibError as error:
                promise.keep(self._answer(False, str(error)))
            except OSError as error:
                promise.keep(self._answer(False, f'{error}; mend the permissions, or set '
                                                 'calibration_file'))
            except Exception as error:
                promise.keep(self._answer(False, f'a fault in accel_calib ({error!r}); please '
                                                 'report it with the log'))
                raise

        self._worker.run(job, then)
        return promise

    def _answer(self, success: bool, message: str) -> Trigger.Response:
        """Make a response, and a line in the log."""
        log = self._node.get_logger()
        if success:
            log.info(message)
        else:
            log.warning(message)
        return Trigger.Response(success=success, message=message)
