# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Samples to rests to poses, and what is stored of them; without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from accel_calib.calibrate import level
from accel_calib.capture import CaptureSettings, Dwell, poses_from
from accel_calib.errors import StoredCalibrationError
from accel_calib.files import read_calibration
from accel_calib.ros.applied import Applied, rest_after
from accel_calib.ros.fitting import asked_for, fitted
from accel_calib.ros.pose_book import dwells_of, PoseBook, with_temperature
from accel_calib.ros.settings import CalibratorSettings
from accel_calib.ros.storage import load, safe_name, Store, store_of
from accel_calib.ros.watch import Watch
from accel_calib.simulate import model_with, simulate_recording
from accel_calib.sphere import spread_directions
from accel_calib.units import units_of
import numpy as np
import pytest

UNITS = units_of('m/s2')
GRAVITY = 9.80665
FACES = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]

Readings = Callable[..., Any]


def push_all(watch: Watch, readings: Any, *, start: float = 0.0, capture: bool = True
             ) -> list[Any]:
    """Push readings 50 times a second; give what changed."""
    changes = [watch.push(start + k / 50.0, tuple(reading), None, {}, capture)
               for k, reading in enumerate(readings)]
    return [change for change in changes if change is not None]


def dwell(time: float, direction: Any, count: float = 50.0) -> Dwell:
    return Dwell(time, time + 1.0, time + 0.5, np.array(direction, float) * GRAVITY,
                 np.full(3, 0.01), count, 50, {}, round(time))


def test_rest_counts_before_it_ends_and_is_known_better_later(readings: Readings) -> None:
    watch = Watch(CaptureSettings(), UNITS)
    changes = push_all(watch, readings([[0, 0, 1]], dwell=9.0))
    counts = [change.rest.samples for change in changes if change.poses]
    assert len(watch.book.poses()) == 1
    assert counts == sorted(counts)
    assert counts[0] < 80
    assert counts[-1] > 150


def test_poses_held_are_replaced_by_what_they_come_to(readings: Readings) -> None:
    watch = Watch(CaptureSettings(repeated='keep'), UNITS)
    changes = push_all(watch, readings(FACES, dwell=2.0))
    assert len(watch.book.poses()) == 3
    assert sum(len(change.ended) for change in changes) >= 1
    assert np.all(np.diff(watch.book.poses()['time']) > 1.5)


@pytest.mark.parametrize('dwell', [1.5, 3.0, 10.0])
@pytest.mark.parametrize('turn', [0.2, 1.0, 5.0])
@pytest.mark.parametrize('rate', [25.0, 400.0])
def test_no_pose_of_a_turned_sensor_is_taken_back(dwell: float, turn: float, rate: float) -> None:
    watch = Watch(CaptureSettings(), UNITS)
    recording = simulate_recording(
        model_with({}), np.array(FACES, float), np.random.default_rng(1), noise_g=0.002,
        rate_hz=rate, dwell=dwell, turn=turn)
    changes = [watch.push(time, tuple(reading), tuple(omega), {}, True) for time, reading, omega
               in zip(recording['time'], recording.reading * GRAVITY, recording['rate'])]
    assert len(watch.book.poses()) == 3
    assert sum(change.taken_back for change in changes if change) == 0


def test_time_that_jumps_back_ends_a_rest_and_no_more(readings: Readings) -> None:
    watch = Watch(CaptureSettings(repeated='merge'), UNITS)
    for _ in range(3):
        push_all(watch, readings(FACES, dwell=2.0), start=100.0)
    assert len(watch.book.poses()) == 3
    assert len(watch.detector.interruptions) == 2


def test_pose_taken_back_is_not_captured_again_in_the_same_rest(readings: Readings) -> None:
    watch = Watch(CaptureSettings(), UNITS)
    rest = readings([[0, 0, 1]], dwell=12.0)
    push_all(watch, rest[:150])
    assert watch.undo()
    push_all(watch, rest[150:], start=3.0)
    push_all(watch, readings(FACES[1:], dwell=2.0), start=12.0)
    assert len(watch.book.poses()) == 2


def test_without_auto_capture_only_the_pose_asked_for_is_kept(readings: Readings) -> None:
    watch = Watch(CaptureSettings(), UNITS)
    turned = readings(FACES, dwell=2.0)
    push_all(watch, turned[:90], capture=False)
    assert watch.capture_now() is not None
    push_all(watch, turned[90:], start=1.8, capture=False)
    poses = watch.book.poses()
    assert len(poses) == 1
    assert poses['reading'][0, 2] > 9.0


def test_moving_sensor_is_no_pose() -> None:
    watch = Watch(CaptureSettings(), UNITS)
    rng = np.random.default_rng(1)
    push_all(watch, [0, 0, GRAVITY] + rng.normal(size=(500, 3)) * 3.0)
    assert len(watch.book.poses()) == 0
    assert watch.capture_now() is None


def test_repeated_poses_are_merged_and_undone_one_by_one() -> None:
    book = PoseBook(CaptureSettings(repeated='merge'), UNITS)
    for time, direction in ((0.0, [0, 0, 1]), (10.0, [1, 0, 0]), (20.0, [0.01, 0, 1])):
        book.end(dwell(time, direction))
    assert len(book.poses()) == 2
    assert book.poses()['count'].max() == pytest.approx(100.0)
    assert book.undo()
    assert book.poses()['count'].max() == pytest.approx(50.0)
    assert len(book.poses()) == 2


def test_book_of_a_robot_that_parks_for_years_stays_small() -> None:
    book = PoseBook(CaptureSettings(repeated='merge'), UNITS)
    directions = spread_directions(6)
    for k in range(600):
        book.end(dwell(10.0 * k, directions[k % 6]))
    assert len(book.poses()) == 6
    assert book.poses()['count'].sum() == pytest.approx(600 * 50.0)
    assert len(book._earlier) + len(book._dwells) < 80


def test_stored_poses_are_taken_up_as_they_were() -> None:
    book = PoseBook(CaptureSettings(repeated='merge'), UNITS)
    for k, direction in enumerate(spread_directions(8)):
        book.end(dwell(10.0 * k, direction))
    poses = book.poses()
    again = PoseBook(CaptureSettings(repeated='merge'), UNITS)
    again.take_up(poses)
    for key in poses.columns:
        np.testing.assert_allclose(again.poses()[key], poses[key], err_msg=key)
    assert len(dwells_of(poses)) == 8


@pytest.mark.parametrize(('sensor', 'name'), [
    ('imu_link', 'imu_link'), ('robot/imu 1', 'robot_imu_1'), ('', 'imu'), ('../../etc', 'etc'),
    ('/a/b', 'a_b')])
def test_name_of_a_sensor_makes_a_safe_file_name(sensor: str, name: str) -> None:
    assert safe_name(sensor) == name


def test_files_are_in_the_home_of_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert store_of('', 'arm').calibration == tmp_path / 'accel_calib' / 'arm.yaml'
    assert store_of('', 'arm').poses == tmp_path / 'accel_calib' / 'arm_poses.csv'
    monkeypatch.delenv('ROS_HOME')
    monkeypatch.setenv('HOME', str(tmp_path / 'me'))
    assert store_of('', 'arm').calibration == tmp_path / 'me/.ros/accel_calib/arm.yaml'
    assert store_of('~/x.yaml', 'arm').calibration == tmp_path / 'me' / 'x.yaml'


def test_damaged_files_are_told_of_and_kept(tmp_path: Path) -> None:
    store = Store(tmp_path / 'arm.yaml')
    store.calibration.write_text('format: something else')
    store.poses.write_text('ax,ay,az\n1,2,words\n')
    loaded = load(store, 'arm', 'm/s2')
    assert (loaded.calibration, loaded.poses) == (None, None)
    assert 'is not a calibration' in loaded.problem
    assert 'arm_poses.csv.damaged1' in loaded.note
    assert (tmp_path / 'arm_poses.csv.damaged1').read_text() == 'ax,ay,az\n1,2,words\n'
    assert store.calibration.exists()


def test_nothing_stored_is_no_problem(tmp_path: Path) -> None:
    loaded = load(Store(tmp_path / 'arm.yaml'), 'arm', 'm/s2')
    assert (loaded.calibration, loaded.poses, loaded.problem, loaded.note) == (None, None, '', '')


def test_calibration_in_another_unit_is_refused(stored: Callable[..., Path]) -> None:
    with pytest.raises(StoredCalibrationError, match='for readings in g'):
        Store(stored(unit='g')).load_calibration('', 'm/s2')


def test_fit_keeps_what_was_flat_before(stored: Callable[..., Path]) -> None:
    flat = np.array([0.2, -0.4, 0.8]) / np.sqrt(0.84)
    before = read_calibration(stored(flat=flat))
    again = fitted(before.poses, UNITS, CalibratorSettings(model='10'), '', before, {})
    np.testing.assert_allclose(again.model.rotation, before.model.rotation, atol=1e-6)
    new = fitted(before.poses, UNITS, CalibratorSettings(model='10'), '', None, {})
    np.testing.assert_array_equal(new.model.rotation, np.eye(3))


@pytest.mark.parametrize('unit', ['m/s2', 'native'])
@pytest.mark.parametrize('count', [0, 1, 5])
def test_a_next_pose_is_asked_for_whatever_there_is(unit: Any, count: int) -> None:
    book = PoseBook(CaptureSettings(), UNITS)
    for k in range(count):
        book.end(dwell(10.0 * k, [0, 0, 1]))
    poses = book.poses()
    assert 'turn the sensor' in asked_for(poses, units_of(unit), 'auto').words


def test_drift_is_that_of_the_rests_since_the_calibration(stored: Callable[..., Path]) -> None:
    calibration = read_calibration(stored())
    applied = Applied(GRAVITY)
    assert applied.standing is None
    applied.adopt(calibration)
    for k, direction in enumerate(spread_directions(5)):
        reading = calibration.predict((direction * GRAVITY * 1.01)[None])[0]
        rest = dwell(10.0 * k, reading / GRAVITY)
        applied.rested(rest, 0.001)
        applied.ended(rest, 0.001)
    assert applied.residual == pytest.approx(0.01, abs=1e-6)
    assert applied.standing.drift == pytest.approx(0.01, abs=1e-6)
    applied.adopt(calibration)
    assert applied.standing.count == 0
    assert applied.residual == pytest.approx(0.01, abs=1e-6)


def test_departure_is_told_while_the_third_rest_goes_on_and_survives_a_new_level(
        stored: Callable[..., Path]) -> None:
    calibration = read_calibration(stored())
    applied = Applied(GRAVITY)
    applied.adopt(calibration)

    def rest(time: float, off: float) -> Dwell:
        reading = calibration.predict(np.array([[0.0, 0.0, (1.0 + off) * GRAVITY]]))[0]
        return dwell(time, reading / GRAVITY)

    for time, off in ((0.0, 0.0), (10.0, 0.05), (20.0, 0.0), (30.0, 0.005), (40.0, 0.005)):
        applied.rested(rest(time, off), 0.001)
        applied.ended(rest(time, off), 0.001)
        assert applied.standing is not None
        assert applied.standing.departure is None
    applied.rested(rest(50.0, 0.005), 0.001)
    assert applied.standing.departure is not None
    applied.rested(rest(50.0, 0.0), 0.001)
    assert applied.standing.departure is None
    applied.ended(rest(50.0, 0.005), 0.001)
    assert applied.standing.departure is not None
    assert applied.standing.count == 6
    flat = calibration.predict(np.array([[0.0, 0.6, 0.8]]) * GRAVITY)[0]
    applied.adopt(level(calibration, flat, 'ros'))
    assert applied.standing.departure is not None
    applied.adopt(None)
    assert applied.standing is None


def test_rest_that_is_told_of_late_does_not_hide_the_one_that_goes_on(
        stored: Callable[..., Path]) -> None:
    calibration = read_calibration(stored())
    applied = Applied(GRAVITY)
    applied.adopt(calibration)
    early, late = dwell(0.0, [0, 0, 1]), dwell(10.0, [0, 0, 1.01])
    applied.rested(early, 0.001)
    applied.rested(late, 0.001)
    applied.ended(early, 0.001)
    assert applied.standing is not None
    assert applied.standing.count == 2
    applied.ended(late, 0.001)
    assert applied.standing.count == 2


def test_part_of_a_rest_is_what_came_after_the_other_part() -> None:
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(200, 3)), rng.normal(size=(100, 3))
    part = Dwell(0.0, 2.0, 1.0, first.mean(axis=0), np.ones(3), 100.0, 200,
                 {'temperature': 20.0}, 1)
    both = np.vstack([first, second])
    whole = Dwell(0.0, 3.0, 1.5, both.mean(axis=0), 2.0 * np.ones(3), 90.0, 300,
                  {'temperature': 22.0}, 1)
    rest = rest_after(part, whole)
    np.testing.assert_allclose(rest.mean, second.mean(axis=0))
    assert (rest.start, rest.end, rest.samples) == (2.0, 3.0, 100)
    assert rest.count == pytest.approx(50.0)
    np.testing.assert_array_equal(rest.std, np.ones(3))
    assert rest.time == pytest.approx(2.5)
    assert rest.context['temperature'] == pytest.approx(26.0)


def test_robot_that_stands_for_hours_is_watched_all_the_while(stored: Callable[..., Path]) -> None:
    calibration = read_calibration(stored())
    applied, watch = Applied(GRAVITY), Watch(CaptureSettings(), UNITS)
    applied.adopt(calibration)
    rng = np.random.default_rng(1)
    counts, left_at = [], 0.0
    base = calibration.predict(np.array([[0.0, 0.0, GRAVITY]]))[0]
    for k in range(4 * 5000):  # at 4 Hz; the offset begins to move after 2500 s
        time = k / 4.0
        shift = GRAVITY * 0.000003 * max(0.0, time - 2500.0)
        reading = base + 0.01 * rng.normal(size=3) + [0.0, 0.0, shift]
        change = watch.push(time, tuple(reading), None, {}, False)
        if change is not None and change.rest is not None:
            applied.rested(change.rest, 0.001)
        if applied.standing is not None and applied.standing.departure is not None:
            left_at = left_at or time
        counts.append(0 if applied.standing is None else applied.standing.count)
    assert max(counts) > 12
    assert 2500.0 < left_at < 4500.0


def test_pose_from_before_the_first_temperature_takes_that_of_the_next() -> None:
    book = PoseBook(CaptureSettings(repeated='merge'), UNITS)
    book.end(dwell(0.0, [0, 0, 1]))
    for time, direction in ((10.0, [1, 0, 0]), (20.0, [0, 0, 1])):
        book.end(replace(dwell(time, direction), context={'temperature': 30.0 + 0.1 * time}))
    np.testing.assert_allclose(book.poses()['temperature'], [31.5, 31.0])
    early = replace(dwell(-500.0, [0, 1, 0]), context={})
    assert 'temperature' not in poses_from(with_temperature([early, *book._dwells]))


@pytest.mark.parametrize(('repeated', 'count'), [('merge', 100.0), ('refuse', 50.0)])
def test_pose_at_another_temperature_is_no_repeated_one(repeated: Any, count: float) -> None:
    book = PoseBook(CaptureSettings(repeated=repeated), UNITS)
    for time, temperature in ((0.0, 24.0), (10.0, 25.0), (20.0, 38.0)):
        book.end(replace(dwell(time, [0, 0, 1]), context={'temperature': temperature}))
    np.testing.assert_allclose(book.poses()['count'], [count, 50.0])
    assert book.poses()['temperature'][1] == 38.0
