# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses before a node starts, messages while its services are called, and its output in a file."""

from collections.abc import Callable
from pathlib import Path
import subprocess
import sys
from typing import Any

from accel_calib import simulate
from accel_calib.logs import write_table
from inside import spread_directions
from shared import ROOT

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


class Logged(subprocess.Popen[str]):
    """A process with its output in a file: a pipe that nobody reads would stop it."""

    def __init__(self, command: list[str], path: Path, environment: dict[str, str]) -> None:
        self._path = path
        with path.open('w', encoding='utf-8') as file:
            super().__init__(command, cwd=ROOT, env=environment, stdout=file,
                             stderr=subprocess.STDOUT, text=True)

    def communicate(self, input: str | None = None,  # noqa: A002
                    timeout: float | None = None) -> tuple[str, str]:
        """Wait for the end, and return the output so far."""
        self.wait(timeout)
        return self._path.read_text(encoding='utf-8'), ''


def log_to_files(bench: Any, folder: Path) -> None:
    """Let the processes of a bench write to files in a folder."""
    def run(*arguments: str) -> Logged:
        path = folder / f'output{len(bench._processes)}.txt'
        process = Logged([sys.executable, *arguments], path, bench._environment)
        bench._processes.append(process)
        return process

    bench.run = run
