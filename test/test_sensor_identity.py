# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
No calibration is applied to another sensor without a word.

A name is that of the calibration, of the data (frame_id, or `sensor` of a table), or the one that
the user states (parameter or option `sensor`). An unnamed one fits every sensor.

"""

from collections.abc import Generator
from dataclasses import replace
import json
from pathlib import Path

from accel_calib.errors import AccelCalibError
from accel_calib.session import enable, Mounting, run
from inside import spread_directions, use_calibration
import numpy as np
import pytest
from shared import Readings, result, Stored
from test_session import Driver

pytestmark = pytest.mark.usefixtures('home')


@pytest.mark.parametrize('owner', ['', 'imu_link', 'arm', 'other'])
@pytest.mark.parametrize('stated', ['', 'imu_link', 'arm'])
@pytest.mark.parametrize('given', [False, True])
def test_node_uses_a_stored_calibration_only_for_its_sensor(
        home: Path, stored: Stored, readings: Readings, owner: str, stated: str, given: bool
        ) -> None:
    path = stored(sensor=owner)
    if not given:
        home.mkdir(parents=True)
        path = path.rename(home / f'{stated or "imu.data_raw@imu_link"}.yaml')
    before = path.read_bytes()
    driver = Driver(sensor=stated, calibration_file=str(path) if given else '')
    driver.feed(readings([[0, 0, 1]])[:30])
    used = driver.session.sensor.calibration is not None
    assert used is (owner in ('', stated or 'imu_link'))
    if not used:
        assert repr(owner) in driver.finding('calibration').words
    assert path.read_bytes() == before


@pytest.mark.parametrize(('name', 'words'), [
    ('fit', 'call ~/fit again'),
    *((name, "'other' has replaced 'imu_link' meanwhile") for name in ('undo', 'load', 'reset'))])
def test_a_command_that_ends_after_another_sensor_took_over_changes_nothing_of_it(
        readings: Readings, name: str, words: str) -> None:
    driver = Driver()
    turned = readings(spread_directions(12))
    driver.feed(turned)
    if name != 'fit':
        driver.ask('fit')
    task = run(driver.session, name)
    found = result(next(task))
    driver.now += 3.0
    driver.feed(turned[:200], 'other')
    poses = len(driver.session.sensor.live.poses())
    with pytest.raises(AccelCalibError, match=words):
        task.send(found)
    assert driver.session.state.name == 'other'
    assert driver.session.sensor.calibration is None
    assert len(driver.session.sensor.live.poses()) == poses > 0


def test_files_that_are_read_too_late_are_not_used_for_the_next_sensor(
        home: Path, stored: Stored, readings: Readings) -> None:
    home.mkdir(parents=True)
    stored(sensor='imu_link').rename(home / 'imu.data_raw@imu_link.yaml')
    driver, rest = Driver(), readings([[0, 0, 1]])[:30]
    assert driver.session.accepts('imu_link')
    late = [event for event in driver.session.events if isinstance(event, Generator)]
    driver.session.events.clear()
    driver.now += 3.0
    driver.feed(rest, 'other')
    for task in late:
        driver.done(task)
    assert driver.session.state.name == 'other'
    assert driver.session.sensor.calibration is None


def test_an_automatic_fit_of_a_sensor_is_not_one_of_the_next(readings: Readings) -> None:
    driver = Driver()
    turned = readings(spread_directions(12))
    driver.feed(turned)
    driver.session.set_settings(replace(driver.session.state.settings, auto_fit=True))
    driver.session.tick()
    task, = driver.session.events
    driver.session.events.clear()
    driver.now += 3.0
    driver.feed(turned[:200], 'other')
    assert driver.done(task) == ''
    assert driver.session.sensor.calibration is None
    driver.session.tick()
    assert not driver.session.events


def test_correction_that_was_switched_off_stays_off_with_the_next_sensor(readings: Readings
                                                                         ) -> None:
    driver = Driver()
    enable(driver.session, False)
    driver.feed(readings([[0, 0, 1]])[:30])
    assert not driver.session.state.enabled
    assert 'nothing is published' in enable(driver.session, True)


def test_mounting_is_published_in_the_frame_of_the_messages_and_not_under_the_parameter(
        stored: Stored) -> None:
    driver = Driver(sensor='arm', calibration_file=str(stored(sensor='arm', flat=[0, 0.6, 0.8])))
    driver.session.accepts('imu_link')
    found = [event[1:] for event in driver.session.events if isinstance(event, Mounting)]
    assert found == [('imu_link', 'imu_link_levelled')]
    driver.handle()
    use_calibration(driver.session, None)  # a static transform cannot be removed
    turned = next(event for event in driver.session.events if isinstance(event, Mounting))
    assert turned.levelled == 'imu_link_levelled'
    np.testing.assert_array_equal(turned.rotation, np.eye(3))
    driver.handle()
    assert json.loads(driver.results[-1])['in_use'] is False
