# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One trial of the Imu path: a driver, a relay or the node, and a user, each a process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
CLIENTS = ROOT / 'benchmarks' / 'imu_clients.py'
SETTLE = 2.0
"""After the first message came through, before anything is measured [s]."""

Stamps = NDArray[np.int64]

_DOMAINS = itertools.cycle(range(1, 102))


@dataclass(frozen=True)
class Trial:
    """
    What was measured in a stretch of time.

    Parameters
    ----------
    cpu_us : float
        CPU time of the process between driver and user, a message that it was given [µs].
    latency_us : (n,) array
        From the driver's stamp to the user [µs].
    sent, lost : int
        Messages of the driver, and of these not seen by the user.
    rate : float
        Messages a second that reached the user.
    start : float
        From the start of the process to the first message that came through it [s].

    """

    cpu_us: float
    latency_us: NDArray[np.float64]
    sent: int
    lost: int
    rate: float
    start: float


def cpu_seconds(pid: int) -> float:
    """Give the CPU time of all threads of a process."""
    tasks = Path(f'/proc/{pid}/task').glob('*/schedstat')
    return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9


def first_of(client: subprocess.Popen[str]) -> int:
    """Wait for the first message of a client; give its time [ns]."""
    assert client.stdout is not None
    return int(client.stdout.readline())


@contextmanager
def process(command: list[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program; end it by the end of its input, or by SIGTERM."""
    running = subprocess.Popen([sys.executable, *command], env=environment, cwd=ROOT, text=True,
                               stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        yield running
    finally:
        if command[0] == '-m':
            running.send_signal(signal.SIGTERM)
        running.communicate(timeout=60)


def trial(command: list[str], rate: float, during: Callable[[], object], *,
          listened: bool = True) -> Trial:
    """
    Run a relay, or the node, between a driver and a user.

    Parameters
    ----------
    command : list of str
        Of the program to be measured.
    rate : float
        Messages a second; 0: without a pause.
    during : callable
        Takes as long as is to be measured.
    listened : bool
        Whether there is a user.

    """
    environment = {**os.environ, 'PYTHONPATH': str(ROOT), 'ROS_DOMAIN_ID': str(next(_DOMAINS)),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    with tempfile.TemporaryDirectory() as folder:
        environment |= {'ROS_LOG_DIR': folder, 'ROS_HOME': folder}
        os.environ['ROS_DOMAIN_ID'] = environment['ROS_DOMAIN_ID']
        sent_file, heard_file = Path(folder) / 'sent.npy', Path(folder) / 'heard.npy'
        listen = ([str(CLIENTS), 'listen', '--file', str(heard_file)] if listened
                  else ['-c', 'input()'])
        drive = [str(CLIENTS), 'drive', f'--rate={rate}', '--file', str(sent_file)]
        with process(listen, environment) as user, process(drive, environment) as driver:
            first_of(driver)
            began = time.monotonic()
            with process(command, environment) as measured:
                start = first_of(user) * 1e-9 - began if listened else np.nan
                time.sleep(SETTLE if listened else 2.0 * SETTLE)
                cpu, first = cpu_seconds(measured.pid), time.monotonic_ns()
                during()
                cpu, last = cpu_seconds(measured.pid) - cpu, time.monotonic_ns()
                time.sleep(0.3)
        sent = np.load(sent_file)
        heard = np.load(heard_file) if listened else np.empty((0, 2), np.int64)
    return _between(first, last, sent, heard, cpu, start)


def _between(first: int, last: int, sent: Stamps, heard: Stamps, cpu: float, start: float
             ) -> Trial:
    """Give what there was between two times [ns]."""
    sent = sent[(sent >= first) & (sent < last)]
    came = int(np.sum((heard[:, 1] >= first) & (heard[:, 1] < last)))
    heard = heard[(heard[:, 0] >= first) & (heard[:, 0] < last)]
    return Trial(cpu * 1e6 / (came or len(sent)), (heard[:, 1] - heard[:, 0]) * 1e-3, len(sent),
                 len(sent) - len(np.unique(heard[:, 0])), came / ((last - first) * 1e-9), start)


def relay(kind: str) -> list[str]:
    """Give the command of a bare relay."""
    return [str(CLIENTS), kind]


def node(calibration: Path) -> list[str]:
    """Give the command of the node with a stored calibration."""
    return ['-m', 'accel_calib.ros.calibrator', '--ros-args', '--log-level', 'error', '-p',
            f'calibration_file:={calibration}']
