# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Nodes that are killed at random times have stored all that they answered."""

from collections.abc import Callable, Iterable
from pathlib import Path
import re
import signal
import time
from typing import Any

from accel_calib.logs import read_poses
from accel_calib.stored import read_calibration
from faults.nodes import Caller, send_until, start_poses
from faults.order import AFTER, Call, State
from faults.sample import FACTOR
from inside import is_partial, spread_directions
import numpy as np
import pytest

pytest.importorskip('rclpy')

KILLS = 6 * FACTOR
COMMANDS = ('capture_pose', 'fit', 'set_level', 'fit', 'undo_pose', 'save', 'capture_pose', 'undo',
            'fit', 'refine', 'calibrate_at_rest', 'load', 'reset')
_POSES = 12
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


def after_call(states: Iterable[State], call: Call) -> list[State]:
    """Return the states that a call with its response may leave."""
    found = [after for state in states for after in AFTER[call.name](state, call)]
    assert found, call
    return found


def after_kill(states: Iterable[State], name: str) -> list[State]:
    """Return the states that a call without a response may leave, if it was killed or done."""
    unknown, found = 'roll 999°, pitch 999°, yaw 999°', []
    for state in states:
        found.append(state)
        for count in {max(state.poses - 1, 0), state.poses, state.poses + 1}:
            for undone in ('', 'no calibration any more'):
                found += AFTER[name](state, Call(
                    name, 0.0, 0.0, f'{count} poses; {unknown}; {undone}', good=True))
    return found


def call_until_killed(bench: Any, node: Any, turned: Any, rng: np.random.Generator,
                      states: list[State]) -> list[State]:
    """Call services one after the other, kill the node, and return what may be stored."""
    ends, caller = time.monotonic() + rng.uniform(0.1, _LATEST_KILL_S), Caller(bench)
    while True:
        caller.begin(str(rng.choice(COMMANDS)))
        send_until(bench, turned, lambda: caller.poll() or time.monotonic() > ends)
        if caller.last is None:
            bench.end(node, signal.SIGKILL)
            return after_kill(states, caller.name)
        states = after_call(states, caller.last)


def test_a_killed_node_has_stored_all_that_it_answered(
        bench: Any, readings: Callable[..., Any]) -> None:
    folder = bench.home / 'accel_calib'
    start_poses(folder / 'arm_poses.csv', _POSES)
    bench.without_shared_memory()
    turned, rng = readings(spread_directions(14), dwell=4.0), np.random.default_rng(FACTOR)
    states = [State(_POSES)]
    for _ in range(KILLS):
        node = bench.calibrator(sensor='arm', passthrough=True, auto_capture=False)
        bench.feed(turned[:100])
        found = call_until_killed(bench, node, turned, rng, states)
        bench.join_anew()
        assert 'Traceback' not in node.printed
        stored = Stored(folder)
        assert not stored.damaged
        states = [state for state in set(found) if stored.agrees(state)]
        assert states, (found[0], stored.calibration, stored.poses)
