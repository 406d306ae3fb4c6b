# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The calibrator without ROS: files of each sensor, accepted messages and refusals."""

from dataclasses import fields, replace
from pathlib import Path
import shutil
from typing import Any

from accel_calib.calibration import level, set_heading
from accel_calib.effects import Covariate
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.finding import Finding, LEVELS
from accel_calib.logs import open_log, read_poses
from accel_calib.session import (
    CalibratorSettings, changed, enable, Mounting, next_step, progress, Surroundings)
from accel_calib.stored import read_calibration, write_calibration
from driven import Driver, RATE
from inside import (
    LARGEST_NUMBER_OF_STEPS, Model, rotation_from_rpy, SensorStore, spread_directions, store_of,
    StreamStatistics, use_calibration)
import numpy as np
import pytest
from shared import GRAVITY, python, Readings, ROOT, rows_of, Stored, table, with_effects

UP, LEFT, FORWARD = [0, 0, 1], [0, 1, 0], [1, 0, 0]
NOSE_DOWN = [-0.6, 0.0, 0.8]
MOTOR = 'motor_current:=/motor/current'
MOUNTING = rotation_from_rpy(*np.radians((5.0, -3.0, 40.0))).T

pytestmark = pytest.mark.usefixtures('home')


SENSORS = [
    ('', 'imu_link', '/left/imu/data_raw'), ('', 'imu_link', '/right/imu/data_raw'),
    *(('', name, '/imu') for name in (
        'left/imu', 'left_imu', '/imu_link', 'imu link', 'übung', 'ßbung', '', 'imu', 'a')),
    *((name, name, '/imu') for name in ('left/imu', 'left_imu', 'x' * 300, 'x' * 301, 'imu@a'))]
"""Parameter `sensor`, name and topic of sensors."""


def test_each_sensor_has_files_of_its_own(home: Path) -> None:
    files = [store_of(CalibratorSettings(sensor=sensor), name, topic).calibration
             for sensor, name, topic in SENSORS]
    assert len(set(files)) == len(files)
    for file in files:
        assert file.parent == home
        assert len(file.name) < 200
        assert not file.name.startswith('.')


def test_plain_names_of_files_are_readable(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    left = store_of(CalibratorSettings(), 'imu_link', '/left/imu/data_raw')
    assert left.calibration == home / 'left.imu.data_raw@imu_link.yaml'
    arm = CalibratorSettings(sensor='arm.v2')
    assert store_of(arm, 'arm.v2', '/imu').calibration == home / 'arm.v2.yaml'
    assert store_of(arm, 'arm.v2', '/imu').poses == home / 'arm.v2_poses.csv'
    monkeypatch.delenv('ROS_HOME')
    monkeypatch.setenv('HOME', '/me')
    assert store_of(arm, 'arm.v2', '/imu').calibration == (
        Path('/me/.ros/accel_calib/arm.v2.yaml'))
    given = store_of(CalibratorSettings(calibration_file='~/x.yaml'), 'arm.v2', '/imu')
    assert given.calibration == Path('/me/x.yaml')


def test_second_node_on_the_same_files_is_refused_until_the_first_ends(
        stored: Stored, readings: Readings) -> None:
    path, words = stored(sensor='imu_link'), 'is used by the node with process id'
    before = path.read_bytes()
    first, second = Driver(calibration_file=str(path)), Driver(calibration_file=str(path))
    for driver in (first, second):
        driver.feed(readings(spread_directions(12)))
    assert first.session.state.files.lock
    assert not second.session.state.files.lock
    assert second.finding('calibration').level == 'BAD'
    assert words in second.finding('calibration').words
    second.refuses(words, 'fit', 'save', 'load')
    for on in (False, True):
        assert 'files, nothing is published' in enable(second.session, on)
    assert path.read_bytes() == before
    assert len(read_poses(path.with_name('known_poses.csv'))) == 12
    first.session.close()
    second.tick()
    assert second.session.state.files.lock
    assert second.calibration is not None
    assert second.finding('calibration').level == 'GOOD'


def test_calibration_in_g_corrects_messages_in_m_s2(stored: Stored) -> None:
    path, reading = stored(unit='g'), np.array([[1.0, -2.0, 9.0]])
    loaded = Driver(calibration_file=str(path)).calibration
    assert (loaded.units.name, loaded.units.per_g) == ('m/s2', GRAVITY)
    np.testing.assert_allclose(
        loaded.correct(reading), read_calibration(path).correct(reading / GRAVITY) * GRAVITY,
        rtol=1e-14)


@pytest.mark.parametrize(('units', 'per_g'), [('native', 16384.0), ('m/s2', 9.80665)])
def test_sensor_that_tumbles_from_the_first_second_is_not_still_until_it_rests(
        units: str, per_g: float) -> None:
    driver, shown = Driver(units=units), []
    time = np.arange(600) / RATE
    noise = 0.002 * np.random.default_rng(1).normal(size=(len(time), 3))
    turn, lean = 0.8 * time, 0.3 * np.sin(0.5 * time)
    up = np.column_stack([np.sin(turn) * np.cos(lean), np.sin(lean), np.cos(turn) * np.cos(lean)])
    for block in np.array_split((up + noise) * per_g, 120):
        driver.feed(block)
        shown.append(progress(driver.session.state).still)
    assert not any(shown)
    for direction in (*spread_directions(5), np.array([0.6, 0.0, 0.8])):
        driver.feed((direction + noise[:150]) * per_g)
    now = progress(driver.session.state)
    assert now.still
    np.testing.assert_allclose(now.up, (0.6, 0.0, 0.8), atol=0.1)


def test_levelling_between_two_messages_imports_no_large_library(stored: Stored) -> None:
    code = ('import sys; from driven import Driver, GRAVITY; import numpy as np; '
            'driver = Driver(calibration_file=sys.argv[1]); '
            'driver.feed(np.random.default_rng(1).normal((0.0, 0.0, GRAVITY), 0.01, (300, 3))); '
            'before = {*sys.modules}; print(driver.ask("set_level")); '
            'print({name.split(".")[0] for name in {*sys.modules} - before})')
    words, imported = python('-c', code, stored(), PYTHONPATH=f'{ROOT}:{ROOT}/test'
                             ).stdout.splitlines()
    assert 'is levelled' in words
    assert imported == 'set()'


def captured(driver: Driver) -> list[list[int]]:
    """Return the directions of the captured poses."""
    return np.round(driver.poses.reading / GRAVITY).astype(int).tolist()


def test_a_rest_is_not_used_while_the_stamps_stand(readings: Readings) -> None:
    driver = Driver()
    driver.feed(readings([UP], dwell=3.0))
    rows = rows_of(np.full(15, driver.stamp), [GRAVITY, 0.0, 0.0])
    for _ in range(12):
        driver.now += 0.3
        driver.session.push(rows, driver.now)
        driver.handle()
    driver.refuses('stamps', 'set_level')
    driver.feed(readings([LEFT, UP], dwell=3.0))
    assert captured(driver) == [UP, LEFT]


# Guidance


def test_advice_changes_with_the_poses_and_with_a_request_that_is_not_followed(
        readings: Readings) -> None:
    driver = Driver()
    driver.feed(readings(spread_directions(5)))
    before = next_step(driver.session.state)
    rest = readings([spread_directions(5)[0]], dwell=20.0)
    driver.feed(rest[:300])
    after = next_step(driver.session.state)
    assert after.direction != before.direction
    driver.feed(rest[300:])
    assert next_step(driver.session.state) == after
    assert driver.logged('info').count('repeats') == 1
    driver.feed(readings(spread_directions(30)))
    lines = len(driver.log)
    driver.feed(readings(spread_directions(30)[:4]))  # after the last useful pose
    assert not [line.words for line in driver.log[lines:] if 'pose' in line.words]


def test_findings_are_logged_by_their_level(stored: Stored) -> None:
    driver = Driver(calibration_file=str(stored()))
    use_calibration(driver.session, replace(driver.calibration, noted=tuple(
        Finding('note', f'about {level}', level=level) for level in LEVELS)))
    driver.handle()
    assert [line.severity for line in driver.log if 'about ' in line.words] == [
        'info', 'warning', 'error']


# Automatic fits


def test_a_refined_calibration_is_not_replaced_by_an_automatic_fit(readings: Readings) -> None:
    driver = Driver(auto_fit=True, auto_fit_poses=30)
    driver.feed(readings(spread_directions(14)))
    assert driver.ask('fit')
    refined = with_effects(driver.calibration, {'quadratic': np.zeros(3)}, 1e-8)
    use_calibration(driver.session, refined)
    driver.feed(readings(spread_directions(33)))
    assert driver.sensor.fitted_poses >= 30
    assert driver.calibration is refined


def test_automatic_fits_are_a_minute_apart(readings: Readings) -> None:
    driver = Driver(auto_fit=True)
    driver.feed(readings(spread_directions(12)))
    first = driver.now
    driver.feed(readings([[0.6, 0.0, 0.8]]))
    while driver.sensor.fitted_poses == 12:
        driver.tick(1.0)
    assert 57.0 < driver.now - first < 61.0


# Parameters


@pytest.mark.parametrize(('name', 'value'), table('parameters_out_of_range'))
def test_values_that_parameters_do_not_accept_are_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f'parameter {name} is .*, expected '):
        changed(CalibratorSettings(), {name: value})


def accepts(name: str, value: Any) -> bool:
    """Return whether a parameter has a value, also if it contradicts that of another one."""
    try:
        return bool(getattr(changed(CalibratorSettings(), {name: value}), name) == value)
    except InputError as error:
        return f'parameter {name} is ' not in str(error)


def test_parameters_accept_their_limits_and_nothing_beyond_them() -> None:
    for each in fields(CalibratorSettings):
        step = 1 if type(each.metadata['default']) is int else 1e-6
        for limit, beyond in zip(each.metadata['limits'] or (), (-step, step)):
            assert accepts(each.name, limit), each.name
            assert not accepts(each.name, limit + beyond * max(abs(limit), 1)), each.name


# The stream


def statistics_of(*batches: Any, pause: float = 0.3) -> StreamStatistics:
    """Return statistics of batches of stamps that arrive with pauses."""
    now = 100.0
    found = StreamStatistics(lambda: now)
    for stamps in batches:
        now += pause
        found.add(rows_of(stamps, [1.0, 1.0, 1.0]), now)
    return found


def test_rate_and_faults_of_the_stamps_follow_the_last_seconds() -> None:
    times = [np.arange(60) / 200.0 + 0.3 * k for k in range(30)]
    found = statistics_of(*times)
    assert found.rate == pytest.approx(200.0)
    assert not found.stamp_fault
    assert 'zero' in statistics_of(*(0.0 * each for each in times)).stamp_fault
    assert 'constant' in statistics_of(*(0.0 * each + 5.0 for each in times)).stamp_fault
    assert 'out of order' in statistics_of(*(each[::-1] for each in times)).stamp_fault
    again = [*times, *(each + 9.0 for each in times)]  # a bag is played again
    assert not statistics_of(*times, *again).stamp_fault
    played = [*times, *(each + 9.0 - 36.0 * (each[0] > 8.0) for each in times)]
    for jumped in ([each + 1e5 * (each[0] > 7.0) for each in times], played[8:]):
        assert not statistics_of(*jumped).stamp_fault
    assert '1e3 times' in statistics_of(*(1e3 * each for each in times)).stamp_fault
    assert statistics_of(*times[:1]).rate == 0.0
    clock = [0.0]
    gap, slow = (StreamStatistics(lambda: clock[0]) for _ in range(2))
    for clock[0] in (0.0, 0.3, 60.0, 60.3):  # the mean over a silence is no rate
        gap.add(rows_of(times[0] + clock[0], [1.0, 1.0, 1.0]), clock[0])
    assert gap.rate == pytest.approx(200.0)
    for clock[0] in range(9):  # a message per batch does not show the noise
        slow.add(rows_of([clock[0]], [1.0, 1.0, 1.0 + 1e-3 * (clock[0] % 2)]), clock[0])
    assert slow.turn_rate(0.1, 1.0) == 0.0


@pytest.mark.parametrize(('settings', 'words'), table('contradicting_settings'))
def test_settings_that_contradict_each_other_are_refused(settings: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        Driver(**settings)


def test_a_frame_that_is_renamed_while_the_node_runs_is_checked_and_shown(stored: Stored) -> None:
    driver = Driver(calibration_file=str(stored(flat=UP)), publish_tf=True, base_frame='base')
    driver.feed(np.full((5, 3), GRAVITY))
    session = driver.session
    for name, value, warned in (('rotate', False, 0), ('output_frame_id', 'imu_link', 0),
                                ('rotate', True, 1), ('output_frame_id', 'level', 1)):
        session.set_settings(changed(session.state.settings, {name: value}))
        assert len([each for each in session.events if isinstance(each, Mounting)]) == 1
        driver.handle()
        assert driver.logged('warning').count('the frame of the sensor') == warned
    with pytest.raises(InputError, match='a child of the frame of the sensor'):
        changed(session.state.settings, {'output_frame_id': 'base'})


# Steps back


def test_steps_back_are_kept_for_changes_only_and_have_a_limit(
        stored: Stored, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*LARGEST_NUMBER_OF_STEPS, 3)
    path = stored(sensor='imu_link')
    store = SensorStore(path, 'imu_link', '/imu/data_raw', 'm/s2')
    first = store.load_calibration()
    store.write(store.prepared(first))
    before = len(store.steps())
    store.write(store.prepared(first))
    assert len(store.steps()) == before
    for k in range(8):
        store.write(store.prepared(replace(first, date=f'{k}')))
    assert len(store.steps()) == 3
    shutil.copy(path, path.with_name(f'{path.name}.before999'))  # a write failed after this copy
    for k in reversed(range(5, 7)):
        assert store.step_back().date == f'{k}'


def test_a_step_that_cannot_be_used_leaves_the_file_in_use(stored: Stored) -> None:
    path = stored(sensor='imu_link')
    before = path.read_text()
    step = path.with_name(f'{path.name}.before1')
    step.write_text(before.replace('readings: m/s2', 'readings: native'))
    store = SensorStore(path, 'imu_link', '/imu/data_raw', 'm/s2')
    with pytest.raises(StoredCalibrationError, match='is for readings in native'):
        store.step_back()
    assert path.read_text() == before
    assert step.exists()


@pytest.mark.parametrize('of_sensor', [0.0, 1.0])
def test_lag_of_the_temperature_is_followed_while_the_node_runs(
        of_sensor: float, stored: Stored, readings: Readings) -> None:
    path = stored(sensor='imu_link')
    values, turn = np.array([0.0, 0.0, 5e-3, 60.0, of_sensor]), np.arange(20)
    write_calibration(path, with_effects(
        read_calibration(path), {'offset_temperature': values}, 0.0,
        temperature=25.0 + 20.0 * np.sin(turn * 2.0), time=turn * 100.0))
    driver = Driver(calibration_file=str(path))
    still = readings([UP], dwell=4.0)[:20]
    warm = 20.0 + 0.04 * np.arange(450)  # 0.1 °C/s, for 180 s
    for each in warm:
        driver.feed(still, temperature=each)
    calibration, time = driver.calibration, 1000.0 + np.arange(9000) / RATE
    during = (time >= driver.sensor.rest.start) & (time <= driver.sensor.rest.end)

    def with_values(*lag: float) -> Any:
        return replace(calibration, model=Model(
            {**calibration.model.values, 'offset_temperature': np.array(lag)}))

    def offline(found: Any) -> Any:
        return found.apply(np.tile(still, (450, 1)), time=time, temperature=np.repeat(warm, 20))

    expected, plain = (offline(each)[during].mean(axis=0) for each in (
        calibration, with_values(*values[:3])))
    np.testing.assert_allclose(driver.session.state.gravity, expected, atol=0.01)
    assert abs(expected[2] - plain[2]) > 0.15
    offered = with_values(*values * [1.0, 1.0, 1.0, 2.0, 1.0])
    driver.session.change_sensor(offered=offered)
    assert progress(driver.session.state).corrected == pytest.approx(
        np.linalg.norm(offline(offered)[-1]) / GRAVITY, abs=1e-3)


# Frames


@pytest.mark.parametrize('frame', ['ned', 'win8'])
def test_a_stored_mounting_of_the_documents_is_turned_before_it_is_used(
        stored: Stored, frame: Any) -> None:
    path = stored()
    found = read_calibration(path)
    flat, nose_down = found.predict(np.array([UP, NOSE_DOWN]) @ MOUNTING.T * GRAVITY)
    write_calibration(path, set_heading(level(found, flat, frame), nose_down))
    driver = Driver(calibration_file=str(path), frame='ned')
    applied = driver.session.state.on_topics(driver.calibration).rotation
    np.testing.assert_allclose(applied, MOUNTING @ np.diag([1.0, -1.0, -1.0]), atol=1e-6)
    assert f'frame {frame},' in driver.logged('warning')


def test_a_frame_whose_readings_are_gravity_is_refused_for_messages() -> None:
    with pytest.raises(InputError, match="'win8', expected one of ros, ned, android"):
        changed(CalibratorSettings(), {'frame': 'win8'})


# Further context

PER_AMPERE = np.array([2e-3, -1.5e-3, 1e-3])
"""Offset per ampere of the motor [g]."""


def test_a_quantity_is_a_column_of_poses_and_its_last_value_holds_when_it_stops(
        readings: Readings) -> None:
    driver = Driver(sensor='arm', context=[MOTOR])
    for k, direction in enumerate(spread_directions(26)):
        current = 6.0 + 5.0 * np.sin(2.1 * k)
        driver.feed(readings([direction]) + PER_AMPERE * (current - 6.0) * GRAVITY,
                    motor_current=current)
    driver.feed(readings([UP])[:15], motor_current=6.0)
    poses, around = driver.poses, driver.session.state.around
    assert np.ptp(poses['motor_current']) > 8.0
    driver.ask('refine')
    assert Covariate('offset', ('motor_current',)) in driver.calibration.model.effects

    def force(current: float) -> Any:
        reading = np.array([0.0, 0.0, GRAVITY]) + PER_AMPERE * (current - 6.0) * GRAVITY
        return np.array(driver.sensor.force_of(tuple(reading), {'motor_current': current}))

    np.testing.assert_allclose(force(2.0), force(10.0), atol=1e-3)
    driver.session.change(surroundings=Surroundings(
        missing={'motor_current': 'nothing comes on /motor/current'}))
    around.take('motor_current', 10.0)
    line = 'no motor_current arrives: nothing comes on /motor/current; the last value holds'
    for seconds, count in ((29.0, 0), (2.0, 1), (20.0, 1)):
        driver.tick(seconds)
        assert driver.logged('warning').count(line) == count
    assert line in driver.finding('stream').words
    reading = (0.0, 0.0, GRAVITY)
    assert driver.sensor.force_of(reading, driver.session.state.context) == pytest.approx(
        driver.sensor.force_of(reading, {'motor_current': 10.0}))
    around.take('motor_current', 3.0)
    driver.tick()
    assert 'motor_current' not in driver.finding('stream').words
    driver.session.close()
    np.testing.assert_allclose(Driver(sensor='arm', context=[MOTOR]).poses['motor_current'],
                               poses['motor_current'], atol=1e-6)


def test_poses_in_one_direction_are_not_merged_over_a_quantity(readings: Readings) -> None:
    driver = Driver(context=[MOTOR])
    for current in (0.0, 10.0, 0.1):
        for direction in (LEFT, UP):
            driver.feed(readings([direction]), motor_current=current)
    driver.feed(readings([LEFT])[:15], motor_current=0.0)
    assert np.sort(driver.poses['motor_current'] > 5.0).tolist() == [False, False, True, True]


@pytest.mark.parametrize('column', ['motor_current', 'temperature'])
def test_a_start_without_a_column_leaves_it_in_the_stored_poses(
        readings: Readings, column: str) -> None:
    known = {'context': [MOTOR]} if column != 'temperature' else {}
    for k, (way, given, lack) in enumerate((
            ([UP, LEFT, FORWARD], known, 0), ([[0, 0, -1]], {}, 1), ([[0, -1, 0]], known, 1))):
        driver = Driver(sensor='arm', **given)
        driver.stamp += 500.0 * k
        driver.feed(readings(way), rate=0.0, **({} if k == 1 else {column: 25.0 + k}))
        driver.feed(readings([way[-1]])[:15], rate=0.0, **({} if k == 1 else {column: 25.0 + k}))
        driver.tick()
        assert np.sum(np.isnan(driver.poses[column])) == lack
        assert ('1 of 5 poses' in driver.logged('info')) is (k == 2 and bool(known))
        assert column not in driver.sensor.live.poses_for_fit(()) or not lack
        fitted = driver.sensor.live.poses_for_fit((), ['rate', column])
        assert (column in fitted, len(fitted)) == (True, len(driver.poses) - lack)
        assert (f'1 pose without {column} left out' in [each.text for each in fitted.findings]
                ) is bool(lack)
        driver.session.close()
        if k == 1:
            with open_log(driver.session.state.files.store.poses) as log:  # as a command reads it
                assert column not in log.poses
                assert [column in note for note in log.notes] == [True]
