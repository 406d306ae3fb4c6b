# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Services that answer later, in every executor, and the worker process."""

from collections.abc import Iterator
import math
import os
from pathlib import Path
import re
import signal
import threading
import time
from typing import Any

from accel_calib.errors import InputError, RefusedFitError
from accel_calib.logs import write_table
from accel_calib.session import CalibratorSettings, Files, Log, nothing, Session, Task
from accel_calib.stored import read_calibration
from faults.sample import sample
from inside import fit_in_node, PATIENCE_OF_A_WORKER, Worker, WorkerProcess
from inside_ros import in_executor, serve
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from shared import children, Stored, wait

TICKS = 20
"""Number of ticks of a timer for which the work of a service waits."""


def events_executor(context: Any) -> Any:
    experimental = pytest.importorskip('rclpy.experimental')
    return experimental.EventsExecutor(context=context)


@pytest.mark.parametrize('make_executor', [SingleThreadedExecutor, events_executor])
def test_callbacks_continue_while_a_service_works(bench: Any, make_executor: Any) -> None:
    context = bench.node.context
    node = Node('calibrator', context=context)
    logged, ticks, threads = [], [], set()
    session = Session(CalibratorSettings(), '/imu/data_raw')
    worker = Worker(session.events, in_executor(node), logged.append)

    def fit() -> Task:
        found = yield Files(work)
        threads.add(threading.current_thread())
        return found

    def load() -> Task:
        yield Files(nothing)
        raise InputError('absent', 'add it')

    def save() -> Task:
        yield from ()
        return 'at once'

    def work() -> str:
        before, ends = len(ticks), time.monotonic() + 60.0
        while len(ticks) < before + TICKS and time.monotonic() < ends:
            time.sleep(0.01)
        return f'{min(len(ticks) - before, TICKS)} ticks'

    for command in (fit, load, save):
        serve(node, command.__name__, command, worker)
    node.create_timer(0.005, lambda: ticks.append('another'))
    executor, over = make_executor(context=context), Future()
    executor.add_node(node)

    def spin() -> None:
        while not over.done():
            executor.spin_until_future_complete(over, timeout_sec=0.1)

    spinner = threading.Thread(target=spin)
    spinner.start()
    try:
        assert bench.call('fit').message == f'{TICKS} ticks'
        assert threads == {spinner}
        answer = bench.call('load')
        assert (answer.success, answer.message) == (False, 'absent; add it')
        assert bench.call('save').message == 'at once'
        lines = [event for event in logged if isinstance(event, Log)]
        assert [line.severity for line in lines] == ['info', 'warning', 'info']
    finally:
        over.set_result(None)
        spinner.join()
        worker.close()
        executor.shutdown()
        node.destroy_node()


@pytest.mark.parametrize('make_executor', [SingleThreadedExecutor, events_executor])
def test_an_error_of_a_function_is_logged_and_the_executor_continues(
        bench: Any, make_executor: Any, capfd: pytest.CaptureFixture[str]) -> None:
    executor = make_executor(context=bench.node.context)
    node = Node('calibrator', context=bench.node.context)
    executor.add_node(node)
    call_soon, over = in_executor(node), Future()
    call_soon(lambda: math.sqrt(-1.0))
    call_soon(lambda: over.set_result(None))
    executor.spin_until_future_complete(over, timeout_sec=60.0)
    executor.shutdown()
    node.destroy_node()
    assert over.done()
    printed = capfd.readouterr().err
    assert printed.count('unexpected error') == 1
    assert 'ValueError: math' in printed


@pytest.fixture
def process() -> Iterator[WorkerProcess]:
    made = WorkerProcess()
    yield made
    made.close()


def test_worker_process_computes_and_fails_as_this_process(
        process: WorkerProcess, stored: Stored) -> None:
    calibration = read_calibration(stored())
    given = calibration.units, CalibratorSettings(model='10'), '', None
    found = process.call(fit_in_node, calibration.poses, *given).calibration
    here = fit_in_node(calibration.poses, *given).calibration
    np.testing.assert_array_equal(found.model.vector, here.model.vector)
    np.testing.assert_array_equal(found.covariance, here.covariance)
    assert process.call(os.getpid) != os.getpid()
    few = calibration.poses.take(slice(0, 2))
    with pytest.raises(RefusedFitError) as refused:
        fit_in_node(few, *given)
    with pytest.raises(RefusedFitError, match=re.escape(str(refused.value))):
        process.call(fit_in_node, few, *given)
    with pytest.raises(ValueError, match='math domain'):
        process.call(math.sqrt, -1.0)
    assert process.call(math.sqrt, 4.0) == 2.0


def test_the_worker_process_runs_only_while_the_processor_is_idle(process: WorkerProcess) -> None:
    process.start()  # a call could wait for idle time until it is restarted
    pid = children(os.getpid())[-1]
    wait(lambda: os.sched_getscheduler(pid) == os.SCHED_IDLE, 60.0)


def test_process_that_waits_too_long_is_restarted_with_normal_priority(
        process: WorkerProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_OF_A_WORKER, 0.5)
    process.call(time.sleep, 0.7)
    assert process.call(os.sched_getscheduler, 0) == os.SCHED_OTHER
    process.call(time.sleep, 0.7)


def test_the_node_computes_if_the_worker_process_was_killed(process: WorkerProcess) -> None:
    os.kill(process.call(os.getpid), signal.SIGKILL)
    assert process.call(math.sqrt, 4.0) == 2.0
    assert process.call(os.getpid) != os.getpid()


def test_a_file_does_not_wait_for_the_worker_process(process: WorkerProcess) -> None:
    assert process.call_if_free(os.getpid) == os.getpid()  # it is not started for this
    worker = process.call(os.getpid)
    assert process.call_if_free(os.getpid) == worker
    computing = threading.Thread(target=process.call, args=(time.sleep, 2.0))
    computing.start()
    found = {process.call_if_free(os.getpid)}
    while computing.is_alive() and os.getpid() not in found:
        found.add(process.call_if_free(os.getpid))
    assert computing.is_alive()
    computing.join()
    process.close()
    assert process.call_if_free(math.sqrt, 4.0) == 2.0


def test_a_node_that_ends_does_not_wait_for_a_computation(process: WorkerProcess) -> None:
    worker = process.call(os.getpid)
    closing = threading.Timer(0.2, process.close)
    closing.start()
    with pytest.raises(InputError, match='shutting down'):
        process.call(time.sleep, 3600.0)
    closing.join()
    assert not Path(f'/proc/{worker}').exists()


@pytest.mark.parametrize('number', sample([signal.SIGKILL, signal.SIGTERM, signal.SIGINT], 2))
def test_no_process_outlives_the_node(bench: Any, stored: Stored, number: int) -> None:
    path = stored()
    write_table(path.with_name(f'{path.stem}_poses.csv'), read_calibration(path).poses)
    node = bench.calibrator(calibration_file=path)
    bench.spin(lambda: children(node.pid))
    started = children(node.pid)
    bench.end(node, number)
    bench.spin(lambda: not any(Path(f'/proc/{pid}').exists() for pid in started))
