# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Drivers and calibrators that are killed: whether the other processes notice.

The benchmark itself does not use ROS. Driver and listener count in memory that they share with it,
because a killed process cannot write its records. Each message has the number of its trial, and
its own number in it, where the orientation would be; the sensor has no orientation.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
import faulthandler
import multiprocessing
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
from tempfile import TemporaryDirectory
import time
from typing import Any

from figures import Frame, markdown, ROOT, tell
import numpy as np

PARTIES = ('driver', 'calibrator', 'listener')
RATE = 1000.0
"""Messages per second of the driver."""

PATIENCE = 60.0
"""Longest time until messages arrive, and until the self-test answers [s]."""

LATEST, LATEST_END = 0.5, 1.5
"""Latest kill after the first message, or after the start, and latest end after a kill [s]."""

UDP = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
       'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / 'config' / 'fast_dds_udp.xml')}
LOCALHOST = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
NANO = 1_000_000_000

_STAMP, _NUMBERS = struct.Struct('<iI'), struct.Struct('<dd')
_STAMP_AT, _NUMBERS_AT = 4, -296
"""Place of the stamp and of the orientation in a serialized Imu [bytes]."""


@dataclass(frozen=True)
class Case:
    """What is killed, and how; `words` is the description for the table."""

    words: str
    victim: str = 'driver'
    starting: bool = False  # whether every second kill comes while it starts
    ends: bool = False  # whether the calibrator is ended by SIGTERM after each kill of the driver
    loops: int = 0  # number of busy loops beside
    udp: bool = False  # whether the processes use UDP without shared memory


CASES = {
    'driver': Case('the driver is killed'),
    'busy': Case('the same, beside 4 busy loops', loops=4),
    'starting': Case('the driver is killed, every second time while it starts', starting=True),
    'end': Case(f'the driver is killed, and the calibrator is ended up to {LATEST_END:g} s later',
                ends=True),
    'end-udp': Case('the same without shared memory', ends=True, udp=True),
    'calibrator': Case('the calibrator is killed, and started again', 'calibrator'),
    'calibrator-udp': Case('the same without shared memory', 'calibrator', udp=True)}


def begin(folder: Path, environment: dict[str, str], name: str) -> Any:
    """Work in a folder, where a crash leaves a core and the Python stack; return a ROS node."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    faulthandler.enable((folder / 'faults.log').open('a'))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    return rclpy.create_node(name)


def drive(folder: Path, environment: dict[str, str], trial: Any, sent: Any) -> None:
    """Publish a sensor at rest until the process is killed."""
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import Imu
    publisher = begin(folder, environment, 'driver').create_publisher(Imu, 'imu/data_raw', 100)
    message = Imu()
    message.header.frame_id = 'imu_link'
    message.orientation_covariance[0] = -1.0
    message.linear_acceleration.z = 9.81
    data = bytearray(serialize_message(message))
    began, count = time.monotonic_ns(), 0
    while True:
        wait = began + count * NANO / RATE - time.monotonic_ns()
        if wait > 0.0:
            time.sleep(wait / NANO)
        count += 1
        now, number = time.monotonic_ns(), trial.value
        _STAMP.pack_into(data, _STAMP_AT, now // NANO, now % NANO)
        sent[number] += 1
        _NUMBERS.pack_into(data, len(data) + _NUMBERS_AT, number, sent[number])
        publisher.publish(bytes(data))


def listen(folder: Path, environment: dict[str, str], heard: Any, first: Any, asked: Any,
           answered: Any) -> None:
    """
    Count the calibrated messages of each trial until the process is killed.

    The self-test is called when `asked` changes, again every 5 s until it answers.

    """
    from diagnostic_msgs.srv import SelfTest
    from rclpy.executors import SingleThreadedExecutor
    from sensor_msgs.msg import Imu

    def on_imu(data: bytes) -> None:
        trial, number = map(int, _NUMBERS.unpack_from(data, len(data) + _NUMBERS_AT))
        first[trial] = first[trial] or number
        heard[trial] += 1

    node, executor = begin(folder, environment, 'listener'), SingleThreadedExecutor()
    executor.add_node(node)
    client = node.create_client(SelfTest, 'calibrator/self_test')
    node.create_subscription(Imu, 'imu/data_calibrated', on_imu, 100, raw=True)
    future, called = None, 0.0
    while True:
        executor.spin_once(timeout_sec=0.02)
        if answered.value != asked.value:
            if future is not None and future.done():
                answered.value, future = asked.value, None
            elif future is None or time.monotonic() - called > 5.0:
                ready = client.service_is_ready()
                future = client.call_async(SelfTest.Request()) if ready else None
                called = time.monotonic()


@dataclass(frozen=True)
class Trial:
    """One life of the victim."""

    seconds: float  # from its start to the first message that the listener received, or NaN
    sent: int  # messages that the driver sent, from the first one received
    heard: int  # messages that the listener received
    died: Mapping[str, int]  # exit statuses of those that ended by themselves, or not with 0
    silent: bool  # whether messages or an answer did not come within `PATIENCE`


class World:
    """The three processes, with a folder for their logs, and counters of some trials."""

    def __init__(self, folder: Path, count: int) -> None:
        # A server that has imported ROS starts driver and listener within 0.1 s.
        self._context = multiprocessing.get_context('forkserver')
        self._context.set_forkserver_preload([
            '__main__', 'numpy', 'rclpy', 'diagnostic_msgs.srv', 'sensor_msgs.msg'])
        self._folder = folder
        self.running: dict[str, Any] = {}
        self.trial = self._context.RawValue('i', 0)
        self.sent, self.heard, self.first = (self._context.RawArray('q', count) for _ in range(3))
        self.asked, self.answered = (self._context.RawValue('i', -1) for _ in range(2))

    def start(self, name: str) -> None:
        """Start one of the processes."""
        folder = self._folder / name
        folder.mkdir(exist_ok=True)
        if name == 'calibrator':
            with (folder / 'calibrator.log').open('ab') as log:
                self.running[name] = subprocess.Popen(
                    [sys.executable, '-X', 'faulthandler', '-m', 'accel_calib.ros.run',
                     'calibrator', '--ros-args', '-p', 'passthrough:=true'], cwd=folder,
                    stdout=log, stderr=log)
            return
        # The environment is given, because that of the server is the one of its start.
        own, process = (folder, dict(os.environ)), self._context.Process
        self.running[name] = (
            process(target=drive, args=(*own, self.trial, self.sent)) if name == 'driver' else
            process(target=listen, args=(*own, self.heard, self.first, self.asked, self.answered)))
        self.running[name].start()

    def kill(self, name: str) -> None:
        """Kill a process."""
        process = self.running.pop(name, None)
        if process is not None:
            process.kill()
            (process.wait if name == 'calibrator' else process.join)()

    def end(self, after: float) -> dict[str, int]:
        """End the calibrator by SIGTERM; return its exit status if it is not 0."""
        calibrator = self.running.pop('calibrator')
        time.sleep(after)
        calibrator.send_signal(signal.SIGTERM)
        status = calibrator.wait(PATIENCE)
        return {'calibrator': status} if status else {}

    def died(self) -> dict[str, int]:
        """Return the exit statuses of the processes that have ended."""
        found = {name: process.poll() if name == 'calibrator' else process.exitcode
                 for name, process in self.running.items()}
        return {name: status for name, status in found.items() if status is not None}

    def wait(self, over: Callable[[], bool]) -> bool:
        """Wait until a condition holds; return whether it does and no process has ended."""
        ends = time.monotonic() + PATIENCE
        while not over():
            if self.died() or time.monotonic() > ends:
                return False
            time.sleep(0.002)
        return True


def run_trial(world: World, case: Case, number: int, rng: np.random.Generator) -> Trial:
    """Start the victim, kill it, and look at the others."""
    for name in PARTIES:
        if name != case.victim and (name not in world.running or name in world.died()):
            world.start(name)
    world.trial.value = number
    began, seconds, silent = time.monotonic(), np.nan, False
    world.start(case.victim)
    if not (case.starting and number % 2):
        silent = not world.wait(lambda: world.heard[number] > 0)
        seconds = np.nan if silent else time.monotonic() - began
    ends = time.monotonic() + rng.uniform(0.0, LATEST)
    world.wait(lambda: time.monotonic() > ends)
    died = world.died()
    world.kill(case.victim)
    if case.ends and not died:
        died |= world.end(rng.uniform(0.0, LATEST_END))
    elif case.victim == 'driver' and not died:
        world.asked.value = number
        silent |= not world.wait(lambda: world.answered.value == number)
    died |= world.died()
    sent = world.sent[number] - world.first[number] + 1 if world.heard[number] else 0
    return Trial(seconds, sent, world.heard[number], died, silent and not died)


def run_case(case: Case, count: int, seed: int) -> Iterator[Trial]:
    """Yield the trials of a case; start again what has ended, or all if they are silent."""
    os.environ.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    os.environ.update(UDP if case.udp else LOCALHOST)
    rng = np.random.default_rng(seed)
    with ExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        os.environ.update(ROS_HOME=folder, ROS_LOG_DIR=folder)
        for _ in range(case.loops):
            loop = stack.enter_context(subprocess.Popen([sys.executable, '-c', 'while True: 1']))
            stack.callback(loop.kill)
        world = World(Path(folder), count)
        for name in PARTIES:
            stack.callback(world.kill, name)
        for number in range(count):
            each = run_trial(world, case, number, rng)
            tell(f'{number + 1}: {each.seconds:.2f} s, {each.heard} of {each.sent}',
                 *(f'{name} {status_words(status)}' for name, status in each.died.items()),
                 'silent' * each.silent)
            for name in PARTIES if each.silent else ():
                world.kill(name)
            yield each


def status_words(status: int) -> str:
    """Return an exit status in words."""
    return signal.Signals(-status).name if status < 0 else f'status {status}'


def row_of(case: Case, found: list[Trial]) -> tuple[object, ...]:
    def ends_of(*names: str) -> str:
        every = [status_words(status) for each in found for name, status in each.died.items()
                 if name in names]
        return ', '.join(f'{every.count(words)} {words}' for words in sorted(set(every))) or '0'

    seconds = np.array([each.seconds for each in found])
    seconds = seconds[np.isfinite(seconds)]
    start = f'{np.median(seconds):.2f}, {seconds.max():.2f}' if len(seconds) else ''
    sent = sum(each.sent for each in found)
    lost = sent - sum(each.heard for each in found)
    return (case.words, len(found), ends_of('calibrator'), ends_of('driver', 'listener'),
            sum(each.silent for each in found),
            f'{lost:,} of {sent:,}' if case.victim == 'driver' and not case.ends else '', start)


def driver_kills(frame: Frame, kills: int = 200, seed: int = 1,
                 cases: tuple[str, ...] = tuple(CASES)) -> Iterator[str]:
    """Yield the parts of the page; `kills` is the number of each case."""
    os.environ.update(ROS_DOMAIN_ID=str(os.getpid() % 101 + 1))
    rows, loads = [], []
    for name in cases:
        rows.append(row_of(CASES[name], list(run_case(CASES[name], kills, seed))))
        loads.append(f'{os.getloadavg()[0]:.0f}')
    yield markdown(('', 'kills', 'ends of the calibrator', 'ends of the others', 'silent',
                    'messages lost', 'from the start to the first message, s: median, longest'),
                   rows)
    yield f'Load of the machine after each case: {", ".join(loads)}.'
