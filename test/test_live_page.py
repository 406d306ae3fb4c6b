# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The live page in Chromium, with a simulated sensor that is turned as the page says."""

from collections.abc import Iterator
from pathlib import Path
import re

from accel_calib import simulate
from accel_calib.logs import write_table
from accel_calib.stored import read_calibration
from inside import spread_directions
from live_bench import GRAVITY, live_page, LivePage, SIZES, TRUTH, Viewers
import numpy as np
from playwright.sync_api import Browser, expect, Locator, Page
import pytest
from shared import text_of, wait


def script(name: str) -> str:
    return text_of(f'test/data/scripts/{name}.js')


_MARKUP = '<img src=x onerror="document.title=1"><b>\u202e\x07\n</b>' + 'w' * 200


@pytest.fixture
def viewers(browser: Browser) -> Iterator[Viewers]:
    """Open pages that must not complain: no errors and no violations of the policy."""
    opened = Viewers(browser)
    yield opened
    opened.close()
    assert opened.complaints == []


@pytest.fixture(scope='module')
def idle(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LivePage]:
    """Serve the page of a sensor that is never turned: it has no poses."""
    with live_page(tmp_path_factory.mktemp('idle')) as served:
        yield served


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LivePage]:
    """Serve the page of a sensor without poses."""
    with live_page(tmp_path) as served:
        yield served


@pytest.fixture
def with_poses(tmp_path: Path) -> Iterator[LivePage]:
    """Serve the page of a sensor whose stored poses are enough for a fit."""
    write_table(tmp_path / 'imu_poses.csv', simulate(
        TRUTH, directions=spread_directions(14), noise=0.002, seed=3))
    with live_page(tmp_path) as served:
        yield served


def button(page: Page, name: str) -> Locator:
    return page.get_by_role('button', name=name, exact=True)


def answer(page: Page) -> Locator:
    return page.locator('#answer p')


def fit(page: Page) -> None:
    """Fit, and wait until the calibration is offered with its verdict."""
    button(page, 'Fit').click()
    expect(page.locator('#offer')).to_be_visible()
    expect(page.locator('#verdict strong')).to_have_text('GOOD')
    expect(answer(page)).not_to_contain_text('~/')  # a page has buttons, and no services


def decide(page: Page, name: str) -> None:
    """Accept what is offered, or take it back."""
    button(page, name).click()
    expect(page.locator('#offer')).to_be_hidden()


def shows(page: Page, title: str, *emphasised: str) -> None:
    """Wait for the title of the next action, and compare the buttons that are emphasised."""
    expect(page.locator('#next')).to_have_text(title)
    assert page.locator('button.primary:visible').all_inner_texts() == [*emphasised]


def has_poses(page: Page, count: str) -> None:
    expect(page.locator('#poses')).to_have_text(re.compile(rf'^{count}\b'))


def log_numbers(page: Page) -> list[str]:
    return [str(line.get_attribute('data-number')) for line in page.locator('#log li').all()]


def is_within(page: Page, width: int) -> bool:
    return int(page.evaluate('document.documentElement.scrollWidth')) <= width


def test_a_person_who_follows_the_page_gets_a_good_calibration(
        tmp_path: Path, viewers: Viewers) -> None:
    name = '<img src=x onerror=alert(1)>.yaml'  # all names are shown as text
    with live_page(tmp_path, name=_MARKUP, file=name) as live:
        page = viewers.visit(live.link, SIZES[0])
        expect(page.locator('#sensor')).to_contain_text('<img src=x')
        live.follow(page)
        expect(page.locator('#next')).to_have_text('Press Fit')
        fit(page)
        assert not (tmp_path / name).exists()
        decide(page, 'Accept')
        expect(answer(page)).to_contain_text('stored in')
        expect(answer(page)).to_contain_text('<img')
        page.locator('#log summary').click()
        page.get_by_text('Calibration page').click()
        frame = page.frame_locator('#report iframe')
        expect(frame.get_by_role('heading', level=1)).to_contain_text('<img')
        assert frame.locator('img[src=x]').count() == page.locator('img').count() == 0
        assert page.title() != '1'
        assert is_within(page, SIZES[0][0])
        viewers.close()  # before the server, whose end is an error in the console
    stored = read_calibration(tmp_path / name)
    off = stored.offset / GRAVITY - np.array(TRUTH['offset'])
    assert np.all(np.abs(off) < 5.0 * stored.offset_sd / GRAVITY)


def test_the_page_names_the_next_action_until_nothing_is_left(
        with_poses: LivePage, viewers: Viewers, tmp_path: Path) -> None:
    page = viewers.visit(with_poses.link, SIZES[0])
    has_poses(page, '14')
    fit(page)
    shows(page, 'Good. Accept it?', 'Accept')
    decide(page, 'Take back')
    expect(answer(page)).to_contain_text('discarded')
    shows(page, 'Press Fit', 'Fit')
    assert not (tmp_path / 'imu.yaml').exists()
    fit(page)
    decide(page, 'Accept')
    assert (tmp_path / 'imu.yaml').exists()
    shows(page, 'Set level', 'Set level')
    with_poses.sensor.turn_to(np.array([0.0, 0.0, 1.0]))
    expect(page.locator('#ring')).to_have_attribute('data-kind', 'captured')
    shows(page, 'Set level', 'Set level')  # although this rest is a pose more
    button(page, 'Set level').click()
    expect(page.locator('#offer')).to_be_visible()
    decide(page, 'Accept')
    shows(page, 'Done')
    expect(page.locator('#advice')).to_contain_text('Use the calibration')
    expect(button(page, 'Set heading')).to_be_visible()
    assert '--' not in page.locator('main').inner_text()


def test_more_poses_after_a_good_calibration_change_nothing_and_reset_asks_first(
        with_poses: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(with_poses.link)
    fit(page)
    decide(page, 'Accept')
    button(page, 'Export …').click()
    with page.expect_download() as started:
        button(page, 'c').click()
    assert started.value.suggested_filename == 'calibration.h'
    assert 'accel' in Path(started.value.path()).read_text(encoding='utf-8')
    expect(page.locator('dialog[open]')).to_have_count(0)
    for count, direction in (('15', [0.6, 0.8, 0.0]), ('16', [-0.6, 0.0, 0.8])):
        with_poses.sensor.turn_to(np.array(direction))
        has_poses(page, count)
    expect(page.locator('#next')).to_have_text('Set level')
    button(page, 'Reset …').click()
    expect(button(page, 'Cancel')).to_be_focused()
    page.keyboard.press('Escape')
    button(page, 'Undo pose').click()
    has_poses(page, '15')
    button(page, 'Reset …').click()
    button(page, 'Reset').click()
    has_poses(page, '[01]')


def test_the_keyboard_alone_performs_a_fit_that_blocks_the_buttons_of_other_viewers(
        with_poses: LivePage, viewers: Viewers) -> None:
    page, other = (viewers.visit(with_poses.link) for _ in range(2))
    other.evaluate(script('watch_refine_button'))
    page.keyboard.press('Tab')
    expect(page.get_by_text('Skip to the commands')).to_be_focused()
    page.keyboard.press('Enter')
    for _ in range(10):
        page.keyboard.press('Tab')
        if page.evaluate('document.activeElement.dataset.command') == 'fit':
            break
    assert page.evaluate('getComputedStyle(document.activeElement).outlineStyle') == 'solid'
    page.keyboard.press('Enter')
    expect(page.locator('#offer')).to_be_visible()
    expect(button(page, 'Fit')).to_be_focused()
    expect(other.locator('#offer')).to_be_visible()
    expect(button(other, 'Refine')).to_have_attribute('aria-disabled', 'false')
    assert 'true' in other.evaluate('window.seen')
    page.locator('#log summary').click()
    expect(page.locator('#verdict strong')).to_have_text('GOOD')
    for scheme in ('light', 'dark'):
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        found = page.evaluate(script('contrasts'))
        assert len(found) > 30
        assert [each for each in found if each[0] < 4.5] == [], scheme


def test_all_viewers_see_the_same_and_change_nothing_without_the_token(
        live: LivePage, viewers: Viewers) -> None:
    bare = live.link.partition('#')[0]
    page, guest = viewers.visit(live.link), viewers.visit(f'{bare}#wrong')
    assert page.url == bare
    page.reload()
    expect(page.locator('#showing')).to_be_hidden()
    expect(button(page, 'Fit')).to_have_attribute('aria-disabled', 'false')
    expect(guest.locator('#showing')).to_contain_text('only shows')
    live.follow(page, 2)
    for each in (page, guest):
        has_poses(each, '2')
    for name in ('Undo pose', 'Reset …', 'Export …'):
        assert button(guest, name).get_attribute('aria-disabled') == 'true'
        button(guest, name).click(force=True)
        expect(answer(guest)).to_contain_text('token')
    expect(guest.locator('dialog[open]')).to_have_count(0)
    has_poses(page, '2')
    button(page, 'Undo pose').click()
    has_poses(guest, '1')
    expect(guest.locator('#log li').first).to_contain_text('the last pose is removed')


def test_a_viewer_that_sleeps_has_lost_nothing(live: LivePage, browser: Browser) -> None:
    viewers = Viewers(browser)  # a lost connection is an error in the console
    asleep = viewers.visit(live.link, script=script('show_wake_lock'))
    awake = viewers.visit(live.link)
    expect(asleep.locator('#log li').first).to_be_attached()
    expect(asleep.locator('html')).to_have_attribute('data-awake', 'true')
    before = log_numbers(asleep)
    asleep.context.set_offline(True)
    expect(asleep.locator('#connection')).to_contain_text('lost')
    expect(asleep.locator('#next')).to_have_text('No connection')
    expect(asleep.locator('#wanted')).to_be_hidden()
    expect(asleep.locator('html')).to_have_attribute('data-awake', 'false')
    live.follow(awake, 2)
    button(awake, 'Undo pose').click()
    expect(answer(awake)).to_contain_text('the last pose is removed')
    has_poses(awake, '1')
    asleep.context.set_offline(False)
    expect(asleep.locator('body')).to_have_attribute('data-connection', 'open')
    expect(asleep.locator('#poses')).to_have_text(awake.locator('#poses').inner_text())
    expect(asleep.locator('#log li').first).to_contain_text('the last pose is removed')
    expect(asleep.locator('#next')).to_have_text(re.compile(' up$'))
    expect(asleep.locator('html')).to_have_attribute('data-awake', 'true')
    now = log_numbers(asleep)
    assert now == log_numbers(awake)
    assert len(now) > len(before)
    viewers.close()


def test_speech_names_captured_poses_and_the_next_one_if_it_is_switched_on(
        live: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(live.link, SIZES[1], script="""
      window.spoken = [];
      speechSynthesis.speak = (utterance) => window.spoken.push(utterance.text);
    """)
    live.follow(page, 1)
    assert page.evaluate('window.spoken') == []
    button(page, 'Speech').click()
    expect(button(page, 'Speech')).to_have_attribute('aria-pressed', 'true')
    live.follow(page, 2)
    assert page.evaluate('window.spoken')[-1].startswith('Pose 2 ')
    assert page.evaluate('window.spoken')[-1].endswith(f' {page.locator("#next").inner_text()}.')
    button(page, 'Speech').click()
    live.follow(page, 5)
    assert len(page.evaluate('window.spoken')) == 2
    page.locator('#log summary').click()  # the keyboard scrolls its lines
    page.keyboard.press('Tab')
    expect(page.locator('#log ol')).to_be_focused()
    page.keyboard.press('ArrowDown')
    wait(lambda: page.locator('#log ol').evaluate('(lines) => lines.scrollTop > 0'))


def test_nothing_also_no_refusal_is_wider_than_the_screen_and_targets_are_large_enough(
        idle: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(idle.link, SIZES[0])
    for each in page.locator('button:visible, summary:visible').all():
        box = each.bounding_box()
        assert box is not None
        assert min(box['width'], box['height']) >= 44.0, each.inner_text()
    button(page, 'Fit').click()
    expect(answer(page)).not_to_be_empty()
    assert answer(page).inner_text().replace('−', '-') == idle.lines[-1].words  # the refusal
    expect(page.locator('#answer')).to_have_attribute('data-success', 'false')
    page.locator('#log summary').click()
    for width, height in SIZES:
        page.set_viewport_size({'width': width, 'height': height})
        assert is_within(page, width)
        page.evaluate('scrollTo(0, 0)')
        words = page.locator('#next').bounding_box()
        assert words is not None
        assert words['y'] + words['height'] < height
    button(page, 'Dismiss the answer').click()
    expect(page.locator('#answer')).to_be_hidden()


def test_a_sensor_that_falls_silent_is_noticed(idle: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(idle.link)
    for silent, kind in ((False, 'moving'), (True, 'silent'), (False, 'moving')):
        idle.sensor.silent = silent
        expect(page.locator('#ring')).to_have_attribute('data-kind', kind)
        expect(page.locator('#problem')).to_be_visible(visible=silent)
        expect(page.locator('#problem')).to_have_text(
            re.compile('^simulated sends no samples: check the board' if silent else '^$'))


def test_a_browser_without_a_voice_says_so(idle: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(idle.link, script="""
      speechSynthesis.speak = (utterance) => utterance.onerror({ error: 'voice-unavailable' });
    """)
    button(page, 'Speech').click()
    expect(answer(page)).to_contain_text('does not speak')
    expect(button(page, 'Speech')).to_have_attribute('aria-pressed', 'false')


def test_a_browser_without_speech_and_wake_lock_shows_the_page_over_ipv6(
        tmp_path: Path, viewers: Viewers) -> None:
    with live_page(tmp_path, web_host='::1') as live:
        assert live.link.startswith('http://[::1]:')
        page = viewers.visit(live.link, script="""
          delete window.speechSynthesis;
          delete Navigator.prototype.wakeLock;
        """)
        assert page.evaluate('[window.speechSynthesis, navigator.wakeLock]') == [None, None]
        expect(button(page, 'Speech')).to_be_hidden()
        expect(page.locator('#next')).to_have_text(re.compile(' up$'))
        viewers.close()


def test_the_sound_switch_is_remembered_and_the_ball_turns_by_keys_until_it_follows_again(
        idle: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(idle.link)
    button(page, 'Sound').click()
    page.reload()
    expect(button(page, 'Sound')).to_have_attribute('aria-pressed', 'false')
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


def test_labels_of_drawings_change_at_most_every_two_seconds(
        idle: LivePage, viewers: Viewers) -> None:
    page = viewers.visit(idle.link)
    page.clock.install()
    page.clock.pause_at(page.evaluate('Date.now() + 10'))
    page.evaluate(script('label_a_drawing'))
    for passed, words in ((1999, []), (1, []), (1999, ['fourth']), (1, [])):
        page.clock.run_for(passed)
        page.evaluate('(words) => window.show(...words)', words)
    assert page.evaluate('window.found') == ['first', 'first', 'third', 'third', 'fourth']
