# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Bags of every kind, read and corrected without ROS, and by `rosbags` for comparison."""

from dataclasses import replace
from functools import cache

from accel_calib.calibrate import fit_poses, level
from accel_calib.capture import capture
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.logs import LogOptions, open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.units import units_of
from bag_files import (
    a_calibration, header, IMU, imu, McapFile, STORE, STRING, TEMPERATURE, write_bag)
from inside import (
    BLOCK_OF_A_BAG, rotation_from_rpy, ROWS_OF_A_BAG, simulate_recording, spread_directions)
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from scipy.spatial.transform import Rotation
from shared import sensor
import yaml

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


TOPICS = [('/imu/a', IMU), ('/imu/b', IMU), ('/temperature', TEMPERATURE), ('/words', STRING)]
MAKES = ['mcap', 'lz4', 'zstd', 'no chunks', 'no summary', 'sqlite3', 'sqlite3 messages',
         'mcap by rosbags', 'zstd by rosbags', 'mcap file', 'split']
COUNT = 200


def imu_bytes(rng, stamp, frame_id, little_endian=True):
    numbers = rng.normal(size=37)
    made = imu(STORE, header(STORE, stamp, frame_id), 9.0 + numbers[25:28], numbers[13:16],
               numbers[:4], (numbers[4:13], numbers[16:25], np.zeros(9)))
    return bytes(STORE.serialize_cdr(made, IMU, little_endian=little_endian))


@cache
def messages(seed, *, shuffled=False, frame_ids=('imu',), little_endian=True):
    """Return (channel, log time, bytes); some messages are slightly out of order."""
    rng = np.random.default_rng(seed)
    made = []
    for k in range(COUNT):
        stamp = 10 ** 9 * 1_700_000_000 + 10 ** 7 * k
        for channel in (0, 1):
            name = frame_ids[k % len(frame_ids)]
            made.append((channel, stamp + channel,
                         imu_bytes(rng, stamp, name, little_endian)))
        if k % 7 == 3:
            warm = STORE.types[TEMPERATURE](header(STORE, stamp, 'imu'), 20.0 + 0.01 * k, 0.0)
            made.append((2, stamp + 2, bytes(STORE.serialize_cdr(
                warm, TEMPERATURE, little_endian=little_endian))))
        if k % 11 == 5:
            word = STORE.types[STRING]('x' * (k % 23))
            made.append((3, stamp + 3, bytes(STORE.serialize_cdr(word, STRING))))
    if shuffled:
        order = np.argsort(np.arange(len(made)) + rng.uniform(0, 40, len(made)))
        made = [made[k] for k in order]
    return tuple(made)


def write_by_rosbags(path, made, plugin, mode=CompressionMode.NONE):
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        known = [writer.add_connection(name, kind, typestore=STORE) for name, kind in TOPICS]
        for channel, time, data in made:
            writer.write(known[channel], time, data)
    return path


def split(path, made):
    """Write a bag of two files, the second without words."""
    first, second = made[:len(made) // 2], [each for each in made[len(made) // 2:] if each[0] < 3]
    write_by_rosbags(path, first, StoragePlugin.MCAP)
    McapFile(TOPICS[:3], 'zstd').write(path / 'second.mcap', second)
    about = yaml.safe_load((path / 'metadata.yaml').read_text())
    about['rosbag2_bagfile_information']['relative_file_paths'].append('second.mcap')
    (path / 'metadata.yaml').write_text(yaml.safe_dump(about))
    return path


def write(folder, make, made):
    """Write a bag of one kind."""
    by_rosbags = {'sqlite3': (StoragePlugin.SQLITE3,), 'mcap by rosbags': (StoragePlugin.MCAP,),
                  'zstd by rosbags': (StoragePlugin.MCAP, CompressionMode.STORAGE),
                  'sqlite3 messages': (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
                  'mcap file': (StoragePlugin.MCAP, CompressionMode.FILE)}
    if make == 'split':
        return split(folder / 'bag', made)
    if make in by_rosbags:
        return write_by_rosbags(folder / 'bag', made, *by_rosbags[make])
    file = McapFile(TOPICS, make if make in ('lz4', 'zstd') else '',
                    in_chunks=make != 'no chunks', summary=make != 'no summary')
    return file.write(folder / 'bag.mcap', made)


def deserialized(path, topic='/imu/a'):
    """Return stamp, rate and acceleration of each message, deserialized by `rosbags`."""
    rows = []
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages(
                [c for c in reader.connections if c.topic == topic]):
            message = reader.deserialize(raw, connection.msgtype)
            stamp, rate, force = (message.header.stamp, message.angular_velocity,
                                  message.linear_acceleration)
            rows.append([stamp.sec + 1e-9 * stamp.nanosec, rate.x, rate.y, rate.z, force.x,
                         force.y, force.z])
    return np.array(rows)


@pytest.mark.parametrize(('make', 'topic'), [
    *((make, '/imu/a') for make in MAKES), ('lz4', '/imu/b'), ('sqlite3', '/imu/b')])
def test_samples_are_those_that_rosbags_deserializes(make, topic, tmp_path):
    shuffled = make not in ('no chunks', 'no summary', 'split')  # rosbags refuses these
    path = write(tmp_path, make, messages(1, shuffled=shuffled))
    found = read_recording(path, topic)
    expected = deserialized(path, topic)
    assert len(expected) == COUNT
    np.testing.assert_array_equal(found['time'], expected[:, 0])
    np.testing.assert_array_equal(found['rate'], expected[:, 1:4])
    np.testing.assert_array_equal(found.reading, expected[:, 4:])
    assert list(found.row) == list(range(1, COUNT + 1))
    warm = 20.0 + np.clip((expected[:, 0] - 1.7e9), 0.03, 1.99)
    np.testing.assert_allclose(found['temperature'], warm, atol=1e-6)


@pytest.mark.parametrize('names', [('imu', 'imb'), ('imu', 'a_much_longer_name'), ('', 'imu')])
@pytest.mark.parametrize('make', ['mcap', 'sqlite3'])
def test_messages_of_another_sensor_are_refused_until_one_is_chosen(make, names, calibration,
                                                                    tmp_path):
    path = write(tmp_path, make, messages(20, frame_ids=names * 50 + names[1:] * 100))
    message = f"/imu/a: message 2 is from the sensor '{names[1]}', expected '{names[0]}' as before"
    with pytest.raises(InputError, match=message):
        read_recording(path, '/imu/a')
    with pytest.raises(InputError, match=message):
        correct_bag(path, calibration, tmp_path / 'out', '/imu/a')
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    found = read_recording(path, '/imu/a', names[1])
    assert (len(found), found.sensor) == (150, names[1])
    whole = deserialized(path)
    np.testing.assert_array_equal(found.reading, whole[found.row - 1, 4:])


@pytest.mark.parametrize('make', ['mcap', 'sqlite3'])
def test_big_endian_messages_are_read_and_corrected(make, tmp_path, calibration):
    path = write(tmp_path, make, messages(2, little_endian=False))
    found = read_recording(path, '/imu/a')
    expected = deserialized(path)
    np.testing.assert_array_equal(np.column_stack([found['time'], found['rate'], found.reading]),
                                  expected)
    correct_bag(path, calibration, tmp_path / 'out', '/imu/a')
    np.testing.assert_allclose(deserialized(tmp_path / 'out')[:, 4:],
                               calibration.correct(expected[:, 4:]), atol=1e-12)


@pytest.fixture(scope='module')
def calibration():
    return a_calibration()


@pytest.mark.parametrize(('make', 'turned'), [
    *((make, True) for make in MAKES), ('zstd', False), ('sqlite3', False)])
def test_a_corrected_bag_keeps_all_other_content(make, turned, calibration, tmp_path):
    if turned:
        model = replace(calibration.model, rotation=rotation_from_rpy(0.2, -0.4, 1.0))
        calibration = replace(calibration, model=model)
    shuffled = make not in ('no chunks', 'no summary', 'split')
    path = write(tmp_path, make, messages(4, shuffled=shuffled))
    calls = []
    count = correct_bag(path, calibration, tmp_path / 'out', '/imu/a',
                        lambda done, of: calls.append((done, of)))
    assert count == COUNT
    assert calls[-1] == (COUNT, COUNT) or make == 'split'  # whose metadata count the first file
    with AnyReader([path]) as before, AnyReader([tmp_path / 'out']) as after:
        pairs = zip(before.messages(), after.messages(), strict=True)
        for (c0, t0, raw0), (c1, t1, raw1) in pairs:
            assert (c0.topic, c0.msgtype, c0.msgdef.data, c0.ext, t0) == (
                c1.topic, c1.msgtype, c1.msgdef.data, c1.ext, t1)
            if c0.topic != '/imu/a':
                assert bytes(raw0) == bytes(raw1)
                continue
            old, new = (reader.deserialize(raw, IMU) for reader, raw in ((before, raw0),
                                                                         (after, raw1)))
            rotation = calibration.model.rotation
            assert old.header.stamp == new.header.stamp
            assert new.header.frame_id == old.header.frame_id + '_levelled' * turned
            before_turn, after_turn = (Rotation.from_quat(
                [getattr(each.orientation, axis) for axis in 'xyzw']) for each in (old, new))
            np.testing.assert_allclose(after_turn.as_matrix(),
                                       before_turn.as_matrix() @ rotation, atol=1e-9)
            for name, expected in (
                    ('linear_acceleration', lambda x: calibration.correct(x[np.newaxis])[0]),
                    ('angular_velocity', lambda x, rotation=rotation: x @ rotation)):
                x0, x1 = (np.array([getattr(getattr(each, name), axis) for axis in 'xyz'])
                          for each in (old, new))
                np.testing.assert_allclose(x1, expected(x0), atol=1e-12)
            np.testing.assert_array_equal(old.linear_acceleration_covariance,
                                          new.linear_acceleration_covariance)
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted([path.name, 'out'])


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_file_becomes_a_file_or_a_folder_with_the_metadata_of_its_messages(
        plugin, calibration, tmp_path):
    path = write_by_rosbags(tmp_path / 'bag', messages(7), plugin)
    file = next(item for item in path.iterdir() if item.suffix != '.yaml')
    correct_bag(file, calibration, tmp_path / f'out{file.suffix}', '/imu/a')
    assert (tmp_path / f'out{file.suffix}').is_file()
    correct_bag(file, calibration, tmp_path / 'out', '/imu/a')
    expected, found = (yaml.safe_load((folder / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information'] for folder in (path, tmp_path / 'out'))
    for about in (expected, found):
        assert about['relative_file_paths'] == [about['files'][0].pop('path')]
        del about['relative_file_paths'], about['ros_distro']
    assert found == expected
    np.testing.assert_array_equal(deserialized(tmp_path / 'out'),
                                  deserialized(tmp_path / f'out{file.suffix}'))


@pytest.mark.parametrize('make', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('spoil', [
    lambda raw: b'', lambda raw: raw[:100], lambda raw: raw[:-8], lambda raw: raw + bytes(8),
    lambda raw: raw[:12] + b'\xff' * 4 + raw[16:], lambda raw: b'\x00\x03' + raw[2:]],
    ids=['empty', 'short', 'a double less', 'a double more', 'long frame_id', 'parameter list'])
def test_a_damaged_message_is_reported_in_one_line(make, spoil, calibration, tmp_path):
    made = list(messages(9))
    which = [k for k, (channel, _, _) in enumerate(made) if channel == 0][100]
    broken = spoil(made[which][2])
    made[which] = (0, made[which][1], broken)
    path = write(tmp_path, make, made)
    message = f'/imu/a: message 101 of {len(broken)} bytes is damaged'
    with pytest.raises(InputError, match=message) as refusal:
        read_recording(path, '/imu/a')
    assert '\n' not in str(refusal.value)
    with pytest.raises(InputError, match=message):
        correct_bag(path, calibration, tmp_path / 'out', '/imu/a')
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    assert len(read_recording(path, '/imu/b')) == COUNT


def test_a_topic_without_messages_is_reported_in_one_line(tmp_path, calibration):
    for make in ('mcap', 'sqlite3'):
        path = write(tmp_path, make, [each for each in messages(11) if each[0]])
        with pytest.raises(InputError, match='has no message on /imu/a'):
            read_recording(path, '/imu/a')
        with pytest.raises(InputError, match='has no message on /imu/a'):
            correct_bag(path, calibration, tmp_path / 'out', '/imu/a')


def test_poses_do_not_depend_on_the_size_of_blocks(tmp_path, monkeypatch):
    rng = np.random.default_rng(12)
    recording = simulate_recording(sensor(rng), spread_directions(8), rng, dwell=2.0, turn=0.5)
    made = []
    for k, (time, reading) in enumerate(zip(recording['time'], UNITS.from_g(recording.reading))):
        raw = bytearray(imu_bytes(rng, 10 ** 12 + round(1e9 * time), 'imu'))
        raw[-96:-72] = reading.tobytes()
        raw[-192:-168] = recording['rate'][k].tobytes()
        made.append((0, 10 ** 12 + round(1e9 * time), bytes(raw)))
    path = McapFile(TOPICS, 'lz4').write(tmp_path / 'bag.mcap', made)
    whole = capture(read_recording(path, '/imu/a'), UNITS)
    monkeypatch.setattr(*ROWS_OF_A_BAG, 50)
    monkeypatch.setattr(*BLOCK_OF_A_BAG, 20)
    with open_log(path, LogOptions(topic='/imu/a')) as stream:
        assert stream.samples == len(recording)
        found = capture(stream.blocks, UNITS)
    assert len(whole.poses) == 8
    assert (found.recorded, found.seconds) == (len(recording), whole.seconds)
    for key in whole.poses.columns:
        np.testing.assert_allclose(found.poses[key], whole.poses[key], rtol=1e-12)
