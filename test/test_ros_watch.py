# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib watch`` beside a calibrator node, and the live page of a node."""

from collections.abc import Callable, Iterator
import fcntl
import math
import os
from pathlib import Path
import pty
import re
import signal
import socket
import struct
import subprocess
import sys
import termios
import threading
from typing import Any

from faults.sample import sample
from inside import CALIBRATOR, COMMAND, spread_directions
import pytest
import rcl_interfaces.msg
from shared import Readings, wait
from viewer import link_of, Viewer

WATCH = (*COMMAND, 'watch')
ATTITUDES = ([0, 0, 1], [1, 0, 0], [0, 1, 0])


def turn(bench: Any, readings: Readings, seen: Callable[[int], bool]) -> None:
    """Turn the sensor; each attitude waits until the pose before it is seen."""
    for count, attitude in enumerate(ATTITUDES, 1):
        bench.feed(readings([attitude]))
        bench.spin(lambda count=count: seen(count))


@pytest.mark.parametrize('number', sample([signal.SIGINT, signal.SIGTERM], 1))
def test_a_file_gets_a_line_for_each_pose_and_for_a_silence_of_the_node(
        bench: Any, readings: Readings, number: int) -> None:
    node = bench.calibrator(sensor='arm', passthrough=True)
    process = bench.run(*WATCH)
    bench.spin(lambda: 'poses: 0 of about 12; ' in process.printed)
    turn(bench, readings, lambda count: f'captured pose {count} of' in process.printed)
    lines = process.printed.splitlines()
    assert all(map(str.isprintable, lines))
    assert {'moving', 'still'} <= {line.partition(': ')[0] for line in lines}
    bench.end(node, signal.SIGINT)
    bench.spin(lambda: 'expected a message' in process.printed)
    bench.calibrator(sensor='arm')
    bench.spin(lambda: 'arrive again\n' in process.printed)
    status, printed = bench.end(process, number)
    assert (status, 'Traceback' in printed) == (0, False)


def test_terminal_is_drawn_with_a_bell_for_each_pose(bench: Any, readings: Readings) -> None:
    bench.calibrator(sensor='arm', passthrough=True)
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
    process = subprocess.Popen([sys.executable, *WATCH], stdin=terminal, stdout=terminal,
                               stderr=terminal, env={**bench._environment, 'TERM': 'xterm'},
                               start_new_session=True)
    os.close(terminal)
    shown = bytearray()

    def read() -> None:
        try:
            while data := os.read(reader, 65536):
                shown.extend(data)
        except OSError:
            return  # so Linux reports that the other side is closed

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        bench.spin(lambda: b'0 of about 12' in shown)
        turn(bench, readings, lambda count: f' {count} of about'.encode() in shown)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
        thread.join()
        os.close(reader)
    assert shown.count(b'\a') == len(ATTITUDES)
    assert shown.rindex(b'\x1b[?25h') > shown.rindex(b'\x1b[?25l')  # the cursor is back
    assert b'3 of about' in shown[shown.rindex(b'\x1b[?1049l'):]
    assert 'Traceback' not in shown.decode()


def test_node_is_found_by_its_name_or_what_is_there_is_named(bench: Any) -> None:
    def once(*arguments: str) -> tuple[int, str]:
        return bench.end(bench.run(*WATCH, '--once', *arguments))

    status, printed = once()
    assert (status, printed.count('\n')) == (2, 1)
    assert re.search('/calibrator/progress .*accel-calib node.*ROS_DOMAIN_ID', printed)
    bench.run(*CALIBRATOR, '--ros-args', '-r', '__ns:=/left')
    bench.spin(lambda: bench.node.count_publishers('/left/calibrator/progress'))
    for arguments, status, words in (
            (['--node', 'left/calibrator'], 0, 'poses: 0 of about 12'),
            (['--ros-args', '-r', '__ns:=/left'], 0, 'poses: 0 of about 12'),
            ([], 2, 'set --node left/calibrator\n'),
            (['--node', 'left calibrator'], 2, 'expected the name of a node')):
        found = once(*arguments)
        assert found[0] == status, found
        assert words in found[1]


DIRECTIONS = spread_directions(12)


def free_port() -> int:
    with socket.create_server(('127.0.0.1', 0)) as probe:
        return int(probe.getsockname()[1])


def page_link(bench: Any, node: Any, count: int = 1) -> str:
    """Return the link of the last page of a node, once it has served so many."""
    bench.spin(lambda: node.printed.count('live page: ') == count)
    return link_of(node.printed.rpartition('live page: ')[2].splitlines()[0])


@pytest.fixture
def viewer(bench: Any, tmp_path: Path) -> Iterator[Viewer]:
    """Yield a viewer of a calibrator with a page."""
    node = bench.calibrator(calibration_file=tmp_path / 'c.yaml', web_port=free_port(),
                            passthrough=True)
    made = Viewer(page_link(bench, node))
    made.node = node  # type: ignore[attr-defined]
    yield made
    made.close()


def test_a_whole_calibration_through_the_page_of_a_node_that_ends_and_logs_no_token(
        bench: Any, viewer: Viewer, readings: Readings, tmp_path: Path) -> None:
    path, node = tmp_path / 'c.yaml', viewer.node  # type: ignore[attr-defined]
    heard = bench.listen(rcl_interfaces.msg.Log, '/rosout', latched=True)
    refusal = bench.call('fit').message
    bench.spin(lambda: refusal in [line['words'] for line in viewer.of('log')])
    assert viewer.ask('fit', bench.spin)['words'] == refusal
    numbers = [line['number'] for line in viewer.of('log')]
    assert numbers == sorted(set(numbers))
    bench.feed(readings(DIRECTIONS))
    bench.spin(lambda: len(viewer.of('poses')[-1]['up']) >= len(DIRECTIONS))

    for command in ('fit', 'save'):
        assert viewer.ask(command, bench.spin)['success']
        assert (viewer.state['preview'], path.exists()) == (command == 'fit', command == 'save')
    bench.feed(readings(DIRECTIONS[:1]))
    bench.spin(lambda: abs((viewer.of('progress')[-1]['corrected'] or 0.0) - 1.0) < 0.003)
    count = len(viewer.of('progress'))
    for k in range(10):  # the last one is shown, and not the batch of the session
        bench.send(bench.imu([0.0, 0.0, 9.80665 * (1.0 + 0.01 * k)]))
    bench.spin(lambda: any(math.isclose(each['length'] or 0.0, 1.09, abs_tol=1e-6)
                           for each in viewer.of('progress')[count:]))

    assert viewer.ask('undo', bench.spin)['success']
    assert viewer.state['result'] is None

    bench.spin(lambda: any('live page: ' in line.msg for line in heard))
    code, printed = bench.end(node, signal.SIGINT)
    assert (code, 'Traceback' in printed) == (0, False)
    wait(lambda: viewer.code)
    folder = Path(os.environ.get('ROS_LOG_DIR') or bench.home / 'log')
    file, = folder.glob(f'*_{node.pid}_*.log')
    logged = file.read_text(encoding='utf-8')
    assert 'live page: ' in logged
    for text in (printed, logged, *(line.msg for line in heard)):
        assert viewer.token not in text
    assert not list((bench.home / 'accel_calib').glob('live_page_*'))


def test_a_node_whose_port_is_in_use_says_so_and_works_on(
        bench: Any, readings: Readings, tmp_path: Path) -> None:
    with socket.create_server(('127.0.0.1', 0)) as taken:
        port = taken.getsockname()[1]
        node = bench.calibrator(calibration_file=tmp_path / 'c.yaml', web_port=port,
                                passthrough=True)
        bench.spin(lambda: f'the port {port} of 127.0.0.1 is in use' in node.printed)
        still = readings(DIRECTIONS[:1])
        bench.feed(still)
        assert 'pose' in bench.call_while('capture_pose', lambda: bench.imu(still[-1])).message
        assert node.poll() is None
