# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Shutdown of the nodes by signals and by a kill, and restart."""

from collections.abc import Callable
import shutil
import signal
from typing import Any

from accel_calib.logs import write_table
from accel_calib.stored import read_calibration
from diagnostic_msgs.srv import SelfTest
from faults.sample import FACTOR, sample
from inside import CALIBRATOR
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
import pytest
from sensor_msgs.msg import Imu
from shared import Stored
from std_srvs.srv import Trigger

BUSY = 10 if FACTOR > 1 else 4
TROUBLE = ('Traceback', 'FATAL', 'ERROR', 'Fatal Python error', 'Failed to')
"""What no node may print at its end: of Python, of the log, and of the layers below."""


@pytest.mark.parametrize('number', sample((signal.SIGINT, signal.SIGTERM), 1))
def test_signals_end_the_simulator_with_status_0(bench: Any, number: int) -> None:
    node = bench.start('simulator')
    bench.spin(lambda: bench.node.count_publishers('imu/data_raw'))
    bench.spin(iter([False, False, True]).__next__)
    status, printed = bench.end(node, number)
    assert status == 0, printed
    assert 'Traceback' not in printed


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
            *CALIBRATOR, '--ros-args', '-r', f'__ns:=/{name}',
            '-r', 'imu/data_raw:=/imu/data_raw',
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
    node = bench.start(name, **given)
    printed = node.communicate(timeout=60)[0]
    assert node.returncode == 2
    assert words in printed
    assert len(printed.strip().splitlines()) == 1, printed
