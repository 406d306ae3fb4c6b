# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pages of a calibration and of a refinement: complete, self-contained, readable."""

import re

from accel_calib.refine import refine
from accel_calib.report import refinement_page
from accel_calib.units import Units
from inside import all_drawings, curve_parts, model_with, simulate_poses
import numpy as np
from page_parser import parsed
import pytest
from shared import random_directions

pytest.importorskip('matplotlib')


def refined(base='10', poses=60, knocked=(), **hidden):
    rng = np.random.default_rng(5)
    model = model_with({'offset': np.array([0.02, -0.01, 0.03]),
                        'axis_gain': np.array([0.01, -0.02, 0.005]), **hidden})
    time = np.arange(poses) * 20.0
    context = {'time': time, 'temperature': 30.0 + 10.0 * np.sin(time / 190.0)}
    table = simulate_poses(model, random_directions(poses, rng), rng, noise_g=0.002,
                           context=context)
    reading = table.reading.copy()
    for row in knocked:
        reading[row - 1] *= 1.05
    return refine(table.with_columns(reading=reading), Units('g', 1.0), base=base)


@pytest.fixture(scope='module')
def warm():
    return refined(knocked=(9,), offset_temperature=np.array([2e-4, -1e-4, 1.5e-4]))


@pytest.fixture(scope='module')
def text(warm):
    return refinement_page(warm, '<b onload="x">&.csv')


def test_page_is_complete_and_self_contained(text):
    found = parsed(text)
    assert not found.open
    assert len(found.ids) == len(set(found.ids))
    referred = set(re.findall(r'(?:href="|url\()#([^")]+)', text))
    assert referred <= set(found.ids)
    assert not re.search(r'https?:|//[a-z]|<link|<img|@import|src=|fetch|XMLHttp|WebSocket', text)
    assert '<html lang="en">' in text
    assert 'name="viewport"' in text
    assert '<b onload' not in text
    assert '&lt;b onload=&quot;x&quot;&gt;&amp;.csv' in text


def test_before_and_after_have_one_scale(warm):
    figures = {drawing.name: drawing.figure for drawing in all_drawings(warm)}
    ladder = {text.get_text() for text in figures['ladder'].axes[0].texts}
    assert '+ offset_temperature' in ladder
    before, after = (figures[f'step1_offset_temperature_variable_{when}'].axes[0]
                     for when in ('before', 'after'))
    assert before.get_ylim() == after.get_ylim()
    assert before.get_ylim()[0] == -before.get_ylim()[1]
    maps = [figures[f'step1_offset_temperature_sphere_{when}'].axes[0].collections[-1]
            for when in ('before', 'after')]
    assert maps[0].get_clim() == maps[1].get_clim()


@pytest.fixture(scope='module')
def bumpy():
    """Return a refinement of an offset of z that is larger near 35 °C, and that bump."""
    rng = np.random.default_rng(5)
    warm = rng.uniform(10.0, 50.0, 100)
    poses = simulate_poses(
        model_with({'offset': np.array([0.02, -0.01, 0.03])}), random_directions(100, rng), rng,
        noise_g=0.001, context={'time': np.arange(100) * 20.0, 'temperature': warm})
    shift = np.zeros((100, 3))
    shift[:, 2] = bump(warm)
    return refine(poses.with_columns(reading=poses.reading + shift), Units('g', 1.0), base='10')


def bump(warm):
    return 0.004 * np.exp(-((warm - 35.0) / 5.0) ** 2)


def test_figure_of_a_curve_shows_the_truth_within_its_band(bumpy):
    step = bumpy.steps[-1]
    assert bumpy.verdict == 'described'
    assert step.effect == 'empirical'
    parts = {part.name: part for part in curve_parts(bumpy, step.name)}
    for name, part in parts.items():
        truth = bump(part.at) - np.mean(bump(part.poses)) if name == 'z' else 0.0
        np.testing.assert_array_less(np.abs(part.change - truth), 6.0 * part.deviation + 2e-4)
        np.testing.assert_allclose(part.poses, bumpy.poses_g['temperature'])
    assert np.ptp(parts['z'].change) == pytest.approx(0.004, rel=0.15)

    figures = {drawing.name: drawing.figure for drawing in all_drawings(bumpy)}
    panel = figures[f'step{len(bumpy.steps)}_curve'].axes[0]
    assert panel.get_xlabel() == 'temperature [°C]'
    assert panel.get_ylabel() == 'change from the mean [mg]'
    assert len(panel.collections) == len(parts)
    ticks = [line for line in panel.lines if line.get_marker() == '|']
    np.testing.assert_allclose(ticks[0].get_xdata(), bumpy.poses_g['temperature'])
    band = panel.collections[0].get_paths()[0].vertices[:, 1]
    first = next(iter(parts.values()))
    assert np.max(band) == pytest.approx(1e3 * np.max(first.change + 1.96 * first.deviation))
