# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""``accel-calib watch`` beside a calibrator node, both as processes."""

from __future__ import annotations

from collections.abc import Callable
import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import threading
from typing import Any

from faults.sample import sample
from inside import CALIBRATOR, COMMAND
import pytest

Readings = Callable[..., Any]
WATCH = (*COMMAND, 'watch')
ATTITUDES = ([0, 0, 1], [1, 0, 0], [0, 1, 0])


def lines_of(process: subprocess.Popen[str]) -> tuple[list[str], threading.Thread]:
    """Return a list to which the lines of a process are added, and the thread that adds them."""
    lines: list[str] = []
    assert process.stdout is not None
    thread = threading.Thread(target=lines.extend, args=(process.stdout,), daemon=True)
    thread.start()
    return lines, thread


def turn(bench: Any, readings: Readings, seen: Callable[[int], bool]) -> None:
    """Turn the sensor; each attitude waits until the pose before it is seen."""
    for count, attitude in enumerate(ATTITUDES, 1):
        bench.feed(readings([attitude]))
        bench.spin(lambda count=count: seen(count))


def environment(bench: Any) -> dict[str, str]:
    """Return the environment of a process in the domain of a bench."""
    return {**os.environ, 'TERM': 'xterm',
            'ROS_DOMAIN_ID': str(bench.node.context.get_domain_id())}


@pytest.mark.parametrize('number', sample([signal.SIGINT, signal.SIGTERM], 1))
def test_pipe_gets_a_line_for_each_pose(bench: Any, readings: Readings, number: int) -> None:
    bench.calibrator(sensor='arm', passthrough=True)
    process = bench.run(*WATCH)
    lines, thread = lines_of(process)
    bench.spin(lambda: any(line.startswith('poses: 0 of about 12; ') for line in lines))
    turn(bench, readings, lambda count: any(f'captured pose {count} of' in x for x in lines))
    assert all(character.isprintable() for line in lines for character in line.rstrip('\n'))
    assert {'moving\n', 'still: hold it for 1 s\n'} <= set(lines)
    process.send_signal(number)
    assert process.wait(60) == 0
    thread.join()
    assert not any('Traceback' in line for line in lines)


def test_terminal_is_drawn_with_a_bell_for_each_pose(bench: Any, readings: Readings) -> None:
    bench.calibrator(sensor='arm', passthrough=True)
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack('HHHH', 24, 80, 0, 0))
    process = subprocess.Popen([sys.executable, *WATCH], stdin=terminal, stdout=terminal,
                               stderr=terminal, env=environment(bench), start_new_session=True)
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


def test_once_without_a_node_is_one_line(bench: Any) -> None:
    process = bench.run(*WATCH, '--once')
    printed = process.communicate(timeout=60)[0]
    assert process.returncode == 2
    assert printed == (
        'accel-calib watch: found no calibrator /calibrator, expected a message on '
        '/calibrator/progress every second; start it with accel-calib node, or check --node and '
        'ROS_DOMAIN_ID\n')


def test_node_in_a_namespace_is_found_by_its_name(bench: Any) -> None:
    bench.run(*CALIBRATOR, '--ros-args', '-r', '__ns:=/left')
    bench.spin(lambda: bench.node.count_publishers('/left/calibrator/progress'))
    for arguments, status, words in (
            (['--node', 'left/calibrator'], 0, 'poses: 0 of about 12'),
            (['--ros-args', '-r', '__ns:=/left'], 0, 'poses: 0 of about 12'),
            ([], 2, 'set --node left/calibrator\n'),
            (['--node', 'left calibrator'], 2, 'expected the name of a node')):
        process = bench.run(*WATCH, '--once', *arguments)
        printed = process.communicate(timeout=60)[0]
        assert process.returncode == status, printed
        assert words in printed


def test_silence_of_the_node_is_reported(bench: Any) -> None:
    node = bench.calibrator()
    process = bench.run(*WATCH)
    lines, thread = lines_of(process)
    bench.spin(lambda: lines)
    bench.end(node, signal.SIGINT)
    bench.spin(lambda: any('expected a message' in line for line in lines))
    bench.calibrator()
    bench.spin(lambda: any(line.endswith('arrive again\n') for line in lines))
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    thread.join()


def test_reader_of_the_pipe_may_end(bench: Any) -> None:
    node = bench.calibrator()
    with subprocess.Popen([sys.executable, *WATCH], env=environment(bench), text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline()
        process.stdout.close()
        bench.end(node, signal.SIGINT)  # so that there is another line to write
        assert process.wait(60) == 0
        assert process.stderr.read() == ''
