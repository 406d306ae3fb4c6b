# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Services that four clients call at random while messages arrive."""

from collections.abc import Callable
import re
import signal
from typing import Any

from accel_calib.stored import read_calibration
from faults.nodes import Caller, send_until, start_poses
from faults.order import explained, State
from faults.sample import FACTOR, sample
from inside import spread_directions
import numpy as np
import pytest

pytest.importorskip('rclpy')

CLIENTS = 4
CALLS = 50
"""Calls of a client; of many more, the search for their order takes too long."""

SHARES = {'capture_pose': 18, 'undo_pose': 3, 'fit': 12, 'refine': 3, 'set_level': 10,
          'set_heading': 3, 'calibrate_at_rest': 5, 'save': 10, 'load': 6, 'undo': 10, 'reset': 1,
          'enable': 8, 'self_test': 10}
"""How often each service is called, relative to the others."""

ENABLES, AT_ONCE = 10_000 if FACTOR > 1 else 200, 100
READING = np.array([1.0, 2.0, 9.0])
_POSES = 12


@pytest.mark.parametrize('run', sample(range(5), 1))
def test_each_call_is_answered_and_all_agree_with_some_order(
        run: int, bench: Any, readings: Callable[..., Any]) -> None:
    home, rng = bench.home / 'accel_calib', np.random.default_rng(run)
    start_poses(home / 'arm_poses.csv', _POSES)
    node = bench.calibrator(sensor='arm', passthrough=True, auto_capture=False)
    turned = readings(spread_directions(14), dwell=4.0)
    callers = [Caller(bench, number) for number in range(CLIENTS)]
    weights = np.array([*SHARES.values()]) / sum(SHARES.values())

    def begin(caller: Caller) -> None:
        name = str(rng.choice([*SHARES], p=weights))
        caller.begin(name, **({'data': bool(rng.integers(2))} if name == 'enable' else {}))

    def all_called() -> bool:
        for caller in callers:
            if caller.poll() and len(caller.calls) < CALLS:
                begin(caller)
        return all(len(caller.calls) == CALLS for caller in callers)

    for caller in callers:
        begin(caller)
    send_until(bench, turned, all_called, 60.0 + 2.0 * CALLS)
    assert bench.call('enable', data=True).success
    force = bench.echo([bench.imu(READING)], bench.came_out)[0].linear_acceleration
    status, printed = bench.end(node, signal.SIGINT)
    assert status == 0, printed
    assert not re.search('Traceback|unexpected error', printed)
    stored = home / 'arm.yaml'
    levelled = stored.exists() and read_calibration(stored).is_levelled
    steps = sum(bool(re.fullmatch(r'arm\.yaml\.before\d+', path.name)) for path in home.iterdir())

    def fits(state: State) -> bool:
        return ((state.stored is not None) is stored.exists() and state.has(steps)
                and (state.stored is not None and state.stored.levelled) is levelled)

    found, stuck = explained([caller.calls for caller in callers], State(_POSES), fits)
    assert found is not None, stuck
    expected = (read_calibration(stored).apply(READING[np.newaxis])[0] if stored.exists()
                else READING)
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
