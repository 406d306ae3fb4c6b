# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The stillness detector: many sensors, tremor, slow turning, real recordings."""

from dataclasses import replace

from accel_calib.errors import InputError
from accel_calib.stillness import (
    capture, Captured, CaptureSettings, poses_from, select, StillDetector)
from accel_calib.units import units_of
from inside import (
    excess_of_means, long_run, Model, oscillation, repeated_extremes, simulate_recording)
import numpy as np
import pytest
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation, Slerp
from shared import G, rows_of as rows, samples_of, table


def still(seed, seconds, rate=100.0, noise=2e-3):
    """Return times and readings of a sensor at rest."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(seconds * rate)) / rate
    force = Rotation.random(random_state=seed).apply([0.0, 0.0, 1.0])
    return time, force + noise * rng.normal(size=(len(time), 3))


def turned(seed, rate=100.0, noise=2e-3, correlation=0.0, step=0.0, dwell=(1.5, 8.0), poses=8):
    """Return times, readings and (start, end, force) of a sensor turned by hand."""
    rng = np.random.default_rng(seed)
    lengths = np.column_stack([rng.uniform(*dwell, poses), rng.uniform(0.6, 2.0, poses)])
    keys = np.concatenate([[0.0], np.cumsum(lengths)])[:-1]
    attitude = Rotation.random(poses, random_state=seed)
    time = np.arange(int(keys[-1] * rate)) / rate
    slerp = Slerp(keys, attitude[np.repeat(np.arange(poses), 2)])
    moving = (np.searchsorted(keys, time, side='right') % 2 == 0)[:, np.newaxis]
    decay = np.exp(-40.0 / rate)
    hand = max(0.08, 4.0 * noise) * moving * lfilter(
        [np.sqrt(1.0 - decay**2)], [1.0, -decay], rng.normal(size=(len(time), 3)), axis=0)
    own = lfilter([np.sqrt(1.0 - correlation**2)], [1.0, -correlation],
                  rng.normal(size=(len(time) + 500, 3)), axis=0)[500:]
    reading = slerp(time).apply([0.0, 0.0, 1.0]) + hand + noise * own
    if step > 0.0:
        reading = np.round(reading / step) * step
    truth = [(keys[2 * i], keys[2 * i + 1], attitude[i].apply([0.0, 0.0, 1.0]))
             for i in range(poses)]
    return time, reading, truth


def captured(time, reading, units=G, settings=CaptureSettings(), **columns) -> Captured:
    return capture(samples_of(time, units.from_g(reading), **columns), units, settings)


def pushed(samples, block=60, keep=None) -> StillDetector:
    """Return a detector that received the samples in blocks of this size."""
    detector = StillDetector(CaptureSettings(), G, keep)
    for start in range(0, len(samples), block):
        detector.push(samples[start:start + block])
    detector.close()
    return detector


def assert_all_found(result: Captured, truth):
    time = result.poses['time']
    assert [np.sum((time > start) & (time < end)) for start, end, _ in truth] == [1] * len(truth)
    assert len(time) == len(truth), 'a pose was found while the sensor moved'


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('sensor', [
    {}, {'noise': 5e-5}, {'noise': 0.05, 'dwell': (9.0, 12.0)}, {'noise': 0.0},
    {'rate': 1000.0}, {'rate': 200.0},
    {'rate': 25.0, 'dwell': (2.0, 8.0)}, {'rate': 100.0, 'correlation': 0.9, 'dwell': (3.0, 8.0)},
    {'noise': 5e-5, 'step': 1e-3}, {'noise': 3e-4, 'step': 4e-3}, {'dwell': (1.5, 1.6)}],
    ids=lambda sensor: ' '.join(f'{key} {value}' for key, value in sensor.items()) or 'usual')
def test_all_poses_are_found_and_no_others(sensor, seed):
    time, reading, truth = turned(seed, **sensor)
    assert_all_found(captured(time, reading), truth)


def reasons(result: Captured) -> list[str]:
    return [each.reason for each in result.rests]


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('place', [0.0, 0.5, 1.0])
@pytest.mark.parametrize('what', ['zeros', 'frozen'])
def test_missing_samples_are_no_rest_and_hide_no_other(what, place, seed):
    _, reading, truth = turned(seed, dwell=(2.5, 4.0))
    moving = int(100.0 * (truth[3][1] + truth[4][0]) / 2.0)
    at = {0.0: 0, 0.5: moving, 1.0: len(reading)}[place]
    held = reading[min(at, len(reading) - 1)] * (what == 'frozen')
    reading = np.insert(reading, at, np.tile(held, (200, 1)), axis=0)
    result = captured(np.arange(len(reading)) / 100.0, reading)
    assert reasons(result).count('') == len(result.poses) == len(truth)
    left = [each.end - each.start for each in result.rests if each.reason == what]
    assert sum(left) == pytest.approx(2.0, abs=0.3)
    assert result.threshold == pytest.approx(captured(*turned(seed)[:2]).threshold, rel=0.15)


@pytest.mark.parametrize('ratio', [0.1, 0.2, 0.4, 0.8])
@pytest.mark.parametrize('seed', range(3))
def test_a_coarse_sensor_that_repeats_its_readings_misses_none(ratio, seed):
    time, reading, truth = turned(seed, step=2e-3 / ratio, dwell=(2.0, 5.0))
    result = captured(time, reading)
    assert_all_found(result, truth)
    assert not {'zeros', 'frozen'} & {*reasons(result)}


@pytest.mark.parametrize(('gain', 'offset'), [
    ((1.0, 1.0, 1.0), (0.35, -0.4, 0.3)), ((2.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
    ((0.6, 1.0, 1.4), (0.2, 0.1, -0.3))])
def test_rests_of_a_sensor_with_large_errors_are_poses_and_those_of_no_gravity_are_not(
        gain, offset):
    time, reading, truth = turned(4, poses=14)
    start, end, _ = truth[6]
    reading[(time > start) & (time < end)] *= 1.5  # as in a turn of a vehicle
    result = captured(time, reading * gain + offset)
    assert reasons(result) == [*[''] * 6, 'length', *[''] * 7]


def test_a_sensor_sampled_every_ten_seconds_is_captured():
    time, reading = still(3, 4000.0, rate=0.1, noise=7e-5)
    reading[200:] += [0.3, -0.2, -0.05]
    assert len(captured(time, reading).poses) == 2


@pytest.mark.parametrize('block', [1, 7, 60, 1000])
def test_a_stream_has_the_poses_and_interruptions_of_the_recording_for_any_blocks(block):
    time, reading, _ = turned(5, poses=6)
    rate = np.random.default_rng(5).normal(0.02, 2e-3, reading.shape)
    time = time + 1.7e9
    time[900:] += 4.0
    time[1700:] -= 9.0
    detector, result = pushed(rows(time, reading, rate), block), captured(time, reading, rate=rate)
    assert [each.kind for each in result.interruptions] == ['gap', 'jump_back']
    assert detector.interruptions == result.interruptions
    poses, dwells = result.poses, detector.dwells()
    assert len(poses) >= 6
    np.testing.assert_array_equal([each.time for each in dwells], poses['time'])
    assert sum(each.samples for each in dwells) == result.samples
    streamed = poses_from(dwells)
    for key in ('reading', 'rate', 'std', 'rate_std', 'count'):
        np.testing.assert_array_equal(streamed[key], poses[key])


@pytest.mark.parametrize('speed', [0.5, 1.0, 2.0, 5.0])
@pytest.mark.parametrize('noise', [5e-5, 2e-3, 1e-2])
def test_slow_turning_is_not_still(speed, noise):
    for seed in range(2):
        rng = np.random.default_rng(seed)
        time = np.arange(2000) / 100.0
        angle = np.radians(speed) * np.maximum(time - 6.0, 0.0)
        force = np.column_stack([np.sin(angle), np.zeros(2000), np.cos(angle)])
        result = captured(time, force + noise * rng.normal(size=force.shape))
        assert len(result.poses) == 1
        assert result.poses['time'][0] < 4.0
        assert np.abs(result.poses.reading[0] - [0.0, 0.0, 1.0]).max() < 5e-3 + noise


@pytest.mark.parametrize('seed', range(3))
def test_a_sensor_that_is_tilted_and_tilted_back_in_a_short_dwell_is_not_still(seed):
    time, reading, truth = turned(seed, noise=1e-4, dwell=(1.6, 1.7))
    start, end, force = truth[3]
    share = np.clip((time - start) / (end - start), 0.0, 1.0)
    aside = np.cross(force, [1.0, 0.0, 0.0])
    tilt = 0.003 * (end - start) * (1.0 - np.abs(2.0 * share - 1.0))
    moved = reading + tilt[:, np.newaxis] * aside / np.linalg.norm(aside)
    assert_all_found(captured(time, moved), [*truth[:3], *truth[4:]])


def rests_found(excess, noise, turning=0.0, gyro=True, value=None):
    """
    Return which rests of 3 s are poses.

    The gyro reads the excess of each about y in addition to its bias, and the reading turns at
    the share `turning` of it [°/s]. In three rests it sends one `value`, unless that is None.

    """
    rng, seconds = np.random.default_rng(3), np.arange(300) / 100.0
    readings, rates = [], []
    for index, each in enumerate(excess):
        angle = 0.5 * index + np.radians(each) * turning * seconds
        force = np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)])
        readings += [force + noise * rng.normal(size=(300, 3)), rng.normal(size=(100, 3))]
        rates += [[0.02, -0.01 + np.radians(each), 0.03] + 1e-4 * rng.normal(size=(300, 3)),
                  rng.normal(size=(100, 3))]
    reading, rate = np.concatenate(readings), np.concatenate(rates)
    if value is not None:
        rate[800:2050] = value
    known = {'rate': rate} if gyro else {}
    poses = captured(np.arange(len(reading)) / 100.0, reading, **known).poses
    return (poses['time'] // 4.0).tolist()


def test_a_gyro_decides_whether_a_short_noisy_rest_turns_slowly():
    rests, turned_one = [0.0] * 8, [0.0] * 5 + [1.0, 0.0, 0.0]
    assert len(rests_found(rests, 0.05, gyro=False)) < 4
    assert rests_found(rests, 0.005, gyro=False) == list(range(8))
    assert rests_found(rests, 0.05) == list(range(8))
    assert rests_found(turned_one, 0.05, turning=1.0) == [0, 1, 2, 3, 4, 6, 7]
    for value in (0.0, 0.0123, -0.7):  # a driver that gets no rates for a while
        assert rests_found(rests, 0.005, value=value) == list(range(8))


def test_a_gyro_that_says_turning_overrules_a_steady_reading():
    limit = 6.0 * 1.4826 * 0.1  # [°/s]: 6 times the robust spread
    excess = [0.1, -0.1, 0.1, -0.1, limit - 0.02, 0.1, -0.1, -limit - 0.02, 0.1, -0.1]
    assert rests_found(excess, 1e-3) == [0, 1, 2, 3, 4, 5, 6, 8, 9]


@pytest.mark.parametrize(('noise', 'shift', 'parts'), [
    (2e-3, 1e-3, 1), (2e-3, 0.012, 2), (1e-4, 0.012, 2)])
def test_a_knock_separates_dwells_whose_means_differ_by_more_than_the_noise(noise, shift, parts):
    time, reading = still(5, 12.0, noise=noise)
    reading[600:] += shift * np.linalg.svd(reading[:1])[2][1]
    reading[595:605] += 0.3 * np.random.default_rng(1).normal(size=(10, 3))
    assert len(captured(time, reading).poses) == parts


def test_samples_that_repeat_an_extreme_of_an_axis_are_counted_over_blocks():
    starts = np.array([0, 4])
    first = np.array([[1, 1, 0, 1, 1, 0, 0, 0], [-2, 0, -2, 0, -3, -3, -1, 0],
                      [5, 6, 6, 7, 7, 7, 0, 0.0]])
    found, highest = repeated_extremes(first, starts, np.full(6, -np.inf))
    np.testing.assert_array_equal(found, [[2, 2, 0], [4, 2, 3]])
    later = np.array([[1, 0, 0, 1], [-3, 0, -3, -3], [8, 8, 0, 0.0]])
    np.testing.assert_array_equal(repeated_extremes(later, starts[:1], highest)[0], [[4, 4, 3]])


def shaken(seed, frequency, size=0.1, seconds=12.0, rate=100.0, noise=2e-3):
    """Return times and readings of a sensor shaken along gravity by this share of |a|."""
    time, reading = still(seed, seconds, rate, noise)
    force = reading.mean(axis=0) / np.linalg.norm(reading.mean(axis=0))
    swing = np.sin(2.0 * np.pi * frequency * time + seed)
    return time, reading + size * swing[:, np.newaxis] * force


@pytest.mark.parametrize('frequency', [1.0, 10.0 / 3.0, 4.7])
@pytest.mark.parametrize(('size', 'rate'), [(0.02, 100.0), (0.1, 100.0), (0.05, 1000.0)])
def test_shaking_from_the_first_second_on_is_neither_still_nor_a_pose(frequency, size, rate):
    time, reading = shaken(3, frequency, size, seconds=9.0, rate=rate)
    detector = StillDetector(CaptureSettings(), G)
    block = int(0.1 * rate)
    for start in range(0, len(time), block):
        detector.push(rows(time[start:start + block], reading[start:start + block]))
        assert detector.current() is None or time[start] < 4.0
        assert not detector.still or time[start] < 4.0
    detector.close()
    assert detector.dwells() == []


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(('order', 'corner'), [(1, 5.0), (2, 5.0), (4, 10.0), (2, 20.0)])
def test_noise_behind_a_low_pass_filter_is_still(seed, order, corner):
    time, _ = still(seed, 12.0)
    noise = lfilter(*butter(order, corner, fs=100.0),
                    np.random.default_rng(seed).normal(size=(len(time) + 500, 3)), axis=0)[500:]
    assert len(captured(time, [0.6, 0.0, 0.8] + 0.01 * noise / noise.std()).poses) == 1


def test_the_ongoing_dwell_is_available_before_it_ends():
    time, reading = still(6, 4.0)
    detector = StillDetector(CaptureSettings(), G)
    detector.push(rows(time[:80], reading[:80]))
    assert detector.still
    assert detector.current() is None
    detector.push(rows(time[80:], reading[80:], temperature=21.0))
    dwell = detector.current()
    assert dwell.samples > 300
    assert dwell.context['temperature'] == pytest.approx(21.0)
    assert detector.dwells() == []
    after = np.arange(4.0, 5.5, 0.01)
    detector.push(rows(after, np.column_stack([after % 0.3, np.ones(150), after % 0.7])))
    assert not detector.still
    assert detector.current() is None
    assert len(detector.dwells()) == 1


@pytest.mark.parametrize('correlation', [0.0, 0.6, 0.9])
def test_the_stated_noise_of_a_mean_is_correct(correlation):
    scores = []
    for seed in range(20):
        time, reading, truth = turned(seed, correlation=correlation, poses=6)
        poses = captured(time, reading).poses
        for stamp, mean, noise in zip(poses['time'], poses.reading, poses.noise):
            force = next(force for start, end, force in truth if start < stamp < end)
            scores.append((mean - force) / noise)
    assert 0.85 < np.std(scores) < 1.15


def test_a_detector_that_keeps_only_the_last_dwells_returns_the_same_dwells():
    time, reading, _ = turned(3, poses=8)
    few, every = (pushed(rows(time, reading), keep=keep).dwells() for keep in (3, None))
    assert [each.start for each in few] == [each.start for each in every[-3:]]


def test_a_dwell_that_is_not_still_according_to_later_ones_is_doubtful():
    reading = turned(2, noise=2e-3, poses=4)[1]
    first, held = still(8, 5.0)
    held = held + 0.01 * np.sin(2.0 * np.pi * 8.3 * first + 0.3)[:, np.newaxis]
    reading = np.concatenate([held, [[0.0, 0.0, 3.0]] * 100, reading])
    start, = (each.start for each in pushed(rows(
        np.arange(len(reading)) / 100.0, reading)).judged() if each.reason)
    assert start < 1.0


def test_correlations_at_lags_of_half_a_series_and_more_are_not_used():
    known = np.array([1.0, 0.5, 0.3, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    beyond = known + 0.3 * (np.arange(9) >= 4)
    assert long_run(beyond, 9) == long_run(known, 9)
    assert long_run(known, 9) > long_run(known * (np.arange(9) < 2), 9)


def test_the_excess_of_a_mean_is_1_for_fewer_than_four_cells_or_without_noise():
    series = np.cumsum(np.random.default_rng(2).normal(size=(3, 40)), axis=1)
    found = [excess_of_means(part - part.mean(axis=1, keepdims=True), np.ones(3))
             for part in (series, series[:, :4], series[:, :3])]
    assert found[0] > 3.0
    assert found[1] != found[2] == 1.0
    assert excess_of_means(series - series.mean(axis=1, keepdims=True), np.zeros(3)) == 1.0


@pytest.mark.parametrize('periods', [2.0, 2.5, 3.0, 11.5])
def test_waves_of_half_periods_beside_a_slope_are_oscillations(periods):
    time = np.linspace(-0.5, 0.5, 37)[:-1] + 0.5 / 36
    wave = np.outer([1.0, -0.3, 0.5], np.cos(2.0 * np.pi * periods * time + 0.4))
    values = wave + np.outer([5.0, 1.0, 0.0], time) + 7.0
    assert oscillation(values, 36, np.array([0]))[0] == pytest.approx(1.0)
    noise = np.random.default_rng(1).normal(size=(3, 36))
    assert oscillation(noise, 36, np.array([0]))[0] < 0.3


def visited(directions):
    """Return times and readings of a sensor that is turned to these directions."""
    found = simulate_recording(Model({}), np.array(directions, float), np.random.default_rng(0))
    return found['time'], found.reading


FACES = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, -1, 0), (-1, 0, 0)]
AGAIN = [*FACES, (0.03, 0.0, 0.9996), (0.0, 0.9996, 0.02)]


@pytest.mark.parametrize(('repeated', 'poses'), [('keep', 8), ('merge', 6), ('refuse', 6)])
@pytest.mark.parametrize(('unit', 'scale'), [('g', 1.0), ('native', 4e3)])
def test_repeated_poses_are_kept_merged_or_refused_as_asked(repeated, poses, unit, scale):
    time, reading = visited(AGAIN)
    settings = CaptureSettings(repeated=repeated)
    assert len(captured(time, scale * reading, units_of(unit), settings).poses) == poses


@pytest.mark.parametrize('repeated', ['keep', 'merge', 'refuse'])
def test_parts_of_a_long_rest_are_not_repeated_poses(repeated):
    settings = CaptureSettings(repeated=repeated, max_dwell=5.0)
    assert captured(*still(3, 20.0), settings=settings).poses['orientation'].tolist() == [0] * 4


@pytest.mark.parametrize('repeated', ['merge', 'refuse'])
def test_a_doubtful_pose_does_not_take_the_place_of_a_sure_one(repeated):
    dwells = [replace(each, doubtful=k == 0)
              for k, each in enumerate(pushed(rows(*visited(AGAIN))).dwells())]
    kept = select(dwells, CaptureSettings(repeated=repeated), G)
    assert [each.doubtful for each in kept] == [True, *[False] * 6]
    assert kept[0] is dwells[0]
    assert kept[6] is dwells[6]


def test_a_number_that_is_not_finite_is_refused_with_its_row():
    time, reading = visited(FACES)
    reading = reading.copy()
    reading[70, 1] = np.nan
    with pytest.raises(InputError, match='row 71 .* remove that row'):
        captured(time, reading)


@pytest.mark.parametrize(('count', 'step', 'interruptions'), [
    (0, 0.01, []), (1, 0.01, []), (2, 0.01, []), (12, 0.01, []), (250_000, 0.0, ['stopped'])])
def test_few_samples_or_stamps_that_stop_make_no_pose(count, step, interruptions):
    result = captured(step * np.arange(count), np.tile([0.0, 0.0, 1.0], (count, 1)))
    assert (len(result.poses), result.samples) == (0, 0)
    assert [each.kind for each in result.interruptions] == interruptions


@pytest.mark.parametrize(('name', 'value'), table('capture_settings_out_of_range'))
def test_settings_out_of_range_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f'{name} is'):
        CaptureSettings(**{'max_dwell': np.inf, name: value})
