# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""From recordings to poses: real files, repeated poses, long dwells, invalid input."""

from __future__ import annotations

from dataclasses import replace

from accel_calib.capture import capture, CaptureSettings, select, StillDetector
from accel_calib.errors import InputError
from accel_calib.logs import read_recording
from accel_calib.table import Recording
from accel_calib.units import units_of
import numpy as np
import pytest
from shared import data

G = units_of('g')


def recording(**columns) -> Recording:
    return Recording(columns, np.arange(1, len(columns['time']) + 1))


def visited(directions, seed=0, seconds=3.0, noise=2e-3) -> Recording:
    """Return a recording at 100 Hz with rests in these directions, and shaking in between."""
    rng = np.random.default_rng(seed)
    parts = []
    for direction in directions:
        rest = np.asarray(direction) + noise * rng.normal(size=(int(seconds * 100), 3))
        parts += [rest, np.asarray(direction) + 0.5 * rng.normal(size=(80, 3))]
    reading = np.concatenate(parts)
    return recording(time=np.arange(len(reading)) / 100.0, reading=reading)


@pytest.mark.parametrize(('name', 'unit', 'poses'), [
    ('mpu9150_imu0.csv', 'm/s2', 21), ('mpu9150_imu1.csv', 'm/s2', 21),
    ('xsens_mti_counts.csv', 'native', 38)])
def test_poses_of_real_recordings_are_found(name, unit, poses):
    samples = read_recording(data(name))
    result = capture(samples, units_of(unit))
    assert len(result.poses) == poses
    assert 0.6 * len(samples) < result.samples < len(samples)
    assert result.interruptions == ()
    assert result.seconds == pytest.approx(samples['time'][-1] - samples['time'][0])
    assert result.poses.noise is not None
    assert ('rate' in result.poses) is (unit == 'm/s2')  # counts are not used


def test_poses_of_a_real_recording_are_found_without_the_gyro():
    samples = read_recording(data('mpu9150_imu0.csv'))
    bare = recording(time=samples['time'], reading=samples.reading)
    assert len(capture(bare, units_of('m/s2')).poses) == 21


def test_streaming_a_real_recording_finds_the_same_poses():
    samples = read_recording(data('mpu9150_imu1.csv'))
    detector = StillDetector(CaptureSettings(), units_of('m/s2'))
    table = np.column_stack([samples['time'], samples.reading, samples['rate'],
                             np.full((len(samples), 2), np.nan)])
    for block in np.array_split(table, len(table) // 37):
        detector.push(block)
    detector.close()
    poses = capture(samples, units_of('m/s2')).poses
    dwells = detector.dwells()
    np.testing.assert_allclose([each.mean for each in dwells], poses.reading, rtol=1e-9)
    np.testing.assert_allclose([each.count for each in dwells], poses['count'], rtol=1e-6)


def test_a_sensor_that_lay_still_for_days_has_one_pose_per_orientation():
    result = capture(read_recording(data('sensehat_lsm9ds1_temperature.csv')), G)
    assert 3 <= len(result.poses) <= 5
    assert result.samples > 24000
    assert [each.kind for each in result.interruptions] == ['gap']
    assert 'orientation' not in result.poses


def test_max_dwell_splits_a_dwell_of_changing_temperature():
    poses = capture(read_recording(data('sensehat_lsm9ds1_temperature.csv')), G,
                    CaptureSettings(max_dwell=3600)).poses
    assert 60 < len(poses) < 80
    long = np.bincount(poses['orientation']).max()
    assert long == pytest.approx(58, abs=1)
    assert np.ptp(poses['temperature']) > 1.0
    assert np.all(np.diff(poses['time']) > 0.0)


FACES = [(0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, -1, 0), (-1, 0, 0)]
AGAIN = [*FACES, (0.03, 0.0, 0.9996), (0.0, 0.9996, 0.02)]


@pytest.mark.parametrize(('repeated', 'poses'), [('keep', 8), ('merge', 6), ('refuse', 6)])
@pytest.mark.parametrize('unit', ['g', 'native'])
def test_repeated_poses_are_kept_merged_or_refused_as_asked(repeated, poses, unit):
    samples = visited(AGAIN)
    samples = samples.with_columns(reading=samples.reading * (4e3 if unit == 'native' else 1.0))
    settings = CaptureSettings(repeated=repeated)
    assert len(capture(samples, units_of(unit), settings).poses) == poses


@pytest.mark.parametrize('repeated', ['merge', 'refuse'])
def test_a_doubtful_pose_does_not_take_the_place_of_a_sure_one(repeated):
    samples = visited(AGAIN)
    detector = StillDetector(CaptureSettings(), G)
    detector.push(np.column_stack([samples['time'], samples.reading]))
    detector.close()
    dwells = [replace(each, doubtful=k == 0) for k, each in enumerate(detector.dwells())]
    kept = select(dwells, CaptureSettings(repeated=repeated), G)
    assert [each.doubtful for each in kept] == [True, *[False] * 6]
    assert kept[0] is dwells[0]
    assert kept[6] is dwells[6]


def test_merged_poses_lie_on_the_sphere_and_are_less_noisy():
    kept = capture(visited(AGAIN), G).poses
    poses = capture(visited(AGAIN), G, CaptureSettings(repeated='merge')).poses
    assert np.linalg.norm(poses.reading[0]) == pytest.approx(1.0, abs=4e-4)
    assert poses.reading[0, 0] == pytest.approx(0.015, abs=1e-3)
    assert np.all(poses.noise[:2] < kept.noise[:2])


def test_a_number_that_is_not_finite_is_refused_with_its_row():
    samples = visited(FACES)
    reading = samples.reading.copy()
    reading[70, 1] = np.nan
    with pytest.raises(InputError, match='row 71 .* remove that row'):
        capture(samples.with_columns(reading=reading), G)


@pytest.mark.parametrize('rows', [0, 1, 2, 12])
def test_a_recording_of_a_few_samples_has_no_poses(rows):
    result = capture(visited(FACES).take(slice(0, rows)), G)
    assert len(result.poses) == 0
    assert result.samples == 0


def test_stamps_that_stop_are_reported_and_make_no_pose():
    samples = recording(time=np.zeros(250_000), reading=np.tile([0.0, 0.0, 1.0], (250_000, 1)))
    result = capture(samples, G)
    assert len(result.poses) == 0
    assert [each.kind for each in result.interruptions] == ['stopped']


@pytest.mark.parametrize('settings', [
    {'still_window': 0.0}, {'min_dwell': -1.0}, {'max_dwell': 0.5}, {'still_std_max': -1.0},
    {'still_gyro_max': float('nan')}, {'still_norm_tolerance': 0.0}, {'min_pose_angle': 4.0},
    {'repeated': 'forget'}])
def test_settings_out_of_range_are_refused_by_name(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        CaptureSettings(**settings)
