# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated Imu, and the demonstration with it."""

from dataclasses import replace
import json
from pathlib import Path
import signal
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any

from accel_calib.errors import AccelCalibError
from accel_calib.geometry import coverage
from faults.sample import FACTOR, sample
from geometry_msgs.msg import Vector3Stamped
from inside import DEMO_CHOICES, main, own_domain
from inside_ros import SimulatedImu, SimulatorSettings
import numpy as np
import pytest
from std_srvs.srv import Trigger

RATE = 50.0
SETTINGS = SimulatorSettings(poses=40, mixed=True, dwell=0.4, turn=0.1, rate=RATE,
                             flat_last=False, temperature=[15.0, 35.0], temperature_period=5.0)


# The ports of domains from 215 on are above those that Linux gives out.
@pytest.mark.parametrize(('domain', 'port'), [(229, 2), (230, 10), (231, 12), (232, 28)])
def test_a_domain_is_not_used_beside_a_node_that_is_left_over(domain: int, port: int) -> None:
    with socket(AF_INET, SOCK_DGRAM) as left_over:
        left_over.bind(('127.0.0.1', 7400 + 250 * domain + port))
        with pytest.raises(AccelCalibError, match='all in use'), own_domain([domain]):
            pass
    with own_domain([domain]) as number:
        assert number == domain


def test_temperature_swings_and_each_part_of_the_poses_is_spread() -> None:
    samples = SimulatedImu(SETTINGS).samples(1000)
    expected = 25.0 - 10.0 * np.cos(2.0 * np.pi * samples['time'] / 5.0)
    np.testing.assert_allclose(samples['temperature'], expected, atol=1e-9)
    starts = np.round(np.arange(40) * 25).astype(int)
    for first in (0, 12, 24):
        assert coverage(samples['reference'][starts[first:first + 16]]) > 0.9
    ordered = SimulatedImu(replace(SETTINGS, mixed=False)).samples(1000)['reference'][starts]
    assert coverage(ordered[:16]) < 0.8


def test_parts_of_the_samples_are_the_samples_at_once() -> None:
    settings = replace(SETTINGS, noise=0.0, gyro_noise=0.0, effects=[
        'offset_temperature=8e-4,-6e-4,1e-3,12,0'])
    parts, whole = SimulatedImu(settings), SimulatedImu(settings).samples(600)
    sizes = [1, 7, 200, 392]
    found = [parts.samples(size) for size in sizes]
    assert [len(part) for part in found] == sizes
    for key in ('time', 'reading', 'reference', 'rate', 'temperature'):
        np.testing.assert_allclose(np.concatenate([part[key] for part in found]), whole[key],
                                   atol=1e-12)


def test_the_samples_end_after_the_last_pose_unless_it_is_held_or_comes_again() -> None:
    poses, whole = 3, 3 * 20 + 2 * 5
    ended = SimulatedImu(replace(SETTINGS, poses=poses, hold=False)).samples(1000)
    assert len(ended) == whole
    held = SimulatedImu(replace(SETTINGS, poses=poses)).samples(1000)['reference']
    assert np.all(held[whole:] == held[whole - 1])
    again = SimulatedImu(replace(SETTINGS, poses=poses, loop=True)).samples(1000)['reference']
    np.testing.assert_array_equal(again[whole + 5:whole + 5 + 20], again[:20])


@pytest.mark.parametrize('number', sample((signal.SIGINT, signal.SIGTERM), 1))
def test_the_node_is_turned_by_its_services_and_ended_by_signals(bench: Any, number: int) -> None:
    truth = bench.listen(Vector3Stamped, 'simulator/truth')
    given = {'poses': 2, 'dwell': 0.0, 'turn': 0.2, 'flat_last': False}
    node = bench.start('simulator', **given)
    first, second = 9.80665 * SimulatedImu(SimulatorSettings(**given)).directions

    def call(name: str) -> Any:
        return bench.ask(Trigger, f'simulator/{name}')

    def up() -> tuple[float, ...]:
        vector = truth[-1].vector
        return vector.x, vector.y, vector.z

    bench.spin(lambda: len(truth) > 100)
    assert up() == pytest.approx(first)
    assert call('next').success
    bench.spin(lambda: np.allclose(up(), second) and all(
        each.vector == truth[-1].vector for each in truth[-100:]))
    assert not call('next').success
    assert call('flat').success
    bench.spin(lambda: up() == (0.0, 0.0, 9.80665))
    status, printed = bench.end(node, number)
    assert status == 0, printed
    assert 'Traceback' not in printed


@pytest.mark.parametrize('hidden', ('temperature',) if FACTOR == 1 else (None, *DEMO_CHOICES))
def test_the_demonstration_calibrates_and_finds_what_is_hidden(
        hidden: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ('ROS_DOMAIN_ID', 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'ROS_HOME', 'ROS_LOG_DIR'):
        monkeypatch.setenv(name, '')  # the demonstration sets them
    result = tmp_path / 'result.json'
    given = ['--hidden', hidden] if hidden else []
    assert main(['demo', *given, '--json', str(result)]) == 0
    outcome = json.loads(result.read_text())
    # The sensor has a cross-axis gain, which the drift hides from a fit without temperature.
    assert {*outcome['found']} - {'cross_axis'} == ({outcome['hidden']} if hidden else set())
    assert outcome['hidden'] == (DEMO_CHOICES[hidden].partition('=')[0] if hidden else '')
    assert outcome['vector_before_mg'] > 2.0
    assert outcome['vector_after_mg'] < 0.3 * outcome['vector_before_mg']
    assert outcome['rms_after_mg'] < 1.0
    assert outcome['tilt_after_deg'] < 0.2
    printed = capsys.readouterr().out
    assert 'RMS [mg]' in printed  # a table takes brackets for markup
    assert '\\' not in printed
    assert ('~/refine: ' in printed) == bool(hidden)
    assert printed.count('from the truth') == outcome['rests'] * (2 if hidden else 1)
