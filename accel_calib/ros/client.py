# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What runs beside a calibrator node: the reception of its progress, and a demonstration.

**Progress.** The node publishes ``~/progress`` up to four times per second while somebody listens,
and at least once per second. A longer silence therefore means that the node or the network is
down.

**Demonstration.** It needs no hardware: simulator and calibrator run in separate processes, over
DDS. This process acts as the user. It holds the simulated sensor in a pose until the calibrator
has captured it, turns it to the next one, and calls ``~/fit`` and ``~/set_level``. Then it
compares the messages with the truth of the simulator in other poses. If the sensor hides an
effect, the fit lacks it, and so does the level; ``~/refine`` and another ``~/set_level`` follow,
and the next poses show what remains.

Every step waits for what the nodes report, and none for a time, so that the demonstration also
succeeds on a slow machine.

"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import takewhile
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from time import monotonic, sleep
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from .declare import LATCHED, SENSOR
from .run import own_domain, started
from ..effects import parse_effect
from ..errors import AccelCalibError, InputError
from ..session import Progress
from ..statistics import rms
from ..stored import read_calibration
from ..table import Floats
from ..text import counted
from ..units import MG, STANDARD_GRAVITY


@contextmanager
def _beside(make: Callable[[], Any], args: Sequence[str] = ()) -> Iterator[Any]:
    """Yield a node of this process with an executor; `args` are those of ROS."""
    with (started(list(args), 'check the arguments after --ros-args'),
          SingleThreadedExecutor() as executor):
        node = make()
        executor.add_node(node)
        yield node


# ----------------------------------------------------------------------------- progress

Show = Callable[[str, Progress | None, str], None]
"""Function of the name of the node, its progress (None: no message yet), and a problem or ''."""

_WAIT = 0.1
"""Longest wait for a message before the end is checked [s]."""

_FIRST = 6.0
"""Longest wait for the first message [s]; DDS repeats a lost announcement after 3 s."""

_SILENT = 3.0
"""Longest wait for the next message [s]."""

_NEXT = 1.5
"""Wait for a second message [s]; the first one may have been published long ago."""

_SUFFIX = '/progress'


class _Receiver(Node):
    """The progress of a calibrator: full name, such as ``/left/calibrator``, and messages."""

    def __init__(self, name: str) -> None:
        # A leading underscore hides the node from ros2 node list.
        super().__init__('_accel_calib_watch', enable_rosout=False, start_parameter_services=False)
        self.arrived = monotonic()  # of the last message, or the start
        self.progress: Progress | None = None
        self.received = 0
        try:
            found = self.create_subscription(
                DiagnosticStatus, f'{name.rstrip("/")}{_SUFFIX}', self._on_message, LATCHED)
        except InvalidTopicNameException as err:
            raise InputError(f'--node is {name!r}, expected the name of a node',
                             'set it to a name such as calibrator or left/calibrator') from err
        self._topic = found.topic_name
        self.calibrator = self._topic.removesuffix(_SUFFIX)

    def _on_message(self, message: DiagnosticStatus) -> None:
        self.progress = Progress.from_figures({each.key: each.value for each in message.values})
        self.arrived = monotonic()
        self.received += 1

    def problem(self) -> tuple[str, ...]:
        """Return what was found and expected, and what to do, if a message is overdue."""
        if monotonic() - self.arrived <= (_SILENT if self.received else _FIRST):
            return ()
        topic = self._topic
        others = [name.removesuffix(_SUFFIX) for name, kinds in self.get_topic_names_and_types()
                  if name.endswith(_SUFFIX) and 'diagnostic_msgs/msg/DiagnosticStatus' in kinds
                  and name != topic and self.count_publishers(name)]
        expected = f'expected a message on {topic} every second'
        if self.count_publishers(topic):
            return (f'{self.calibrator} sends no message, {expected}',
                    'check that the node still runs, and the network')
        if others:
            return (f'found {" and ".join(sorted(others))}, but not {self.calibrator}, {expected}',
                    f'set --node {min(others).lstrip("/")}')
        return (f'found no calibrator {self.calibrator}, {expected}',
                'start it with accel-calib node, or check --node and ROS_DOMAIN_ID')


def watch(name: str, show: Show, is_over: Callable[[], bool], args: Sequence[str] = ()) -> None:
    """
    Show the progress of a calibrator at each message, and problems, until it is over.

    `name` is with or without namespace. `show` is called for each message, and each time the
    problem changes; `is_over` about ten times per second. `args` are those of ROS, starting with
    ``--ros-args``. InputError if ROS does not start, the name is not valid, or the node has
    another version.

    """
    with _beside(partial(_Receiver, name), args) as receiver:
        shown, problem = 0, ''
        show(receiver.calibrator, None, problem)
        while not is_over():
            receiver.executor.spin_once(timeout_sec=_WAIT)
            before, problem = problem, '; '.join(receiver.problem())
            if receiver.received != shown or problem != before:
                shown = receiver.received
                show(receiver.calibrator, receiver.progress, problem)


def current(name: str, is_over: Callable[[], bool], args: Sequence[str] = ()
            ) -> tuple[str, Progress | None]:
    """
    Return the full name of a calibrator and its progress now; None: it was over before.

    Parameters and errors are as in `watch`; InputError also if no node answers.

    """
    with _beside(partial(_Receiver, name), args) as receiver:
        while receiver.received < 2 and not is_over():
            receiver.executor.spin_once(timeout_sec=_WAIT)
            if receiver.received and monotonic() - receiver.arrived > _NEXT:
                break
            if problem := receiver.problem():
                raise InputError(*problem)
        return receiver.calibrator, receiver.progress


# ----------------------------------------------------------------------------- demonstration

_POSES, _POSES_HIDDEN = 12, 16
"""Poses of the fit; more of them if the sensor hides an effect."""

_CHECKED, _CHECKED_HIDDEN = 5, 10
"""Rests that are compared with the truth, before and after ``~/refine``."""

_SAMPLES = 100
"""Messages of a rest that are averaged."""

_SETTLED = 20
"""Equal truths after which the sensor rests in the next pose."""

_LONGEST_REST = 4000
"""Messages of a rest after which ``~/set_level`` must have succeeded."""

_SAME_POSE = np.cos(np.radians(10.0))
"""Cosine of the largest angle between a captured pose and the raw reading in it."""

_EFFECTS = ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
            'cross_axis=0.006,-0.004,0.003']
_SENSOR = {'mounting': [8.0, -5.0, 0.0], 'noise': 0.01, 'loop': True, 'wait': 10.0}
_HELD = {**_SENSOR, 'poses': 48, 'mixed': True, 'dwell': 0.0, 'turn': 0.2, 'flat_last': False,
         'temperature': [17.0, 33.0], 'temperature_period': 40.0}
_TIMED = {**_SENSOR, 'poses': _POSES, 'dwell': 1.5, 'turn': 0.5, 'effects': _EFFECTS}
"""Parameters of the simulator: of a person who waits in each pose, and of one with a clock."""

_NODE = {'sensor': 'demo', 'still_window': 0.25, 'min_dwell': 0.6}

_SERVICES = ('calibrator/fit', 'calibrator/refine', 'calibrator/set_level', 'simulator/flat',
             'simulator/next')

_KINDS = {'raw': ('imu/data_raw', Imu), 'corrected': ('imu/data_calibrated', Imu),
          'truth': ('simulator/truth', Vector3Stamped)}
"""Topics and types that are compared: before and after the correction, and the truth."""

_PATIENCE = 120.0
"""Longest time that a step may take, on the slowest machine [s]."""

_LOOK_EVERY = 0.05
"""Interval at which conditions are checked [s]."""


@dataclass(frozen=True)
class Errors:
    """
    Errors of a topic over rests: RMS of the vector, RMS and largest | |a| - 1 g |.

    The tilt is the RMS angle between measured and true direction of up.

    """

    vector_mg: float
    rms_mg: float
    max_mg: float
    tilt_deg: float


@dataclass(frozen=True)
class Outcome:
    """
    Errors before and after a correction.

    Before is ``imu/data_raw`` and after is ``imu/data_calibrated``; with a hidden effect, before
    and after are ``imu/data_calibrated`` before and after ``~/refine``, and `found` has the
    effects that the fit did not contain, with their lag (0: none).

    """

    rests: int
    before: Errors
    after: Errors
    seconds: float
    hidden: str = ''
    found: tuple[str, ...] = ()
    lag_s: float = 0.0

    @property
    def succeeded(self) -> bool:
        """Return whether the errors are smaller, and the hidden effect is found."""
        return (self.after.vector_mg < self.before.vector_mg
                and (not self.hidden or self.hidden in self.found))


class User(Node):
    """A node that receives the messages of both nodes, and calls their services step by step."""

    def __init__(self, processes: Sequence[subprocess.Popen[bytes]],
                 report: Callable[[str], None]) -> None:
        super().__init__('demo')
        self._processes, self._report = processes, report
        self._temperature = float('nan')
        self._poses = np.zeros((0, 3))
        self._messages: dict[str, dict[int, tuple[float, float, float]]] = {
            name: {} for name in _KINDS}
        self.create_subscription(MarkerArray, 'calibrator/poses', self._on_poses, LATCHED)
        self.create_subscription(
            Temperature, 'temperature',
            lambda message: setattr(self, '_temperature', message.temperature), SENSOR)
        for name, (topic, kind) in _KINDS.items():
            self.create_subscription(kind, topic, partial(self._keep, name), SENSOR)
        # Made once: DDS drops an answer to a client that the node has not discovered yet.
        self._triggers = {name: self.create_client(Trigger, name) for name in _SERVICES}

    def _on_poses(self, markers: MarkerArray) -> None:
        at = [marker.pose.position for marker in markers.markers if marker.ns == 'poses']
        self._poses = np.array([[point.x, point.y, point.z] for point in at]).reshape(-1, 3)

    def _keep(self, name: str, message: Any) -> None:
        stamp = message.header.stamp
        vector = message.vector if name == 'truth' else message.linear_acceleration
        self._messages[name][stamp.sec * 10 ** 9 + stamp.nanosec] = vector.x, vector.y, vector.z

    @property
    def _up(self) -> tuple[float, ...]:
        """Return the newest truth [m/s²]; empty before the first one."""
        truth = self._messages['truth']
        return truth[max(truth)] if truth else ()

    def _rest(self, *names: str) -> Floats:
        """Return the messages of these kinds in the ongoing rest [g], (messages, kinds, 3)."""
        truth, up = self._messages['truth'], self._up
        kept = [self._messages[name] for name in names]
        common = sorted(set(truth).intersection(*kept), reverse=True)
        resting = takewhile(lambda stamp: truth[stamp] == up, common)
        found = [[messages[stamp] for messages in kept] for stamp in resting]
        return np.reshape(found, (-1, len(names), 3)) / STANDARD_GRAVITY

    def _has_captured(self) -> bool:
        """Return whether there is a pose in the direction of the ongoing rest."""
        up = self._rest('raw').sum(axis=(0, 1))
        return bool(np.any(self._poses @ up > _SAME_POSE * np.linalg.norm(up)))

    def turn(self, service: str = 'next') -> None:
        """Turn the sensor, and wait until it rests."""
        self._spin(lambda: bool(self._up), 'a message of the simulator')
        before = self._up
        self.call(f'simulator/{service}')
        for kept in self._messages.values():
            kept.clear()
        self._spin(lambda: self._up not in ((), before) and len(self._rest('truth')) >= _SETTLED,
                   'rest of the simulated sensor')

    def capture(self, count: int) -> None:
        """Let the calibrator capture this number of poses."""
        for done in range(1, count + 1):
            if done > 1:
                self.turn()
            self._spin(self._has_captured, f'pose {done}')
            if done % 4 == 0:
                self._report(f'captured {done} poses')

    def measure(self, count: int) -> Floats:
        """Return the means over the rests in this number of further poses, (kinds, count, 3)."""
        rests = []
        for done in range(1, count + 1):
            self.turn()
            self._spin(lambda: len(self._rest(*_KINDS)) >= _SAMPLES and self._has_captured(),
                       f'rest {done}')
            rests.append(self._rest(*_KINDS).mean(axis=0))
            _, corrected, truth = rests[-1]
            error = np.linalg.norm(corrected - truth) * MG
            self._report(f'  rest {done:2d} of {count}, now {self._temperature:.1f} °C: '
                         f'imu/data_calibrated is {error:5.2f} mg from the truth')
        return np.stack(rests, axis=1)

    def level(self) -> str:
        """Put the robot flat, and call ``~/set_level`` as soon as the rest is long enough."""
        self.turn('flat')
        for count in range(_SETTLED, _LONGEST_REST, _SETTLED):
            self._spin(partial(lambda wanted: len(self._rest('raw')) >= wanted, count),
                       'a longer rest')
            with suppress(AccelCalibError):
                return self.call('calibrator/set_level')
        return self.call('calibrator/set_level')

    def call(self, service: str) -> str:
        """Call a service, and return its answer; AccelCalibError if it fails."""
        client = self._triggers[service]
        self._spin(client.service_is_ready, f'the service {service}')
        future = client.call_async(Trigger.Request())
        self._spin(future.done, f'the answer of {service}')
        answer = future.result()
        if not answer.success:
            raise AccelCalibError(f'{service} answered: {answer.message}',
                                  'run the demonstration again')
        return str(answer.message)

    def _spin(self, until: Callable[[], bool], what: str) -> None:
        """Spin until a condition is true; the text names the condition in errors."""
        ends = monotonic() + _PATIENCE
        while not until():
            _check_running(self._processes)
            if monotonic() > ends:
                raise AccelCalibError(f'{what}: not available within {_PATIENCE:.0f} s, '
                                      f'{counted(len(self._poses), "pose")} so far',
                                      'check whether a firewall blocks DDS on this machine')
            look_again = monotonic() + _LOOK_EVERY
            while monotonic() < look_again:
                self.executor.spin_once(timeout_sec=_LOOK_EVERY)


def demonstrate(report: Callable[[str], None], hidden: str = '') -> Outcome:
    """
    Run the demonstration, and compare the errors.

    `report` is called with a line for each step. `hidden` is the effect that the sensor hides,
    such as ``quadratic=0.004``; empty: none. AccelCalibError if a step takes too long, or a
    service refuses.

    """
    began = monotonic()
    report('starting the calibrator node and a simulated Imu, turned by hand'
           + (f', that hides {hidden}' if hidden else ''))
    simulated = {**_HELD, 'effects': [*_EFFECTS, *([hidden] if hidden else [])]}
    with (_isolated() as folder, running('node', _NODE) as node,
          running('simulator', simulated) as simulator,
          _beside(partial(User, [node, simulator], report)) as demo):
        demo.capture(_POSES_HIDDEN if hidden else _POSES)
        report(f'~/fit: {demo.call("calibrator/fit")}')
        report(f'~/set_level: {demo.level()}')
        raw, corrected, truth = demo.measure(_CHECKED_HIDDEN if hidden else _CHECKED)
        outcome = Outcome(len(truth), before=_errors(raw, truth), after=_errors(corrected, truth),
                          seconds=monotonic() - began)
        if not hidden:
            return outcome
        stored = folder / 'accel_calib' / 'demo.yaml'
        fitted = read_calibration(stored).model
        report(f'~/refine: {demo.call("calibrator/refine")}')
        report(f'~/set_level: {demo.level()}')
        refined = read_calibration(stored).model
        lag = refined.lags.get('temperature_of_offset')
        _, corrected, truth = demo.measure(_CHECKED_HIDDEN)
        return replace(
            outcome, before=outcome.after, after=_errors(corrected, truth),
            seconds=monotonic() - began, hidden=parse_effect(hidden)[0],
            found=tuple(str(name) for name in refined.effects if name not in fitted.effects),
            lag_s=0.0 if lag is None else lag.seconds)


def _errors(values: Floats, truth: Floats) -> Errors:
    """Return the errors of mean accelerations [g], (n, 3)."""
    sizes = np.linalg.norm(values, axis=1)
    errors = (sizes - 1.0) * MG
    cosines = np.sum(values * truth, axis=1) / sizes / np.linalg.norm(truth, axis=1)
    return Errors(rms(np.linalg.norm(values - truth, axis=1)) * MG, rms(errors),
                  float(np.max(np.abs(errors))),
                  rms(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))))


def demonstrate_page(port: int, report: Callable[[str], None],
                     is_over: Callable[[], bool]) -> None:
    """Run simulator and calibrator with its live page, until it is over or a node has ended."""
    report('a simulated Imu is turned by hand; open the link of the live page in a browser, wait '
           'for the poses, and press Fit. Ctrl-C ends it')
    with (_isolated(),
          running('node', {'sensor': 'demo', 'web_port': port}, 'info') as node,
          running('simulator', _TIMED) as simulator):
        while not is_over():
            _check_running([node, simulator])
            sleep(_LOOK_EVERY)


@contextmanager
def _isolated() -> Iterator[Path]:
    """Yield a folder for the files, and let processes use it and a domain on this machine."""
    with (tempfile.TemporaryDirectory(prefix='accel_calib_demo_') as folder,
          own_domain() as domain):
        os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST',
                          ROS_HOME=folder, ROS_LOG_DIR=os.path.join(folder, 'log'))
        yield Path(folder)


@contextmanager
def running(command: str, parameters: dict[str, Any], severity: str = 'error'
            ) -> Iterator[subprocess.Popen[bytes]]:
    """Run a node in a process, which prints log lines from this severity on, and end it."""
    given = [part for name, value in parameters.items()
             for part in ('-p', f'{name}:={json.dumps(value)}')]
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


def _check_running(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    if any(process.poll() is not None for process in processes):
        raise AccelCalibError('a node has ended unexpectedly', 'see its output above')
