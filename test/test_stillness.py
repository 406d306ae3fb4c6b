# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The stillness detector: many sensors, tremor, slow turning, interrupted stamps."""

from __future__ import annotations

from accel_calib.capture import capture, Captured, CaptureSettings, Dwell, StillDetector
from accel_calib.table import Recording
from accel_calib.units import units_of
from inside import lines_through, long_run
import numpy as np
import pytest
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation, Slerp

G = units_of('g')


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


def captured(time, reading, settings=CaptureSettings(), units=G, **columns) -> Captured:
    table = {'time': time, 'reading': units.from_g(reading), **columns}
    return capture(Recording(table, np.arange(1, len(time) + 1)), units, settings)


def pushed(time, reading, settings=CaptureSettings(), rate=None) -> StillDetector:
    """Return a detector that received the samples in blocks of 1 to 60."""
    detector = StillDetector(settings, G)
    table = rows(time, reading, rate)
    ends = np.cumsum(np.random.default_rng(len(time)).integers(1, 60, len(time)))
    for block in np.split(table, ends[ends < len(time)]):
        detector.push(block)
    detector.close()
    return detector


def rows(time, reading, rate=None, temperature=np.nan):
    """Return samples as `StillDetector.push` takes them."""
    samples = np.full((len(time), 9), np.nan)
    samples[:, 0], samples[:, 1:4], samples[:, 7] = time, reading, temperature
    if rate is not None:
        samples[:, 4:7] = rate
    return samples


def assert_same(one: Dwell, other: Dwell):
    assert (one.start, one.end, one.samples) == (other.start, other.end, other.samples)
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-12)
    np.testing.assert_allclose(one.std, other.std, rtol=1e-9)
    np.testing.assert_allclose(one.count, other.count, rtol=1e-6)


def assert_all_found(result: Captured, truth, missed=0):
    time = result.poses['time']
    hits = [int(np.sum((time > start) & (time < end))) for start, end, _ in truth]
    assert sum(hits) == len(time), 'a pose was found while the sensor moved'
    assert max(hits) == 1
    assert hits.count(0) <= missed


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


def test_a_sensor_sampled_every_ten_seconds_is_captured():
    time, reading = still(3, 4000.0, rate=0.1, noise=7e-5)
    reading[200:] += [0.3, -0.2, -0.05]
    assert len(captured(time, reading).poses) == 2


@pytest.mark.parametrize(('seed', 'blocks'), [(0, 1), (1, 7), (0, 1000)])
def test_dwells_do_not_depend_on_streaming_or_blocks(seed, blocks):
    time, reading, _ = turned(seed, poses=6)
    rate = np.random.default_rng(seed).normal(0.02, 2e-3, reading.shape)
    one = pushed(time, reading, rate=rate).dwells()
    samples = rows(time, reading, rate)
    detector = StillDetector(CaptureSettings(), G)
    for start in range(0, len(samples), blocks):
        detector.push(samples[start:start + blocks])
    detector.close()
    assert len(one) == len(detector.dwells()) == 6
    for first, second in zip(one, detector.dwells()):
        assert_same(first, second)


def test_streaming_equals_the_array_path_over_interruptions():
    time, reading, _ = turned(5, poses=6)
    time = time + 1.7e9
    time[900:] += 4.0
    time[1700:] -= 9.0
    detector, result = pushed(time, reading), captured(time, reading)
    dwells = detector.dwells()
    assert [each.kind for each in result.interruptions] == ['gap', 'jump_back']
    assert detector.interruptions == result.interruptions
    np.testing.assert_array_equal([each.time for each in dwells], result.poses['time'])


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


@pytest.mark.parametrize('speed', [0.5, 1.0, 2.0])
def test_slow_turning_of_a_noisy_sensor_leaves_no_pose(speed):
    rng = np.random.default_rng(7)
    time = np.arange(3000) / 100.0
    angle = np.radians(speed) * np.maximum(time - 14.0, 0.0)
    force = np.column_stack([np.sin(angle), np.zeros(3000), np.cos(angle)])
    result = captured(time, force + 0.05 * rng.normal(size=force.shape))
    assert np.all(result.poses['time'] < 14.0)


def test_a_slow_turn_there_and_back_within_a_dwell_of_a_noisy_sensor_is_found():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        time = np.arange(700) / 50.0
        angle = np.radians(0.7) * np.abs(time - 7.0)
        force = np.column_stack([np.sin(angle), np.zeros(700), np.cos(angle)])
        assert len(captured(time, force + 0.05 * rng.normal(size=force.shape)).poses) == 0


def rests_with_a_gyro(turned_one, seconds=3.0, noise=0.05, count=8):
    """Return readings and rates of rests; one rest is turned at 1 °/s."""
    rng = np.random.default_rng(3)
    readings, rates = [], []
    for index in range(count):
        angle = np.radians(np.arange(int(seconds * 100)) / 100.0) * (index == turned_one)
        force = np.column_stack([np.sin(angle), 0.0 * angle, np.cos(angle)])
        force = Rotation.random(random_state=index).apply(force)
        readings += [force + noise * rng.normal(size=force.shape), rng.normal(size=(100, 3))]
        axis = Rotation.random(random_state=index).apply([0.0, 1.0, 0.0])
        bias = np.array([0.02, -0.01, 0.03]) - axis * np.radians(1.0) * (index == turned_one)
        rates += [bias + 2e-3 * rng.normal(size=force.shape), rng.normal(size=(100, 3))]
    reading = np.concatenate(readings)
    return np.arange(len(reading)) / 100.0, reading, np.concatenate(rates)


def test_a_dwell_too_short_to_exclude_slow_turning_is_not_a_pose():
    time, reading, _ = rests_with_a_gyro(None)
    assert len(captured(time, reading).poses) < 4
    time, reading, _ = rests_with_a_gyro(None, noise=0.005)
    assert len(captured(time, reading).poses) == 8


def test_a_gyro_distinguishes_rests_from_slow_turning_once_its_bias_is_known():
    time, reading, rate = rests_with_a_gyro(None)
    assert len(captured(time, reading, rate=rate).poses) == 8
    time, reading, rate = rests_with_a_gyro(5)
    poses = captured(time, reading, rate=rate).poses
    assert len(poses) == 7
    assert not np.any((poses['time'] > 20.0) & (poses['time'] < 23.0))


@pytest.mark.parametrize('amplitude', [0.01, 0.03])
def test_a_hand_held_tremor_is_not_a_pose_after_a_quiet_rest(amplitude):
    time, reading, _ = turned(2, noise=2e-3, poses=4)
    first, held = still(8, 5.0)
    held = held + amplitude * np.sin(2.0 * np.pi * 8.3 * first + 0.3)[:, np.newaxis]
    result = captured(np.arange(len(time) + 500) / 100.0, np.concatenate([held, reading]))
    assert len(result.poses) == 4
    assert result.poses['time'].min() > 5.0


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


@pytest.mark.parametrize('seed', range(3))
def test_shaking_at_a_wandering_frequency_is_not_a_pose(seed):
    rng = np.random.default_rng(seed)
    time, reading = still(seed, 12.0)
    frequency = 3.0 + 0.3 * lfilter([0.14], [1.0, -0.99], rng.normal(size=len(time)))
    swing = np.sin(2.0 * np.pi * np.cumsum(frequency) / 100.0)[:, np.newaxis] * [0.05, 0.08, -0.02]
    assert len(captured(time, reading + swing).poses) == 0


@pytest.mark.parametrize(('size', 'poses'), [(0.01, 0), (4e-3, 6)])
def test_shaking_in_counts_is_not_a_pose(size, poses):
    moved = np.random.default_rng(1).normal(size=(6, 100, 3))
    reading = np.concatenate([np.concatenate([shaken(seed, 1.5, size, 8.0)[1], moved[seed]])
                              for seed in range(6)])
    time = np.arange(len(reading)) / 100.0
    assert len(captured(time, 4000.0 * reading, units=units_of('native')).poses) == poses


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize(('order', 'corner'), [(1, 5.0), (2, 5.0), (4, 10.0), (2, 20.0)])
def test_noise_behind_a_low_pass_filter_is_still(seed, order, corner):
    time, _ = still(seed, 12.0)
    noise = lfilter(*butter(order, corner, fs=100.0),
                    np.random.default_rng(seed).normal(size=(len(time) + 500, 3)), axis=0)[500:]
    assert len(captured(time, [0.6, 0.0, 0.8] + 0.01 * noise / noise.std()).poses) == 1


@pytest.mark.parametrize(('slope_g', 'poses'), [(6e-4, 1), (3e-3, 0)])
def test_a_dwell_may_settle_but_not_turn(slope_g, poses):
    time = np.arange(1000) / 100.0
    force = np.column_stack([np.sin(slope_g * time), np.zeros(1000), np.cos(slope_g * time)])
    noise = 5e-4 * np.random.default_rng(1).normal(size=force.shape)
    assert len(captured(time, force + noise).poses) == poses


def test_the_ongoing_dwell_is_available_before_it_ends():
    time, reading = still(6, 4.0)
    detector = StillDetector(CaptureSettings(), G)
    detector.push(rows(time[:80], reading[:80]))
    assert detector.still
    assert detector.current() is None
    detector.push(rows(time[80:], reading[80:], temperature=21.0))
    dwell = detector.current()
    assert dwell is not None
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
    detector = StillDetector(CaptureSettings(), G, keep=3)
    detector.push(rows(time, reading))
    detector.close()
    assert [each.start for each in detector.dwells()] == [
        each.start for each in pushed(time, reading).dwells()[-3:]]


def test_a_dwell_that_is_not_still_according_to_later_ones_is_doubtful():
    reading = turned(2, noise=2e-3, poses=4)[1]
    first, held = still(8, 5.0)
    held = held + 0.01 * np.sin(2.0 * np.pi * 8.3 * first + 0.3)[:, np.newaxis]
    reading = np.concatenate([held, [[0.0, 0.0, 3.0]] * 100, reading])
    detector = pushed(np.arange(len(reading)) / 100.0, reading)
    assert len(detector.doubtful()) == 1
    assert min(detector.doubtful()) < 1.0


def test_lines_through_series_of_unequal_length_are_those_of_least_squares():
    rng, sizes = np.random.default_rng(4), np.array([12, 7])
    series = [rng.normal(size=(3, size)) for size in sizes]
    centred = np.zeros((3, 2, 12))
    for k, values in enumerate(series):
        centred[:, k, :sizes[k]] = values - values.mean(axis=1, keepdims=True)
    line = lines_through(centred, sizes)
    for k, values in enumerate(series):
        time = np.arange(sizes[k])
        fitted = np.polyfit(time, values.T, 1)
        left = values.T - np.outer(time, fitted[0]) - fitted[1]
        np.testing.assert_allclose(line.slope[:, k], fitted[0])
        np.testing.assert_allclose(line.square[:, k], np.sum(left ** 2, axis=0))
        np.testing.assert_allclose(line.time_square[k], np.sum((time - time.mean()) ** 2))


def test_correlations_at_lags_of_half_a_series_and_more_are_not_used():
    sizes = np.array([9])
    known = np.array([[1.0, 0.5, 0.3, 0.2, 0.0, 0.0, 0.0, 0.0]])
    beyond = known + 0.3 * (np.arange(8) >= 4)
    shorter = known * [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_array_equal(long_run(beyond, sizes), long_run(known, sizes))
    assert long_run(known, sizes) > long_run(shorter, sizes)
