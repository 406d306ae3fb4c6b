# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Samples of a serial port (a pseudo-terminal) and of a recording that is played in real time."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
import time

from accel_calib.errors import InputError
from accel_calib.files import LogOptions
from accel_calib.files.logs.read import read_log
from accel_calib.live.sources import is_port, open_source
from accel_calib.table import Floats
import numpy as np
import pytest
from serial_board import board

RATE_HZ = 200.0


def readings(count: int) -> Floats:
    """Return readings of a sensor that lies flat [g]."""
    return np.array([0.02, -0.01, 1.0]) + 0.001 * np.random.default_rng(1).normal(size=(count, 3))


def paced(line: Callable[[int], str], count: int = 4000) -> Iterator[str]:
    """Yield lines at the rate of the samples."""
    begin = time.monotonic()
    for k in range(count):
        while time.monotonic() < begin + k / RATE_HZ:
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


def numbers(reading: Sequence[float]) -> str:
    return ','.join(f'{part:.5f}' for part in reading)


def test_lines_of_a_board_become_samples_with_their_times_and_temperature() -> None:
    reading = readings(4000)
    with board(paced(lambda k: f'{5 * k},{numbers(reading[k])},24.5\n')) as port:
        options = LogOptions(columns={'time': '1', 'ax': '2', 'ay': '3', 'az': '4',
                                      'temperature': '5'})
        with open_source(port, options) as source:
            assert source.units.name == 'g'
            assert 'ms' in source.read_as
            found = samples(source.blocks, 700)
    assert np.allclose(np.diff(found[:, 0]), 0.005)
    first = round(found[0, 0] / 0.005)
    np.testing.assert_allclose(found[:, 1:4], reading[first:first + len(found)], atol=1e-5)
    assert np.isnan(found[:, 4:7]).all()
    assert (found[:, 7] == 24.5).all()


def test_boot_messages_and_garbled_lines_are_skipped() -> None:
    reading = readings(4000)

    def line(k: int) -> str:
        if k < 5:
            return f'rst:0x1 (POWERON_RESET), boot {k}\r\n'
        if k == 5:
            return 'time_ms;accX;accY;accZ;gyroX_dps;gyroY_dps;gyroZ_dps\r\n'
        if k in (300, 450):
            return f'{5 * k};0.0\x00\x81;\r\n'
        return f'{5 * k};{numbers(reading[k]).replace(",", ";")};0.1;0.2;0.3\r\n'

    with board(paced(line)) as port, open_source(port, LogOptions()) as source:
        found = samples(source.blocks, 600)
    assert np.isfinite(found[:, :7]).all()
    np.testing.assert_allclose(found[:, 4:7], np.tile(np.radians([0.1, 0.2, 0.3]),
                                                      (len(found), 1)))
    assert 0.015 in np.round(np.diff(found[:, 0]), 6) or 0.01 in np.round(
        np.diff(found[:, 0]), 6)


def test_lines_without_times_get_the_measured_rate() -> None:
    reading = readings(4000)
    with board(paced(lambda k: f'{numbers(reading[k])}\n')) as port, open_source(
            port, LogOptions()) as source:
        assert '(measured)' in source.read_as
        found = samples(source.blocks, 600)
    assert np.mean(np.diff(found[:, 0])) == pytest.approx(1.0 / RATE_HZ, rel=0.1)


def test_a_stated_rate_is_used_for_lines_without_times() -> None:
    with board(paced(lambda k: f'{numbers(readings(1)[0])}\n')) as port, open_source(
            port, LogOptions(rate=100.0)) as source:
        assert '100 Hz (stated)' in source.read_as
        found = samples(source.blocks, 500)
    np.testing.assert_allclose(np.diff(found[:, 0]), 0.01)


def test_bytes_at_another_baud_rate_are_refused_with_that_advice(
        monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('accel_calib.live.sources._PATIENCE_S', 3.0)
    noise = np.random.default_rng(2).integers(128, 255, size=(4000, 30), dtype=np.uint8)
    with (board(paced(lambda k: noise[k].tobytes().decode('latin-1') + '\n')) as port,
          pytest.raises(InputError, match='baud rate 9600'),
          open_source(port, LogOptions(), baud=9600)):
        pass


def test_a_port_that_is_removed_is_waited_for_and_read_again(tmp_path: Path) -> None:
    port, reading = tmp_path / 'ttyUSB0', readings(4000)

    def line(k: int) -> str:
        return f'{5 * k},{numbers(reading[k])}\n' if k > 5 else f'rst:0x1, boot {k}\r\n'

    with ExitStack() as first, ExitStack() as opened:
        port.symlink_to(first.enter_context(board(paced(line))))
        source = opened.enter_context(open_source(str(port), LogOptions()))
        assert len(samples(source.blocks, 100)) >= 100
        assert source.problem() == ''
        port.unlink()
        first.close()
        ends = time.monotonic() + 5.0
        while not source.problem():
            next(source.blocks)
            assert time.monotonic() < ends
        assert 'connect the sensor again' in source.problem()
        with board(paced(line)) as second:
            port.symlink_to(second)
            found = samples(source.blocks, 100)
            assert source.problem() == ''
    assert np.isfinite(found[:, :4]).all()
    assert 0.0 < found[-1, 0] < 10.0  # the clock of the board has started again


def test_a_number_that_is_too_large_costs_one_line() -> None:
    reading = readings(4000)

    def line(k: int) -> str:
        return f'{5 * k},0.0,1e300,1.0\n' if k == 600 else f'{5 * k},{numbers(reading[k])}\n'

    with board(paced(line)) as port, open_source(port, LogOptions()) as source:
        found = samples(source.blocks, 800)
    assert np.abs(found[:, 1:4]).max() < 2.0


def test_a_port_that_does_not_exist_is_refused_in_one_line() -> None:
    with (pytest.raises(InputError, match='cannot be opened'),
          open_source('/dev/ttyUSB87', LogOptions())):
        pass


def test_a_recording_is_played_in_real_time(tmp_path: Path) -> None:
    reading = readings(400)
    path = tmp_path / 'recording.csv'
    stamps = np.arange(400) / RATE_HZ
    stamps[300:] += 1000.0
    np.savetxt(path, np.column_stack([stamps, reading]), delimiter=',', header='time,ax,ay,az',
               comments='')
    assert not is_port(str(path))
    with open_source(str(path), LogOptions(units='g'), speed=2.0) as source:
        begin = time.monotonic()
        arrivals = [(time.monotonic() - begin, len(block), block) for block in source.blocks]
    found = np.concatenate([block for _, _, block in arrivals])
    table = read_log(path, LogOptions(units='g')).table
    np.testing.assert_array_equal(found[:, 1:4], table.reading)
    np.testing.assert_array_equal(found[:, 0], table['time'])
    half = next(when for when, _, block in arrivals if len(block) and block[-1, 0] >= 0.8)
    assert half > 0.35  # it may be late, but never early
    assert max(size for _, size, _ in arrivals) < 400
