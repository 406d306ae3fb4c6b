# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes that are killed at random times, and two nodes on one store: nothing answered is lost."""

from collections.abc import Callable, Iterable
from pathlib import Path
import re
import signal
import sys
import time
from typing import Any

from accel_calib.logs import read_poses
from accel_calib.stored import read_calibration
from faults.nodes import log_to_files, send_until, start_poses
from faults.order import AFTER, Call, State
from faults.sample import FACTOR
from inside import CALIBRATOR, is_partial, spread_directions
import numpy as np
import pytest

pytest.importorskip('rclpy')

KILLS = 6 * FACTOR
SECONDS = 6.0 * FACTOR
COMMANDS = ('capture_pose', 'fit', 'set_level', 'fit', 'undo_pose', 'save', 'capture_pose', 'undo',
            'fit', 'refine', 'calibrate_at_rest', 'load', 'reset')
_POSES = 12
_SENSOR = {'sensor': 'arm', 'passthrough': True, 'auto_capture': False}
_LATEST_KILL_S = 1.5


class Stored:
    """
    What the files of a store hold.

    Parameters
    ----------
    folder : Path
        The folder of a store of the sensor ``arm``; a torn file raises an error.

    """

    def __init__(self, folder: Path) -> None:
        path, table = folder / 'arm.yaml', folder / 'arm_poses.csv'
        names = [each.name for each in folder.iterdir()]
        self.calibration = read_calibration(path) if path.exists() else None
        self.poses = len(read_poses(table)) if table.exists() else 0
        self.steps = sorted(int(name.rpartition('before')[2]) for name in names
                            if re.fullmatch(r'arm\.yaml\.before\d+', name))
        for number in self.steps:
            step = folder / f'arm.yaml.before{number}'
            if step.stat().st_size:
                read_calibration(step)
        self.damaged = [name for name in names if '.damaged' in name]

    def agrees(self, state: State) -> bool:
        """Return whether this is what a state has stored."""
        made, found = state.stored, self.calibration
        if (made is None) is not (found is None) or state.poses != self.poses:
            return False
        return made is None or found is None or (
            made.levelled is found.is_levelled and made.full is not is_partial(found))


def after_kill(states: Iterable[State], name: str) -> list[State]:
    """Return the states that a call without a response may leave, if it was killed or done."""
    unknown, found = 'roll 999°, pitch 999°, yaw 999°', []
    for state in states:
        found.append(state)
        for count in {max(state.poses - 1, 0), state.poses, state.poses + 1}:
            for undone in ('', 'no calibration any more'):
                call = Call(name, 0.0, 0.0, f'{count} poses; {unknown}; {undone}', good=True)
                found += AFTER[name](state, call)
    return found


def call_until_killed(bench: Any, node: Any, turned: Any, rng: np.random.Generator,
                      states: list[State]) -> list[State]:
    """Call services one after the other, kill the node, and return what may be stored."""
    ends = time.monotonic() + rng.uniform(0.1, _LATEST_KILL_S)
    while True:
        name = str(rng.choice(COMMANDS))
        client = bench.client(name)
        future = client.call_async(client.srv_type.Request())
        send_until(bench, turned, lambda future=future: (future.done() or time.monotonic() > ends))
        if not future.done():
            bench.end(node, signal.SIGKILL)
            return after_kill(states, name)
        answer = future.result()
        call = Call(name, 0.0, 0.0, answer.message, answer.success)
        states = [after for state in states for after in AFTER[name](state, call)]
        assert states, call


@pytest.fixture
def folder(bench: Any, tmp_path: Path) -> Path:
    """Return the folder of a store with poses; nodes may be killed."""
    log_to_files(bench, tmp_path)
    bench.without_shared_memory()
    start_poses(bench.home / 'accel_calib' / 'arm_poses.csv', _POSES)
    return Path(bench.home / 'accel_calib')


def test_a_killed_node_has_stored_all_that_it_answered(
        bench: Any, readings: Callable[..., Any], folder: Path) -> None:
    turned, rng = readings(spread_directions(14), dwell=4.0), np.random.default_rng(FACTOR)
    states = [State(_POSES)]
    for _ in range(KILLS):
        node = bench.calibrator(**_SENSOR)
        bench.feed(turned[:100])
        found = call_until_killed(bench, node, turned, rng, states)
        bench.join_anew()
        printed = node.communicate()[0]
        assert 'Traceback' not in printed
        stored = Stored(folder)
        assert not stored.damaged
        states = [state for state in set(found) if stored.agrees(state)]
        assert states, (found[0], stored.calibration, stored.poses)


def test_of_two_nodes_one_stores_and_the_other_says_so(
        bench: Any, readings: Callable[..., Any], folder: Path) -> None:
    from std_srvs.srv import Trigger
    turned, rng = readings(spread_directions(14), dwell=4.0), np.random.default_rng(FACTOR)
    first = bench.calibrator(**_SENSOR)
    other = bench.run(*CALIBRATOR, '--ros-args', '-r', '__node:=second', '-p', 'sensor:=arm',
                      '-p', 'passthrough:=true', '-p', 'auto_capture:=false')
    names = ('capture_pose', 'fit', 'undo', 'undo_pose', 'set_level', 'save', 'reset')
    clients = {(node, name): bench.node.create_client(Trigger, f'{node}/{name}')
               for node in ('calibrator', 'second') for name in names}
    bench.spin(lambda: all(client.service_is_ready() for client in clients.values()))
    states, ends, refused, called = [State(_POSES)], time.monotonic() + SECONDS, 0, 0
    while time.monotonic() < ends:
        name = str(rng.choice(names, p=[0.3, 0.2, 0.15, 0.1, 0.1, 0.1, 0.05]))
        both = [clients[node, name].call_async(Trigger.Request())
                for node in ('calibrator', 'second')]
        send_until(bench, turned, lambda both=both: all(each.done() for each in both))
        mine, others = (each.result() for each in both)
        call = Call(name, 0.0, 0.0, mine.message, mine.success)
        called += 1
        states = [after for state in states for after in AFTER[name](state, call)]
        assert states, call
        assert not others.success, others.message
        refused += f'process id {first.pid}' in others.message
    stored = Stored(folder)
    assert [state for state in states if stored.agrees(state)], stored.poses
    assert refused > called // 2
    bench.end(first, signal.SIGKILL)
    assert takes_over(bench, turned, clients['second', 'capture_pose'])
    assert bench.end(other, signal.SIGINT)[0] == 0
    sys.stdout.write(f'{called} calls of each node\n')


def takes_over(bench: Any, turned: Any, client: Any) -> bool:
    """Return whether the second node stores poses after the first one has ended."""
    answers: list[Any] = []
    futures = [client.call_async(client.srv_type.Request())]

    def captured() -> bool:
        if futures[-1].done():
            answers.append(futures[-1].result())
            futures.append(client.call_async(client.srv_type.Request()))
        return bool(answers) and answers[-1].success

    send_until(bench, turned, captured)
    return bool(answers[-1].success)
