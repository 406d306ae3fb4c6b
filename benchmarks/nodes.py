# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The processes of the benchmarks of nodes: a driver, the node, bare relays, a user and a caller.

The driver publishes a sensor that is turned through `POSES` poses, again and again. It has effects
of temperature and a non-linear one, so that a refinement finds something. It stamps each message
with the monotonic clock and records the stamps; the user records stamp and arrival. A `Record`
outlives a process that is killed. All are as cheap as rclpy allows: serialized messages under
EventsExecutor. They have the qualities of service of the node, so that only the work differs. They
end with their standard input.

"""

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, replace
import itertools
import mmap
import os
from pathlib import Path
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
from std_srvs.srv import Trigger

Stamps = NDArray[np.int64]

SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
USER = QoSProfile(depth=5000, reliability=ReliabilityPolicy.RELIABLE)
NANO = 1_000_000_000

POSES, DWELL, TURN = 40, 2.0, 0.5
CYCLE = POSES * (DWELL + TURN)
"""Time until the poses begin again [s]; the temperature swings in the same time."""

MORE = {'offset_temperature': [0.001, -0.0005, 0.0008], 'quadratic': [0.002, -0.001, 0.001]}
"""Effects of the driver beside those of `KNOWN`."""

SETTLE = 2.0
"""Time from the first message to the start of the measurement [s]."""

PATIENCE = 60.0
"""Longest time until messages arrive [s]."""

_STAMP = struct.Struct('<iI')
_STAMP_AT, _RATE, _FORCE = 4, slice(-192, -168), slice(-96, -72)
"""Place of the stamp, the angular rate and the acceleration in a serialized Imu [bytes]."""

_DOMAINS = itertools.islice(itertools.cycle(range(1, 102)), os.getpid() % 101, None)

IMU, CALIBRATED = 'imu/data_raw', 'imu/data_calibrated'


class Record:
    """Pairs of stamp and arrival [ns] in a file, which one process writes and others read."""

    SIZE = 2**24

    def __init__(self, file: Path) -> None:
        self.file = file
        with file.open('a+b') as opened:
            opened.truncate(16 * self.SIZE)  # takes no space before it is written
            self._cells = memoryview(mmap.mmap(opened.fileno(), 16 * self.SIZE)).cast('q')
        self._next = 0

    def add(self, stamp: int, arrival: int) -> None:
        """Add a pair."""
        self._cells[self._next + 1] = arrival
        self._cells[self._next] = stamp
        self._next += 2

    def __len__(self) -> int:
        return bisect_left(range(self.SIZE), True, key=lambda k: self._cells[2 * k] == 0)

    def pairs(self) -> Stamps:
        """Return all pairs so far, (n, 2)."""
        return np.frombuffer(self._cells, np.int64).reshape(-1, 2)[:len(self)].copy()


def drive(rate: str, file: str) -> None:
    """
    Publish messages at a rate [1/s] and record their stamps; 0: without a pause.

    Once they are prepared, it says so, and waits for a line before it enters DDS.

    """
    from shared import KNOWN  # here: a relay, whose memory is measured, does without

    per_s, record = float(rate), Record(Path(file))
    often = per_s or 1e4
    settings = SimulatorSettings(  # fewer poses where they have more samples
        rate=often, poses=round(POSES * min(1e3 / often, 1.0)), dwell=DWELL, turn=TURN,
        mixed=True, flat_last=False, temperature=[15.0, 35.0], temperature_period=CYCLE,
        effects=[f'{name}={",".join(map(str, values))}'
                 for name, values in {**KNOWN, **MORE}.items()])
    simulated = SimulatedImu(settings)
    made = simulated.samples(round(simulated.duration * settings.rate))
    forces, rates = made.reading * settings.gravity, made['rate']
    message = Imu()  # with covariances, which make the most work
    message.header.frame_id = 'imu_link'
    message.orientation_covariance[0] = -1.0
    message.angular_velocity_covariance = (np.eye(3) * 0.002**2).ravel()
    message.linear_acceleration_covariance = (np.eye(3) * 0.02**2).ravel()
    data = bytearray(serialize_message(message))
    print('ready', flush=True)
    sys.stdin.readline()
    over, node = ended(), enter('driver')
    imu = node.create_publisher(Imu, IMU, STREAM)
    temperature = node.create_publisher(Temperature, 'temperature', STREAM)
    warm_every, began = round(settings.rate / 10.0), time.monotonic_ns()
    for count in itertools.count():
        wait = began + count * NANO / per_s - time.monotonic_ns() if per_s else 0.0
        if wait > 0.0:
            time.sleep(wait / NANO)
        if over():
            break
        row = count % len(forces)
        data[_FORCE], data[_RATE] = forces[row].tobytes(), rates[row].tobytes()
        now = time.monotonic_ns()
        _STAMP.pack_into(data, _STAMP_AT, now // NANO, now % NANO)
        record.add(now, now)
        imu.publish(bytes(data))
        if (count + 1) % warm_every == 0:
            temperature.publish(Temperature(temperature=float(made['temperature'][row])))


def enter(name: str) -> Node:
    """Enter DDS with a node."""
    rclpy.init(args=[])
    return Node(name)


def ended() -> Callable[[], bool]:
    """Return a function that returns whether standard input has ended."""
    over = threading.Event()

    def wait() -> None:
        sys.stdin.read()
        over.set()

    threading.Thread(target=wait, daemon=True).start()
    return over.is_set


def listen(file: str, topic: str) -> None:
    """Record stamp and arrival of the messages of a topic."""
    node, record = enter('user'), Record(Path(file))

    def on_imu(data: bytes) -> None:
        now = time.monotonic_ns()
        seconds, rest = _STAMP.unpack_from(data, _STAMP_AT)
        record.add(seconds * NANO + rest, now)

    node.create_subscription(Imu, topic, on_imu, USER, raw=True)
    spin(node, EventsExecutor(), 0.05)


def spin(node: Node, executor: Any, seconds: float) -> None:
    """Run a node until standard input has ended, at which it looks every so many seconds."""
    over = ended()
    executor.add_node(node)
    while not over():
        executor.spin_until_future_complete(Future(), timeout_sec=seconds)
    executor.shutdown()


def relay(kind: str, topic: str) -> None:
    """Publish each message unchanged; a sink drops it, a typed relay deserializes it."""
    node = enter('relay')
    out = node.create_publisher(Imu, topic, STREAM)
    callback = out.publish if kind != 'sink' else lambda data: None
    node.create_subscription(Imu, IMU, callback, SENSOR, raw=kind != 'typed')
    spin(node, SingleThreadedExecutor() if kind == 'typed' else EventsExecutor(), 0.25)


def ask(file: str) -> None:
    """Call the self-test for each number on standard input until it answers; record the number."""
    from diagnostic_msgs.srv import SelfTest

    caller, record = Caller(), Record(Path(file))
    for number in sys.stdin:
        while not caller.call('self_test', SelfTest, 5.0).id:
            pass
        record.add(int(number), time.monotonic_ns())
    caller.close()


def client(program: str, *given: object) -> list[str]:
    """Return the command of a program of this file."""
    return [__file__, program, *map(str, given)]


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

    def call(self, name: str, kind: Any = Trigger, seconds: float = 120.0) -> Any:
        """Call a service and return its response; an empty one if none came within a time."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, f'calibrator/{name}')
            self._clients[name].wait_for_service(10.0)
        future = self._clients[name].call_async(kind.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=seconds)
        return future.result() if future.done() else kind.Response()

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

    def between(self, first: int, last: int) -> 'Trial':
        """Return the messages of a shorter interval."""
        sent, heard = self.sent, self.heard
        return replace(
            self, first=first, last=last, sent=sent[(sent >= first) & (sent < last)],
            heard=tuple(each[(each[:, 0] >= first) & (each[:, 0] < last)] for each in heard))

    def latency_us(self, percent: float, program: int = 0) -> float:
        """Return a percentile of the time from driver to user [µs]; NaN without a message."""
        heard = self.heard[program]
        late = (heard[:, 1] - heard[:, 0]) * 1e-3
        return float(np.percentile(late, percent)) if len(late) else np.nan

    def lost(self, program: int = 0) -> int:
        """Return the number of messages that the user did not receive of a program."""
        return int(np.sum(~np.isin(self.sent, self.heard[program][:, 0])))

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
    Run the commands of relays, or of the node, by their topics, between a driver and a user.

    The driver sends at a rate [1/s]; 0: without a pause. `during` is called with the id of each
    program, and the measurement ends when it returns. `listened` is whether there is a user, and
    `lead` the time from the first message to the start of the programs [s].

    """
    with tempfile.TemporaryDirectory() as given, ExitStack() as stack:
        folder = Path(given)
        log, sent = folder / 'log', Record(folder / 'sent')
        heard = {topic: Record(folder / f'heard_{k}') for k, topic in enumerate(programs)}

        def wait_for(*filled: Record) -> None:
            if not wait_until(lambda: all(map(len, filled))):
                raise RuntimeError(f'no messages after {PATIENCE:g} s: {log.read_text()}')

        enter_domain(folder)
        for topic, record in heard.items() if listened else ():
            stack.enter_context(process(client('listen', record.file, topic), log))
        driver = stack.enter_context(prepare_driver(rate, sent.file, log))
        say(driver)
        wait_for(sent)
        time.sleep(lead)
        began = time.monotonic_ns()
        pids = [stack.enter_context(process(command, log)).pid for command in programs.values()]
        if listened:
            wait_for(*heard.values())
        time.sleep(SETTLE if listened else 2.0 * SETTLE)
        cpu, first = cpu_seconds(pids[0]), time.monotonic_ns()
        during(*pids)
        cpu, last = cpu_seconds(pids[0]) - cpu, time.monotonic_ns()
        time.sleep(0.3)
        driver.communicate(timeout=60)  # first: a flooded process may not notice its end
        time.sleep(0.3)
        stack.close()
        pairs = [record.pairs() for record in heard.values()] if listened else []
        start = 1e-9 * (max(each[0, 1] for each in pairs) - began) if listened else np.nan
        return Trial(first, last, start, cpu, sent.pairs()[:, 0], tuple(pairs),
                     log.read_text(encoding='utf-8')).between(first, last)


def enter_domain(folder: Path) -> None:
    """Give the processes that are started from now on a DDS domain and a folder of their own."""
    os.environ.update(ROS_DOMAIN_ID=str(next(_DOMAINS)), PYTHONPATH=str(ROOT),
                      ROS_LOG_DIR=str(folder), ROS_HOME=str(folder))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


@contextmanager
def process(command: list[str], log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program; end it by closing its standard input, or by SIGTERM."""
    own = command[0] == __file__
    with log.open('a') as printed:
        running = subprocess.Popen(
            [sys.executable, '-X', 'faulthandler', *command], cwd=ROOT, text=True, stderr=printed,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE if own else printed)
    try:
        yield running
    finally:
        if running.poll() is None:
            if not own:
                running.send_signal(signal.SIGTERM)
            running.communicate(timeout=60)


@contextmanager
def prepare_driver(rate: float, file: Path, log: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a driver that enters DDS as soon as a line is written to it."""
    with process(client('drive', rate, file), log) as driver:
        assert driver.stdout is not None
        driver.stdout.readline()
        yield driver


def say(program: subprocess.Popen[str], line: object = '') -> None:
    """Write a line to the standard input of a program."""
    assert program.stdin is not None
    print(line, file=program.stdin, flush=True)


def wait_until(over: Callable[[], object]) -> bool:
    """Wait until something holds, at most `PATIENCE`; return whether it does."""
    ends = time.monotonic() + PATIENCE
    while not over():
        if time.monotonic() > ends:
            return False
        time.sleep(0.002)
    return True


PROGRAMS: dict[str, Callable[..., None]] = {
    'drive': drive, 'listen': listen, 'relay': relay, 'ask': ask}

if __name__ == '__main__':
    PROGRAMS[sys.argv[1]](*sys.argv[2:])
    rclpy.try_shutdown()
