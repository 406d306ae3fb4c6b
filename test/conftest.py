# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Fixtures, most of them for the tests of the nodes.

`bench` runs nodes as processes, with a separate DDS domain per test. The clock of the calibrator
are the header stamps, so that a test can publish a minute of readings in a second. Each wait has a
condition and a time limit.

"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from accel_calib.calibration import level
from accel_calib.stored import write_calibration
from inside import model_with, NODES, own_domain, simulate_recording
import numpy as np
import pytest
from shared import GRAVITY, KNOWN, known, ROOT

sys.path[:0] = [str(ROOT / 'benchmarks'), str(ROOT / 'docs')]
"""Some tests are the short form of a benchmark, and others check what makes a page."""

collect_ignore_glob = [] if find_spec('rclpy') else ['test_ros_*.py']
"""Without ROS only the other tests run."""

PATIENCE = 60.0
"""
Longest wait for a condition [s].

A wait ends with its condition, so that only a failure takes this time. On a loaded machine, the
start of a node and the answer of DDS take much longer than on an idle one.

"""

RATE = 50.0
_BATCH = 20


class Process(subprocess.Popen[str]):
    """A process with its output in a file: a pipe that nobody reads would stop it."""

    def __init__(self, arguments: Iterable[str], path: Path, environment: Mapping[str, str]
                 ) -> None:
        self._path = path
        with path.open('w', encoding='utf-8') as file:
            super().__init__([sys.executable, *arguments], cwd=ROOT, env=environment, stdout=file,
                             stderr=subprocess.STDOUT, text=True)

    @property
    def printed(self) -> str:
        """Output so far."""
        return self._path.read_text(encoding='utf-8')


class Bench:
    """
    A node that drives and observes the nodes under test.

    Attributes
    ----------
    deep : dict
        Parameter of a calibrator: a queue for a sensor that does not wait for it. On a loaded
        machine a calibrator may stop for a second, and the simulator then sends all that is due.

    """

    deep: Mapping[str, int] = {'qos_overrides./imu/data_raw.subscription.depth': 5000}

    def __init__(self, folder: Path, domain: int) -> None:
        self.home, self._folder = folder / 'home', folder
        self._domain = domain
        self._environment = {**os.environ, 'ROS_HOME': str(self.home),
                             'ROS_DOMAIN_ID': str(domain)}
        self._processes: list[Process] = []
        self.stamp = 1000.0
        self._join()

    def _join(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=self._domain)
        # Without /rosout: rcl has one publisher per node name for all contexts.
        self.node = Node('bench', context=self._context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[tuple[str, int], Any] = {}
        self._imu: Any = None

    def _leave(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()

    def join_anew(self) -> None:
        """Leave DDS and join it again, because it considers killed processes alive for 20 s."""
        self._leave()
        self._join()

    def start(self, name: str, **parameters: Any) -> Process:
        """Start a node of the package as a process."""
        given = [part for key, value in parameters.items() for part in (
            '-p', f'{key}:={str(value).lower() if isinstance(value, bool) else value}')]
        return self.run(*NODES[name], '--ros-args', *given)

    def run(self, *arguments: str) -> Process:
        """Start Python as a process in the domain of this bench."""
        path = self._folder / f'output{len(self._processes)}.txt'
        self._processes.append(Process(arguments, path, self._environment))
        return self._processes[-1]

    def calibrator(self, **parameters: Any) -> Process:
        """Start a calibrator and wait until it listens."""
        from sensor_msgs.msg import Imu
        process = self.start('calibrator', **parameters)
        if self._imu is None:
            self._imu = self.node.create_publisher(Imu, 'imu/data_raw', 100)
            self.came_out = self.listen(Imu, 'imu/data_calibrated')
        self.spin(lambda: self._imu.get_subscription_count() > 0)
        self.client('self_test')
        return process

    def end(self, process: Process, number: int = 0) -> tuple[int, str]:
        """Send a signal if it is not 0, and return the exit status and the output."""
        process.send_signal(number)
        return process.wait(PATIENCE), process.printed

    def spin(self, until: Callable[[], Any], seconds: float = PATIENCE) -> None:
        """Spin until a condition holds."""
        ends = time.monotonic() + seconds
        while not until():
            late = time.monotonic() > ends
            assert not late, f'not so within {seconds} s'
            # Checks take time, too: on a busy machine messages would accumulate.
            look_again = time.monotonic() + 0.02
            while time.monotonic() < look_again:
                self._executor.spin_once(timeout_sec=0.02)

    def send_until(self, make: Callable[[], Any], until: Callable[[], Any]) -> None:
        """Publish one Imu after the other until a condition holds."""
        self.spin(lambda: self.send(make()) or until())

    def listen(self, kind: Any, topic: str, *, latched: bool = False) -> list[Any]:
        """Return a list to which the messages of a topic are added."""
        from rclpy.qos import DurabilityPolicy, QoSProfile
        qos = QoSProfile(depth=100)
        if latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def client(self, name: str, number: int = 0) -> Any:
        """Wait for a service of the calibrator, and return one of its clients."""
        from diagnostic_msgs.srv import SelfTest
        from std_srvs.srv import SetBool, Trigger
        kind = {'enable': SetBool, 'self_test': SelfTest}.get(name, Trigger)
        if (name, number) not in self._clients:
            self._clients[name, number] = self.node.create_client(kind, f'calibrator/{name}')
        self.spin(self._clients[name, number].service_is_ready)
        return self._clients[name, number]

    def ask(self, kind: Any, name: str, **fields: Any) -> Any:
        """Call any service, and return its answer."""
        client = self.node.create_client(kind, name)
        self.spin(client.service_is_ready)
        return self._answer(client, fields)

    def _answer(self, client: Any, fields: Mapping[str, Any]) -> Any:
        future = client.call_async(client.srv_type.Request(**fields))
        self.spin(future.done)
        return future.result()

    def go(self, transition: int) -> None:
        """Change the state of a managed calibrator."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState
        assert self.ask(ChangeState, 'calibrator/change_state',
                        transition=Transition(id=transition)).success

    def call(self, name: str, **fields: Any) -> Any:
        """Call a service of the calibrator and return its answer."""
        return self._answer(self.client(name), fields)

    def call_while(self, name: str, make: Callable[[], Any]) -> Any:
        """
        Call a service of the calibrator while messages continue, and return its answer.

        The next message waits for the output of the previous one, but not longer than 0.1 s. More
        messages would be dropped while the calibrator is busy.

        """
        client = self.client(name)
        self.send(make())
        future, sent = client.call_async(client.srv_type.Request()), time.monotonic()

        def answered() -> bool:
            nonlocal sent
            if self.came_out or time.monotonic() - sent > 0.1:
                self.came_out.clear()
                self.send(make())
                sent = time.monotonic()
            return bool(future.done())

        self.spin(answered)
        return future.result()

    def imu(self, reading: Any, **fields: Any) -> Any:
        """Return an Imu message with the next stamp."""
        from geometry_msgs.msg import Vector3
        from rclpy.time import Time
        from sensor_msgs.msg import Imu
        self.stamp += 1.0 / RATE
        message = Imu(**fields)
        message.header.stamp = Time(nanoseconds=round(self.stamp * 1e9)).to_msg()
        message.header.frame_id = message.header.frame_id or 'imu_link'
        x, y, z = (float(part) for part in reading)
        message.linear_acceleration = Vector3(x=x, y=y, z=z)
        return message

    def send(self, message: Any) -> None:
        """Publish an Imu."""
        self._imu.publish(message)

    def feed(self, readings: Any) -> None:
        """
        Publish readings [m/s²], at `RATE` by their stamps but faster in real time.

        The output of the calibrator sets the pace, because sensor data are dropped while it is
        busy. Without a calibration, this needs `passthrough`.

        """
        if not self.came_out:
            rng = np.random.default_rng(1)  # moving, until both sides have discovered each other
            self.exchange(self.came_out, lambda: self.imu(readings[0] + 3.0 * rng.normal(size=3)))
        for start in range(0, len(readings), _BATCH):
            batch = [self.imu(reading) for reading in readings[start:start + _BATCH]]
            self.came_out.clear()
            for message in batch:
                self.send(message)
            self.spin(lambda last=batch[-1]: _came(last, self.came_out))

    def echo(self, messages: Iterable[Any], heard: list[Any]) -> list[Any]:
        """
        Publish messages, each after the output of the previous one, and return their output.

        The list contains nothing else, such as late output of earlier messages.

        """
        output = []
        for message in messages:
            self.send(message)
            self.spin(lambda message=message: _came(message, heard))
            output.append(heard[-1])
        heard[:] = output
        return heard

    def exchange(self, heard: list[Any], make: Callable[[], Any]) -> Any:
        """Publish messages of `make` until there is output, and return the first output."""
        heard.clear()
        self.send_until(make, lambda: heard)
        return heard[0]

    def close(self) -> None:
        """Leave DDS, and kill all started processes."""
        self._leave()  # first, because a killed process leaves its shared memory unchanged
        for process in self._processes:
            process.kill()
            sys.stdout.write(self.end(process)[1])  # pytest shows it if a test fails


def _came(message: Any, heard: list[Any]) -> bool:
    """Return whether the output of a message is the last one."""
    return bool(heard) and heard[-1].header.stamp == message.header.stamp


@pytest.fixture(scope='session')
def temporary() -> Iterator[Path]:
    """Yield a folder for temporary files, in which any user can write."""
    # TMPDIR may be a folder of root alone.
    folder = Path(tempfile.mkdtemp(dir='/tmp' if os.geteuid() == 0 else None))
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope='session', autouse=True)
def without_waiting_for_the_disk() -> Iterator[None]:
    """Let what is stored stay in memory: a session of a test stores hundreds of files."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, 'fsync', lambda _: None)
        yield


@pytest.fixture(autouse=True)
def defects_are_failures(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test that left the details of an exception that nobody expected."""
    monkeypatch.setattr(tempfile, 'tempdir', str(temporary))
    yield
    details = []
    for path in temporary.glob('accel_calib-*.txt'):
        details.append(path.read_text(encoding='utf-8'))
        path.unlink()
    if details:
        pytest.fail('\n'.join(details), pytrace=False)


@pytest.fixture
def without_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands draw no page: that takes longer than all the rest."""
    monkeypatch.setitem(sys.modules, 'matplotlib', None)


@pytest.fixture
def domain() -> Iterator[int]:
    """Yield a DDS domain of this test."""
    with own_domain() as number:
        yield number


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, domain: int) -> Iterator[Bench]:
    """Yield a bench in a DDS domain of its own."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    made = Bench(tmp_path, domain)
    yield made
    made.close()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the files of sensors."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'home'))
    return tmp_path / 'home' / 'accel_calib'


@pytest.fixture
def in_time() -> Iterator[None]:
    """End a test that hangs, such as one that reads a pipe; one that is only slow goes on."""
    def end(*_: object) -> None:
        raise AssertionError(f'not ready within {10.0 * PATIENCE:g} s')

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(round(10.0 * PATIENCE))
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    """Yield Chromium."""
    from live_bench import chromium
    with chromium() as started:
        yield started


@pytest.fixture
def tf_message() -> Any:
    """Return the message type of transforms; `make test` builds tf2_msgs."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        pytest.skip('tf2_msgs is not installed; make test builds it')
    return TFMessage


@pytest.fixture
def without_tf2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide tf2_msgs from this process, and from nodes of a `bench` that is requested after it."""
    hidden = tmp_path / 'without_tf2'
    hidden.mkdir()
    (hidden / 'tf2_msgs.py').touch()  # a module without tf2_msgs.msg
    monkeypatch.setenv('PYTHONPATH', str(hidden), prepend=os.pathsep)
    monkeypatch.setitem(sys.modules, 'tf2_msgs.msg', None)


@pytest.fixture
def readings() -> Callable[..., Any]:
    """Return a function that simulates readings of a sensor that is turned."""
    def make(directions: Any, *, dwell: float = 1.8, rotation: Any = None,
             effects: Mapping[str, Any] = KNOWN) -> Any:
        recording = simulate_recording(
            model_with(effects, rotation), np.array(directions, float), np.random.default_rng(7),
            noise_g=0.0005, rate_hz=RATE, dwell=dwell, turn=0.4)
        return recording.reading * GRAVITY

    return make


@pytest.fixture
def stored(tmp_path: Path) -> Callable[..., Path]:
    """Return a function that stores a calibration of known parameters."""
    def make(name: str = 'known.yaml', *, sensor: str = '', unit: Any = 'm/s2',
             flat: Any = None) -> Path:
        calibration = replace(known(unit), sensor=sensor)
        if flat is not None:
            reading = calibration.predict(np.array([flat], float) * calibration.force_per_g)[0]
            calibration = level(calibration, reading, 'ros')
        write_calibration(tmp_path / name, calibration)
        return tmp_path / name

    return make
