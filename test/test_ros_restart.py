# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Shutdown of the nodes by signals and by a kill, and restart."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import signal
import subprocess
import sys
from typing import Any

from accel_calib.files import read_calibration, read_poses
from accel_calib.sphere import spread_directions
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
KILLS = 4


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize('name', ['calibrator', 'simulator'])
def test_signals_end_the_nodes_with_status_0(bench: Any, name: str, number: int) -> None:
    node = bench.start(name)
    bench.spin(lambda: bench.node.count_publishers('imu/data_calibrated')
               or bench.node.count_publishers('imu/data_raw'))
    bench.spin(iter([False, False, True]).__next__)
    status, printed = bench.end(node, number)
    assert status == 0, printed
    assert 'Traceback' not in printed


def test_files_are_complete_after_a_kill_at_any_moment(
        bench: Any, readings: Callable[..., Any]) -> None:
    turned = readings(spread_directions(12))
    pauses = np.random.default_rng(5).uniform(0.1, 0.9, KILLS)
    table = bench.home / 'accel_calib' / 'arm_poses.csv'
    stored = bench.home / 'accel_calib' / 'arm.yaml'
    fewest = 0
    for pause in pauses:
        node = bench.calibrator(sensor='arm', auto_fit=True, auto_fit_poses=10, passthrough=True)
        bench.feed(turned[:round(pause * len(turned))])
        bench.end(node, signal.SIGKILL)
        bench.join_anew()
        if table.exists():
            assert len(read_poses(table)) >= fewest
            fewest = len(read_poses(table))
        if stored.exists():
            assert read_calibration(stored).sensor == 'arm'
    assert fewest >= 4


@pytest.mark.parametrize(('given', 'words'), [
    ('gravity:=900.0', 'gravity'), ('still_window:=wide', 'still_window'),
    ('model:=11', 'expected one of auto'), ('max_dwell:=1.5', 'contradict each other')])
def test_bad_parameters_get_one_line_and_status_2(bench: Any, given: str, words: str) -> None:
    node = bench.start('calibrator', **dict([given.split(':=')]))
    printed = node.communicate(timeout=10)[0]
    assert node.returncode == 2
    assert words in printed
    assert len(printed.strip().splitlines()) == 1, printed


def test_effect_that_is_not_in_the_catalogue_ends_the_simulator(bench: Any) -> None:
    node = bench.start('simulator', effects=['nonsense=1'])
    printed = node.communicate(timeout=10)[0]
    assert node.returncode == 2
    assert 'nonsense' in printed.strip().splitlines()[0]


def test_without_ros_there_is_one_line_and_status_2(tmp_path: Path) -> None:
    (tmp_path / 'rclpy.py').write_text("raise ImportError('no rclpy')\n")
    paths = [str(tmp_path), str(ROOT)]
    done = subprocess.run(
        [sys.executable, '-c', 'import sys\nfrom accel_calib.ros.calibrator import main\n'
         'sys.exit(main())'], env={**os.environ, 'PYTHONPATH': os.pathsep.join(paths)},
        capture_output=True, text=True, timeout=30, check=False, cwd=tmp_path)
    assert done.returncode == 2
    assert 'source /opt/ros/jazzy/setup.bash' in done.stderr
    assert len(done.stderr.splitlines()) == 1
