# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""One trial of the Imu path: a driver, a relay or the node, and a user, one process each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
CLIENTS = ROOT / 'benchmarks' / 'imu_clients.py'
Stamps = NDArray[np.int64]

SETTLE = 2.0
"""Time from the first message to the start of the measurement [s]."""

_DOMAINS = itertools.islice(itertools.cycle(range(1, 102)), os.getpid() % 101, None)


@dataclass(frozen=True)
class Trial:
    """
    The measurements of one interval.

    Parameters
    ----------
    cpu : float
        CPU time of the process between driver and user, without the processes that it starts [s].
    start : float
        Time from the start of that process to the first message that the user receives [s].
    first, last : int
        Begin and end of the interval [ns].
    sent : (n,) array
        Stamps of the messages that the driver sent [ns].
    heard : (m, 2) array
        Stamp and arrival of the messages that the user received [ns].
    memory : (float, float)
        Resident memory of that process at the begin and the end [MB].

    """

    cpu: float
    start: float
    first: int
    last: int
    sent: Stamps
    heard: Stamps
    memory: tuple[float, float] = (np.nan, np.nan)

    def between(self, first: int, last: int) -> Trial:
        """Return the messages of a shorter interval."""
        sent, heard = self.sent, self.heard
        return replace(self, first=first, last=last, sent=sent[(sent >= first) & (sent < last)],
                       heard=heard[(heard[:, 0] >= first) & (heard[:, 0] < last)])

    @property
    def latency_us(self) -> NDArray[np.floating[Any]]:
        """Return the time of each message from driver to user [µs]."""
        return (self.heard[:, 1] - self.heard[:, 0]) * 1e-3

    @property
    def lost(self) -> int:
        """Return the number of messages that the user did not receive."""
        return len(self.sent) - len(np.unique(self.heard[:, 0]))

    @property
    def rate(self) -> float:
        """Return the messages per second that the user received."""
        return len(self.heard) / (self.last - self.first) * 1e9

    @property
    def cpu_us(self) -> float:
        """Return the CPU time per received message, or per sent one without a user [µs]."""
        return self.cpu * 1e6 / (len(self.heard) or len(self.sent))


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of all threads of a process [s]."""
    tasks = Path(f'/proc/{pid}/task').glob('*/schedstat')
    return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(Path(f'/proc/{pid}/statm').read_text().split()[1])
    return pages * os.sysconf('SC_PAGE_SIZE') * 1e-6


def first_of(client: subprocess.Popen[str]) -> int:
    """Wait for the first message of a client, and return its time [ns]."""
    assert client.stdout is not None
    return int(client.stdout.readline())


def end(running: subprocess.Popen[str]) -> None:
    """End a process that has not ended yet."""
    if running.poll() is None:
        running.communicate(timeout=60)


@contextmanager
def process(command: list[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program; end it by closing its standard input, or by SIGTERM."""
    running = subprocess.Popen([sys.executable, *command], env=environment, cwd=ROOT, text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield running
    finally:
        if command[0] == '-m':
            running.send_signal(signal.SIGTERM)
        end(running)


def trial(command: list[str], rate: float, during: Callable[[], object], *,
          listened: bool = True, lead: float = 0.0, domain: int | None = None,
          namespace: str = '/') -> Trial:
    """
    Run a relay, or the node, between a driver and a user.

    Parameters
    ----------
    command : list of str
        Command of the program to measure.
    rate : float
        Messages per second; 0: without a pause.
    during : callable
        Is called during the measurement, which ends when it returns.
    listened : bool
        Whether there is a user.
    lead : float
        Time from the first message of the driver to the start of the program [s].
    domain : int, optional
        DDS domain; by default one of its own.
    namespace : str
        Namespace of all topics.

    """
    domain = next(_DOMAINS) if domain is None else domain
    os.environ.update(ROS_DOMAIN_ID=str(domain), PYTHONPATH=str(ROOT))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, 'ROS_LOG_DIR': folder, 'ROS_HOME': folder}
        sent_file, heard_file = Path(folder) / 'sent.npy', Path(folder) / 'heard.npy'
        own = ['--namespace', namespace, '--file']
        listen = ([str(CLIENTS), 'listen', *own, str(heard_file)] if listened
                  else ['-c', 'import sys; sys.stdin.read()'])
        drive = [str(CLIENTS), 'drive', f'--rate={rate}', *own, str(sent_file)]
        with process(listen, environment) as user, process(drive, environment) as driver:
            first_of(driver)
            time.sleep(lead)
            began = time.monotonic()
            with process(command, environment) as measured:
                start = first_of(user) * 1e-9 - began if listened else np.nan
                time.sleep(SETTLE if listened else 2.0 * SETTLE)
                cpu, first = cpu_seconds(measured.pid), time.monotonic_ns()
                memory = resident_mb(measured.pid)
                during()
                cpu, last = cpu_seconds(measured.pid) - cpu, time.monotonic_ns()
                grown = memory, resident_mb(measured.pid)
                time.sleep(0.3)
                end(driver)  # first: a flooded process may not notice that it must end
        sent = np.load(sent_file)
        heard = np.load(heard_file) if listened else np.empty((0, 2), np.int64)
    return Trial(cpu, start, first, last, sent, heard, grown).between(first, last)


def relay(kind: str) -> list[str]:
    """Return the command of a bare relay."""
    return [str(CLIENTS), kind]


def node(calibration: Path, *parameters: str) -> list[str]:
    """Return the command of the node with a stored calibration."""
    given = [part for parameter in parameters for part in ('-p', parameter)]
    return ['-m', 'accel_calib.ros.run', 'calibrator', '--ros-args', '--log-level', 'error', '-p',
            f'calibration_file:={calibration}', *given]
