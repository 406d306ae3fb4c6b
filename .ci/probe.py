# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Start an installed executable as `ros2 run` does, and see that it works.

    probe.py EXECUTABLE PREFIX

EXECUTABLE is accel-calib, calibrator, calibrator_lifecycle or simulator; PREFIX is where the ament
index must say that the package is installed. The exit status is 0 if accel-calib prints its help,
also when it is found in PATH; or if the node answers over DDS and ends with 0 on SIGINT.

"""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from ament_index_python.packages import get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

PACKAGE = 'accel_calib'
COMMAND = 'accel-calib'
COMES_UP_SECONDS = 60.0
ENDS_SECONDS = 30.0


class ProbeError(Exception):
    """The executable does not do what it should."""


def executable_path(name: str, prefix: Path) -> Path:
    """Find the executable where `ros2 run` looks."""
    found = Path(get_package_prefix(PACKAGE))
    if found.resolve() != prefix.resolve():
        raise ProbeError(f'the ament index says {found}, expected {prefix}')
    path = found / 'lib' / PACKAGE / name
    if not os.access(path, os.X_OK):
        raise ProbeError(f'{path} is not there or cannot be executed')
    return path


def wait_for(node: Node, process: subprocess.Popen[bytes], what: str,
             is_there: Callable[[], bool]) -> None:
    """Spin until it is there, the process has ended or time is up."""
    end = time.monotonic() + COMES_UP_SECONDS
    while not is_there():
        if process.poll() is not None:
            raise ProbeError(f'ended with {process.returncode} before {what}')
        if time.monotonic() > end:
            raise ProbeError(f'no {what} within {COMES_UP_SECONDS:.0f} s')
        rclpy.spin_once(node, timeout_sec=0.1)


def answer_of(node: Node, process: subprocess.Popen[bytes], kind: Any, name: str) -> Any:
    """Call a service without arguments."""
    client = node.create_client(kind, name)
    wait_for(node, process, f'service {name}', client.service_is_ready)
    future = client.call_async(kind.Request())
    wait_for(node, process, f'answer of {name}', future.done)
    return future.result()


def probe_calibrator(node: Node, process: subprocess.Popen[bytes]) -> None:
    """See diagnostics, and an answer to ~/fit: there are no poses, and it says so."""
    heard: list[DiagnosticArray] = []
    node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)
    wait_for(node, process, 'message on /diagnostics', lambda: bool(heard))
    answer = answer_of(node, process, Trigger, '/calibrator/fit')
    if answer.success or not answer.message:
        raise ProbeError(f'/calibrator/fit without poses answers {answer}')


def probe_lifecycle(node: Node, process: subprocess.Popen[bytes]) -> None:
    """See a managed node that waits to be configured."""
    state = answer_of(node, process, GetState, '/calibrator/get_state').current_state
    if state.label != 'unconfigured':
        raise ProbeError(f'the state is {state.label}, expected unconfigured')


def probe_simulator(node: Node, process: subprocess.Popen[bytes]) -> None:
    """See a reading."""
    heard: list[Imu] = []
    node.create_subscription(Imu, '/imu/data_raw', heard.append, qos_profile_sensor_data)
    wait_for(node, process, 'message on /imu/data_raw', lambda: bool(heard))


def end(process: subprocess.Popen[bytes]) -> None:
    """Send SIGINT and see the process end with 0."""
    process.send_signal(signal.SIGINT)
    try:
        status = process.wait(ENDS_SECONDS)
    except subprocess.TimeoutExpired:
        raise ProbeError(f'still runs {ENDS_SECONDS:.0f} s after SIGINT') from None
    if status != 0:
        raise ProbeError(f'ends with {status} on SIGINT')


def probe_command(path: Path, folder: Path) -> None:
    """See the help of the command, where `ros2 run` looks and where a shell looks."""
    in_path = shutil.which(COMMAND)
    if in_path is None or not Path(in_path).is_relative_to(path.parents[2]):
        raise ProbeError(f'{COMMAND} in PATH is {in_path}, expected it in {path.parents[2]}')
    for each in (path, Path(in_path)):
        done = subprocess.run([each, '--help'], cwd=folder, stdin=subprocess.DEVNULL,
                              stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                              timeout=COMES_UP_SECONDS, check=False)
        if done.returncode != 0 or 'verify' not in done.stdout:
            raise ProbeError(f'{each} --help ends with {done.returncode}:\n{done.stdout}')


def probe_node(name: str, path: Path, folder: Path) -> None:
    """Start the node in an empty folder, look at it, end it."""
    look = {'calibrator': probe_calibrator, 'calibrator_lifecycle': probe_lifecycle,
            'simulator': probe_simulator}[name]
    output = folder / 'output'
    environment = {**os.environ, 'ROS_HOME': str(folder)}
    with output.open('wb') as stream:
        process = subprocess.Popen([path], cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                                   stdout=stream, stderr=subprocess.STDOUT)
    node = rclpy.create_node('probe')
    try:
        look(node, process)
        end(process)
    except ProbeError as error:
        said = output.read_text(errors='replace')
        raise ProbeError(f'{path}: {error}. It said:\n{said}') from None
    finally:
        node.destroy_node()
        process.kill()
        process.wait()
    if 'Traceback' in output.read_text(errors='replace'):
        raise ProbeError(f'{path}: {output.read_text(errors="replace")}')


def main() -> int:
    # A shell may start us with SIGINT ignored; the child would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    name, prefix = sys.argv[1:]
    rclpy.init(args=[])
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = executable_path(name, Path(prefix))
            if name == COMMAND:
                probe_command(path, Path(folder))
            else:
                probe_node(name, path, Path(folder))
    except ProbeError as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
