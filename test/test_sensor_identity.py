# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
No calibration is applied to another sensor without a word.

A name is that of the calibration, of the data (frame_id, or `sensor` of a table), or the one that
the user states (parameter or option `sensor`). An unnamed one fits every sensor.

"""

from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

from accel_calib.errors import AccelCalibError
from accel_calib.session import enable, Mounting, run
from accel_calib.stored import read_calibration
from inside import main, spread_directions
import pytest
from shared import Readings, result, Stored
from test_session import Driver

pytestmark = pytest.mark.usefixtures('home')


@pytest.fixture(scope='module')
def tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with poses and a recording of no sensor, of a and of b."""
    folder = tmp_path_factory.mktemp('tables')
    for kind, options in (('poses', []), ('recording', ['--recording'])):
        path = folder / f'{kind}.csv'
        assert main(['simulate', '-o', str(path), '--effect', 'offset=0.01,0.02,0.03',
                     *options]) == 0
        for name, text in (('a', '"a"'), ('b', 'b')):
            (folder / f'{kind}_{name}.csv').write_text(f'# sensor: {text}\n{path.read_text()}')
        path.rename(folder / f'{kind}_.csv')
    return folder


@pytest.mark.parametrize(('command', 'owner', 'data', 'stated', 'accepted'), [
    *((command, owner, data, '', not owner or data in ('', owner))
      for command in ('verify', 'apply') for owner in ('', 'a') for data in ('', 'a', 'b')),
    *(('refine', 'a', data, stated, {data, stated} <= {'', 'a'})
      for data in ('', 'a', 'b') for stated in ('', 'a', 'b'))])
def test_commands_refuse_data_of_another_sensor(
        tables: Path, tmp_path: Path, stored: Stored, capsys: pytest.CaptureFixture[str],
        command: str, owner: str, data: str, stated: str, accepted: bool) -> None:
    kind, out = 'recording' if command == 'apply' else 'poses', tmp_path / 'out.csv'
    options = {'apply': ['-o', str(out)], 'refine': ['--sensor', stated] if stated else []}
    status = main([command, str(tables / f'{kind}_{data}.csv'), '-c', str(stored(sensor=owner)),
                   *options.get(command, [])])
    assert (status != 2) == accepted  # 1: the poses are not those of the calibration
    assert (f'to sensor {owner!r}' in capsys.readouterr().err) is not accepted
    assert out.exists() is (accepted and command == 'apply')


@pytest.mark.parametrize(('data', 'stated', 'name'), [
    ('', '', ''), ('a', '', 'a'), ('', 'b', 'b'), ('a', 'b', 'b')])
def test_fit_names_the_sensor_as_stated_or_as_in_the_table(tables: Path, tmp_path: Path,
                                                           data: str, stated: str, name: str
                                                           ) -> None:
    option = ['--sensor', stated] if stated else []
    out = tmp_path / 'fit.yaml'
    assert main(['fit', str(tables / f'poses_{data}.csv'), '-o', str(out), *option]) == 0
    assert read_calibration(out).sensor == name


@pytest.mark.parametrize(('names', 'status'), [(('a', 'a'), 0), (('a', ''), 0), (('a', 'b'), 2)])
def test_compare_refuses_calibrations_of_two_sensors(stored: Stored, names: tuple[str, str],
                                                     status: int) -> None:
    files = [str(stored(f'{k}.yaml', sensor=name)) for k, name in enumerate(names)]
    assert main(['compare', *files]) == status


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
    found = [event.frame_id for event in driver.session.events if isinstance(event, Mounting)]
    assert found == ['imu_link']
