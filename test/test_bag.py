# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of every kind, written by `rosbags`, read and corrected without ROS."""

from accel_calib.calibrate import fit_poses, level
from accel_calib.capture import capture
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.logs import read_recording
from accel_calib.messages import correct_bag
from accel_calib.units import units_of
from bag_files import write_bag
from inside import simulate_recording, spread_directions
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from shared import sensor

KINDS = ['mcap', 'sqlite3', 'bag']
UNITS = units_of('m/s2')


@pytest.fixture(scope='module')
def recording():
    rng = np.random.default_rng(5)
    return simulate_recording(sensor(rng), spread_directions(12), rng, dwell=2.0, turn=0.5,
                              temperatures=(20.0, 30.0))


def name(folder, kind):
    return folder / ('recording.bag' if kind == 'bag' else kind)


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_of_bag_has_the_same_samples(kind, recording, tmp_path):
    found = read_recording(write_bag(name(tmp_path, kind), kind, recording))
    assert (found.units, found.sensor) == ('m/s2', 'imu_link')
    np.testing.assert_array_equal(found.reading, UNITS.from_g(recording.reading))
    np.testing.assert_array_equal(found['rate'], recording['rate'])
    np.testing.assert_allclose(found['time'], recording['time'] + 100.0, atol=1e-6)
    np.testing.assert_allclose(found['temperature'], recording['temperature'], atol=0.2)


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3'])
def test_the_file_inside_a_rosbag2_folder_is_enough(kind, recording, tmp_path):
    folder = write_bag(name(tmp_path, kind), kind, recording)
    file = next(path for path in folder.iterdir() if path.suffix in ('.mcap', '.db3'))
    assert len(read_recording(file)) == len(recording)


def test_a_corrected_bag_of_ros_1_differs_only_in_the_acceleration(recording, tmp_path):
    path = write_bag(tmp_path / 'recording.bag', 'bag', recording)
    poses = capture(read_recording(path), UNITS).poses
    calibration = fit_poses(poses, UNITS, sensor='imu_link')
    out = tmp_path / 'out.bag'
    assert correct_bag(path, calibration, out) == len(recording)
    with AnyReader([path]) as before, AnyReader([out]) as after:
        assert [c.topic for c in before.connections] == [c.topic for c in after.connections]
        pairs = zip(before.messages(), after.messages(), strict=True)
        for (c0, t0, raw0), (c1, t1, raw1) in pairs:
            assert (c0.topic, c0.msgtype, t0) == (c1.topic, c1.msgtype, t1)
            if c0.topic != '/imu/data_raw':
                assert bytes(raw0) == bytes(raw1)
                continue
            assert bytes(raw0[:-96]) == bytes(raw1[:-96])
            assert bytes(raw0[-72:]) == bytes(raw1[-72:])
            m0, m1 = (reader.deserialize(raw, c0.msgtype)
                      for reader, raw in ((before, raw0), (after, raw1)))
            force = calibration.correct(np.array([[
                m0.linear_acceleration.x, m0.linear_acceleration.y, m0.linear_acceleration.z]]))[0]
            assert (m1.linear_acceleration.x, m1.linear_acceleration.y,
                    m1.linear_acceleration.z) == pytest.approx(tuple(force), abs=1e-12)
    still = capture(read_recording(out), UNITS).poses
    assert np.linalg.norm(still.reading, axis=1) == pytest.approx(9.80665, abs=0.01)


def test_two_imu_topics_need_a_choice(recording, tmp_path):
    path = write_bag(tmp_path / 'two', 'mcap', recording.take(slice(0, 60)), ('/a', '/b'))
    with pytest.raises(InputError, match='has 2 Imu topics, expected one: /a, /b; choose one'):
        read_recording(path)
    assert len(read_recording(path, '/b')) == 60
    with pytest.raises(InputError, match='has the Imu topics /a, /b, expected /c'):
        read_recording(path, '/c')


def test_a_message_about_hundreds_of_topics_stays_short(recording, tmp_path):
    names = [f'/robot_{number}/imu' for number in range(300)]
    path = write_bag(tmp_path / 'many', 'mcap', recording.take(slice(0, 60)), names)
    with pytest.raises(InputError, match='300 Imu topics, expected one: .* and 288 more') as told:
        read_recording(path)
    assert len(str(told.value)) < 500 + len(str(path))


def test_a_bag_without_imu_is_refused(recording, tmp_path):
    path = write_bag(tmp_path / 'none', 'mcap', recording.take(slice(0, 60)), ())
    with pytest.raises(InputError, match='expected a topic of type sensor_msgs/msg/Imu'):
        read_recording(path)


@pytest.mark.parametrize('file', ['x.bag', 'x.mcap', 'x.db3'])
def test_a_file_that_is_not_a_bag_is_refused_in_one_line(file, tmp_path):
    path = tmp_path / file
    path.write_bytes(b'not a bag at all')
    with pytest.raises(InputError, match='is damaged or not a bag'):
        read_recording(path)
    with pytest.raises(FileNotFoundError):
        read_recording(tmp_path / f'missing{file}')


def test_an_empty_folder_is_not_a_bag(tmp_path):
    with pytest.raises(InputError, match='is a folder without a bag'):
        read_recording(tmp_path)


def test_a_message_with_nan_is_refused(recording, tmp_path):
    reading = recording.reading[:60].copy()
    reading[40, 1] = np.nan
    path = write_bag(tmp_path / 'nan', 'mcap',
                     recording.take(slice(0, 60)).with_columns(reading=reading))
    with pytest.raises(InputError, match='Imu message 41 contains NaN or infinity'):
        read_recording(path)


def test_a_calibration_of_another_sensor_writes_no_bag(recording, tmp_path):
    path = write_bag(tmp_path / 'in', 'mcap', recording)
    poses = capture(read_recording(path), UNITS).poses
    other = fit_poses(poses, UNITS, sensor='imu_rear')
    with pytest.raises(StoredCalibrationError, match='imu_rear'):
        correct_bag(path, other, tmp_path / 'out')
    with pytest.raises(InputError, match='in exists'):
        correct_bag(path, other, path)
    assert [item.name for item in tmp_path.iterdir()] == ['in']


def test_a_bag_in_ned_is_forward_right_down_and_one_of_gravity_is_refused(recording, tmp_path):
    path = write_bag(tmp_path / 'recording.bag', 'bag', recording)
    poses = capture(read_recording(path), UNITS).poses
    fitted = fit_poses(poses, UNITS, sensor='imu_link')
    by_frame = {frame: level(fitted, poses.reading[0], frame) for frame in ('ros', 'ned', 'win8')}
    out = {frame: tmp_path / f'{frame}.bag' for frame in by_frame}
    for frame in ('ros', 'ned'):
        correct_bag(path, by_frame[frame], out[frame])
    ros, ned = (read_recording(out[frame]) for frame in ('ros', 'ned'))
    for key in ('reading', 'rate'):
        np.testing.assert_allclose(ned[key], ros[key] * [1.0, -1.0, -1.0], atol=1e-9)
    np.testing.assert_allclose(np.abs(by_frame['ned'].rotation[:, 2]),
                               np.abs(by_frame['ros'].rotation[:, 2]))
    with pytest.raises(InputError, match='win8, whose readings are gravity'):
        correct_bag(path, by_frame['win8'], out['win8'])
