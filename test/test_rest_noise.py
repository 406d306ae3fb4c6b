# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Bias of the gyro and noise of the samples, from simulated and real rests."""

from dataclasses import replace

from accel_calib.calibration import fit_poses, gyro_bias_of, GyroBias, level, sample_noise_of
from accel_calib.logs import read_recording
from accel_calib.refinement import refine
from accel_calib.stillness import capture
from accel_calib.table import Poses, Recording
from inside import (
    format_calibration, Model, parse_calibration, simulate_poses, simulate_recording,
    spread_directions)
import numpy as np
import pytest
from shared import data, G, MPS2

BIAS = np.array([0.01, -0.02, 0.03])
TURNING = np.array([0.3, -0.2, 0.9])


def rests(seed, count=24, *, scatter=2e-4, noise=(0.003, 0.002, 0.005), samples=300, warmth=None,
          slope=(0.0, 0.0, 0.0)) -> Poses:
    """Return rests of a calibrated accelerometer and of a gyro with this scatter [rad/s]."""
    rng = np.random.default_rng(seed)
    rate = BIAS + rng.normal(size=(count, 3)) * scatter
    rate += rng.normal(size=(count, 3)) * noise / np.sqrt(samples)
    measured = noise * np.sqrt(rng.chisquare(samples, size=(count, 3)) / samples)
    known = {'rate': rate, 'rate_std': measured}
    if warmth is not None:
        known['temperature'] = warmth
        known['rate'] = rate + np.outer(warmth - np.mean(warmth), slope)
    return simulate_poses(Model({}), spread_directions(count), rng, samples=samples, context=known)


def found(poses: Poses) -> GyroBias:
    gyro = gyro_bias_of(poses)
    assert gyro is not None
    return gyro


def without(poses: Poses, row: int) -> Poses:
    return poses.take(np.arange(len(poses)) != row)


def only(poses: Poses, *keys: str) -> Poses:
    return Poses({key: poses[key] for key in keys}, poses.row)


@pytest.mark.parametrize(('count', 'scatter', 'known'), [
    (6, 0.0, True), (6, 3e-4, True), (24, 3e-4, True), (12, 2e-4, False)])
def test_the_stated_uncertainty_covers_the_true_bias_also_without_the_noise(count, scatter, known):
    inside, ratio = [], []
    for seed in range(150):
        poses = rests(seed, count, scatter=scatter)
        gyro = found(poses if known else only(poses, 'reading', 'rate'))
        inside.append(np.abs(gyro.bias - BIAS) < 1.96 * gyro.sd)
        ratio.append(gyro.sd / found(poses).sd)
    assert 0.9 < np.mean(inside) < 0.99
    assert 0.8 < np.median(ratio) < 1.25


def test_a_slope_over_temperature_is_found_where_it_is_and_only_there():
    warmth, slope = np.linspace(20.0, 40.0, 24), np.array([2e-4, 0.0, -3e-4])
    for seed in range(10):
        gyro = found(rests(seed, warmth=warmth, slope=slope))
        assert gyro.slope[0] != 0.0
        assert gyro.slope[2] != 0.0
        np.testing.assert_allclose(gyro.slope, slope, atol=5e-5)
        assert gyro.temperature == pytest.approx(30.0, abs=1.0)
        np.testing.assert_allclose(gyro.at(25.0), BIAS + slope * -5.0, atol=5e-4)
    slopes = [found(rests(seed, warmth=warmth)).slope for seed in range(100)]
    assert np.mean(np.array(slopes) != 0.0) < 0.01


def test_a_rest_at_which_the_platform_turned_is_ignored_beside_a_slope():
    warmth, slope = np.linspace(20.0, 40.0, 24), (2e-3, 0.0, -3e-3)
    for seed in range(5):
        poses = rests(seed, warmth=warmth, slope=slope)
        moved = np.outer(np.arange(len(poses)) == seed, 0.01 * TURNING)
        gyro = found(poses.with_columns(rate=poses['rate'] + moved))
        expected = found(without(poses, seed))
        assert gyro.rests < len(poses)
        assert np.all(np.abs(gyro.bias - expected.bias) < gyro.sd)


def test_noise_that_is_not_known_is_nan():
    poses = rests(7)
    only_force, in_counts, constant = map(sample_noise_of, (
        only(poses, 'reading', 'std'), poses.with_columns(rate=poses['rate'] + 32768.0),
        poses.with_columns(rate_std=poses['rate_std'] * [1.0, 0.0, 1.0])))
    np.testing.assert_allclose(only_force.force, 0.003)
    np.testing.assert_array_equal(np.isnan([only_force.rate, in_counts.rate, constant.rate]), [
        3 * [True], 3 * [True], [False, True, False]])


def recorded(seed=8, *, step=0.0, drift=0.0) -> Recording:
    """Return a recording with noise that differs by axis, and a gyro that drifts or is rounded."""
    rng = np.random.default_rng(seed)
    samples = simulate_recording(Model({}), spread_directions(12), rng, noise_g=0.0, dwell=6.0,
                                 gyro_noise=0.0)
    size, time = samples.reading.shape, samples['time'][:, np.newaxis]
    rate = samples['rate'] + BIAS + rng.normal(size=size) * [0.002, 0.004, 0.001]
    rate += drift * np.sin(2.0 * np.pi * time / 12.0)
    return samples.with_columns(
        reading=samples.reading + rng.normal(size=size) * [0.003, 0.005, 0.002],
        rate=np.round(rate / step) * step if step else rate)


@pytest.mark.parametrize(('drift', 'rtol'), [(0.0, 0.05), (0.004, 0.1)])
def test_the_white_noise_of_each_axis_is_recovered_from_a_recording_without_drift(drift, rtol):
    samples = recorded(drift=drift)
    poses = capture(samples, G).poses
    noise = sample_noise_of(poses)
    np.testing.assert_allclose(noise.force, [0.003, 0.005, 0.002], rtol=0.05)
    np.testing.assert_allclose(noise.rate, [0.002, 0.004, 0.001], rtol=rtol)
    whole = [samples['rate'][np.abs(samples['time'] - time) < 2.5].std(axis=0)[2]
             for time in poses['time']]
    assert (np.median(whole) > 1.5 * noise.rate[2]) == (drift > 0.0)


def test_a_coarse_gyro_has_at_least_the_noise_of_its_rounding_and_no_gyro_none():
    step, samples = 0.05, recorded()
    poses = capture(recorded(step=step), G).poses
    assert np.all(poses['rate_std'] >= 0.999 * step / np.sqrt(12.0))
    columns = {key: values for key, values in samples.columns.items() if key != 'rate'}
    poses = capture(replace(samples, columns=columns), G).poses
    assert {'rate', 'rate_std'}.isdisjoint(poses.columns)


@pytest.mark.parametrize('name', ['mpu9150_imu0.csv', 'mpu9150_imu1.csv'])
def test_a_real_gyro_has_the_bias_of_its_quietest_seconds(name):
    samples = read_recording(data(name))
    gyro = found(capture(samples, MPS2).poses)
    seconds = samples['rate'][:len(samples) // 100 * 100].reshape(-1, 100, 3)
    spread = seconds.std(axis=1).max(axis=1)
    quiet = np.median(seconds[spread < np.quantile(spread, 0.25)].mean(axis=1), axis=0)
    np.testing.assert_allclose(gyro.bias, quiet, atol=np.radians(0.04))
    assert np.all(gyro.sd < np.radians(0.015))
    assert np.all(gyro.sd > np.radians(0.003))


def test_poses_that_the_fit_rejects_are_no_rests():
    poses = rests(11)
    moved = (np.arange(len(poses)) == 5)[:, np.newaxis]
    disturbed = poses.with_columns(reading=poses.reading * (1.0 + 0.2 * moved),
                                   rate=poses['rate'] + 5e-4 * moved)
    calibration = fit_poses(disturbed, G, model='4')
    assert [each.row for each in calibration.rejected] == [6]
    np.testing.assert_array_equal(calibration.gyro.bias, found(without(poses, 5)).bias)


def test_a_refinement_takes_the_bias_of_new_rests_with_rates_and_keeps_the_stored_one_otherwise():
    stored, later = fit_poses(rests(12), G, model='10'), rests(13)
    changed = later.with_columns(rate=later['rate'] + 0.005)
    gyro = refine(changed, G, base=stored).calibration.gyro
    assert np.all(np.abs(gyro.bias - BIAS - 0.005) < 5.0 * gyro.sd)
    bare = only(later, 'reading', 'std', 'count')
    assert refine(bare, G, base=stored).calibration.gyro is stored.gyro
    assert refine(bare, G, base='10').calibration.gyro is None


@pytest.mark.parametrize('known', [
    {}, {'warmth': np.linspace(20.0, 40.0, 24), 'slope': (2e-4, 0.0, -3e-4)}])
def test_a_fit_has_bias_and_noise_which_levelling_and_a_file_keep(known):
    calibration = fit_poses(rests(10, **known), G, model='4')
    assert calibration.noise is not None
    assert np.all(np.abs(calibration.gyro.bias - BIAS) < 5.0 * calibration.gyro.sd)
    levelled = level(calibration, np.array([0.0, 0.0, 1.0]), 'ros')
    read = parse_calibration(format_calibration(levelled), 'x.yaml')
    for kept in (levelled, read):
        assert (kept.gyro, kept.noise) == (calibration.gyro, calibration.noise)
