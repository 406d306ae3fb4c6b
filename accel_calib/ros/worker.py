# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The thread of a node for jobs: files, and waiting for the worker process.

Jobs run in that thread, in the order given, and finish as callbacks in the thread of the executor,
so that only callbacks change the session.

"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from queue import SimpleQueue
from traceback import format_exc
from typing import Any, TYPE_CHECKING

from ..errors import AccelCalibError
from ..session import Job
from ..session.worker_process import WorkerProcess

if TYPE_CHECKING:
    from rclpy.node import Node

Answer = Callable[[bool, str], object]
"""Takes whether a job succeeded, and its result in words."""


class Worker:
    """
    A thread beside the executor of a node.

    Parameters
    ----------
    node : Node
        The node.
    on_events : callable
        Called after each job, in the thread of the executor.

    """

    def __init__(self, node: Node, on_events: Callable[[], None]) -> None:
        self._node, self._on_events = node, on_events
        self._pool = ThreadPoolExecutor(1, 'accel_calib')
        self._done: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._process = WorkerProcess()

    def run(self, job: Job, answer: Answer) -> None:
        """Run a job in the thread, finish it in the executor, and answer."""
        future = self._pool.submit(job.run, self._process.call)
        future.add_done_callback(lambda done: self._call_back(job, answer, done))

    def _call_back(self, job: Job, answer: Answer, done: Future[Any]) -> None:
        self._done.put(lambda: self._finish(job, answer, done))
        executor = self._node.executor
        if executor is not None:
            # The executor may run tasks in any order; the queue keeps that of the jobs.
            executor.create_task(lambda: self._done.get()())

    def _finish(self, job: Job, answer: Answer, done: Future[Any]) -> None:
        """Finish a job and answer; a fault of the program is logged, and the stream goes on."""
        try:
            words, success = job.finish(done.result()), True
        except AccelCalibError as error:
            words, success = str(error), False
        except OSError as error:
            words = f'{error}; correct the permissions, or set calibration_file'
            success = False
        except Exception as error:
            self._node.get_logger().error(f'a fault in accel_calib:\n{format_exc()}')
            words = f'a fault in accel_calib ({error!r}); please report it with the log'
            success = False
        answer(success, words)
        self._on_events()

    def close(self) -> None:
        """End what is being computed, and finish what is being written."""
        self._process.close()
        self._pool.shutdown(wait=True)
