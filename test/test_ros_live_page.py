# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A whole calibration through the live page of a node, with a simulated sensor over DDS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
import socket
import subprocess
from typing import Any

from accel_calib.stored import read_calibration
from live_bench import chromium, GRAVITY, PATIENCE, TRUTH, Viewers
import numpy as np
from playwright.sync_api import Browser, expect, sync_playwright
import pytest

POSES = 12


@pytest.fixture
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = chromium(playwright)
        yield browser
        browser.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return int(probe.getsockname()[1])


def link_of(process: subprocess.Popen[str]) -> str:
    """Wait until a node prints the link of its page."""
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(r'live page: (\S+)', line)
        if found:
            return found.group(1)
    raise AssertionError('the node has ended without a link')


def test_a_node_is_calibrated_through_its_page(
        bench: Any, browser: Browser, tmp_path: Path) -> None:
    from sensor_msgs.msg import Imu
    file = tmp_path / 'imu.yaml'
    calibrator = bench.start('calibrator', calibration_file=str(file), web_port=free_port(),
                             **bench.deep)
    viewers = Viewers(browser)
    page = viewers.visit(link_of(calibrator), (360, 740))
    expect(page.locator('#ring')).to_have_attribute('data-kind', 'silent')
    effects = ','.join(f"'{name}={','.join(map(str, values))}'" for name, values in TRUTH.items())
    bench.start('simulator', poses=POSES, dwell=1.6, turn=0.5, noise=0.01, wait=15.0,
                flat_last=False, effects=f'[{effects}]')
    expect(page.locator('#poses')).to_have_text(re.compile(f'^{POSES}'), timeout=3 * PATIENCE)
    page.get_by_role('button', name='Fit', exact=True).click()
    expect(page.locator('#offer')).to_be_visible(timeout=PATIENCE)
    assert not file.exists()
    page.get_by_role('button', name='Accept').click()
    expect(page.locator('#offer')).to_be_hidden(timeout=PATIENCE)
    stored = read_calibration(file)
    off = stored.offset / GRAVITY - np.array(TRUTH['offset'])
    assert np.all(np.abs(off) < 5.0 * stored.offset_sd / GRAVITY)
    corrected = bench.listen(Imu, 'imu/data_calibrated')
    bench.spin(lambda: len(corrected) > 100)
    lengths = [np.linalg.norm([(a := each.linear_acceleration).x, a.y, a.z])
               for each in corrected]
    assert abs(np.mean(lengths) / GRAVITY - 1.0) < 0.001
    assert viewers.complaints == []
