# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The pages of results: complete, self-contained, readable."""

from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
import re

import accel_calib as ac
from accel_calib.comparison import compare, history_of
from accel_calib.errors import InputError
from accel_calib.finding import Finding, NextStep
from accel_calib.findings import rate, Rating
from accel_calib.refinement import refine
from accel_calib.report import calibration_page, refinement_page
from accel_calib.statistics import rms
from accel_calib.text import milli
from inside import (
    all_drawings, axis_figures, comparison_page, curve_parts, drawn, linear_model, model_with,
    page_of, residuals_of, simulate_poses)
from live_bench import PATIENCE
import numpy as np
from playwright.sync_api import expect
import pytest
from shared import changed, G, random_directions, SENSOR

pytest.importorskip('matplotlib')

HOSTILE = '</script><script>alert(1)</script></title><b onload="x">&\''


VOID = {'meta', 'br', 'link', 'img', 'hr', 'input'}


class Parsed(HTMLParser):
    """The tags of a page, with a check that every tag that opens is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.tags, self.texts, self.marks = [], [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs, tuple(self.open)))
        self.ids += [attrs['id']] if 'id' in attrs else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if self.open[-2:] == ['use', 'title']:
            self.marks.append(data)

    def named(self, wanted):
        return [attrs for tag, attrs, _ in self.tags if tag == wanted]


def simulated(seed=0, poses=24, units='m/s2', **options):
    return ac.simulate(SENSOR, poses=poses, seed=seed, units=units,
                       temperature=np.linspace(20.0, 40.0, poses),
                       time=np.arange(poses) * 10.0, **options)


@pytest.fixture(scope='module')
def poses():
    return simulated()


@pytest.fixture(scope='module')
def calibration(poses):
    return ac.fit(poses, flat=1, sensor='imu_link')


@pytest.fixture(scope='module')
def text(calibration):
    return calibration_page(calibration, rate(calibration), 'poses.csv')


@pytest.fixture(scope='module')
def dated():
    """Return calibrations of a sensor whose offset of z jumps between the third and the fourth."""
    found = []
    for k in range(5):
        offset = [0.02, -0.01, 0.03 + (0.004 if k > 2 else 0.0)]
        table = ac.simulate({**SENSOR, 'offset': offset}, poses=24, seed=k,
                            temperature=[20.0 + k, 22.0 + k])
        found.append(replace(ac.fit(table), sensor='imu_link',
                             date=f'2026-0{k + 1}-12T10:00:00+00:00'))
    return found


def rows_in(found, tag):
    """Return the rows of the poses that tags of a page are about."""
    return [each['data-row'] for each in found.named(tag) if 'data-row' in each]


def test_every_figure_has_a_text_and_every_pose_can_be_pointed_at(text, poses, calibration):
    found = Parsed(text)
    figures, live = found.named('svg'), found.named('figure')
    assert len(live) == len(figures) == 4
    assert all(each['role'] == 'img' and each['aria-label'] for each in figures)
    assert all(each['tabindex'] == '0' and each['aria-label'] for each in live)
    for row, warm, before, after in zip(
            poses.row, poses['temperature'], residuals_of(calibration).before_mg,
            residuals_of(calibration).after_mg, strict=True):
        one, other = (f'row {row}, {milli(value, signed=True)} mg, {warm:.0f} °C'
                      for value in (before, after))
        mine = [mark for mark in found.marks if mark.startswith(f'row {row}, ')]
        # Before; coverage, after, by direction, against temperature and against time.
        assert sorted(mine) == sorted([one, *[other] * 5])
    assert {*rows_in(found, 'tr')} == {*rows_in(found, 'use')} == {*map(str, poses.row)}


def test_labels_of_a_small_quantity_are_apart():
    with drawn(2.0) as (figure, (panel,)):
        panel.plot([6.6e-5, 3.94e-4], [0.0, 1.0])
        figure.draw_without_rendering()
        labels = [each.get_window_extent() for each in panel.get_xticklabels()]
    assert all(one.x1 + one.height < other.x0 for one, other in pairwise(labels))


def test_hostile_names_are_text(calibration, poses):
    labelled = poses.with_columns(label=np.array([HOSTILE] * len(poses)))
    hostile = replace(calibration, sensor=HOSTILE, date=HOSTILE, reason=HOSTILE, poses=labelled,
                      noted=(Finding('note', HOSTILE),))
    rating = Rating('GOOD', HOSTILE, HOSTILE, NextStep('done', HOSTILE))
    text = calibration_page(hostile, rating, HOSTILE, stored=HOSTILE, notes=(HOSTILE,))
    found = Parsed(text)
    assert not found.open
    assert text.count('<script>') == 1
    assert '<b onload' not in text
    assert not [attrs for _, attrs, _ in found.tags if 'onload' in attrs]
    assert '<b onload="x">' in ''.join(found.texts)
    shown = comparison_page(compare([hostile, hostile]), rating, [Path(HOSTILE)] * 2,
                            [hostile, hostile])
    assert shown.count('<script>') == 1
    assert '<b onload' not in shown


def opened(browser, path, text):
    """Return a page of this text in a browser, and a list of what its console says."""
    path.write_text(text, encoding='utf-8')
    page, complaints = browser.new_page(), []
    page.on('console', lambda line: complaints.append(line.text))
    page.on('pageerror', lambda error: complaints.append(str(error)))
    page.goto(path.as_uri())
    return page, complaints


def test_the_script_of_a_page_runs_under_its_policy(browser, text, tmp_path):
    page, complaints = opened(browser, tmp_path / 'page.html', text)
    expect(page.locator('#tip')).to_be_hidden()
    page.locator('figure.live').first.focus()
    page.keyboard.press('ArrowRight')
    expect(page.locator('#tip')).to_be_visible()
    expect(page.locator('#tip')).to_contain_text('row 2')
    assert page.locator('.lit').count() > 1
    assert page.locator('main').evaluate('(e) => getComputedStyle(e).maxWidth') != 'none'
    assert complaints == []
    page.close()


@pytest.mark.parametrize('has_script', [True, False])
def test_the_policy_of_a_page_stops_what_is_not_its_own(browser, tmp_path, has_script):
    hostile = ('<script>document.title = "ran"</script><img src="x:" onerror="document.title = 1">'
               '<link rel="stylesheet" href="https://127.0.0.1:9/x.css">'
               '<iframe srcdoc="x"></iframe><form action="https://127.0.0.1:9/">')
    rating = Rating('GOOD', 'reason', 'figures', NextStep('done', 'nothing'))
    text = page_of('comparison', 'Title', [], rating, script=has_script, **dict.fromkeys(
        ('history', 'drawings', 'runs', 'parameters', 'notes'), ()))
    page, complaints = opened(browser, tmp_path / 'page.html',
                              text.replace('</main>', f'{hostile}</main>'))
    for each in ('script', 'event handler', 'image', 'stylesheet'):
        assert any(each in line for line in complaints), (each, complaints)
    assert page.title() == 'Good: title'
    with page.expect_console_message(lambda line: 'form' in line.text, timeout=PATIENCE):
        page.evaluate('document.forms[0].submit()')
    page.close()


@pytest.mark.parametrize(('model', 'units', 'known'), [
    ('4', 'm/s2', False), ('7', 'g', False), ('9', 'm/s2', False), ('10', 'native', False),
    ('12', 'm/s2', True)])
def test_residuals_are_those_of_the_quality(model, units, known):
    table = simulated(units='m/s2' if units == 'native' else units, reference=known)
    if units == 'native':
        table = replace(table, columns={**table.columns, 'reading': table.reading * 1671.0,
                                        'std': table['std'] * 1671.0}, units='native')
    fitted = ac.fit(table, model=model)
    residuals = residuals_of(fitted)
    quality = fitted.quality
    assert np.sqrt(np.mean(residuals.before_mg ** 2)) == pytest.approx(quality.rms_before_mg)
    assert rms(residuals.after_mg) == pytest.approx(quality.rms_after_mg, rel=1e-6)
    assert residuals.signed is not known
    if model in '4 12':
        text = calibration_page(replace(fitted, sensor=''), rate(fitted), '')
        assert '<h1>Calibration</h1>' in text  # without a name
        assert 'id="coverage-up"' in text
        assert '0 ± 0' not in text
        assert ('gain all axes' in text) is (model == '4')
        assert ('angle' in text) is (model == '12')  # others are absent


def test_figures_by_axis_are_those_of_the_axes():
    apart = np.radians(89.0)
    mat = np.diag([1.01, 1.0, 0.99]) @ np.array(
        [[np.sin(apart), np.cos(apart), 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    model = linear_model('12', mat, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(axis_figures(model.vector, model.effects),
                               [0.1, 0.2, 0.3, 1.01, 1.0, 0.99, 89.0, 90.0, 90.0])


def test_lines_of_c_and_of_python_correct_as_apply_does(calibration, tmp_path):
    path = tmp_path / "robot's.yaml"
    calibration.save(path)
    text = calibration_page(calibration, rate(calibration), '', stored=str(path))
    lines = {title: unescape(code) for title, code in re.findall(
        r'(?s)<h3>(.*?)</h3>\s*<pre tabindex="0"><code>(.*?)</code>', text)}
    reading = np.array([[1, -4, 9], [-9, 3, 1.0]])
    numbers = [float(value) for value in re.findall(r'(-?\d\.\d+e[+-]\d+)f', lines['C'])]
    vec, mat = np.array(numbers[:3]), np.reshape(numbers[3:], (3, 3))
    known = {'readings': reading}
    exec(lines['Python'], known)
    for found in ((reading - vec) @ mat.T, known['force']):
        np.testing.assert_allclose(found, calibration.apply(reading), rtol=1e-6)


def test_history_is_in_order_of_date_and_finds_the_change(dated):
    shuffled = [dated[k] for k in (3, 0, 4, 2, 1)]
    history = history_of(shuffled)
    assert [moment.index for moment in history.moments] == [1, 4, 3, 0, 2]
    assert [change.comparison.agree for change in history.changes] == [True, True, False, True]
    jump = history.changes[2]
    assert jump.parameter == 'offset.z'
    assert jump.change == pytest.approx(0.004, abs=4.0 * jump.sd)
    assert [moment.temperature for moment in history.moments] == pytest.approx(
        [21.0, 22.0, 23.0, 24.0, 25.0])
    offset = next(each for each in history.parameters if each.name == 'offset.z')
    expected = [each.offset[2] / 9.80665 for each in dated]
    np.testing.assert_allclose(offset.values, expected, atol=1e-9)


def test_labels_of_a_history_are_its_dates_with_the_time_where_a_day_has_several(dated):
    morning, evening, undated, wrong = (replace(dated[0], date=date) for date in (
        '2026-03-12T08:30:00+00:00', '2026-03-12T19:30:00+00:00', '', 'Monday'))
    assert history_of([evening, dated[1], morning]).labels == (
        '2026-02-12 10:00', '2026-03-12 08:30', '2026-03-12 19:30')
    history = history_of([dated[2], undated, dated[1]])
    assert [moment.index for moment in history.moments] == [0, 1, 2]
    assert history.labels == ('2026-03-12', 'no date', '2026-02-12')
    with pytest.raises(InputError, match="the date of calibration 2 is 'Monday', expected"):
        history_of([dated[0], wrong])
    with pytest.raises(InputError, match='found 1 calibration, expected at least 2'):
        history_of(dated[:1])


# ----------------------------------------------------------------------------- refinements

@pytest.fixture(scope='module')
def warm():
    """Return a refinement of poses with an effect of the temperature, one of them knocked."""
    rng, time = np.random.default_rng(5), np.arange(60) * 20.0
    model = model_with({'offset': np.array([0.02, -0.01, 0.03]),
                        'axis_gain': np.array([0.01, -0.02, 0.005]),
                        'offset_temperature': np.array([2e-4, -1e-4, 1.5e-4])})
    table = simulate_poses(model, random_directions(60, rng), rng, noise_g=0.002, context={
        'time': time, 'temperature': 30.0 + 10.0 * np.sin(time / 190.0)})
    return refine(changed(table, 8, 1.05), G, base='10')


def test_page_is_complete_and_self_contained(warm):
    text = refinement_page(warm, '<b onload="x">&.csv')
    found = Parsed(text)
    assert not found.open
    assert len(found.ids) == len(set(found.ids))
    referred = set(re.findall(r'(?:href="|url\()#([^")]+)', text))
    assert referred <= set(found.ids)
    assert not re.search(r'https?:|//[a-z]|<link|<img|@import|src=|fetch|XMLHttp|WebSocket', text)
    assert '<html lang="en">' in text
    assert 'name="viewport"' in text
    assert text.count('b onload') == text.count('&lt;b onload=&#34;x&#34;&gt;&amp;.csv') > 0


def test_figure_of_a_curve_shows_the_truth_within_its_band():
    def bump(warm):  # the offset of z is larger near 35 °C
        return 0.004 * np.exp(-((warm - 35.0) / 5.0) ** 2)

    rng = np.random.default_rng(5)
    warm = rng.uniform(10.0, 50.0, 100)
    poses = simulate_poses(
        model_with({'offset': np.array([0.02, -0.01, 0.03])}), random_directions(100, rng), rng,
        noise_g=0.001, context={'time': np.arange(100) * 20.0, 'temperature': warm})
    shift = np.outer(bump(warm), [0.0, 0.0, 1.0])
    bumpy = refine(changed(poses, plus=shift), G, base='10')
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
    assert panel.get_ylabel().endswith(' [mg]')
    assert len(panel.collections) == len(parts)
    ticks = [line for line in panel.lines if line.get_marker() == '|']
    np.testing.assert_allclose(ticks[0].get_xdata(), bumpy.poses_g['temperature'])
    band = panel.collections[0].get_paths()[0].vertices[:, 1]
    first = next(iter(parts.values()))
    assert np.max(band) == pytest.approx(1e3 * np.max(first.change + 1.96 * first.deviation))
