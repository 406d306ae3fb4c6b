# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of a serial port (a pseudo-terminal) or a recording, and ``accel-calib live``."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, ExitStack, suppress
import fcntl
import os
from pathlib import Path
import re
import signal
import socket
import stat
import struct
import subprocess
import sys
import tempfile
import termios
from threading import Event, Thread
import time
import tty
from typing import Any
from urllib.parse import urlsplit

from accel_calib.errors import InputError
from accel_calib.logs import LogOptions
from accel_calib.stored import read_calibration
from accel_calib.table import Floats
from inside import (
    announce, CLOCK_OF_A_SOURCE, COMMAND, HEAD_OF_A_PORT, interval_of_lines, is_port,
    MOST_OF_A_HEAD, open_source, PATIENCE_OF_A_PORT, read_log)
from live_bench import TurnedSensor
import numpy as np
import pytest
from shared import wait
from viewer import link_of, Viewer

RATE_HZ = 200.0
TIMED = {'time': '1', 'ax': '2', 'ay': '3', 'az': '4'}


READINGS = [0.02, -0.01, 1.0] + 0.001 * np.random.default_rng(1).normal(size=(4000, 3))
"""Readings of a sensor that lies flat [g]."""


def paced(line: Callable[[int], str], late: tuple[float, float] = (0.0, 0.0)) -> Iterator[str]:
    """Yield lines at the rate of the samples; those due from one time to another at the other."""
    begin = time.monotonic()
    for k in range(len(READINGS)):
        due = k / RATE_HZ
        due = late[1] if late[0] < due < late[1] else due
        while time.monotonic() < begin + due:
            time.sleep(0.002)
            yield ''
        yield line(k)
    while True:
        time.sleep(0.01)
        yield ''


def samples(blocks: Iterator[Floats], count: int) -> Floats:
    """Return at least this number of samples of a source."""
    found: list[Floats] = []
    while sum(map(len, found)) < count:
        found.append(next(blocks))
    return np.concatenate(found)


def received(line: Callable[[int], str], count: int = 300, **options: Any) -> tuple[str, Floats]:
    """Return the unit and reading of the lines of a board, and so many of its samples."""
    with (board(paced(line)) as port,
          open_source(port, LogOptions(**options), baud=9600) as source):
        return f'{source.units.name}, {source.read_as}', samples(source.blocks, count)


def numbers(k: int, separator: str = ',') -> str:
    return separator.join(f'{part:.5f}' for part in READINGS[k])


@pytest.fixture(autouse=True)
def short_head(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a port be understood after a moment, except where its rate is measured."""
    monkeypatch.setattr(*HEAD_OF_A_PORT, 0.3)


def test_lines_of_a_board_become_samples_with_their_times_and_temperature() -> None:
    read_as, found = received(lambda k: f'{5 * k},{numbers(k)},24.5\n',
                              columns={**TIMED, 'temperature': '5'})
    assert re.match('g, .*ms', read_as)
    assert np.allclose(np.diff(found[:, 0]), 0.005)
    first = round(found[0, 0] / 0.005)
    np.testing.assert_allclose(found[:, 1:4], READINGS[first:first + len(found)], atol=1e-5)
    assert np.isnan(found[:, 4:7]).all()
    assert (found[:, 7] == 24.5).all()


def test_boot_messages_garbled_lines_and_impossible_numbers_are_skipped() -> None:
    def line(k: int) -> str:
        if k < 5:
            return f'rst:0x1 (POWERON_RESET), boot {k}\r\n'
        if k == 5:
            return 'time_ms;accX;accY;accZ;gyroX_dps;gyroY_dps;gyroZ_dps\r\n'
        if k in (200, 250):
            return f'{5 * k};0.0\x00\x81;\r\n'
        if k == 220:
            return f'{5 * k};0.0;1e300;1.0;0.1;0.2;0.3\r\n'
        return f'{5 * k};{numbers(k, ";")};0.1;0.2;0.3\r\n'

    found = received(line)[1]
    assert np.isfinite(found[:, :7]).all()
    assert np.abs(found[:, 1:4]).max() < 2.0
    np.testing.assert_allclose(found[:, 4:7], np.tile(np.radians([0.1, 0.2, 0.3]),
                                                      (len(found), 1)))
    assert np.sum(np.diff(found[:, 0]) > 0.0051) >= 3


@pytest.mark.parametrize(('timed', 'seed'), [(True, 0), (True, 2), (False, 0)])
def test_times_never_run_backwards_though_characters_are_lost(timed: bool, seed: int) -> None:
    rng = np.random.default_rng([20, seed])

    def line(k: int) -> str:
        text = f'{5 * k + 1000},{numbers(k)}\n' if timed else f'{numbers(k)}\n'
        cut = int(rng.integers(len(text) - 1))
        return text if k < 100 or k % 9 else text[:cut] + text[cut + int(rng.integers(1, 9)):]

    times = received(line, 400, columns=TIMED if timed else {})[1][:, 0]
    assert np.all(np.diff(times) >= 0.0)
    assert np.ptp(times) == pytest.approx(len(times) / RATE_HZ, rel=0.1) or not timed


def test_samples_of_a_board_that_starts_again_are_kept() -> None:
    found = received(lambda k: f'{5 * k - 1500 * (k >= 300)},{numbers(k)}\n', 500,
                     columns=TIMED)[1]
    assert np.sum(np.diff(found[:, 0]) < 0.0) == 1
    assert abs(np.diff(found[:, 0])).sum() == pytest.approx(1.495 + 0.005 * (len(found) - 2))


def test_lines_without_times_get_the_stated_rate() -> None:
    found = received(lambda k: f'{numbers(k)}\n', 150, rate=100.0)[1]
    np.testing.assert_allclose(np.diff(found[:, 0]), 0.01)


@pytest.mark.parametrize(('boots', 'late'), [
    (0, (0.0, 0.0)), (0, (0.0, 0.6)), (0, (1.5, 2.5)), (100, (0.0, 0.0))])
def test_a_rate_is_measured_also_if_lines_are_late_or_follow_a_boot(
        boots: int, late: tuple[float, float], monkeypatch: pytest.MonkeyPatch) -> None:
    def line(k: int) -> str:
        return ('rst:0x1, boot\r\n' * boots if k == 0 else '') + f'{numbers(k)}\n'

    monkeypatch.setattr(*HEAD_OF_A_PORT, 2.0)
    monkeypatch.setattr(*MOST_OF_A_HEAD, 2000)  # fewer lines than the 400 of this time
    with (board(paced(line, late)) as port, open_source(port, LogOptions(), baud=9600) as source):
        first = next(source.blocks)
        found = np.concatenate([first, samples(source.blocks, 450 - len(first))])
    assert 20 < len(first) < 400
    assert np.mean(np.diff(found[:, 0])) == pytest.approx(1.0 / RATE_HZ, rel=0.1)


def test_a_backlog_of_many_short_reads_does_not_change_the_rate() -> None:
    backlog = [(k, 0.6 + 1e-4 * k) for k in range(2, 121)]
    later = [(20 * k, 0.1 * k) for k in range(7, 27)]
    assert interval_of_lines([(1, 0.0), *backlog, *later]) == pytest.approx(0.005, rel=0.01)


def test_bytes_at_another_baud_rate_are_refused_with_that_advice(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_OF_A_PORT, 1.0)
    noise = np.random.default_rng(2).integers(128, 255, size=(4000, 30), dtype=np.uint8)
    with (board(paced(lambda k: noise[k].tobytes().decode('latin-1') + '\n')) as port,
          pytest.raises(InputError, match='baud rate 9600'),
          open_source(port, LogOptions(), baud=9600)):
        pass


def test_a_port_that_is_removed_is_waited_for_and_read_again(tmp_path: Path) -> None:
    port = tmp_path / 'ttyUSB0'

    def line(k: int) -> str:
        return f'{5 * k},{numbers(k)}\n' if k > 5 else f'rst:0x1, boot {k}\r\n'

    with ExitStack() as first, ExitStack() as opened:
        port.symlink_to(first.enter_context(board(paced(line))))
        source = opened.enter_context(open_source(str(port), LogOptions(), baud=9600))
        assert len(samples(source.blocks, 100)) >= 100
        assert source.problem() == ''
        port.unlink()
        first.close()
        wait(lambda: source.problem() or next(source.blocks) is None)
        with board(paced(line)) as second:
            port.symlink_to(second)
            found = samples(source.blocks, 100)
            assert source.problem() == ''
    assert np.isfinite(found[:, :4]).all()
    assert 0.0 < found[-1, 0] < 10.0  # the clock of the board has started again


class Clock:
    """A clock that only sleeping advances."""

    now = 50.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def test_a_recording_is_played_in_real_time(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, path = Clock(), tmp_path / 'recording.csv'
    stamps = np.arange(400) / RATE_HZ
    stamps[300:] += 1000.0
    np.savetxt(path, np.column_stack([stamps, READINGS[:400]]), delimiter=',',
               header='time,ax,ay,az', comments='')
    assert not is_port(str(path))
    table = read_log(path, LogOptions(units='g')).table
    monkeypatch.setattr(*CLOCK_OF_A_SOURCE, clock)
    with open_source(str(path), LogOptions(units='g'), baud=9600, speed=2.0) as source:
        arrivals = [(clock.now - 50.0, block) for block in source.blocks]
    found = np.concatenate([block for _, block in arrivals])
    np.testing.assert_array_equal(found[:, 1:4], table.reading)
    np.testing.assert_array_equal(found[:, 0], table['time'])
    late = np.concatenate([when - (block[:, 0] - found[0, 0]) / 2.0 for when, block in arrivals])
    assert np.all((late[:300] > -1e-9) & (late[:300] < 0.05))
    assert np.ptp(late[300:]) < 0.05  # the gap of 1000 s is left out
    assert arrivals[-1][0] < 2.0


COUNTS = 16384.0 / 9.80665
PATIENCE = 120.0
LIVE = (sys.executable, *COMMAND, 'live', '--port', '0')


def lines_of(sensor: TurnedSensor) -> Iterator[str]:
    """Yield what a board sends: a greeting, a header, and a line of counts for each sample."""
    yield 'boot ok\r\n'
    yield 't_ms;accX;accY;accZ;temp_C\r\n'
    for block in sensor.blocks:
        yield ''  # the board can end between two blocks
        for row in block:
            x, y, z = np.round(row[1:4] * COUNTS)
            yield f'{1000.0 * row[0]:.1f};{x:g};{y:g};{z:g};24.5\r\n'


@contextmanager
def live(*arguments: str) -> Iterator[tuple[str, list[str], subprocess.Popen[str]]]:
    """Run the command, and yield the link of its page, its lines, and the process."""
    lines: list[str] = []
    with (tempfile.TemporaryDirectory() as home,
          subprocess.Popen([*LIVE, *arguments], stdout=subprocess.PIPE, text=True, umask=0,
                           env={**os.environ, 'ROS_HOME': home}) as process):
        try:
            for line in process.stdout or ():
                lines.append(line.strip())
                if line.startswith('live page: '):
                    break
            yield link_of(lines[-1]), lines, process
        finally:
            process.kill()


def follow(viewer: Viewer, sensor: TurnedSensor) -> None:
    """Turn a sensor as the page asks, until it asks for the fit."""
    wait(lambda: viewer.of('progress') and viewer.of('progress')[-1]['direction'])
    while direction := (now := viewer.of('progress')[-1])['direction']:
        sensor.turn_to(np.array(direction))
        wait(lambda poses=now['poses']: viewer.of('progress')[-1]['poses'] > poses)
    assert '~/fit' in now['advice']


def test_a_board_on_a_serial_port_is_calibrated(tmp_path: Path) -> None:
    sensor, stored = TurnedSensor(speed=5.0), tmp_path / 'board.yaml'
    with (board(lines_of(sensor)) as port, live(port, '-o', str(stored)) as (link, lines, run)):
        viewer = Viewer(link)
        follow(viewer, sensor)
        wait(lambda: viewer.of('progress')[-1]['up'])  # also before the zero is fitted
        assert viewer.ask('fit')['success']
        wait(lambda: viewer.state['preview'] and viewer.state['rating'])
        assert viewer.state['rating']['rating'] == 'GOOD'
        counts_per_g = viewer.state['counts_per_g']
        assert viewer.ask('save')['success']
        viewer.close()
        run.send_signal(signal.SIGINT)
        printed = ' '.join(run.communicate(timeout=PATIENCE)[0].split())
        assert run.returncode == 0
    assert not re.search('~/|Imu messages|frame_id', printed)
    assert any(line.startswith("read as: ';'") for line in lines)
    calibration = read_calibration(stored)
    assert calibration.units.name == 'native'
    assert counts_per_g == pytest.approx(float(np.mean(np.linalg.norm(calibration.gain, axis=0))),
                                         rel=1e-3)
    offset = calibration.units.to_g(calibration.offset)
    np.testing.assert_allclose(offset, (0.03, -0.02, 0.04), atol=0.002)


def flat(folder: Path) -> Path:
    """Write a recording of a sensor that lies flat."""
    path = folder / 'recording.csv'
    path.write_text('time,ax,ay,az\n' + ''.join(f'{k / 50},0,0,9.8\n' for k in range(100)),
                    encoding='utf-8')
    return path


def test_the_limit_of_a_still_sensor_is_in_the_unit_of_the_readings(tmp_path: Path) -> None:
    path, noise = tmp_path / 'g.csv', 0.015 * np.random.default_rng(3).normal(size=(2000, 3))
    np.savetxt(path, np.column_stack([np.arange(2000) / 50.0, np.array([0.0, 0.0, 1.0]) + noise]),
               delimiter=',', header='time,ax,ay,az', comments='')
    with live(str(path), '-o', str(tmp_path / 'c.yaml'), '--units', 'g', '--speed', '5',
              '--still-std-max', '0.04') as (link, _, _):
        viewer = Viewer(link)
        wait(lambda: viewer.of('progress') and viewer.of('progress')[-1]['poses'] == 1)
        viewer.close()


def test_only_its_owner_has_the_link_and_idle_connections_do_not_keep_it_out(
        tmp_path: Path) -> None:
    with (live(str(flat(tmp_path)), '-o', str(tmp_path / 'c.yaml')) as (link, lines, run),
          ExitStack() as idle):
        file, token = Path(lines[-1].rpartition(' is in ')[2]), link.partition('#')[2]
        assert (stat.S_IMODE(file.stat().st_mode), len(token)) == (0o600, 22)
        assert token not in '\n'.join(lines)
        at = urlsplit(link)
        for _ in range(300):
            idle.enter_context(socket.create_connection((at.hostname, at.port)))
        viewer = Viewer(link)
        assert viewer.got[0]['may']
        for _ in range(200):
            idle.enter_context(socket.create_connection((at.hostname, at.port)))
        assert not viewer.ask('fit')['success']  # it is answered
        assert viewer.code is None
        assert len(os.listdir(f'/proc/{run.pid}/fd')) < 200
        viewer.close()
        run.send_signal(signal.SIGINT)
        printed = run.communicate(timeout=PATIENCE)[0].splitlines()
        assert run.returncode == 0
        assert not file.exists()
    assert sum('ended a connection' in line for line in printed) == 1
    assert len(printed) < 20


def test_without_a_folder_for_the_link_the_page_only_shows(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
        ) -> None:
    monkeypatch.setenv('ROS_HOME', str(flat(tmp_path)))
    words, file = announce('http://127.0.0.1:1/#secret', 'live_page_1.txt')
    assert ('secret' in words, file) == (False, None)
    assert capfd.readouterr().out == ''


def test_a_terminal_shows_the_link_with_the_token(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    run = subprocess.Popen([*LIVE, str(flat(tmp_path)), '-o', str(tmp_path / 'c.yaml')],
                           stdout=theirs, env={**os.environ, 'ROS_HOME': str(tmp_path)})
    try:
        shown = b''
        while not re.search(rb'http://127.0.0.1:\d+/#[\w-]{22}\r\n', shown):
            shown += os.read(ours, 4096)
        assert not (tmp_path / 'accel_calib').exists()
        run.send_signal(signal.SIGINT)
        assert run.wait(PATIENCE) == 0
    finally:
        run.kill()
        run.wait()
        os.close(ours)
        os.close(theirs)


@contextmanager
def board(lines: Iterable[str]) -> Iterator[str]:
    """
    Yield the port of a board that sends these lines; their iterator sets the pace.

    As on a real port, bytes that nobody reads in time are lost. The board starts when the port is
    opened, as many do. Opening it discards what has arrived, so that only the second of two lines
    that are gone is known to be read.

    """
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    over = Event()

    def send() -> None:
        for _ in range(2):
            os.write(ours, b'\n')
            while struct.unpack('i', fcntl.ioctl(theirs, termios.FIONREAD, bytes(4)))[0]:
                if over.wait(0.001):
                    return
        for line in lines:
            if over.is_set():
                return
            with suppress(BlockingIOError):
                os.write(ours, line.encode('latin-1'))

    sender = Thread(target=send)
    sender.start()
    try:
        yield os.ttyname(theirs)
    finally:
        over.set()
        sender.join()
        os.close(ours)
        os.close(theirs)
