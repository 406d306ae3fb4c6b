# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses captured while samples arrive, and rests compared with the calibration in use."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from accel_calib.calibration import fit_poses, level
from accel_calib.session import CalibratorSettings
from accel_calib.stillness import capture, CaptureSettings, Dwell, poses_from
from accel_calib.stored import read_calibration
from inside import (
    LiveCapture, model_with, new_sensor, rest_after, simulate_recording, spread_directions,
    with_temperature)
import numpy as np
import pytest
from shared import GRAVITY, MPS2, NATIVE, Readings, rows_of, samples_of, Stored

SETTINGS = CalibratorSettings()

FACES = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


def push_all(live: LiveCapture, readings: Any, *, start: float = 0.0, rate: float = 50.0,
             capture: bool = True, omega: Any = np.nan, block: int = 5) -> list[Any]:
    """Push readings in small blocks, and return the changes."""
    samples = rows_of(start + np.arange(len(readings)) / rate, readings, omega)
    blocks = np.array_split(samples, max(1, len(samples) // block))
    return [change for block in blocks for change in live.push(block, capture)]


def monitored(stored: Stored) -> tuple[Any, Any]:
    """Return a calibration, and a sensor that uses it."""
    calibration = read_calibration(stored())
    return calibration, new_sensor(SETTINGS, MPS2).adopt(calibration)


def dwell(time: float, direction: Any, count: float = 50.0) -> Dwell:
    return Dwell(time, time + 1.0, time + 0.5, np.array(direction, float) * GRAVITY,
                 np.full(3, 0.01), count, 50, {}, round(time))


@pytest.mark.parametrize('seed', range(3))
def test_the_first_poses_at_a_limit_are_marked_as_in_a_recording(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = np.array([[0.0, 0, 1], [0.9, 0.1, 0.4], [0.1, 1.0, 0], [0.5, -0.6, 0.6],
                     [-0.6, 0.5, 0.6], [0.6, 0.6, -0.5], [-0.6, -0.6, -0.5], [-0.6, 0.6, -0.5]])
    up = np.repeat(ends / np.linalg.norm(ends, axis=1)[:, np.newaxis], 150, axis=0)
    reading = np.minimum(GRAVITY * (up + 0.003 * rng.normal(size=up.shape)), 0.8 * GRAVITY)
    live = LiveCapture(CaptureSettings(), MPS2)
    push_all(live, reading)
    whole = capture(samples_of(np.arange(len(reading)) / 50.0, reading), MPS2).poses
    poses = live.poses_for_fit(())
    assert poses['at_limit'].tolist() == whole['at_limit'][:len(poses)].tolist()
    assert poses['at_limit'].tolist() == [1.0, 1.0, 1.0, *[0.0] * (len(poses) - 3)]


@pytest.mark.parametrize(('up', 'noise'), [
    ((300.0, -200.0, 16500.0), 0.4), ((300.0, -200.0, 16500.0), 40.0),
    ((2048.0, 2060.0, 2458.0), 3.0)])  # 12 bits with the zero in the middle
@pytest.mark.parametrize('seed', range(3))
def test_a_board_that_sends_counts_is_still_within_3_s(up: Any, noise: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    live, times = LiveCapture(CaptureSettings(), NATIVE), np.arange(1200) / 84.0
    samples = rows_of(np.round(times, 3),
                      np.round(np.array(up) + rng.normal(0.0, noise, (len(times), 3))))
    still = []
    for block in np.array_split(samples, 150):
        list(live.push(block, True))
        still.append((block[-1, 0], live.still))
    assert all(found for time, found in still if time > 3.0)
    assert len(live.poses()) == 1


def test_rest_counts_before_it_ends_and_its_final_average_replaces_it(readings: Readings) -> None:
    live = LiveCapture(CaptureSettings(), MPS2)
    changes = push_all(live, readings([[0, 0, 1]], dwell=9.0))
    counts = [change.rest.samples for change in changes if change.poses]
    assert len(live.poses()) == 1
    assert counts == sorted(counts)
    assert counts[0] < 80 < 150 < counts[-1]
    live = LiveCapture(CaptureSettings(repeated='keep'), MPS2)
    changes = push_all(live, readings(FACES, dwell=2.0))
    assert len(live.poses()) == 3
    assert sum(len(change.ended) for change in changes) >= 1
    starts = [change.rest.start for change in changes if change.rest]
    assert starts == sorted(starts)  # an end that is known late is not that of the last rest
    assert np.all(np.diff(live.poses()['time']) > 1.5)


@pytest.mark.parametrize(('rate', 'turn', 'dwell'), [
    (25.0, 0.2, 1.5), (25.0, 5.0, 3.0), (25.0, 1.0, 10.0), (400.0, 0.2, 3.0), (400.0, 1.0, 1.5),
    (400.0, 5.0, 1.5)])
def test_no_pose_of_a_turned_sensor_is_doubtful(dwell: float, turn: float, rate: float) -> None:
    live = LiveCapture(CaptureSettings(), MPS2)
    recording = simulate_recording(
        model_with({}), np.array(FACES, float), np.random.default_rng(1), noise_g=0.002,
        rate_hz=rate, dwell=dwell, turn=turn)
    changes = push_all(live, recording.reading * GRAVITY, rate=rate, omega=recording['rate'])
    assert len(live.poses()) == 3
    assert sum(change.doubted for change in changes) == 0
    assert 'doubtful' not in live.poses()


def test_removed_pose_is_not_captured_again_in_the_same_rest(readings: Readings) -> None:
    live, rest = LiveCapture(CaptureSettings(), MPS2), readings([[0, 0, 1]], dwell=12.0)
    push_all(live, rest[:150])
    assert live.undo()
    push_all(live, rest[150:], start=3.0)
    push_all(live, readings(FACES[1:], dwell=2.0), start=12.0)
    assert len(live.poses()) == 2


def book_of(rests: Iterable[Any], repeated: Any = 'merge') -> LiveCapture:
    """Return the poses of rests, each with its time, direction and perhaps temperature."""
    live = LiveCapture(CaptureSettings(repeated=repeated), MPS2)
    for time, direction, *warm in rests:
        live.put(replace(dwell(time, direction), context=dict(zip(['temperature'], warm))),
                 ended=True)
    return live


def test_repeated_poses_are_merged_and_undone_one_by_one() -> None:
    live = book_of([(0.0, [0, 0, 1]), (10.0, [1, 0, 0]), (20.0, [0.01, 0, 1])])
    assert len(live.poses()) == 2
    assert live.poses()['count'].max() == pytest.approx(100.0)
    assert live.undo()
    assert live.poses()['count'].max() == pytest.approx(50.0)
    assert len(live.poses()) == 2


def test_a_rest_that_is_played_again_is_no_other_pose_unless_its_mean_differs() -> None:
    live = book_of([(0.0, [0, 0, 1]), (10.0, [0, 1, 0])], 'keep')
    for direction, count in (([0, 0, 1], 2), ([0, 0.001, 1], 3)):
        live.put(dwell(0.0, direction), ended=True)
        assert len(live.poses()) == count


def test_poses_of_a_robot_that_parks_for_years_need_bounded_memory() -> None:
    directions = spread_directions(6)
    live = book_of((10.0 * k, directions[k % 6]) for k in range(600))
    assert len(live.poses()) == 6
    assert live.poses()['count'].sum() == pytest.approx(600 * 50.0)
    assert len(live._earlier) + len(live._dwells) < 80


def test_stored_poses_are_added_as_they_were() -> None:
    live = book_of((10.0 * k, up) for k, up in enumerate(spread_directions(8)))
    live.put(replace(dwell(-5.0, [0, 0, 1]), at_limit=True, doubtful=True), ended=True)
    poses, again = live.poses(), book_of([])
    again.add_stored(poses)
    for key in poses.columns:
        np.testing.assert_allclose(again.poses()[key], poses[key], err_msg=key)
    assert again.poses()['at_limit'].sum() == again.poses()['doubtful'].sum() == 1.0


def test_change_is_reported_during_the_third_rest_and_survives_a_new_level(stored: Stored) -> None:
    calibration, sensor = monitored(stored)

    def rest(time: float, off: float) -> Dwell:
        reading = calibration.predict(np.array([[0.0, 0.0, (1.0 + off) * GRAVITY]]))[0]
        return dwell(time, reading / GRAVITY)

    rests = [(10.0 * k, off, ended) for k, off in enumerate((0.0, 0.05, 0.0, 0.005, 0.005))
             for ended in (False, True)]  # what is reported stays for rests without it
    for time, off, ended in [*rests, (50, 0.005, False), (50, 0.0, False), (50, 0.005, True)]:
        sensor = sensor.update(rest(time, off), 0.001, ended=ended)
        assert sensor.has_changed is (time == 50)
    assert sensor.drift.count == 6
    flat = calibration.predict(np.array([[0.0, 0.6, 0.8]]) * GRAVITY)[0]
    sensor = sensor.adopt(level(calibration, flat, 'ros'))
    assert sensor.has_changed
    assert sensor.adopt(None).drift is None


def test_rest_that_is_reported_late_does_not_hide_the_ongoing_rest(stored: Stored) -> None:
    (_, sensor), counts = monitored(stored), []
    early, late = dwell(0.0, [0, 0, 1]), dwell(10.0, [0, 0, 1.01])
    jumped = replace(late, end=late.end + 1e3)  # by a clock
    for rest, ended in ((early, False), (late, False), (early, True), (late, True),
                        (jumped, False)):
        sensor = sensor.update(rest, 0.001, ended=ended)
        counts.append(sensor.drift.count)
    assert counts[2:] == [2, 2, 2]


def test_remainder_of_a_rest_is_what_came_after_its_part() -> None:
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
    np.testing.assert_array_equal(rest.std, np.ones(3))
    assert (rest.count, rest.time, rest.context['temperature']) == pytest.approx((50.0, 2.5, 26.0))


def test_robot_that_stands_for_hours_is_monitored_all_the_time(stored: Stored) -> None:
    (calibration, sensor), live = monitored(stored), LiveCapture(CaptureSettings(), MPS2)
    rng = np.random.default_rng(1)
    counts, left_at = [], 0.0
    base = calibration.predict(np.array([[0.0, 0.0, GRAVITY]]))[0]
    for k in range(0, 4 * 2000, 40):  # at 4 Hz; the offset begins to change after 1000 s
        time = (k + np.arange(40)) / 4.0
        readings = base + 0.01 * rng.normal(size=(40, 3))
        readings[:, 2] += GRAVITY * 0.00001 * np.maximum(0.0, time - 1000.0)
        for change in push_all(live, readings, start=time[0], rate=4.0, capture=False, block=40):
            if change.rest is not None:
                sensor = sensor.update(change.rest, 0.001)
        left_at = left_at or time[0] * sensor.has_changed
        counts.append(sensor.drift.count)
    assert max(counts) >= 5  # long rests are compared in parts of 5 minutes
    assert 1000.0 < left_at < 1800.0


def test_pose_without_a_temperature_gets_that_between_its_neighbours() -> None:
    live = book_of([(0.0, [0, 0, 1]), (10.0, [1, 0, 0], 31.0), (17.5, [0, 1, 0]),
                    (20.0, [0, 0, 1], 32.0)])
    np.testing.assert_allclose(live.poses()['temperature'], [31.5, 31.0, 31.75])
    early = dwell(-500.0, [0, 1, 0])
    assert 'temperature' not in poses_from(with_temperature([early, *live._dwells]))


@pytest.mark.parametrize(('repeated', 'count'), [('merge', 100.0), ('refuse', 50.0)])
def test_pose_at_another_temperature_is_not_repeated(repeated: Any, count: float) -> None:
    live = book_of([(0.0, [0, 0, 1], 24.0), (10.0, [0, 0, 1], 25.0), (20.0, [0, 0, 1], 38.0)],
                   repeated)
    np.testing.assert_allclose(live.poses()['count'], [count, 50.0])
    assert live.poses()['temperature'][1] == 38.0


def test_poses_of_a_noisier_time_are_marked_and_kept() -> None:
    rng = np.random.default_rng(3)
    live = LiveCapture(CaptureSettings(repeated='keep'), MPS2)
    start, changes = 0.0, []
    for noise in (0.004, 0.0004):
        for direction in spread_directions(12):
            moving = GRAVITY * (direction + 0.4 * rng.normal(size=(50, 3)))
            held = GRAVITY * (direction + 0.004 * np.sin(0.9 * np.arange(150))[:, np.newaxis]
                              * (noise > 0.001) + noise * rng.normal(size=(150, 3)))
            changes += push_all(live, np.vstack([moving, held]), start=start)
            start += 4.0
    poses = live.poses()
    assert poses['doubtful'].tolist() == [1.0] * 12 + [0.0] * 12
    assert sum(change.doubted for change in changes) == 12
    calibration = fit_poses(poses, MPS2, model='10')
    assert [each.row for each in calibration.rejected] == list(range(1, 13))
    assert list(calibration.used_poses.row) == list(range(13, 25))
    needed = fit_poses(poses.take(slice(0, 13)), MPS2, model='10')
    assert not needed.rejected
    assert [each.rows for each in needed.noted if each.kind == 'doubtful'] == [tuple(range(1, 13))]
