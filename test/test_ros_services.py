# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The services, the parameters, and all names of the nodes, as stated in files of config/."""

from collections.abc import Iterator
from dataclasses import fields
import math
import os
from pathlib import Path
import re
import signal
import threading
import time
from typing import Any

from accel_calib.errors import InputError, RefusedFitError
from accel_calib.finding import NextStep
from accel_calib.logs import read_poses, write_table
from accel_calib.session import CalibratorSettings, Files, Log, nothing, Session, Task
from accel_calib.stored import read_calibration
from diagnostic_msgs.msg import DiagnosticArray
from faults.sample import sample
from inside import changed, fit_in_node, PATIENCE_OF_A_WORKER, Worker, WorkerProcess
from inside_ros import in_executor, pose_markers, serve, SimulatorSettings
import numpy as np
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import Imu
from shared import children, Readings, Stored, wait
from std_msgs.msg import Bool
from test_policy import granted, optional_elements, profile_of
from visualization_msgs.msg import MarkerArray


def count(markers: list[Any], namespace: str = 'poses') -> int:
    return sum(m.ns == namespace for m in markers[-1].markers) if markers else 0


def test_markers_show_the_next_step() -> None:
    text, = [m.text for m in pose_markers(np.zeros((0, 3)), NextStep('done', 'x'), 'imu').markers
             if m.ns == 'next']
    few = NextStep('poses', 'turn', direction=(0.6, 0.0, 0.8))
    arrow, turn = [m for m in pose_markers(np.zeros((0, 3)), few, 'imu').markers if m.ns == 'next']
    assert tuple(getattr(arrow.points[1], axis) for axis in 'xyz') == few.direction
    assert (text, turn.text) == ('x', 'turn')


def test_poses_are_captured_and_removed_on_request(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(auto_capture=False, sensor='arm', passthrough=True)
    poses = readings([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dwell=3.0)
    bench.feed(poses[:140])
    bench.send_until(lambda: bench.imu(poses[130]), lambda: still and still[-1].data)
    assert count(markers) == 0
    answer = bench.call_while('capture_pose', lambda: bench.imu(poses[130]))
    assert answer.success, answer.message
    asked = answer.message.partition('; next: ')[2]
    assert re.search(r' up \([-+xyz ]+\)$', asked)
    bench.send_until(lambda: bench.imu(poses[130]), lambda: count(markers) == 1)
    assert asked in [each.markers[-1].text for each in markers]
    bench.send_until(lambda: bench.imu(poses[130]), lambda: diagnostics and any(
        value.key == 'next' and value.value == asked
        for value in diagnostics[-1].status[0].values))
    bench.feed(poses[140:165])
    bench.spin(lambda: not still[-1].data)
    rng = np.random.default_rng(1)
    answer = bench.call_while('capture_pose', lambda: bench.imu(
        poses[150] + 2.0 * rng.normal(size=3)))
    assert not answer.success
    bench.feed(poses[165:310])
    bench.spin(lambda: still[-1].data)
    assert bench.call_while('capture_pose', lambda: bench.imu(poses[300])).success
    bench.spin(lambda: count(markers) == 2)
    known = len(diagnostics)
    bench.spin(lambda: len(diagnostics) > known + 2)  # nothing more is to be drawn
    later = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    bench.spin(lambda: count(later) == 2)
    stored = bench.home / 'accel_calib' / 'arm_poses.csv'
    bench.spin(lambda: len(read_poses(stored)) == 2)
    assert bench.call('undo_pose').success
    bench.spin(lambda: count(markers) == 1)
    assert bench.call('undo_pose').success
    assert not bench.call('undo_pose').success


def test_self_test_names_what_fails(bench: Any, stored: Stored) -> None:
    rng = np.random.default_rng(1)

    def moving() -> Imu:
        return bench.imu(np.array([0, 0, 9.8]) + 3.0 * rng.normal(size=3))

    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=stored('good.yaml'))
    answer = bench.call('self_test')
    assert answer.passed == b'\x00'
    assert 'no Imu messages' in {status.name: status.message for status in answer.status}[
        'calibrator: stream']
    bench.exchange(bench.came_out, moving)
    diagnostics.clear()

    bench.send_until(moving, lambda: len(diagnostics) > 1)
    answer = bench.call('self_test')
    assert answer.passed == b'\x01', [status.message for status in answer.status]
    assert answer.id == 'imu_link'


def test_parameters_accept_numbers_of_other_types_and_lists() -> None:
    settings = changed(CalibratorSettings(), {'model': 10, 'min_dwell': 2, 'sensor': 7,
                                              'use_sim_time': True})
    assert (settings.model, settings.min_dwell, settings.sensor) == ('10', 2.0, '7')
    assert isinstance(settings.min_dwell, float)
    lists = changed(SimulatorSettings(), {'mounting': [1, 2.5, 3], 'effects': []})
    assert (lists.mounting, lists.effects) == ([1.0, 2.5, 3.0], [])


def test_node_declares_all_parameters_and_refuses_invalid_values_while_it_runs(bench: Any) -> None:
    from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
    from rclpy.parameter import Parameter
    bench.calibrator()

    def ask(kind: Any, name: str, **request: Any) -> Any:
        return bench.ask(kind, f'calibrator/{name}', **request)

    stated = {parameter.name: parameter.metadata for parameter in fields(CalibratorSettings)}
    names = ask(ListParameters, 'list_parameters').result.names
    assert set(stated) <= set(names)
    described = ask(DescribeParameters, 'describe_parameters', names=list(stated)).descriptors
    assert {each.name: (each.description, not each.read_only) for each in described} == {
        name: (about['words'], about['live']) for name, about in stated.items()}
    tried = [Parameter('model', value=7), Parameter('model', value='11'),
             Parameter('gravity', value=9.81), Parameter('auto_fit_poses', value=2)]
    results = ask(SetParameters, 'set_parameters',
                  parameters=[each.to_parameter_msg() for each in tried]).results
    assert [each.successful for each in results] == [True, False, False, False]


Names = dict[str, set[str]]

RIGHTS = {'publish': 'topics', 'subscribe': 'topics', 'reply': 'services', 'request': 'services'}


def allowed(executable: str, *parameters: str) -> Names:
    """Return the full names by right, with the rights for these parameters."""
    profile = profile_of(executable)
    node = profile.get('node')
    found = {right: {name if name.startswith('/') else f'/{name.replace("~", node)}'
                     for name in granted(profile, tag, right)} for right, tag in RIGHTS.items()}
    for parameter, block in optional_elements():
        if parameter in parameters:
            for right in block.attrib:
                found[right] |= {each.text for each in block}
    return found


def used(bench: Any, node: str) -> Names:
    """Return the full names that a node uses, as DDS shows them."""
    graph = bench.node
    looks = {'publish': graph.get_publisher_names_and_types_by_node,
             'subscribe': graph.get_subscriber_names_and_types_by_node,
             'reply': graph.get_service_names_and_types_by_node,
             'request': graph.get_client_names_and_types_by_node}
    return {right: {name for name, _ in look(node, '/')} for right, look in looks.items()}


@pytest.mark.parametrize(('executable', 'parameters'), [
    ('calibrator', {}),
    ('calibrator', {'use_sim_time': True, 'base_frame': 'base_link', 'publish_tf': True}),
    ('calibrator_lifecycle', {}), ('simulator', {})])
def test_each_node_uses_all_that_the_policy_grants_and_nothing_else(
        executable: str, parameters: dict[str, Any], bench: Any,
        request: pytest.FixtureRequest) -> None:
    if parameters:
        request.getfixturevalue('tf_message')
    bench.start(executable, **parameters)
    if executable == 'calibrator_lifecycle':
        bench.go(1)  # TRANSITION_CONFIGURE
    node, expected = executable.partition('_')[0], allowed(executable, *parameters)
    bench.spin(lambda: node in bench.node.get_node_names())
    bench.spin(lambda: all(expected[right] <= names for right, names in used(bench, node).items()))
    assert used(bench, node) == expected


# Services that answer later, and the worker process


TICKS = 20
"""Number of ticks of a timer for which the work of a service waits."""


def events_executor(context: Any) -> Any:
    experimental = pytest.importorskip('rclpy.experimental')
    return experimental.EventsExecutor(context=context)


@pytest.mark.parametrize('make_executor', [SingleThreadedExecutor, events_executor])
def test_callbacks_continue_while_a_service_works_and_after_an_error(
        bench: Any, make_executor: Any, capfd: pytest.CaptureFixture[str]) -> None:
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

    def work() -> str:
        before, ends = len(ticks), time.monotonic() + 60.0
        while len(ticks) < before + TICKS and time.monotonic() < ends:
            time.sleep(0.01)
        return f'{min(len(ticks) - before, TICKS)} ticks'

    for command in (fit, load):
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
        in_executor(node)(lambda: math.sqrt(-1.0))
        assert bench.call('fit').message == f'{TICKS} ticks'
        assert threads == {spinner}
        answer = bench.call('load')
        assert (answer.success, answer.message) == (False, 'absent; add it')
        lines = [event for event in logged if isinstance(event, Log)]
        assert [line.severity for line in lines] == ['info', 'warning']
        printed = capfd.readouterr().err
        assert printed.count('unexpected error') == 1
        assert 'ValueError: math' in printed
    finally:
        over.set_result(None)
        spinner.join()
        worker.close()
        executor.shutdown()
        node.destroy_node()


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
