# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The processes of the benchmarks of nodes: a driver, the node, bare relays, a user and a caller.

The driver publishes a sensor that is turned through `POSES` poses, again and again. It has effects
of temperature and a non-linear one, so that a refinement finds something. It stamps each message
with the monotonic clock and records the stamps; the user records stamp and arrival. Both write
their records as arrays at the end of standard input. All are as cheap as rclpy allows: serialized
messages under EventsExecutor. They have the qualities of service of the node, so that only the
work differs.

"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
import itertools
import os
from pathlib import Path
from select import select
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

from accel_calib.ros.simulator_node import SimulatedImu, SimulatorSettings
from figures import ROOT
import numpy as np
from numpy.typing import NDArray
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import Imu, Temperature

Stamps = NDArray[np.int64]

SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
USER = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
NANO = 1_000_000_000

POSES, DWELL, TURN = 40, 2.0, 0.5
CYCLE = POSES * (DWELL + TURN)
"""Time until the poses begin again [s]; the temperature swings in the same time."""

EFFECTS = ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
           'cross_axis=0.006,-0.004,0.003', 'offset_temperature=0.001,-0.0005,0.0008',
           'quadratic=0.002,-0.001,0.001']

SETTLE = 2.0
"""Time from the first message to the start of the measurement [s]."""

PATIENCE = 60.0
"""Longest time until messages arrive [s]."""

_STAMP = struct.Struct('<iI')
_STAMP_AT, _RATE, _FORCE = 4, slice(-192, -168), slice(-96, -72)
"""Place of the stamp, the angular rate and the acceleration in a serialized Imu [bytes]."""

_DOMAINS = itertools.islice(itertools.cycle(range(1, 102)), os.getpid() % 101, None)


def drive(rate: float, file: Path) -> None:
    """Publish messages at a rate [1/s] and record their stamps; 0: without a pause."""
    often = rate or 1e4
    settings = SimulatorSettings(  # fewer poses where they have more samples
        rate=often, poses=round(POSES * min(1e3 / often, 1.0)), dwell=DWELL, turn=TURN,
        mixed=True, flat_last=False, effects=EFFECTS, temperature=[15.0, 35.0],
        temperature_period=CYCLE)
    simulated = SimulatedImu(settings)
    made = simulated.samples(round(simulated.duration * settings.rate))
    forces, rates = made.reading * settings.gravity, made['rate']
    message = Imu()  # with covariances, which make the most work
    message.header.frame_id = 'imu_link'
    message.orientation_covariance[0] = -1.0
    message.angular_velocity_covariance = (np.eye(3) * 0.002**2).ravel()
    message.linear_acceleration_covariance = (np.eye(3) * 0.02**2).ravel()
    data, over, sent = bytearray(serialize_message(message)), ended(), array('q')
    node = Node('driver')
    imu = node.create_publisher(Imu, 'imu/data_raw', STREAM)
    temperature = node.create_publisher(Temperature, 'temperature', STREAM)
    warm_every, began = round(settings.rate / 10.0), time.monotonic_ns()
    while not over():
        wait = began + len(sent) * NANO / rate - time.monotonic_ns() if rate else 0.0
        if wait > 0.0:
            time.sleep(wait / NANO)
        row = len(sent) % len(forces)
        data[_FORCE], data[_RATE] = forces[row].tobytes(), rates[row].tobytes()
        now = time.monotonic_ns()
        _STAMP.pack_into(data, _STAMP_AT, now // NANO, now % NANO)
        imu.publish(bytes(data))
        sent.append(now)
        if len(sent) == 1:
            print(now, flush=True)
        if len(sent) % warm_every == 0:
            temperature.publish(Temperature(temperature=float(made['temperature'][row])))
    np.save(file, np.array(sent))


def ended() -> Callable[[], bool]:
    """Return a function that returns whether standard input has ended."""
    over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait, daemon=True).start()
    return over.is_set


def listen(file: Path, *topics: str) -> None:
    """Record stamp and arrival of the messages of topics, in arrays that do not slow down."""
    node = Node('user')
    heard = {topic: array('q') for topic in topics}

    def subscribe(topic: str, record: array[int]) -> None:
        def on_imu(data: bytes) -> None:
            now = time.monotonic_ns()
            seconds, rest = _STAMP.unpack_from(data, _STAMP_AT)
            record.extend((seconds * NANO + rest, now))

        node.create_subscription(Imu, topic, on_imu, USER, raw=True)

    for each in heard.items():
        subscribe(*each)
    executor, over, printed = EventsExecutor(), ended(), False
    executor.add_node(node)
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=0.05)
        if not printed and all(heard.values()):
            print(max(record[1] for record in heard.values()), flush=True)
            printed = True
    np.savez(file, *(np.array(record).reshape(-1, 2) for record in heard.values()))
    executor.shutdown()


def relay(kind: str, topic: str) -> None:
    """Publish each message unchanged; a sink drops it, a typed relay deserializes it."""
    node = Node('relay')
    out = node.create_publisher(Imu, topic, STREAM)
    callback = out.publish if kind != 'sink' else lambda data: None
    executor = SingleThreadedExecutor() if kind == 'typed' else EventsExecutor()
    node.create_subscription(Imu, 'imu/data_raw', callback, SENSOR, raw=kind != 'typed')
    executor.add_node(node)
    over = ended()
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=0.25)
    executor.shutdown()


def relay_command(kind: str, topic: str = 'imu/data_calibrated') -> list[str]:
    """Return the command of a bare relay."""
    return [__file__, 'relay', kind, topic]


def node_command(*parameters: str) -> list[str]:
    """Return the command of the node."""
    given = [part for parameter in parameters for part in ('-p', parameter)]
    return ['-m', 'accel_calib.ros.run', 'calibrator', '--ros-args', *given]


def cpu_seconds(pid: int) -> float:
    """Return the CPU time of all threads of a process, without its children [s]."""
    tasks = Path(f'/proc/{pid}/task').glob('*/schedstat')
    return sum(int(task.read_text().split()[0]) for task in tasks) * 1e-9


class Caller:
    """A user who calls the services of the node in the DDS domain of the environment."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context)
        self.node = rclpy.create_node('caller', context=self._context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def wait(self, until: float, over: Callable[[], bool] = lambda: False) -> None:
        """Wait until a time of the monotonic clock [s], or until something holds."""
        while not over() and (left := until - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))

    def call(self, name: str) -> Any:
        """Call a service and return its response; without words none came."""
        from std_srvs.srv import Trigger
        if name not in self._clients:
            self._clients[name] = self.node.create_client(Trigger, f'calibrator/{name}')
            self._clients[name].wait_for_service(10.0)
        future = self._clients[name].call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=120.0)
        return future.result() if future.done() else Trigger.Response()

    def close(self) -> None:
        """Leave DDS."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


@dataclass(frozen=True)
class Trial:
    """The measurements of programs between a driver and a user, from one time to another [ns]."""

    first: int
    last: int
    start: float  # time from the start of the programs to the first message of all [s]
    cpu: float  # CPU time of the first program, without the processes that it starts [s]
    sent: Stamps  # (n,) stamps of the messages of the driver [ns]
    heard: tuple[Stamps, ...]  # of each program, (m, 2) stamp and arrival of its messages [ns]
    log: str  # what the programs printed

    def between(self, first: int, last: int) -> Trial:
        """Return the messages of a shorter interval."""
        sent, heard = self.sent, self.heard
        return replace(
            self, first=first, last=last, sent=sent[(sent >= first) & (sent < last)],
            heard=tuple(each[(each[:, 0] >= first) & (each[:, 0] < last)] for each in heard))

    def latency_us(self, percent: float) -> float:
        """Return a percentile of the time from driver to user of the first program [µs]."""
        heard = self.heard[0]
        return float(np.percentile((heard[:, 1] - heard[:, 0]) * 1e-3, percent))

    @property
    def lost(self) -> int:
        """Return the number of messages that the user did not receive of the first program."""
        return len(self.sent) - len(np.unique(self.heard[0][:, 0]))

    @property
    def rate(self) -> float:
        """Return the messages per second that the user received of the first program."""
        return len(self.heard[0]) / (self.last - self.first) * 1e9

    @property
    def cpu_us(self) -> float:
        """Return the CPU time per received message, or per sent one without a user [µs]."""
        return self.cpu * 1e6 / (len(self.heard[0]) if self.heard else len(self.sent))


def run_trial(programs: Mapping[str, list[str]], rate: float,
              during: Callable[..., object], *, listened: bool = True, lead: float = 0.0) -> Trial:
    """
    Run relays, or the node, between a driver and a user.

    Parameters
    ----------
    programs : mapping of str to list of str
        Commands of the programs to measure, by their topics.
    rate : float
        Messages per second; 0: without a pause.
    during : callable
        Is called with the id of each program during the measurement, which ends when it returns.
    listened : bool
        Whether there is a user.
    lead : float
        Time from the first message of the driver to the start of the programs [s].

    Raises
    ------
    RuntimeError
        If messages do not arrive.

    """
    with tempfile.TemporaryDirectory() as given, ExitStack() as stack:
        folder = Path(given)
        os.environ.update(ROS_DOMAIN_ID=str(next(_DOMAINS)), PYTHONPATH=str(ROOT),
                          ROS_LOG_DIR=given, ROS_HOME=given)
        os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        sent, heard, log = folder / 'sent.npy', folder / 'heard.npz', folder / 'log'
        user = stack.enter_context(process([__file__, 'listen', str(heard), *programs]
                                           if listened else [__file__, 'none'], log))
        driver = stack.enter_context(process([__file__, 'drive', str(rate), str(sent)], log))
        first_of(driver, log)
        time.sleep(lead)
        began = time.monotonic()
        pids = [stack.enter_context(process(command, log)).pid for command in programs.values()]
        start = first_of(user, log) * 1e-9 - began if listened else np.nan
        time.sleep(SETTLE if listened else 2.0 * SETTLE)
        cpu, first = cpu_seconds(pids[0]), time.monotonic_ns()
        during(*pids)
        cpu, last = cpu_seconds(pids[0]) - cpu, time.monotonic_ns()
        time.sleep(0.3)
        driver.communicate(timeout=60)  # first: a flooded process may not notice its end
        time.sleep(0.3)
        stack.close()
        arrived = np.load(heard) if listened else {}
        return Trial(first, last, start, cpu, np.load(sent), tuple(arrived.values()),
                     log.read_text(encoding='utf-8')).between(first, last)


@contextmanager
def process(command: list[str], log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program; end it by closing its standard input, or by SIGTERM."""
    own = command[0] == __file__
    with log.open('a') as printed:
        running = subprocess.Popen(
            [sys.executable, *command], cwd=ROOT, text=True, stderr=printed,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE if own else printed)
    try:
        yield running
    finally:
        if running.poll() is None:
            if not own:
                running.send_signal(signal.SIGTERM)
            running.communicate(timeout=60)


def first_of(client: subprocess.Popen[str], log: Path) -> int:
    """Wait for the first message of a client, and return its time [ns]."""
    assert client.stdout is not None
    if not select([client.stdout], [], [], PATIENCE)[0]:
        raise RuntimeError(f'no messages after {PATIENCE:g} s: {log.read_text(encoding="utf-8")}')
    return int(client.stdout.readline())


def main() -> None:
    """Run the process that the first argument names."""
    what, *given = sys.argv[1:]
    rclpy.init(args=[])
    if what == 'drive':
        drive(float(given[0]), Path(given[1]))
    elif what == 'listen':
        listen(Path(given[0]), *given[1:])
    elif what == 'relay':
        relay(*given)
    else:
        sys.stdin.read()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
