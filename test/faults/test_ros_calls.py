# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Services that four clients call at random while messages arrive; test_tasks has their order."""

from collections.abc import Callable
import re
import signal
from typing import Any

from accel_calib import simulate
from accel_calib.logs import write_table
from accel_calib.stored import read_calibration
from faults.sample import FACTOR, sample
from inside import spread_directions
import numpy as np
import pytest

pytest.importorskip('rclpy')

CLIENTS = 4
CALLS = 50
"""Calls of a client."""

SHARES = {'capture_pose': 18, 'undo_pose': 3, 'fit': 12, 'refine': 3, 'set_level': 10,
          'set_heading': 3, 'calibrate_at_rest': 5, 'save': 10, 'load': 6, 'undo': 10, 'reset': 1,
          'enable': 8, 'self_test': 10}
"""How often each service is called, relative to the others."""

ENABLES, AT_ONCE = 10_000 if FACTOR > 1 else 200, 100
READING = np.array([1.0, 2.0, 9.0])


@pytest.mark.parametrize('run', sample(range(5), 1))
def test_each_call_is_answered_and_what_is_published_is_corrected_as_stored(
        run: int, bench: Any, readings: Callable[..., Any]) -> None:
    home, rng = bench.home / 'accel_calib', np.random.default_rng(run)
    home.mkdir(parents=True)
    write_table(home / 'arm_poses.csv', simulate({}, directions=spread_directions(12), seed=2))
    node = bench.calibrator(sensor='arm', passthrough=True, auto_capture=False)
    turned = iter(np.tile(readings(spread_directions(14), dwell=4.0), (1000, 1)))
    weights = np.array([*SHARES.values()]) / sum(SHARES.values())
    calls: list[Any] = [None] * CLIENTS
    answered = 0

    def all_called() -> bool:
        nonlocal answered
        for number, call in enumerate(calls):
            if call is None or call.done():
                answered += call is not None
                client = bench.client(name := str(rng.choice([*SHARES], p=weights)), number)
                given = {'data': bool(rng.integers(2))} if name == 'enable' else {}
                calls[number] = client.call_async(client.srv_type.Request(**given))
        bench.send(bench.imu(next(turned)))
        return answered >= CLIENTS * CALLS

    bench.spin(all_called, 60.0 + 2.0 * CALLS)
    bench.send_until(lambda: bench.imu(next(turned)), lambda: all(call.done() for call in calls))
    assert bench.call('enable', data=True).success
    force = bench.echo([bench.imu(READING)], bench.came_out)[0].linear_acceleration
    status, printed = bench.end(node, signal.SIGINT)
    assert status == 0, printed
    assert not re.search('Traceback|unexpected error', printed)
    stored = home / 'arm.yaml'
    expected = read_calibration(stored).apply(READING[np.newaxis])[0] if stored.exists() else (
        READING)
    np.testing.assert_allclose([force.x, force.y, force.z], expected, atol=1e-9)


def test_each_call_of_enable_is_answered_while_messages_arrive(
        bench: Any, readings: Callable[..., Any]) -> None:
    from rclpy.qos import QoSProfile
    from std_srvs.srv import SetBool
    bench.calibrator(passthrough=True)
    client = bench.node.create_client(SetBool, 'calibrator/enable',
                                      qos_profile=QoSProfile(depth=AT_ONCE))
    bench.spin(client.service_is_ready)
    turned = readings(spread_directions(14), dwell=4.0)
    for _ in range(ENABLES // AT_ONCE):
        bench.send(bench.imu(turned[0]))
        sent = [client.call_async(SetBool.Request(data=bool(k % 2))) for k in range(AT_ONCE)]
        bench.spin(lambda sent=sent: all(each.done() for each in sent))
        words = [each.result().message for each in sent]
        assert all(f'correction {("switched off", "on")[k % 2]}' in each
                   for k, each in enumerate(words))
