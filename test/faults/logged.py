# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Processes that write to files: a pipe that nobody reads would stop them."""

from pathlib import Path
import subprocess
import sys
from typing import Any

ROOT = Path(__file__).parents[2]


class Logged(subprocess.Popen[str]):
    """A process with its output in a file."""

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
