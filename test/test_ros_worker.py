# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Services that answer later, in every executor the nodes may run in, and computing apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
import os
from pathlib import Path
import signal
import threading
import time
from typing import Any

from accel_calib.errors import InputError, RefusedFitError
from accel_calib.files import read_calibration, write_table
from accel_calib.ros.answers import Answers
from accel_calib.ros.apart import Apart
from accel_calib.ros.fitting import fitted
from accel_calib.ros.settings import CalibratorSettings
from accel_calib.ros.worker import Worker
import numpy as np
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


@pytest.fixture
def apart() -> Iterator[Apart]:
    made = Apart()
    yield made
    made.close()


def test_computing_apart_gives_what_it_gives_here(apart: Apart, stored: Callable[..., Path]
                                                  ) -> None:
    calibration = read_calibration(stored())
    given = calibration.poses, calibration.units, CalibratorSettings(model='10'), '', None, {}
    found, here = apart.call(fitted, *given), fitted(*given)
    np.testing.assert_array_equal(found.model.vector, here.model.vector)
    np.testing.assert_array_equal(found.covariance, here.covariance)
    assert apart.call(os.getpid) != os.getpid()
    assert apart.call(os.sched_getscheduler, 0) == os.SCHED_IDLE


def test_what_waits_too_long_for_the_processor_gets_its_share(
        apart: Apart, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('accel_calib.ros.apart._PATIENCE', 0.5)
    apart.call(time.sleep, 0.7)
    assert apart.call(os.sched_getscheduler, 0) == os.SCHED_OTHER
    apart.call(time.sleep, 0.7)


def test_errors_of_computing_apart_are_those_of_computing_here(
        apart: Apart, stored: Callable[..., Path]) -> None:
    calibration = read_calibration(stored())
    few = calibration.poses.take(slice(0, 2)), calibration.units, CalibratorSettings(model='10')
    with pytest.raises(RefusedFitError) as here:
        fitted(*few, '', None, {})
    with pytest.raises(RefusedFitError) as there:
        apart.call(fitted, *few, '', None, {})
    assert str(there.value) == str(here.value)
    with pytest.raises(ValueError, match='math domain'):
        apart.call(math.sqrt, -1.0)
    assert apart.call(math.sqrt, 4.0) == 2.0


def test_what_cannot_be_computed_apart_is_computed_here(apart: Apart) -> None:
    os.kill(apart.call(os.getpid), signal.SIGKILL)
    assert apart.call(math.sqrt, 4.0) == 2.0
    assert apart.call(os.getpid) != os.getpid()


def test_nothing_waits_for_what_is_computed_when_the_node_ends(apart: Apart) -> None:
    apart.call(os.getpid)
    threading.Timer(WORK, apart.close).start()
    began = time.monotonic()
    with pytest.raises(InputError, match='ending'):
        apart.call(time.sleep, 60.0)
    assert time.monotonic() - began < 10.0


def children(pid: int) -> list[int]:
    """Give the processes that a process started."""
    tasks = Path(f'/proc/{pid}/task').glob('*/children')
    return [int(child) for task in tasks for child in task.read_text().split()]


@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_no_process_outlives_the_node(bench: Any, stored: Callable[..., Path], number: int
                                      ) -> None:
    path = stored()
    write_table(path.with_name(f'{path.stem}_poses.csv'), read_calibration(path).poses)
    node = bench.calibrator(calibration_file=path)
    bench.spin(lambda: children(node.pid))
    started = children(node.pid)
    bench.end(node, number)
    bench.spin(lambda: not any(Path(f'/proc/{pid}').exists() for pid in started))
