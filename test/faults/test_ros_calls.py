# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Services that four processes call at random while messages arrive."""

from collections.abc import Callable
import json
from pathlib import Path
import re
import signal
import sys
from typing import Any

from accel_calib.stored import read_calibration
from faults.nodes import log_to_files, send_until, start_poses
from faults.order import Call, explained, State
from faults.sample import FACTOR, sample
from inside import spread_directions
import numpy as np
import pytest

pytest.importorskip('rclpy')

CALLER = Path(__file__).with_name('caller.py')
CLIENTS = 4
CALLS = 50
"""Calls of a client; of many more, the search for their order takes too long."""

ENABLES, AT_ONCE = 10_000 if FACTOR > 1 else 200, 100
READING = np.array([1.0, 2.0, 9.0])
_POSES = 12
_SLOW = ('fit', 'refine')
_QUICK_S = 0.1


def calls_of(printed: str) -> list[Call]:
    """Return the calls that a caller printed."""
    return [Call(**json.loads(line)) for line in printed.splitlines() if line.startswith('{')]


def figures(clients: list[list[Call]]) -> str:
    """Return how long the responses took."""
    quick = np.array([call.ended - call.begun for calls in clients for call in calls
                      if call.name not in _SLOW])
    p50, p99 = 1e3 * np.quantile(quick, [0.5, 0.99])
    return (f'{sum(map(len, clients))} calls; without fit and refine: '
            f'{100 * np.mean(quick < _QUICK_S):.1f} % within 100 ms, median {p50:.0f} ms, '
            f'p99 {p99:.0f} ms, longest {1e3 * np.max(quick):.0f} ms')


@pytest.mark.parametrize('run', sample(range(5), 1))
def test_each_call_is_answered_and_all_agree_with_some_order(
        run: int, bench: Any, readings: Callable[..., Any], tmp_path: Path) -> None:
    home = bench.home / 'accel_calib'
    start_poses(home / 'arm_poses.csv', _POSES)
    log_to_files(bench, tmp_path)
    node = bench.calibrator(sensor='arm', passthrough=True, auto_capture=False)
    turned = readings(spread_directions(14), dwell=4.0)
    callers = [bench.run(str(CALLER), str(CLIENTS * run + k), str(CALLS)) for k in range(CLIENTS)]
    send_until(bench, turned, lambda: all(each.poll() is not None for each in callers),
               60.0 + 2.0 * CALLS)
    clients = [calls_of(each.communicate()[0]) for each in callers]
    assert bench.call('enable', data=True).success
    force = bench.echo([bench.imu(READING)], bench.came_out)[0].linear_acceleration
    status, printed = bench.end(node, signal.SIGINT)
    sys.stdout.write(f'{figures(clients)}\n')
    assert status == 0, printed
    assert 'Traceback' not in printed
    assert 'unexpected error' not in printed
    assert [len(calls) for calls in clients] == [CALLS] * CLIENTS
    assert not [call for calls in clients for call in calls if call.words is None]
    stored = home / 'arm.yaml'
    levelled = stored.exists() and read_calibration(stored).is_levelled
    steps = sum(bool(re.fullmatch(r'arm\.yaml\.before\d+', path.name)) for path in home.iterdir())

    def fits(state: State) -> bool:
        return ((state.stored is not None) is stored.exists() and state.has(steps)
                and (state.stored is not None and state.stored.levelled) is levelled)

    found, stuck = explained(clients, State(_POSES), fits)
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
        assert all(f'correction is {("off", "on")[k % 2]}' in each for k, each in enumerate(words))
