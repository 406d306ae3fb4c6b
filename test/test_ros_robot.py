# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a robot in the field meets: transforms, several drivers, QoS, a preview, signals, kills."""

from collections.abc import Callable
import math
from pathlib import Path
import re
import shutil
import signal
import time
from typing import Any

from accel_calib.logs import write_table
from accel_calib.stored import read_calibration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from diagnostic_msgs.srv import SelfTest
from faults.sample import FACTOR, sample
from geometry_msgs.msg import Vector3
from inside import CALIBRATOR, NODES, rotation_from_rpy, spread_directions
from inside_ros import force_of, publish_static
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import numpy as np
import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu, Temperature
from shared import GRAVITY, Readings, Stored, wait
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from test_ros_watch import free_port, page_link
from viewer import Viewer


def test_the_mounting_comes_from_the_static_transforms_and_is_published(
        tf_message: Any, bench: Any, stored: Stored) -> None:
    heard = bench.listen(tf_message, '/tf_static', latched=True)
    publish_static(bench.node, *(
        (parent, child, (0.0, 0.0, math.sin(half), math.cos(half)))
        for parent, child, half in (('base_link', 'mast', 0.3), ('mast', 'imu_link', 0.2))))
    path = stored()
    bench.calibrator(calibration_file=path, base_frame='base_link', publish_tf=True)
    reading = np.array([1.0, 2.0, 9.5])
    bench.exchange(bench.came_out, lambda: bench.imu(reading))
    expected = rotation_from_rpy(0.0, 0.0, 1.0) @ read_calibration(path).correct(reading[None])[0]

    def levelled() -> Any:
        return [each for message in heard for each in message.transforms
                if each.child_frame_id == 'imu_link_levelled']

    bench.send_until(lambda: bench.imu(reading), lambda: np.allclose(
        force_of(bench.came_out[-1]), expected, atol=1e-6))
    bench.spin(levelled)
    found = levelled()[0]
    assert found.header.frame_id == 'imu_link'
    # It undoes the mounting: the levelled frame is parallel to the base.
    assert found.transform.rotation.z == pytest.approx(-math.sin(0.5))
    assert found.transform.rotation.w == pytest.approx(math.cos(0.5))


# The stream


def test_the_qos_can_be_overridden_and_an_incompatible_one_is_named_with_what_to_do(
        bench: Any) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    node = bench.run(
        *CALIBRATOR, '--ros-args',
        '-p', 'qos_overrides./imu/data_raw.subscription.reliability:=reliable',
        '-p', 'qos_overrides./imu/data_calibrated.publisher.reliability:=best_effort')
    bench.client('self_test')
    bench.spin(lambda: diagnostics)
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
    bench.node.create_publisher(Imu, 'imu/data_raw', best_effort)
    bench.node.create_subscription(Imu, 'imu/data_calibrated', print, latched)
    wanted = ('/bench publishes on /imu/data_raw with the QoS best effort, but the subscriber '
              'expects reliable', '/imu/data_calibrated has the QoS volatile, but the subscriber '
              'expects transient local, so that /bench receives nothing')
    bench.spin(lambda: all(words in diagnostics[-1].status[0].message for words in wanted))
    info, = bench.node.get_publishers_info_by_topic('/imu/data_calibrated')
    assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    status, printed = bench.end(node, signal.SIGTERM)
    assert status == 0, printed
    assert all(printed.count(words) == 1 for words in wanted)


def test_the_diagnostics_have_the_true_rate_and_the_resolved_names(
        bench: Any, stored: Stored) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    process = bench.run(*CALIBRATOR, '--ros-args', '-r', '__ns:=/left',
                        '-r', 'imu/data_raw:=/driver/imu', '-p', f'calibration_file:={stored()}')
    publisher = bench.node.create_publisher(Imu, '/driver/imu', 100)
    bench.spin(lambda: publisher.get_subscription_count() > 0)
    started, sent = time.monotonic(), 0

    def rate() -> float:
        stream = next((each.message for each in diagnostics[-1].status
                       if each.name == 'left/calibrator: stream'), '') if diagnostics else ''
        shown = re.match(r'([\d.]+) Hz on /driver/imu$', stream)
        return float(shown[1]) if shown else 0.0

    def true() -> bool:
        nonlocal sent
        while sent < (time.monotonic() - started) * 100.0:
            publisher.publish(bench.imu([0.1, 0.2, 9.8]))  # with stamps at 50 Hz
            sent += 1
        return rate() == pytest.approx(100.0, rel=0.05)

    bench.spin(true)
    found = {each.name: each for each in diagnostics[-1].status}
    assert set(found) == {f'left/calibrator: {concern}' for concern in (
        'state', 'stream', 'calibration', 'drift', 'storage')}
    assert {each.hardware_id for each in found.values()} == {'imu_link'}
    assert 'rate [Hz]' in {each.key for each in found['left/calibrator: state'].values}
    assert bench.end(process, signal.SIGINT)[0] == 0


def test_the_node_says_what_it_waits_for_and_names_a_wrong_unit_a_parameter_and_two_publishers(
        bench: Any) -> None:
    lines = bench.listen(Log, '/rosout', latched=True)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    process = bench.calibrator(unit='g')
    bench.spin(lambda: any('although /bench publishes' in line.msg for line in lines))

    bench.send_until(lambda: bench.imu([0.0, 0.1, 1.0]),
                     lambda: any('units:=g' in line.msg for line in lines))
    bench.start('simulator')

    def stream() -> DiagnosticStatus:
        return next((each for message in diagnostics[-1:] for each in message.status
                     if each.name == 'calibrator: stream'), DiagnosticStatus())

    bench.send_until(lambda: bench.imu([0.1, 0.2, 9.8]), lambda: all(
        words in stream().message for words in (
            'two publishers on the topic /imu/data_raw', '/bench', '/simulator')))
    assert stream().level == DiagnosticStatus.WARN
    assert 'no parameter unit,' in bench.end(process, signal.SIGINT)[1]


def test_topics_of_imus_and_thermometers_that_exist_are_named(bench: Any) -> None:
    lines = bench.listen(Log, '/rosout', latched=True)
    bench.node.create_publisher(Imu, '/arm/imu', 10)
    bench.node.create_publisher(Temperature, '/board/temperature', 10)
    bench.run(*NODES['calibrator'], '--ros-args', '-r', 'imu/data_raw:=/elsewhere',
              '-r', '__node:=astray')

    def said(*words: str) -> bool:
        return any(all(each in line.msg for each in words) for line in lines)

    bench.spin(lambda: said('no Imu messages on /elsewhere', 'such as /arm/imu'))
    bench.calibrator()
    bench.run(*NODES['calibrator'], '--ros-args', '-r', 'imu/data_raw:=/far')  # beside another
    bench.spin(lambda: said('no Imu messages on /far', 'such as /arm/imu'))
    assert not said('such as', '/preview')

    bench.send_until(lambda: bench.imu([0.1, 0.2, 9.8]), lambda: said(
        'no temperature arrives', 'temperature:=/board/temperature'))


def test_one_rest_gives_gyro_bias_mounting_and_the_offset_along_gravity(bench: Any) -> None:
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    bench.calibrator(sensor='arm', passthrough=True, gyro_bias=True, fill_covariance=True)
    bias, rng = np.array([0.01, -0.02, 0.005]), np.random.default_rng(1)

    def make() -> Imu:
        x, y, z = bias + 0.001 * rng.normal(size=3)
        return bench.imu([0.5, 0.0, 10.0] + 0.01 * rng.normal(size=3),
                         angular_velocity=Vector3(x=x, y=y, z=z))

    bench.exchange(bench.came_out, make)
    bench.echo((make() for _ in range(150)), bench.came_out)
    bench.spin(lambda: still and still[-1].data)
    answer = bench.call_while('calibrate_at_rest', make)
    assert answer.success, answer.message
    found = read_calibration(bench.home / 'accel_calib' / 'arm.yaml')
    np.testing.assert_allclose(found.gyro.bias, bias, atol=5 * found.gyro.sd.max() + 1e-4)
    bench.exchange(bench.came_out, make)
    bench.send_until(make, lambda: bench.came_out[-1].header.frame_id == 'imu_link_levelled')
    got = bench.echo((make() for _ in range(40)), bench.came_out)
    rates = np.array([[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z]
                      for m in got])
    np.testing.assert_allclose(rates.mean(axis=0), 0.0, atol=1e-3)
    assert np.linalg.norm(np.mean([force_of(m) for m in got], axis=0)) == pytest.approx(
        GRAVITY, abs=0.01)
    assert got[-1].angular_velocity_covariance[0] == pytest.approx(1e-6, rel=0.5)
    assert got[-1].linear_acceleration_covariance[0] > 0.5e-4


# Preview, accept, undo


def test_a_fit_waits_for_confirmation_on_the_preview(bench: Any, readings: Readings) -> None:
    preview = bench.listen(Imu, 'calibrator/preview')
    bench.calibrator(sensor='arm', passthrough=True, confirm=True, rotate=False,
                     mounting_rpy=[0.5, 0.0, 0.0])
    bench.feed(readings(spread_directions(12)))
    path = bench.home / 'accel_calib' / 'arm.yaml'
    for end in ('undo', 'save'):
        answer = bench.call('fit')
        assert answer.success, answer.message
        assert not path.exists()
        raw = bench.imu([0.3, 0.4, 9.7])
        bench.exchange(preview, lambda raw=raw: raw)
        assert preview[-1].header.frame_id == raw.header.frame_id
        assert 0.05 < np.linalg.norm(force_of(preview[-1]) - [0.3, 0.4, 9.7]) < 1.0
        assert bench.exchange(bench.came_out, lambda raw=raw: raw) == raw
        assert bench.call(end).success
        assert path.exists() is (end == 'save')
    bench.send_until(lambda: bench.imu([0.3, 0.4, 9.7]), lambda: np.linalg.norm(
        force_of(bench.came_out[-1]) - [0.3, 0.4, 9.7]) > 0.05)


# Start and end


def test_a_signal_at_any_time_of_the_start_ends_the_node_without_a_traceback(bench: Any) -> None:
    for regions in sample((20, 100, 250, 400, 600, 800, 1000), 3):  # 1300 after the start
        process = bench.start('calibrator')
        memory = Path(f'/proc/{process.pid}/maps')
        bench.spin(lambda memory=memory, most=regions: len(
            memory.read_text(encoding='utf-8').splitlines()) > most)
        status, printed = bench.end(process, signal.SIGTERM)
        assert status in (0, -signal.SIGTERM), printed
        assert 'Traceback' not in printed


def test_the_managed_node_loads_and_has_a_page_on_configure_and_publishes_when_active(
        bench: Any, stored: Stored) -> None:
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import GetState
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    heard = bench.listen(Imu, 'imu/data_calibrated')
    process = bench.start('calibrator_lifecycle', calibration_file=stored(), web_port=free_port())
    tried = {'model': '77', 'frame': 'ned', 'gravity': 9.81, 'mounting_rpy': [0.0, 0.0, 0.5]}

    def set_all() -> list[bool]:
        return [each.successful for each in bench.ask(
            SetParameters, 'calibrator/set_parameters', parameters=[
                Parameter(name, value=value).to_parameter_msg()
                for name, value in tried.items()]).results]

    assert set_all() == [False, True, True, True]
    publisher = bench.node.create_publisher(Imu, 'imu/data_raw', 100)

    def pushes() -> int:
        """Return the number of messages that come out before the answer to a later request."""
        heard.clear()
        for _ in range(5):
            publisher.publish(bench.imu([0.1, 0.2, 9.8]))
        bench.ask(GetState, 'calibrator/get_state')
        return len(heard)

    for count in (1, 2):  # the second page is at the same port
        for wrong in (Transition.TRANSITION_ACTIVATE, Transition.TRANSITION_CLEANUP, 200):
            assert not bench.ask(ChangeState, 'calibrator/change_state',
                                 transition=Transition(id=wrong)).success
        bench.go(Transition.TRANSITION_CONFIGURE)
        viewer = Viewer(page_link(bench, process, count))
        bench.spin(lambda viewer=viewer: viewer.of('state') and viewer.state['calibration'])
        bench.spin(lambda: publisher.get_subscription_count() > 0)
        assert set_all() == [False] * 4
        assert pushes() == 0
        assert 'not activated, nothing is published' in bench.call('enable', data=True).message
        bench.go(Transition.TRANSITION_ACTIVATE)
        bench.spin(lambda viewer=viewer: pushes() > 0 and any(
            each['length'] for each in viewer.of('progress')))
        assert viewer.ask('disable', bench.spin)['success']
        bench.go(Transition.TRANSITION_DEACTIVATE)
        pushes()
        assert pushes() == 0
        bench.go(Transition.TRANSITION_CLEANUP)
        wait(lambda viewer=viewer: viewer.code)
        viewer.close()
        state = bench.ask(GetState, 'calibrator/get_state').current_state
        assert state.label == 'unconfigured'
    assert bench.end(process, signal.SIGINT)[0] == 0


@pytest.mark.parametrize('publisher', sample([
    QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
    QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)], 1))
def test_every_qos_of_a_driver_fits_and_nothing_is_published_before_a_calibration(
        bench: Any, publisher: QoSProfile) -> None:
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    came_out = bench.listen(Imu, 'imu/data_calibrated')
    node = bench.start('calibrator', use_sim_time=True)  # and nobody publishes /clock
    bench.client('self_test')
    driver = bench.node.create_publisher(Imu, 'imu/data_raw', publisher)

    bench.spin(lambda: driver.publish(bench.imu([0.0, 0.0, GRAVITY])) or (
        diagnostics and 'no calibration yet' in diagnostics[-1].status[0].message))
    assert not came_out
    assert 'QoS' not in bench.end(node, signal.SIGTERM)[1]


# Signals, kills and restarts


BUSY = 10 if FACTOR > 1 else 4
TROUBLE = ('Traceback', 'FATAL', 'ERROR', 'Fatal Python error', 'Failed to')
"""What no node may print at its end: of Python, of the log, and of the layers below."""


def send_many(bench: Any, publisher: Any) -> Callable[[], None]:
    """Return a function that publishes 20 messages; a turn of `Bench.spin` takes 0.02 s."""
    def send() -> None:
        for _ in range(20):
            publisher.publish(bench.imu([0.1, 0.2, 9.8]))

    return send


def test_busy_nodes_end_with_status_0_and_without_words(bench: Any, stored: Stored) -> None:
    path = stored()
    write_table(path.with_name(f'{path.stem}_poses.csv'), read_calibration(path).poses)
    nodes, clients, heard = [], [], []
    for name in (f'n{k}' for k in range(BUSY)):
        for end in ('.yaml', '_poses.csv'):
            shutil.copy(path.with_name(f'{path.stem}{end}'), path.with_name(f'{name}{end}'))
        nodes.append(bench.run(
            *CALIBRATOR, '--ros-args', '-r', f'__ns:=/{name}', '-r', 'imu/data_raw:=/imu/data_raw',
            '-p', f'calibration_file:={path.with_name(name)}.yaml'))
        clients.append(bench.node.create_client(Trigger, f'/{name}/calibrator/refine'))
        heard.append(bench.listen(Imu, f'/{name}/imu/data_calibrated'))
    send = send_many(bench, bench.node.create_publisher(Imu, 'imu/data_raw', 100))
    bench.spin(lambda: send() or all(heard))
    bench.spin(lambda: send() or all(client.service_is_ready() for client in clients))
    numbers = [signal.SIGINT, signal.SIGTERM] * (BUSY // 2)
    for node, client, number in zip(nodes, clients, numbers, strict=True):
        client.call_async(Trigger.Request())
        bench.spin(lambda turns=iter([False] * 3 + [True]): send() or next(turns))
        node.send_signal(number)
    bench.spin(lambda: send() or all(node.poll() is not None for node in nodes))
    for node, number in zip(nodes, numbers, strict=True):
        status, printed = bench.end(node, number)
        assert status == 0, printed
        assert not [word for word in TROUBLE if word in printed], printed


def test_a_managed_node_is_cleaned_up_while_messages_and_requests_arrive(bench: Any) -> None:
    node = bench.start('calibrator_lifecycle', passthrough=True)
    change = bench.node.create_client(ChangeState, 'calibrator/change_state')
    test = bench.node.create_client(SelfTest, 'calibrator/self_test')
    send = send_many(bench, bench.node.create_publisher(Imu, 'imu/data_raw', 100))
    heard = bench.listen(Imu, 'imu/data_calibrated')
    bench.spin(change.service_is_ready)

    def go(transition: int) -> None:
        changed = change.call_async(ChangeState.Request(transition=Transition(id=transition)))
        for _ in range(20):
            send()
            test.call_async(SelfTest.Request())
        bench.spin(changed.done)
        assert changed.result().success

    for _ in range(5):
        go(Transition.TRANSITION_CONFIGURE)
        go(Transition.TRANSITION_ACTIVATE)
        heard.clear()
        bench.spin(lambda: send() or heard)
        bench.spin(test.service_is_ready)
        go(Transition.TRANSITION_DEACTIVATE)
        go(Transition.TRANSITION_CLEANUP)
    status, printed = bench.end(node, signal.SIGTERM)
    assert status == 0, printed
    assert not [word for word in TROUBLE if word in printed], printed


@pytest.mark.parametrize(('name', 'given', 'words'), sample([
    ('calibrator', {'gravity': 900.0}, 'gravity'),
    ('calibrator', {'still_window': 'wide'}, 'still_window'),
    ('calibrator', {'max_dwell': 1.5}, 'expected at least twice min_dwell'),
    ('simulator', {'effects': ['nonsense=1']}, 'nonsense')], 1))
def test_bad_parameters_get_one_line_and_status_2(
        bench: Any, name: str, given: dict[str, Any], words: str) -> None:
    status, printed = bench.end(bench.start(name, **given))
    assert status == 2
    assert words in printed
    assert len(printed.strip().splitlines()) == 1, printed
