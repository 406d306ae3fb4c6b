# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Services that answer later, in every executor that the nodes may run in."""

from __future__ import annotations

import threading
import time
from typing import Any

from accel_calib.errors import InputError
from accel_calib.ros.answers import Answers
from accel_calib.ros.worker import Worker
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future

WORK = 0.2


def events_executor(context: Any) -> Any:
    experimental = pytest.importorskip('rclpy.experimental')
    return experimental.EventsExecutor(context=context)


def single_threaded_executor(context: Any) -> Any:
    return SingleThreadedExecutor(context=context)


@pytest.mark.parametrize('make_executor', [single_threaded_executor, events_executor])
def test_callbacks_go_on_while_a_service_works(bench: Any, make_executor: Any) -> None:
    context = bench.node.context
    node = Node('calibrator', context=context)
    worker, ticks, threads = Worker(node), [0], set()
    answers = Answers(node, worker)

    def finish(found: str) -> str:
        threads.add(threading.current_thread())
        return found

    def refuse(found: str) -> str:
        raise InputError('no such thing', 'try another')

    def job() -> str:
        time.sleep(WORK)
        return 'done'

    answers.serve('fit', lambda: answers.later(job, finish))
    answers.serve('load', lambda: answers.later(lambda: 'read', refuse))
    answers.serve('save', lambda: 'at once')
    node.create_timer(0.005, lambda: ticks.__setitem__(0, ticks[0] + 1))
    executor = make_executor(context)
    executor.add_node(node)
    over = Future()

    def spin() -> None:
        while not over.done():
            executor.spin_until_future_complete(over, timeout_sec=0.1)

    spinner = threading.Thread(target=spin)
    spinner.start()
    try:
        before = ticks[0]
        assert bench.call('fit').message == 'done'
        assert ticks[0] - before > WORK / 0.005 / 3
        assert threads == {spinner}
        answer = bench.call('load')
        assert (answer.success, answer.message) == (False, 'no such thing; try another')
        assert bench.call('save').message == 'at once'
    finally:
        over.set_result(None)
        spinner.join()
        worker.close()
        executor.shutdown()
        node.destroy_node()
