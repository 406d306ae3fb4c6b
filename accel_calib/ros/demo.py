# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A demonstration without hardware: simulator and calibrator in separate processes, over DDS.

This process acts as the user. It waits for the poses and calls ``~/fit`` and ``~/set_level``. Then
it compares raw and corrected messages with the truth of the simulator while the sensor turns
again.

"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
import math
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from geometry_msgs.msg import Vector3Stamped
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from . import qos
from ..errors import AccelCalibError, counted
from ..table import Floats
from ..units import MG, STANDARD_GRAVITY

POSES = 12
_EFFECTS = ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
            'cross_axis=0.006,-0.004,0.003']
_SIMULATED = {'poses': POSES, 'dwell': 1.5, 'turn': 0.5, 'mounting': [8.0, -5.0, 0.0],
              'effects': _EFFECTS, 'loop': True}
"""Parameters of the simulator."""

_CHECKED, _LEAST_SAMPLES = 5, 100
_PATIENCE, _LOOK_EVERY, _AGAIN = 45.0, 0.1, 0.2


Spin = Callable[[Callable[[], bool], str], None]
"""Function that spins until a condition is true; the text names the condition in errors."""


@dataclass(frozen=True)
class Outcome:
    """
    Errors of raw and corrected messages, over rests in several orientations.

    Parameters
    ----------
    rests : int
        Number of rests.
    rms_before_mg, rms_after_mg : float
        RMS of |a| - 1 g [mg].
    max_before_mg, max_after_mg : float
        Largest | |a| - 1 g | [mg].
    tilt_before_deg, tilt_after_deg : float
        RMS angle between measured and true direction of up [°].
    seconds : float
        Duration of the demonstration.

    """

    rests: int
    rms_before_mg: float
    rms_after_mg: float
    max_before_mg: float
    max_after_mg: float
    tilt_before_deg: float
    tilt_after_deg: float
    seconds: float


class User(Node):
    """A node that receives the messages of both nodes and calls the calibrator."""

    def __init__(self) -> None:
        super().__init__('demo')
        self.poses = 0
        self.temperature = math.nan
        self.messages: dict[str, dict[int, tuple[float, float, float]]] = {
            'raw': {}, 'corrected': {}, 'truth': {}}
        self.create_subscription(MarkerArray, 'calibrator/poses', self._on_poses, qos.LATCHED)
        self.create_subscription(Temperature, 'temperature', self._on_temperature, qos.SENSOR)
        for name, topic, kind in (('raw', 'imu/data_raw', Imu),
                                  ('corrected', 'imu/data_calibrated', Imu),
                                  ('truth', 'simulator/truth', Vector3Stamped)):
            self.create_subscription(kind, topic, self._keeper(name), qos.SENSOR)

    def _on_poses(self, markers: MarkerArray) -> None:
        self.poses = sum(marker.ns == 'poses' for marker in markers.markers)

    def _on_temperature(self, message: Temperature) -> None:
        self.temperature = message.temperature

    def _keeper(self, name: str) -> Callable[[Any], None]:
        kept = self.messages[name]

        def keep(message: Any) -> None:
            stamp = message.header.stamp
            vector = message.vector if name == 'truth' else message.linear_acceleration
            kept[stamp.sec * 10 ** 9 + stamp.nanosec] = vector.x, vector.y, vector.z

        return keep

    def is_flat(self) -> bool:
        """Return whether the robot is flat now."""
        truth = self.messages['truth']
        return bool(truth) and truth[max(truth)] == (0.0, 0.0, STANDARD_GRAVITY)


def _has_passed(instant: float) -> bool:
    return time.monotonic() > instant


def at_least(user: User, count: int) -> bool:
    """Return whether the node has captured this number of poses."""
    return user.poses >= count


class DemoError(AccelCalibError):
    """The demonstration failed."""


def demonstrate(report: Callable[[str], None]) -> Outcome:
    """
    Run the demonstration.

    Parameters
    ----------
    report : callable
        Function that is called with a line for each step.

    Returns
    -------
    Outcome
        The comparison.

    Raises
    ------
    DemoError
        If a step takes too long.

    """
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix='accel_calib_demo_') as folder, ExitStack() as stack:
        set_environment(Path(folder))
        report('starting a simulated Imu, turned by hand, and the calibrator node')
        processes = [
            stack.enter_context(running('node', {'sensor': 'demo'})),
            stack.enter_context(running('simulator', {**_SIMULATED, 'wait': 10.0}))]
        user, spin = stack.enter_context(user_of(processes))
        spin(lambda: user.poses > 0, 'the first pose')
        for count in range(4, POSES + 1, 4):
            spin(partial(at_least, user, count), f'{count} poses')
            report(f'captured {count} poses')
        report(f'~/fit: {call(user, spin, "fit")}')
        spin(user.is_flat, 'the flat pose')
        report(f'~/set_level: {_call_patiently(user, spin, "set_level")}')
        for messages in user.messages.values():
            messages.clear()
        spin(lambda: len(rests_of(user)) > _CHECKED, f'{_CHECKED} more rests')
        return _outcome(rests_of(user)[1:], time.monotonic() - began)


def demonstrate_page(port: int, report: Callable[[str], None],
                     is_over: Callable[[], bool]) -> None:
    """
    Run simulator and calibrator with its live page, until it is over.

    Parameters
    ----------
    port : int
        Port of the page.
    report, is_over : callable
        Function that is called with a line for the user; function that returns whether to end.

    Raises
    ------
    DemoError
        If a node ends on its own.

    """
    with tempfile.TemporaryDirectory(prefix='accel_calib_demo_') as folder, ExitStack() as stack:
        set_environment(Path(folder))
        report('a simulated Imu is turned by hand; open the link of the live page in a browser, '
               'wait for the poses, and press Fit. Ctrl-C ends it')
        processes = [
            stack.enter_context(running('node', {'sensor': 'demo', 'web_port': port}, 'info')),
            stack.enter_context(running('simulator', {**_SIMULATED, 'wait': 10.0}))]
        while not is_over():
            _check_running(processes)
            time.sleep(_LOOK_EVERY)


def set_environment(folder: Path) -> None:
    """Isolate the demonstration: own domain, local machine only, own files."""
    os.environ.update(ROS_DOMAIN_ID=str(random.SystemRandom().randint(1, 101)),
                      ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST', ROS_HOME=str(folder),
                      ROS_LOG_DIR=str(folder / 'log'))


@contextmanager
def running(command: str, parameters: dict[str, Any], severity: str = 'error'
            ) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node in a process, which prints log lines from this severity on, and end it."""
    given = [part for name, value in parameters.items()
             for part in ('-p', f'{name}:={_in_yaml(value)}')]
    process = subprocess.Popen(
        [sys.executable, '-m', 'accel_calib.cli.main', command, '--ros-args',
         '--log-level', severity, *given])
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _in_yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@contextmanager
def user_of(processes: Sequence[subprocess.Popen[bytes]]) -> Iterator[tuple[User, Spin]]:
    """Yield the user of the nodes, and a function that spins until a condition is true."""
    rclpy.init(args=[])
    user = User()
    executor = SingleThreadedExecutor()
    executor.add_node(user)

    def spin(until: Callable[[], bool], what: str) -> None:
        ends = time.monotonic() + _PATIENCE
        while not until():
            _check_running(processes)
            if time.monotonic() > ends:
                raise DemoError(f'{what}: not available within {_PATIENCE:.0f} s, '
                                f'{counted(user.poses, "pose")} so far',
                                'check whether a firewall blocks DDS on this machine')
            look_again = time.monotonic() + _LOOK_EVERY
            while time.monotonic() < look_again:
                executor.spin_once(timeout_sec=_LOOK_EVERY)

    try:
        yield user, spin
    finally:
        executor.shutdown()
        user.destroy_node()
        rclpy.try_shutdown()


def _check_running(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    if any(process.poll() is not None for process in processes):
        raise DemoError('a node has ended unexpectedly', 'see its output above')


def _request(user: User, spin: Spin, name: str) -> Trigger.Response:
    client = user.create_client(Trigger, f'calibrator/{name}')
    spin(client.service_is_ready, f'the service {name}')
    future = client.call_async(Trigger.Request())
    spin(future.done, f'the answer of {name}')
    user.destroy_client(client)
    return future.result()


def call(user: User, spin: Spin, name: str) -> str:
    """Call a service of the calibrator; raise DemoError if it fails."""
    answer = _request(user, spin, name)
    if not answer.success:
        raise DemoError(f'~/{name} answered: {answer.message}', 'run the demonstration again')
    return str(answer.message)


def _call_patiently(user: User, spin: Spin, name: str) -> str:
    """Call a service repeatedly until the sensor has been still for long enough."""
    while user.is_flat():
        answer = _request(user, spin, name)
        if answer.success:
            return str(answer.message)
        spin(partial(_has_passed, time.monotonic() + _AGAIN), 'a moment')
    return call(user, spin, name)


def rests_of(user: User) -> list[dict[str, Floats]]:
    """Return the means of raw, corrected and true acceleration over each complete rest [g]."""
    common = sorted(set.intersection(*(set(kept) for kept in user.messages.values())))
    if len(common) < 2:
        return []
    arrays = {name: np.array([kept[stamp] for stamp in common]) / STANDARD_GRAVITY
              for name, kept in user.messages.items()}
    moving = np.any(np.diff(arrays['truth'], axis=0) != 0.0, axis=1)
    ends = np.flatnonzero(np.concatenate([[True], moving, [True]]))
    return [{name: values[a:b].mean(axis=0) for name, values in arrays.items()}
            for a, b in pairwise(ends) if b - a > _LEAST_SAMPLES]


def _outcome(rests: list[dict[str, Floats]], seconds: float) -> Outcome:
    errors, tilts = {}, {}
    truth = np.array([rest['truth'] for rest in rests])
    for name in ('raw', 'corrected'):
        values = np.array([rest[name] for rest in rests])
        sizes = np.linalg.norm(values, axis=1)
        errors[name] = (sizes - 1.0) * MG
        cosines = np.sum(values * truth, axis=1) / sizes / np.linalg.norm(truth, axis=1)
        tilts[name] = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return Outcome(len(rests), rms(errors['raw']), rms(errors['corrected']),
                   float(np.max(np.abs(errors['raw']))),
                   float(np.max(np.abs(errors['corrected']))), rms(tilts['raw']),
                   rms(tilts['corrected']), seconds)


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values ** 2)))
