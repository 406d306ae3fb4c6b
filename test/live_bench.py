# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A simulated sensor in the hands of a person, and the live page in a real browser.

The person knows only what the page shows.

"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
import math
import os
from pathlib import Path
import re
import shutil
import time

from accel_calib.session import Log
from accel_calib.table import Floats
from inside import Host, model_with, predict, unit
import numpy as np
from playwright.sync_api import Browser, expect, Page, sync_playwright
import pytest
from shared import GRAVITY
from viewer import hosted

TRUTH = {'offset': (0.03, -0.02, 0.04), 'axis_gain': (0.01, -0.02, 0.005)}
SIZES = ((360, 740), (740, 360), (820, 1180), (1440, 900), (2560, 1440))
PATIENCE = 120_000
"""Longest time until the page shows something [ms]; it is waited for no longer than necessary."""

expect.set_options(timeout=PATIENCE)

_FLAGS = ('--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
          '--disable-background-networking', '--disable-component-update', '--disable-sync')
_SIDES = {'front': (0, 1), 'back': (0, -1), 'left': (1, 1), 'right': (1, -1), 'top': (2, 1),
          'bottom': (2, -1)}
_GOAL = re.compile(r'([\w ]+) (?:side|edge|corner) up', re.IGNORECASE)
_RATE = 100.0
_TURN = 1.2
_REST = 4.0
_NOISE = 0.002


class TurnedSensor:
    """
    A sensor that is turned by hand; it is the source of a host.

    `speed` is that of its time until it has been at rest for a pose; later it is 1. `up` points up
    in the last pose.

    """

    name, findings = 'simulated', ()
    problem = str

    def __init__(self, speed: float = 20.0, sensor: str = 'imu_link') -> None:
        self.speed, self.sensor = speed, sensor
        self.silent = False
        self._model = model_with(TRUTH)
        self._rng = np.random.default_rng(5)
        self._start = self.up = np.array([0.0, 0.0, 1.0])
        self._since, self._stamp = math.inf, 0.0

    def turn_to(self, direction: Floats) -> None:
        """Turn the sensor so that about this direction points up."""
        self._start = self._forces(np.array([self._stamp]))[0]
        shaky = np.asarray(direction) + 0.03 * self._rng.normal(size=3)
        self.up, self._since = unit(shaky[np.newaxis])[0], self._stamp

    def _forces(self, stamps: Floats) -> Floats:
        """Return the (n, 3) force at these times."""
        at = stamps[:, np.newaxis]
        if not math.isfinite(self._since):  # it tumbles until it is turned
            return unit(np.hstack([np.sin(2.0 * at), np.full_like(at, 0.4), np.cos(2.0 * at)]))
        share = np.clip((at - self._since) / _TURN, 0.0, 1.0)
        aside = np.cross(self._start, self.up)
        between = self._start + share * (self.up - self._start) + np.sin(np.pi * share) * aside
        shaken = np.where(share < 1.0, 0.1 * np.sin(20.0 * at), 0.0)
        force: Floats = unit(between) * (1.0 + shaken)
        return force

    @property
    def blocks(self) -> Iterator[Floats]:
        """Yield the samples as they arrive."""
        last = time.monotonic()
        while True:
            time.sleep(0.02)
            now = time.monotonic()
            hurries = 0.0 <= self._stamp - self._since < _TURN + _REST
            rate = _RATE * (self.speed if hurries else 1.0)
            count = int((now - last) * rate)
            last += count / rate
            stamps = self._stamp + np.arange(1, count + 1) / _RATE
            rows = np.zeros((count, 9))
            if count:
                self._stamp = float(stamps[-1])
                noise = _NOISE * self._rng.normal(size=(count, 3))
                rows[:, 0] = 1000.0 + stamps
                rows[:, 1:4] = GRAVITY * (predict(self._model, self._forces(stamps), {}) + noise)
                rows[:, 7:] = 30.0, np.nan
            yield rows[:0] if self.silent else rows


@dataclass
class LivePage:
    """A host with a turned sensor, and its page."""

    sensor: TurnedSensor
    host: Host
    lines: list[Log]

    @property
    def link(self) -> str:
        """Link with the token."""
        return self.host.server.link

    def follow(self, page: Page, poses: int = 100) -> None:
        """Turn the sensor as the page says, until it has so many poses, or asks for the fit."""
        while True:
            expect(page.locator('#next')).to_have_text(re.compile(r' up$|^Press Fit$'))
            asked = asked_on(page)
            count = int(page.locator('#poses').inner_text().split()[0])
            if asked is None or count >= poses:
                return
            self.sensor.turn_to(asked)
            expect(page.locator('#poses')).not_to_have_text(re.compile(rf'^{count}\b'))


def asked_on(page: Page) -> Floats | None:
    """Return the direction of the sides, such as “Front left edge up”; None: another action."""
    found = _GOAL.fullmatch(page.locator('#next').inner_text())
    if found is None:
        return None
    direction = np.zeros(3)
    for side in found[1].lower().split():
        axis, sign = _SIDES[side]
        direction[axis] = sign
    return unit(direction[np.newaxis])[0]


@contextmanager
def live_page(folder: Path, *, speed: float = 20.0, name: str = 'imu_link', file: str = 'imu.yaml',
              web_host: str = '127.0.0.1') -> Iterator[LivePage]:
    """Serve the page of a simulated sensor; the calibration is stored in this folder."""
    sensor = TurnedSensor(speed, name)
    with hosted(sensor, calibration_file=str(folder / file), web_host=web_host) as (host, lines):
        yield LivePage(sensor, host, lines)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start Chromium; without one, skip the test, but not in continuous integration."""
    found = shutil.which('chromium') or shutil.which('chromium-browser') or shutil.which(
        'google-chrome')
    if found is None:
        words = 'no Chromium is found, expected one for the live page; run apt install chromium'
        if os.environ.get('CI'):
            pytest.fail(words)
        pytest.skip(words)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=list(_FLAGS))
        yield browser
        browser.close()


class Viewers:
    """The pages of a test, and what their consoles say."""

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self.complaints: list[str] = []

    def visit(self, link: str, size: tuple[int, int] = (1000, 900), *, script: str = '',
              **options: object) -> Page:
        """Open a page in a context of its own; `script` runs before those of the page."""
        context = self._browser.new_context(
            viewport={'width': size[0], 'height': size[1]}, **options)  # type: ignore[arg-type]
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.add_init_script(script)
        page.on('console', lambda line: self.complaints.append(line.text)
                if line.type in ('error', 'warning') else None)
        page.on('pageerror', lambda error: self.complaints.append(str(error)))
        page.goto(link)
        expect(page.locator('body')).to_have_attribute('data-connection', 'open')
        return page

    def close(self) -> None:
        """Close all pages."""
        for context in self._browser.contexts:
            context.close()
