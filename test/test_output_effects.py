# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Recordings that are clipped or coarsely quantised: their poses, their noise, and the names."""

import accel_calib as ac
from accel_calib.calibration import fit_poses, in_g
from accel_calib.logs import read_recording
from accel_calib.stillness import capture
from accel_calib.units import STANDARD_GRAVITY, Units
from inside import (
    clipped, grid_step, Model, off_grid, simulate_recording, spread_directions, unclipped)
import numpy as np
import pytest
from shared import data, G, MPS2, NATIVE, poses_of, random_directions, sensor

COUNTS_PER_G = 4056.0
IMU, COUNTS = 'mpu9150_imu0.csv', 'xsens_mti_counts.csv'


def limited(recording, low, high):
    return recording.with_columns(reading=np.clip(recording.reading, low, high))


def rounded(recording, step):
    return recording.with_columns(reading=np.round(recording.reading / step) * step)


def simulated(seed, noise=1e-3, count=24):
    rng = np.random.default_rng(seed)
    return simulate_recording(sensor(rng), spread_directions(count), rng, noise_g=noise,
                              dwell=3.0, turn=0.6)


def found(recording, units):
    """Return the captured poses in g."""
    return in_g(capture(recording, units).poses, units)


@pytest.mark.parametrize('name', [IMU, 'mpu9150_imu1.csv'])
@pytest.mark.parametrize('limit', [9.0, 9.6])
def test_a_clipped_recording_has_the_poses_of_the_recording_and_its_limit_is_detected(name, limit):
    recording = read_recording(data(name))
    whole, poses = (found(each, MPS2) for each in (recording, limited(recording, -limit, limit)))
    limit_g = limit / STANDARD_GRAVITY
    assert len(poses) == len(whole) == 21
    free = np.all(np.abs(whole.reading) < limit_g - 0.03, axis=1)
    np.testing.assert_allclose(poses.reading[free], whole.reading[free], atol=0.002)
    clip = clipped(poses)
    assert clip.limit_g == pytest.approx(limit_g, abs=2e-4)
    at_limit = np.any(np.abs(poses.reading) > clip.limit_g - 1e-3, axis=1)
    assert set(np.flatnonzero(at_limit)) <= set(clip.poses)
    assert None not in unclipped(poses, fit_poses(poses, G, model='10').model)
    assert grid_step(poses) is None


def test_counts_around_an_offset_are_clipped_at_different_limits():
    poses = capture(limited(read_recording(data(COUNTS)), 29400, 36900), NATIVE).poses
    clip = clipped(in_g(poses, Units('native', COUNTS_PER_G)))
    at_limit = np.any((poses.reading < 29401) | (poses.reading > 36899), axis=1)
    assert (len(poses), bool(np.sum(at_limit) > 4)) == (38, True)
    assert set(np.flatnonzero(at_limit)) <= set(clip.poses)


def test_one_quiet_pose_at_the_end_of_an_axis_is_no_limit():
    poses = found(simulated(3), G)
    quiet, at_end = np.ones((len(poses), 1)), int(np.argmax(poses.reading[:, 2]))
    quiet[at_end] = 0.6 * np.min(poses['std']) / np.max(poses['std'][at_end])
    assert clipped(poses.with_columns(std=poses['std'] * quiet)) is None


def test_clipped_poses_are_left_out_although_the_base_misfits_the_others_too():
    poses = found(limited(simulated(3), -0.93, 0.93), G)
    assert unclipped(poses, Model({'offset': np.zeros(3)}))[1] is not None


@pytest.mark.parametrize('step_mg', [4, 8, 20])
def test_quantisation_of_a_real_recording_is_detected_with_its_step(step_mg):
    counts = round(step_mg * 1e-3 * COUNTS_PER_G)
    taken = capture(rounded(read_recording(data(COUNTS)), counts), NATIVE).poses
    base = fit_poses(taken, NATIVE, model='10')
    poses = in_g(taken, base.units)
    assert grid_step(poses) == pytest.approx(counts / base.units.per_g, rel=2e-3)
    assert off_grid(poses, base.model)[1] == grid_step(poses)
    assert clipped(poses) is None


@pytest.mark.parametrize(('ratio', 'relevant'), [
    (0.02, True), (0.1, True), (0.2, True), (0.3, True), (0.5, False), (1.0, False),
    (3.0, False)])
def test_a_grid_is_named_if_the_noise_is_clearly_less_than_a_step(ratio, relevant):
    for seed in range(2):
        step = grid_step(found(rounded(simulated(seed, 1e-3), 1e-3 / ratio), G))
        assert step == (pytest.approx(1e-3 / ratio, rel=2e-3) if relevant else None)


@pytest.mark.parametrize('ratio', [0.03, 0.1, 0.2, 0.3])
def test_the_stated_noise_of_means_on_a_coarse_grid_is_correct(ratio):
    scores = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        recording = simulate_recording(Model({}), random_directions(40, rng), rng, noise_g=1e-3,
                                       dwell=3.0, turn=0.6)
        poses = capture(rounded(recording, 1e-3 / ratio), G).poses
        rest = np.array([np.searchsorted(recording['time'], time) for time in poses['time']])
        error = poses.reading - recording['reference'][rest]
        scores.append(np.sum(error**2) / np.sum(poses.noise**2))
    assert 0.6 < np.mean(scores) < 1.4


def test_a_grid_is_named_where_the_noise_includes_it_and_added_to_a_noise_that_lacks_it():
    poses = found(rounded(simulated(4, 2e-4, 40), 8e-3), G)
    model = fit_poses(poses, G, model='10').model
    same, step = off_grid(poses, model)
    assert same is poses
    assert step == pytest.approx(8e-3, rel=1e-3)
    lacking = poses.with_columns(std=np.where(poses['std'] < 2.31e-3, 0.0, poses['std']),
                                 count=np.full(len(poses), 300.0))
    with_it, step = off_grid(lacking, model)
    assert step == pytest.approx(8e-3, rel=1e-3)
    np.testing.assert_allclose(np.median(with_it.noise), np.median(poses.noise), rtol=0.3)
    few = poses.with_columns(std=np.full((40, 3), 5e-4), count=np.ones(40)).take(np.arange(9))
    assert grid_step(few) == pytest.approx(8e-3, rel=1e-3)
    assert off_grid(few, model) == (few, None)  # as many poses as values: no gap to explain


@pytest.mark.parametrize('apart', [1, 2, 3, (2, 3)])
def test_the_coarsest_grid_that_holds_the_means_is_that_of_a_table_without_noise(apart):
    steps = np.random.default_rng(2).choice(np.atleast_1d(apart), (60, 3))
    reading = 2e-3 * np.cumsum(steps, axis=0)
    expected = 2e-3 if isinstance(apart, tuple) else 2e-3 * apart
    assert grid_step(poses_of(reading)) == pytest.approx(expected)


def test_the_samples_of_a_simulated_sensor_end_at_its_limit_and_lie_on_its_grid():
    for effect, value in (('saturation', 0.9), ('quantisation', 0.004)):
        made = ac.simulate({effect: value}, recording=True, poses=8, units='g').reading
        steps = made / 0.004
        assert (np.max(np.abs(made)) == 0.9) == (effect == 'saturation')
        assert (np.max(np.abs(steps - np.round(steps))) < 1e-9) == (effect == 'quantisation')
