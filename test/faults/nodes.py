# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses before a node starts, and calls of its services while messages arrive."""

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any

from accel_calib import simulate
from accel_calib.logs import write_table
from faults.order import Call
from inside import spread_directions

_AT_ONCE = 5
"""Number of messages between two looks at the services."""


def start_poses(path: Path, count: int) -> None:
    """Store poses [m/s²], with which a calibrator starts."""
    path.parent.mkdir(parents=True)
    write_table(path, simulate({}, directions=spread_directions(count), noise=0.0005, seed=2))


def send_until(bench: Any, turned: Any, over: Callable[[], Any], seconds: float = 60.0) -> None:
    """Publish readings until a condition holds; they go on where the last call ended."""
    def sent() -> Any:
        for _ in range(_AT_ONCE):
            bench.sent = getattr(bench, 'sent', 0) + 1
            bench.send(bench.imu(turned[bench.sent % len(turned)]))
        bench.came_out.clear()
        return over()

    bench.spin(sent, seconds)


class Caller:
    """
    A client of a node that makes one call after the other; `calls` are those that have ended.

    The calls of several callers overlap.

    """

    def __init__(self, bench: Any, number: int = 0) -> None:
        self._bench, self._number = bench, number
        self.calls: list[Call] = []
        self.last: Call | None = None

    def begin(self, name: str, **fields: Any) -> None:
        """Call a service."""
        client = self._bench.client(name, self._number)
        self.name, self.last, self._begun = name, None, time.monotonic()
        self._future = client.call_async(client.srv_type.Request(**fields))

    def poll(self) -> Call | None:
        """Return the call if it has ended."""
        if self.last is None and self._future.done():
            answer, ended = self._future.result(), time.monotonic()
            words = answer.message if hasattr(answer, 'message') else '; '.join(
                f'{each.name}: {each.message}' for each in answer.status)
            self.last = Call(self.name, self._begun, ended, words,
                             bool(getattr(answer, 'success', True)))
            self.calls.append(self.last)
        return self.last
