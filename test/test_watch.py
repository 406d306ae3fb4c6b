# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The view of ``accel-calib watch``, without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import io
import math
import os
from pathlib import Path
import subprocess
import sys
from typing import Any

from accel_calib.calibrate import next_pose
from accel_calib.errors import InputError
from accel_calib.session import Progress
from inside import changes, COMMAND, Guide, Plan, screen, state, unit, words_of
import numpy as np
import pytest
from rich.console import Console

ROOT = Path(__file__).parent.parent
NODE = '/left/calibrator'
NOISE_G = 0.0004


def guided() -> Iterator[Progress]:
    """Yield the progress of a person who follows the guidance, until more poses do not help."""
    directions = np.zeros((0, 3))
    while True:
        asked = next_pose(directions, noise_g=NOISE_G)
        up = () if asked.direction is None else tuple(asked.direction.tolist())
        guide = Guide()
        guide.plan = Plan(asked, len(directions), directions, NOISE_G, len(directions) / 20)
        action = guide.action
        assert action is not None
        yield Progress(
            still=True, stillness=0.5, dwell=0.6, min_dwell=1.0, poses=len(directions),
            total=asked.total, coverage=len(directions) / 20, accuracy=asked.error * NOISE_G,
            step=action.kind, advice=action.words, command=action.command, direction=up)
        if asked.direction is None:
            return
        directions = np.vstack([directions, asked.direction])


STEPS = list(guided())
START, MIDDLE, ENOUGH = STEPS[0], STEPS[7], STEPS[-1]
FITTED = replace(MIDDLE, step='done', advice='use the calibration', command='', direction=())


def drawn(view: Any, width: int = 80, height: int = 24, encoding: str = 'utf-8') -> str:
    """Return what a terminal of this size shows, without colours."""
    raw = io.BytesIO()
    file = io.TextIOWrapper(raw, encoding)
    Console(file=file, width=width, height=height, highlight=False).print(view)
    file.flush()
    return raw.getvalue().decode(encoding)


def row(shown: str, label: str) -> str:
    return next(line for line in shown.splitlines() if label in line)


@pytest.mark.parametrize('progress', [*STEPS, FITTED, replace(
    START, still=False, stillness=math.nan, accuracy=math.nan, step='', advice=''), replace(
    START, up=(0.6, 0.0, 0.8), length=1.0213, corrected=1.0002, temperature=-3.5)])
def test_figures_are_read_as_they_are_written(progress: Progress) -> None:
    figures = dict(progress.figures())
    found = Progress.from_figures({**figures, 'a figure of a later version': '1'})
    assert dict(found.figures()) == figures
    assert found.direction == pytest.approx(progress.direction, abs=1e-4)
    assert found.up == pytest.approx(progress.up, abs=1e-4)
    assert found.accuracy == pytest.approx(progress.accuracy, rel=0.01, nan_ok=True)
    assert (found.length, found.corrected, found.temperature) == pytest.approx(
        (progress.length, progress.corrected, progress.temperature), nan_ok=True)
    assert (found.still, found.poses, found.total) == (
        progress.still, progress.poses, progress.total)
    assert (found.step, found.advice, found.command) == (
        progress.step, progress.advice, progress.command)


@pytest.mark.parametrize(('name', 'text', 'words'), [
    ('poses', None, 'no figure poses'), ('still', 'perhaps', 'still: perhaps'),
    ('dwell [s]', 'long', 'dwell \\[s\\]: long')])
def test_figures_of_another_version_are_refused(name: str, text: str | None, words: str) -> None:
    figures = dict(START.figures())
    if text is None:
        del figures[name]
    else:
        figures[name] = text
    with pytest.raises(InputError, match=f'{words}, expected .* install the same version'):
        Progress.from_figures(figures)


def test_screen_shows_all_figures() -> None:
    shown = drawn(screen(NODE, MIDDLE))
    for words in (NODE, 'still, 0.50 times the limit', '0.6 s of 1 s', '7 of about 12',
                  '35% of the sphere', 'not determined by these poses', MIDDLE.advice,
                  'direction in sensor axes: +0.58 +0.58 -0.58'):
        assert words in shown
    assert f'{ENOUGH.accuracy * 1e3:.2g} mg expected' in drawn(screen(NODE, ENOUGH))


@pytest.mark.parametrize('signs', [
    np.array(signs, float) for signs in ((0, 0, 1), (1, -1, 0), (-1, 1, -1))], ids=str)
def test_every_next_pose_is_shown_in_large_words(signs: Any) -> None:
    words = words_of(signs)
    progress = replace(START, direction=tuple(unit(signs[np.newaxis])[0].tolist()),
                       advice=f'turn the sensor so that {words} points up')
    sides = words.removeprefix('the ').rsplit(' ', 1)[0].upper()
    large = drawn(screen(NODE, progress))
    assert sides not in large
    below = large[large.index('accuracy'):]
    assert '██' in below or '▀' in below
    assert all(len(line) == 80 for line in large.splitlines())
    assert f'│ {sides} ' in drawn(screen(NODE, progress), height=14)
    narrow = drawn(screen(NODE, progress), width=40)
    assert all(len(line) == 40 for line in narrow.splitlines())


def test_lengths_and_temperature_are_shown_if_they_are_known() -> None:
    before = drawn(screen(NODE, START))
    assert 'not known' in row(before, '|a|')
    assert 'temperature' not in before
    fitted = drawn(screen(NODE, replace(START, length=1.0213, corrected=1.0002,
                                        temperature=-3.5)))
    assert '1.0213 g, corrected 1.0002 g' in row(fitted, '|a|')
    assert '-3.5 °C' in row(fitted, 'temperature')


def test_terminal_without_unicode_gets_ascii() -> None:
    shown = drawn(screen(NODE, replace(MIDDLE, stillness=1.5)), encoding='ascii')
    assert 'FRONT LEFT BOTTOM' in shown
    assert '#|#' in row(shown, 'stillness')


def test_end_of_the_poses_is_clear() -> None:
    shown = drawn(screen(NODE, ENOUGH))
    assert 'more poses no longer help' in shown
    assert f'ros2 service call {NODE}/fit std_srvs/srv/Trigger' in shown
    assert '██████  ██  ██████' in shown  # FIT
    line, = changes(NODE, STEPS[-2], ENOUGH)
    assert 'more poses no longer help' in line
    assert line.endswith(f'~/fit: ros2 service call {NODE}/fit std_srvs/srv/Trigger')
    assert list(state(NODE, ENOUGH))[-1] == f'ros2 service call {NODE}/fit std_srvs/srv/Trigger'


@pytest.mark.parametrize(('step', 'words'), [
    ('refine', 'CALL REFINE'), ('level', 'SET LEVEL'), ('accept', 'ACCEPT'), ('done', 'DONE')])
def test_every_step_that_is_no_pose_is_shown_in_large_words(step: str, words: str) -> None:
    shown = drawn(screen(NODE, replace(FITTED, step=step)), height=14)
    assert f'│ {words} ' in shown
    large = drawn(screen(NODE, replace(FITTED, step=step)))
    assert words not in large
    assert '██' in large or '▀' in large


def test_missing_ros_is_one_line(tmp_path: Path) -> None:
    for name in ('diagnostic_msgs', 'rclpy'):
        (tmp_path / f'{name}.py').write_text(f"raise ImportError('no {name}')\n")
    paths = [str(tmp_path), str(ROOT)]
    done = subprocess.run(
        [sys.executable, *COMMAND, 'watch', '--once'], capture_output=True, text=True, timeout=60,
        check=False, cwd=tmp_path, env={**os.environ, 'PYTHONPATH': os.pathsep.join(paths)})
    assert done.returncode == 2
    line, = done.stderr.splitlines()
    assert 'ROS 2 is not installed' in line
    assert 'source /opt/ros/jazzy/setup.bash' in line
