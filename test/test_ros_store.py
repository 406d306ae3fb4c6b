# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The node with damaged files: it starts, says what it set aside, and works."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path
import signal
from typing import Any

from accel_calib.stored import read_calibration
from inside import spread_directions
import pytest


@pytest.mark.parametrize('named', [True, False])
def test_the_node_starts_with_a_nested_calibration_and_a_pipe_as_poses(
        named: bool, bench: Any, readings: Callable[..., Any]) -> None:
    folder = bench.home / 'accel_calib'
    folder.mkdir(parents=True)
    path = folder / ('arm.yaml' if named else 'imu.data_raw@imu_link.yaml')
    path.write_text(f'format: accel_calib calibration\nx: {"[" * 100_000}\n')
    os.mkfifo(path.with_name(f'{path.stem}_poses.csv'))
    node = bench.calibrator(passthrough=True, **({'sensor': 'arm'} if named else {}))
    bench.feed(readings(spread_directions(12)))
    answer = bench.call('fit')
    assert answer.success, answer.message
    status, printed = bench.end(node, signal.SIGINT)
    assert status == 0, printed
    assert 'Traceback' not in printed
    for name in (f'{path.name}.damaged1', f'{path.stem}_poses.csv.damaged1'):
        assert f'kept as {folder / name}' in printed
        assert Path(folder / name).exists()
    assert read_calibration(path).model.effects
