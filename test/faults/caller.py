# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A process that calls the services of a calibrator at random.

It prints one line of JSON per call: name, start and end by the steady clock of the machine, and
the response. ``python test/faults/caller.py SEED COUNT [NODE]``.

"""

import json
import sys
import time
from typing import Any

from diagnostic_msgs.srv import SelfTest
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

SHARES = {'capture_pose': 18, 'undo_pose': 3, 'fit': 12, 'refine': 3, 'set_level': 10,
          'set_heading': 3, 'calibrate_at_rest': 5, 'save': 10, 'load': 6, 'undo': 10, 'reset': 1,
          'enable': 8, 'self_test': 10}
"""How often each service is called, relative to the others."""

_LIMIT = 60.0
"""Time after which a call counts as not answered [s]."""

_PAUSE = 0.05
"""Longest pause between two calls [s]."""


def called(executor: SingleThreadedExecutor, client: Any, name: str,
           rng: np.random.Generator) -> dict[str, Any]:
    """Call a service, and return what came of it; ``words`` is None without a response."""
    fields = {'data': bool(rng.integers(2))} if name == 'enable' else {}
    begun = time.monotonic()
    future = client.call_async(client.srv_type.Request(**fields))
    executor.spin_until_future_complete(future, timeout_sec=_LIMIT)
    found = {'name': name, 'begun': begun, 'ended': time.monotonic(), 'words': None, 'good': False}
    if future.done():
        answer = future.result()
        found['words'] = answer.message if name != 'self_test' else '; '.join(
            f'{each.name}: {each.message}' for each in answer.status)
        found['good'] = bool(getattr(answer, 'success', True))
    return found


def main() -> None:
    """Call services at random; the arguments are the seed and the number of calls."""
    seed, count = (int(each) for each in sys.argv[1:3])
    service = sys.argv[3] if len(sys.argv) > 3 else 'calibrator'
    rng = np.random.default_rng(seed)
    rclpy.init(args=[])
    node = Node(f'caller_{seed}')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    kinds = {'enable': SetBool, 'self_test': SelfTest}
    clients = {name: node.create_client(kinds.get(name, Trigger), f'{service}/{name}')
               for name in SHARES}
    for client in clients.values():
        client.wait_for_service(_LIMIT)
    weights = np.array(list(SHARES.values()), float)
    for name in rng.choice(list(SHARES), size=count, p=weights / np.sum(weights)):
        sys.stdout.write(json.dumps(called(executor, clients[str(name)], str(name), rng)) + '\n')
        sys.stdout.flush()
        time.sleep(rng.uniform(0.0, _PAUSE))
    rclpy.shutdown()


if __name__ == '__main__':
    main()
