# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The live page in Chromium, with a simulated sensor that is turned as the page says."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re

from accel_calib.files import read_calibration, write_table
from accel_calib.simulate import model_with, simulate_poses
from accel_calib.sphere import spread_directions
from accel_calib.table import Poses
from live_bench import chromium, GRAVITY, live_page, LivePage, PATIENCE, SIZES, TRUTH, Viewers
import numpy as np
from playwright.sync_api import Browser, expect, Locator, Page, sync_playwright
import pytest


@pytest.fixture(scope='module')
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = chromium(playwright)
        yield browser
        browser.close()


@pytest.fixture
def viewers(browser: Browser) -> Iterator[Viewers]:
    """Open pages that must not complain: no errors and no violations of the policy."""
    opened = Viewers(browser)
    yield opened
    opened.close()
    assert opened.complaints == []


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LivePage]:
    """Serve the page of a sensor without poses."""
    with live_page(tmp_path) as served:
        yield served


@pytest.fixture
def with_poses(tmp_path: Path) -> Iterator[LivePage]:
    """Serve the page of a sensor whose stored poses are enough for a fit."""
    found = simulate_poses(model_with(TRUTH), spread_directions(14), np.random.default_rng(3),
                           noise_g=0.002)
    columns = {**found.columns, 'reading': found.reading * GRAVITY,
               'std': found.columns['std'] * GRAVITY}
    write_table(tmp_path / 'imu_poses.csv', Poses(columns, found.row))
    with live_page(tmp_path) as served:
        yield served


def button(page: Page, name: str) -> Locator:
    return page.get_by_role('button', name=name, exact=True)


def answer(page: Page) -> Locator:
    return page.locator('#answer p')


def fit(page: Page) -> None:
    """Fit, and wait until the calibration is offered with its verdict."""
    button(page, 'Fit').click()
    expect(page.locator('#offer')).to_be_visible(timeout=PATIENCE)
    expect(page.locator('#verdict strong')).to_have_text('GOOD', timeout=PATIENCE)
    expect(answer(page)).not_to_contain_text('~/')  # a page has buttons, and no services


def accept(page: Page) -> None:
    button(page, 'Accept').click()
    expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)


def emphasised(page: Page) -> list[str]:
    return page.locator('button.primary:visible').all_inner_texts()


def log_numbers(page: Page) -> list[str]:
    return [str(line.get_attribute('data-number')) for line in page.locator('#log li').all()]


def test_a_person_who_follows_the_page_gets_a_good_calibration(
        live: LivePage, viewers: Viewers, tmp_path: Path) -> None:
    page = viewers.visit(live.link)
    live.follow(page)
    expect(page.locator('#next')).to_have_text('Press Fit')
    fit(page)
    assert not (tmp_path / 'imu.yaml').exists()
    button(page, 'Accept').click()
    expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)
    expect(answer(page)).to_contain_text('stored in')
    stored = read_calibration(tmp_path / 'imu.yaml')
    off = stored.offset / GRAVITY - np.array(TRUTH['offset'])
    assert np.all(np.abs(off) < 5.0 * stored.offset_sd / GRAVITY)
    page.get_by_text('Calibration page').click()
    frame = page.frame_locator('#report iframe')
    expect(frame.get_by_role('heading', level=1)).to_contain_text('imu_link', timeout=PATIENCE)


def test_a_calibration_that_is_taken_back_is_not_stored(
        with_poses: LivePage, viewers: Viewers, tmp_path: Path) -> None:
    page = viewers.visit(with_poses.link)
    fit(page)
    button(page, 'Take back').click()
    expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)
    expect(answer(page)).to_contain_text('discarded')
    expect(page.locator('#next')).to_have_text('Press Fit')
    assert not (tmp_path / 'imu.yaml').exists()


def test_the_page_names_the_next_action_until_nothing_is_left(
        with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link, SIZES[0])
    title, words = page.locator('#next'), page.locator('#advice')
    expect(page.locator('#poses')).to_have_text(re.compile('^14'))
    fit(page)
    expect(title).to_have_text('Good. Accept it?')
    assert emphasised(page) == ['Accept']
    accept(page)
    expect(title).to_have_text('Set level')
    assert emphasised(page) == ['Set level']
    with_poses.sensor.turn_to(np.array([0.0, 0.0, 1.0]))
    expect(page.locator('#ring')).to_have_attribute('data-kind', 'captured', timeout=PATIENCE)
    expect(title).to_have_text('Set level')  # although this rest is a pose more
    button(page, 'Set level').click()
    expect(page.locator('#offer')).to_be_visible(timeout=PATIENCE)
    accept(page)
    expect(title).to_have_text('Done')
    expect(words).to_contain_text('Nothing more')
    assert emphasised(page) == []
    expect(button(page, 'Set heading')).to_be_visible()
    assert '--' not in page.locator('main').inner_text()


def test_more_poses_after_a_calibration_lead_to_the_next_fit(
        with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link)
    fit(page)
    accept(page)
    expect(page.locator('#next')).to_have_text('Set level')
    poses = page.locator('#poses')
    for count, direction in ((15, [0.6, 0.8, 0.0]), (16, [-0.6, 0.0, 0.8])):
        with_poses.sensor.turn_to(np.array(direction))
        expect(poses).to_have_text(re.compile(f'^{count}'), timeout=PATIENCE)
    expect(page.locator('#next')).to_have_text(re.compile(r' up$|^Press Fit$'), timeout=PATIENCE)


def test_the_keyboard_alone_performs_a_fit(with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link)
    page.keyboard.press('Tab')
    expect(page.get_by_text('Skip to the commands')).to_be_focused()
    page.keyboard.press('Enter')
    for _ in range(10):
        page.keyboard.press('Tab')
        if page.evaluate('document.activeElement.dataset.command') == 'fit':
            break
    assert page.evaluate('getComputedStyle(document.activeElement).outlineStyle') == 'solid'
    page.keyboard.press('Enter')
    expect(page.locator('#offer')).to_be_visible(timeout=PATIENCE)
    expect(button(page, 'Fit')).to_be_focused()


def test_the_keyboard_scrolls_the_log(live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, SIZES[1])
    live.follow(page, 5)
    page.locator('#log summary').click()
    page.keyboard.press('Tab')
    lines = page.locator('#log ol')
    expect(lines).to_be_focused()
    page.keyboard.press('ArrowDown')
    page.wait_for_timeout(500.0)
    assert lines.evaluate('(each) => each.scrollTop') > 0.0


def test_a_wrong_token_shows_everything_and_changes_nothing(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(f'{live.bare_link}#wrong')
    expect(page.locator('#showing')).to_contain_text('only shows')
    live.follow(page, 1)
    for name in ('Undo pose', 'Reset …', 'Export …'):
        assert button(page, name).get_attribute('aria-disabled') == 'true'
        button(page, name).click(force=True)
        expect(answer(page)).to_contain_text('token')
    expect(page.locator('dialog[open]')).to_have_count(0)
    expect(page.locator('#poses')).to_have_text(re.compile('^1 '))


def test_the_token_leaves_the_address_bar_and_survives_a_reload(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    assert page.url == live.bare_link
    page.reload()
    expect(page.locator('body')).to_have_attribute('data-connection', 'open')
    expect(page.locator('#showing')).to_be_hidden()
    expect(button(page, 'Fit')).to_have_attribute('aria-disabled', 'false')


def test_a_viewer_that_sleeps_has_lost_nothing(
        live: LivePage, browser: Browser) -> None:
    viewers = Viewers(browser)  # a lost connection is an error in the console
    asleep, awake = viewers.visit(live.link), viewers.visit(live.link)
    expect(asleep.locator('#log li').first).to_be_attached()
    before = log_numbers(asleep)
    asleep.context.set_offline(True)
    expect(asleep.locator('#connection')).to_contain_text('lost', timeout=PATIENCE)
    live.follow(awake, 2)
    button(awake, 'Undo pose').click()
    expect(answer(awake)).to_contain_text('the last pose is removed')
    asleep.context.set_offline(False)
    expect(asleep.locator('body')).to_have_attribute('data-connection', 'open',
                                                     timeout=PATIENCE)
    expect(asleep.locator('#poses')).to_have_text(awake.locator('#poses').inner_text())
    expect(asleep.locator('#log li').first).to_contain_text('the last pose is removed')
    now = log_numbers(asleep)
    assert now == log_numbers(awake)
    assert len(now) > len(before)
    viewers.close()


def test_two_viewers_see_the_same(live: LivePage, viewers: Viewers) -> None:
    first, second = viewers.visit(live.link), viewers.visit(live.bare_link)
    live.follow(first, 2)
    for page in (first, second):
        expect(page.locator('#poses')).to_have_text(re.compile('^2 '))
    button(first, 'Undo pose').click()
    expect(second.locator('#poses')).to_have_text(re.compile('^1 '), timeout=PATIENCE)
    expect(second.locator('#log li').first).to_contain_text('the last pose is removed')


def test_a_refusal_is_shown_in_its_own_words_until_it_is_dismissed(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    button(page, 'Refine').click()
    expect(answer(page)).not_to_be_empty(timeout=PATIENCE)
    assert answer(page).inner_text() == live.lines[-1].words
    expect(page.locator('#answer')).to_have_attribute('data-success', 'false')
    button(page, 'Dismiss the answer').click()
    expect(page.locator('#answer')).to_be_hidden()


def test_reset_asks_first(with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link)
    poses = page.locator('#poses')
    expect(poses).to_have_text(re.compile('^14'))
    button(page, 'Reset …').click()
    expect(button(page, 'Cancel')).to_be_focused()
    page.keyboard.press('Escape')
    button(page, 'Undo pose').click()
    expect(poses).to_have_text(re.compile('^13'), timeout=PATIENCE)
    button(page, 'Reset …').click()
    button(page, 'Reset').click()
    expect(poses).to_have_text(re.compile('^[01] '), timeout=PATIENCE)


def test_an_export_is_downloaded(with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link)
    fit(page)
    button(page, 'Accept').click()
    expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)
    button(page, 'Export …').click()
    with page.expect_download() as started:
        button(page, 'c').click()
    assert started.value.suggested_filename == 'calibration.h'
    assert 'accel' in Path(started.value.path()).read_text(encoding='utf-8')


def test_a_sensor_that_falls_silent_is_noticed(live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    expect(page.locator('#ring')).to_have_attribute('data-kind', 'moving')
    live.sensor.silent = True
    expect(page.locator('#ring')).to_have_attribute('data-kind', 'silent', timeout=PATIENCE)
    expect(page.locator('#problem')).to_be_visible()


def test_a_lost_connection_is_what_the_page_shows_in_large(
        live: LivePage, browser: Browser) -> None:
    viewers = Viewers(browser)  # a lost connection is an error in the console
    page = viewers.visit(live.link)
    expect(page.locator('#next')).to_have_text(re.compile(' up$'))
    page.context.set_offline(True)
    expect(page.locator('#next')).to_have_text('No connection', timeout=PATIENCE)
    expect(page.locator('#wanted')).to_be_hidden()
    page.context.set_offline(False)
    expect(page.locator('#next')).to_have_text(re.compile(' up$'), timeout=PATIENCE)
    viewers.close()


def test_a_fit_of_one_viewer_blocks_the_buttons_of_the_other(
        with_poses: LivePage, viewers: Viewers) -> None:
    first, second = (viewers.visit(with_poses.link) for _ in range(2))
    second.evaluate("""() => {
      const button = document.querySelector('[data-command=refine]');
      window.seen = [];
      new MutationObserver(() => window.seen.push(button.getAttribute('aria-disabled')))
        .observe(button, { attributeFilter: ['aria-disabled'] });
    }""")
    fit(first)
    expect(second.locator('#offer')).to_be_visible()
    expect(button(second, 'Refine')).to_have_attribute('aria-disabled', 'false')
    assert 'true' in second.evaluate('window.seen')


_SPOKEN = """
window.spoken = [];
speechSynthesis.speak = (utterance) => window.spoken.push(utterance.text);
"""


def test_speech_names_captured_poses_and_the_next_one_if_it_is_switched_on(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, script=_SPOKEN)
    expect(page.locator('#next')).to_have_text(re.compile(' up$'))
    live.follow(page, 1)
    assert page.evaluate('window.spoken') == []
    speech = button(page, 'Speech')
    speech.click()
    expect(speech).to_have_attribute('aria-pressed', 'true')
    live.follow(page, 2)
    assert page.evaluate('window.spoken')[-1] == (
        f'Pose 2 captured. {page.locator("#next").inner_text()}.')
    speech.click()
    live.follow(page, 3)
    assert len(page.evaluate('window.spoken')) == 2


def test_a_browser_without_a_voice_says_so(live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, script="""
      speechSynthesis.speak = (utterance) => utterance.onerror({ error: 'voice-unavailable' });
    """)
    button(page, 'Speech').click()
    expect(answer(page)).to_contain_text('does not speak')
    expect(button(page, 'Speech')).to_have_attribute('aria-pressed', 'false')


def test_a_browser_without_speech_and_wake_lock_shows_the_page(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, script="""
      delete window.speechSynthesis;
      delete Navigator.prototype.wakeLock;
    """)
    assert not page.evaluate('"speechSynthesis" in window || "wakeLock" in navigator')
    expect(button(page, 'Speech')).to_be_hidden()
    live.follow(page, 1)


def test_the_screen_stays_on_while_the_page_is_connected(
        live: LivePage, browser: Browser) -> None:
    viewers = Viewers(browser)  # a lost connection is an error in the console
    page = viewers.visit(live.link, script="""
      const request = WakeLock.prototype.request;
      WakeLock.prototype.request = async function (kind) {
        const lock = await request.call(this, kind);
        const show = () => { document.documentElement.dataset.awake = `${!lock.released}`; };
        lock.addEventListener('release', show);
        show();
        return lock;
      };
    """)
    root = page.locator('html')
    expect(root).to_have_attribute('data-awake', 'true')
    page.context.set_offline(True)
    expect(root).to_have_attribute('data-awake', 'false', timeout=PATIENCE)
    page.context.set_offline(False)
    expect(root).to_have_attribute('data-awake', 'true', timeout=PATIENCE)
    viewers.close()


_MARKUP = '<img src=x onerror="document.title=1"><b>\u202e\x07\n</b>' + 'w' * 200


def test_markup_in_names_is_shown_as_text(tmp_path: Path, viewers: Viewers) -> None:
    with live_page(tmp_path, name=_MARKUP, file='<img src=x onerror=alert(1)>.yaml') as live:
        page = viewers.visit(live.link, SIZES[0])
        expect(page.locator('#sensor')).to_contain_text('<img src=x')
        live.follow(page)
        fit(page)
        accept(page)
        expect(answer(page)).to_contain_text('<img')
        page.locator('#log summary').click()
        page.get_by_text('Calibration page').click()
        frame = page.frame_locator('#report iframe')
        expect(frame.get_by_role('heading', level=1)).to_contain_text('<img', timeout=PATIENCE)
        assert frame.locator('img[src=x]').count() == page.locator('img').count() == 0
        assert page.title() != '1'
        assert page.evaluate('document.documentElement.scrollWidth') <= SIZES[0][0]


def test_the_page_is_served_over_ipv6(tmp_path: Path, viewers: Viewers) -> None:
    with live_page(tmp_path, web_host='::1') as live:
        assert live.link.startswith('http://[::1]:')
        live.follow(viewers.visit(live.link), 1)


def test_the_sound_switch_is_remembered(live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    button(page, 'Sound').click()
    page.reload()
    expect(button(page, 'Sound')).to_have_attribute('aria-pressed', 'false')


def test_the_ball_turns_by_arrow_keys_until_it_follows_again(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    ball, follow = page.locator('#ball-frame'), button(page, 'Follow the sensor')
    expect(follow).to_be_hidden()
    ball.focus()
    before = ball.screenshot()
    page.keyboard.press('ArrowLeft')
    expect(follow).to_be_visible()
    assert ball.screenshot() != before
    follow.click()
    expect(follow).to_be_hidden()
    expect(ball).to_be_focused()


@pytest.mark.parametrize('size', SIZES, ids=str)
def test_nothing_is_wider_than_the_screen(
        live: LivePage, viewers: Viewers, size: tuple[int, int]) -> None:
    page = viewers.visit(live.link, size)
    button(page, 'Fit').click()
    expect(page.locator('#answer')).to_be_visible(timeout=PATIENCE)
    page.locator('#log summary').click()
    assert page.evaluate('document.documentElement.scrollWidth') <= size[0]
    words = page.locator('#next').bounding_box()
    assert words is not None
    assert words['y'] + words['height'] < size[1]


def test_targets_are_large_enough_for_a_finger(live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, SIZES[0])
    for each in page.locator('button:visible, summary:visible').all():
        box = each.bounding_box()
        assert box is not None
        assert min(box['width'], box['height']) >= 44.0, each.inner_text()


_CONTRASTS = """() => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((part) => part / 255).map((part) => part <= 0.03928
    ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)
    .reduce((sum, part, k) => sum + [0.2126, 0.7152, 0.0722][k] * part, 0);
  const back = (element) => {
    for (let each = element; each; each = each.parentElement) {
      const found = parts(getComputedStyle(each).backgroundColor);
      if (found.length < 4 || found[3] > 0) return found;
    }
  };
  return [...document.querySelectorAll('body *')].filter((each) => each.checkVisibility()
    && [...each.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim()))
    .map((each) => {
      const [a, b] = [light(parts(getComputedStyle(each).color)), light(back(each))];
      return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), each.textContent.slice(0, 40)];
    });
}"""


@pytest.mark.parametrize('scheme', ['light', 'dark'])
def test_all_words_have_enough_contrast(
        with_poses: LivePage, viewers: Viewers, scheme: str) -> None:
    page = viewers.visit(with_poses.link, color_scheme=scheme)
    fit(page)
    page.locator('#log summary').click()
    found = page.evaluate(_CONTRASTS)
    assert len(found) > 30
    assert [each for each in found if each[0] < 4.5] == []


def test_labels_of_drawings_change_at_most_every_two_seconds(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link)
    page.evaluate("""() => {
      window.changes = [];
      new MutationObserver((all) => window.changes.push(...all.map(
        (each) => [each.target.id || each.target.tagName, performance.now()])))
        .observe(document.body, { subtree: true, attributeFilter: ['aria-label'] });
    }""")
    live.follow(page, 3)
    changes = page.evaluate('window.changes')
    assert changes
    for name in {each[0] for each in changes}:
        times = [at for found, at in changes if found == name]
        assert all(np.diff(times) > 1900.0)
