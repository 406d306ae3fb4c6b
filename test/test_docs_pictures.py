# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pictures of the documentation are those that the code draws."""

import importlib
from pathlib import Path
import re
from xml.etree import ElementTree

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'docs' / 'pictures'
LARGEST = 300_000  # bytes
RUN_AGAIN = 'run: python docs/pictures.py'


@pytest.fixture
def pictures(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    return importlib.import_module('pictures')


def without_numbers(text):
    return re.sub(r'[-−]?[\d.]+(e-?\d+)?', '#', text)


def test_the_picture_of_the_poses_is_drawn_from_the_planner(pictures):
    assert (FOLDER / 'poses.svg').read_text('utf-8') == pictures.poses_svg(), RUN_AGAIN


def test_the_drawn_poses_are_twelve_directions_that_determine_the_largest_model(pictures):
    directions = np.array([direction for direction, _ in pictures.asked_poses()])
    assert len(directions) == 12
    cosines = directions @ directions.T - 2.0 * np.eye(12)
    assert np.degrees(np.arccos(cosines.max())) > 30.0


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_side_that_points_up_is_on_top_of_the_drawing(pictures, axis, sign):
    up = np.zeros(3)
    up[axis] = sign
    mat_ws = pictures._attitude(up)
    np.testing.assert_allclose(mat_ws @ up, [0.0, 0.0, 1.0], atol=1e-12)
    assert np.linalg.det(mat_ws) == pytest.approx(1.0)
    assert pictures._seen(mat_ws @ up)[1] < pictures._seen(np.zeros(3))[1]


def test_terminals_show_what_the_commands_print(pictures, tmp_path):
    pictures.prepare(tmp_path)
    for name, commands in pictures.TERMINALS.items():
        drawn = pictures.terminal_svg(name, pictures.recorded(commands, tmp_path))
        stored = (FOLDER / f'{name}.svg').read_text('utf-8')
        assert without_numbers(pictures.shown_text(stored)) == without_numbers(
            pictures.shown_text(drawn)), RUN_AGAIN


def test_lines_of_a_terminal_appear_one_after_the_other(pictures):
    lines = [pictures.Line('first', 0.5), pictures.Line('\x1b[1msecond\x1b[0m', 1.25)]
    svg = pictures.terminal_svg('verify', lines)
    shown = re.findall(r'animation-delay:([\d.]+)s[^>]*>([^<]+)<', svg)
    assert [(float(at), text.strip()) for at, text in shown if text.strip()] == [
        (0.5, 'first'), (1.25, 'second')]
    assert 'prefers-reduced-motion' in svg


@pytest.mark.parametrize('path', sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_pictures_are_small_and_need_no_network(path):
    assert path.stat().st_size < LARGEST
    if path.suffix == '.svg':
        root = ElementTree.parse(path).getroot()
        assert root.get('role') == 'img'
        assert root.get('aria-label') or root.get('aria-labelledby')
        text = path.read_text('utf-8').replace('http://www.w3.org/2000/svg', '')
        assert 'http' not in text
