# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Services that respond with the result of a command.

A command returns an answer or a `Job`, or raises an error. For an error the response is ``success:
false`` with the message of the error. For a job the response is sent when the job is done, so that
no callback waits. This works with every executor. Coroutines as service callbacks, which rclpy
offers for this purpose, do not work with EventsExecutor.

**Worker.** The thread of a node for jobs, which use files and wait for the worker process.

Jobs run in this thread one after the other, and finish as callbacks in the thread of the executor.
Only callbacks therefore change the session.

"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from traceback import format_exc
from typing import Any, TYPE_CHECKING

from std_srvs.srv import Trigger

from ..errors import AccelCalibError
from ..session import Job
from ..session.store import writing_advice
from ..session.worker_process import WorkerProcess

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.service import Service

Answer = Callable[[bool, str], object]
"""Function of the success of a job, and of a text about its result."""


class Worker:
    """
    The thread for the jobs of a node.

    Parameters
    ----------
    node : Node
        The node.
    on_events : callable
        Function that is called after each job, in the thread of the executor.

    """

    def __init__(self, node: Node, on_events: Callable[[], None]) -> None:
        self._node, self._on_events = node, on_events
        self._pool = ThreadPoolExecutor(1, 'accel_calib')
        self._done: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._process = WorkerProcess()
        self._closed = False

    def run(self, job: Job, answer: Answer) -> None:
        """Run a job in the thread, finish it in the executor, and call `answer`."""
        future = self._pool.submit(job.run, self._process.call)
        future.add_done_callback(lambda done: self._call_back(job, answer, done))

    def _call_back(self, job: Job, answer: Answer, done: Future[Any]) -> None:
        self._done.put(lambda: self._finish(job, answer, done))
        executor = self._node.executor
        if executor is not None:
            # The executor may run tasks in any order; the queue keeps the order of the jobs.
            executor.create_task(lambda: self._done.get()())

    def _finish(self, job: Job, answer: Answer, done: Future[Any]) -> None:
        """Finish a job and call `answer`; unexpected errors are logged, and the node continues."""
        if self._closed:
            return  # publishers may be destroyed already, which rclpy does not survive
        try:
            words, success = job.finish(done.result()), True
        except AccelCalibError as error:
            words, success = str(error), False
        except OSError as error:
            words = f'{error}; {writing_advice(error)}'
            success = False
        except Exception as error:
            self._node.get_logger().error(f'unexpected error in accel_calib:\n{format_exc()}')
            words = f'unexpected error in accel_calib ({error!r}); please report it with the log'
            success = False
        answer(success, words)
        self._on_events()

    def close(self) -> None:
        """Stop the computation, and finish writing."""
        self._closed = True
        self._process.close()
        self._pool.shutdown(wait=True)


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
