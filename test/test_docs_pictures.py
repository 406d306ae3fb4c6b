# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pictures of the documentation are those that the code draws."""

import importlib
from pathlib import Path
import re
from xml.etree import ElementTree

from faults.sample import FACTOR
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


@pytest.mark.skipif(FACTOR == 1, reason='commands run for half a minute: .ci/run')
def test_terminals_show_what_the_commands_print(pictures, tmp_path):
    pictures.prepare(tmp_path)
    for name, commands in pictures.TERMINALS.items():
        drawn = pictures.terminal_svg(name, pictures.recorded(commands, tmp_path))
        stored = (FOLDER / f'{name}.svg').read_text('utf-8')
        assert without_numbers(pictures.shown_text(stored)) == without_numbers(
            pictures.shown_text(drawn)), RUN_AGAIN


@pytest.mark.parametrize('path', sorted(FOLDER.iterdir()), ids=lambda path: path.name)
def test_pictures_are_small_and_need_no_network(path):
    assert path.stat().st_size < LARGEST
    if path.suffix == '.svg':
        root = ElementTree.parse(path).getroot()
        assert root.get('role') == 'img'
        assert root.get('aria-label') or root.get('aria-labelledby')
        text = path.read_text('utf-8').replace('http://www.w3.org/2000/svg', '')
        assert 'http' not in text
