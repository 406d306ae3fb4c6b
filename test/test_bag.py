# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags of every kind, read and corrected without ROS, and by `rosbags` for comparison.

The golden case `logs_bags` reads topics of any type: temperature, supply voltage and others.

"""

from dataclasses import replace
from functools import cache
from pathlib import Path
import re

from accel_calib.calibration import fit_poses, level
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.logs import field_of, LogOptions, open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stillness import capture
from accel_calib.stored import write_calibration
from accel_calib.table import Recording
from bag_files import (
    check_refused, header, IMU, imu, MAKES, McapFile, RATE_NS, rosbag2, START, STORE, STRING,
    TEMPERATURE, write_bag)
from inside import (
    BLOCK_OF_A_BAG, read_log, rotation_from_rpy, ROWS_OF_A_BAG, simulate_recording,
    spread_directions)
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
from scipy.spatial.transform import Rotation
from shared import known, LOG_CORPUS, MPS2, run, sensor, table, with_effects
import yaml

ON_A = LogOptions(topic='/imu/a')


@pytest.fixture(scope='module')
def recording():
    rng = np.random.default_rng(5)
    return simulate_recording(sensor(rng), spread_directions(12), rng, dwell=2.0, turn=0.5,
                              temperatures=(20.0, 30.0))


@pytest.fixture(scope='module')
def ros1(recording, tmp_path_factory):
    """Return a ROS 1 bag of the recording, its poses, and their calibration."""
    path = write_bag(tmp_path_factory.mktemp('ros1') / 'recording.bag', 'bag', recording)
    poses = capture(read_recording(path), MPS2).poses
    return path, poses, fit_poses(poses, MPS2, sensor='imu_link')


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'bag'])
def test_every_kind_of_bag_and_the_file_in_it_have_the_same_samples(kind, recording, tmp_path):
    path = write_bag(tmp_path / ('in.bag' if kind == 'bag' else 'in'), kind, recording)
    inside = [each for each in path.glob('*') if each.suffix in ('.mcap', '.db3')]
    assert len(inside) == (kind != 'bag')
    for each in (path, *inside):
        found = read_recording(each)
        assert (found.units, found.sensor) == ('m/s2', 'imu_link')
        np.testing.assert_array_equal(found.reading, MPS2.from_g(recording.reading))
        np.testing.assert_array_equal(found['rate'], recording['rate'])
        np.testing.assert_allclose(found['time'], recording['time'] + 100.0, atol=1e-6)
        np.testing.assert_allclose(found['temperature'], recording['temperature'], atol=0.2)


@pytest.mark.parametrize('file', ['x.bag', 'x.mcap', 'x.db3'])
def test_what_is_not_a_bag_is_refused_in_one_line(file, tmp_path):
    with pytest.raises(InputError, match='is a folder without a bag'):
        read_recording(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_recording(tmp_path / file)
    (tmp_path / file).write_bytes(b'not a bag at all')
    with pytest.raises(InputError, match='is damaged'):
        read_recording(tmp_path / file)


def check_copy(path, copy, topic, calibration):
    """Check that a copy differs only in an Imu topic, and there by the calibration."""
    turned, rotation = calibration.is_levelled, calibration.rotation
    with AnyReader([path]) as before, AnyReader([copy]) as after:
        pairs = zip(before.messages(), after.messages(), strict=True)
        for (c0, t0, raw0), (c1, t1, raw1) in pairs:
            assert (c0.topic, c0.msgtype, c0.msgdef.data, c0.ext, t0) == (
                c1.topic, c1.msgtype, c1.msgdef.data, c1.ext, t1)
            if c0.topic != topic:
                assert bytes(raw0) == bytes(raw1)
                continue
            if not turned:
                assert bytes(raw0[:-96]) == bytes(raw1[:-96])
            old, new = (reader.deserialize(raw, IMU) for reader, raw in ((before, raw0),
                                                                         (after, raw1)))
            assert old.header.stamp == new.header.stamp
            assert new.header.frame_id == old.header.frame_id + '_levelled' * turned
            before_turn, after_turn = (Rotation.from_quat(
                [getattr(each.orientation, axis) for axis in 'xyzw']) for each in (old, new))
            np.testing.assert_allclose(after_turn.as_matrix(),
                                       before_turn.as_matrix() @ rotation, atol=1e-9)
            for name, expected in (
                    ('linear_acceleration', lambda x: calibration.correct(x[np.newaxis])[0]),
                    ('angular_velocity', lambda x: x @ rotation)):
                x0, x1 = (np.array([getattr(getattr(each, name), axis) for axis in 'xyz'])
                          for each in (old, new))
                np.testing.assert_allclose(x1, expected(x0), atol=1e-12)
            np.testing.assert_array_equal(old.linear_acceleration_covariance,
                                          new.linear_acceleration_covariance)


def test_a_corrected_bag_of_ros_1_differs_only_in_the_acceleration(ros1, tmp_path):
    path, poses, calibration = ros1
    assert correct_bag(path, calibration, tmp_path / 'out.bag') == len(read_recording(path))
    check_copy(path, tmp_path / 'out.bag', '/imu/data_raw', calibration)
    still = capture(read_recording(tmp_path / 'out.bag'), MPS2).poses
    assert len(still) == len(poses)
    assert np.linalg.norm(still.reading, axis=1) == pytest.approx(9.80665, abs=0.01)


def test_a_calibration_of_another_sensor_writes_no_bag(ros1, tmp_path):
    path, _, calibration = ros1
    with pytest.raises(StoredCalibrationError, match='imu_rear'):
        correct_bag(path, replace(calibration, sensor='imu_rear'), tmp_path / 'out.bag')
    with pytest.raises(InputError, match=r'recording\.bag exists'):
        correct_bag(path, calibration, path)
    assert list(tmp_path.iterdir()) == []


def test_a_bag_in_ned_is_forward_right_down_and_one_of_gravity_is_refused(ros1, tmp_path):
    path, poses, fitted = ros1
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
IN_ORDER = ['mcap without chunks', 'mcap without summary', 'split']
"""Kinds that `rosbags` refuses if their messages are out of order."""

KINDS = [*(name for name in MAKES if 'ros1' not in name), 'split']
COUNT = 200


@cache
def messages(seed, *, shuffled=False, frame_ids=('imu',), little_endian=True):
    """Return (topic, time of receipt, bytes); some messages can be slightly out of order."""
    rng, made = np.random.default_rng(seed), []
    for k in range(COUNT):
        stamp = START + RATE_NS * k
        for topic in (0, 1):
            numbers = rng.normal(size=37)
            about = header(STORE, stamp, frame_ids[k % len(frame_ids)])
            made.append((topic, stamp + topic, imu(
                STORE, about, 9.0 + numbers[25:28], numbers[13:16], numbers[:4],
                (numbers[4:13], numbers[16:25], np.zeros(9)))))
        if k % 7 == 3:
            made.append((2, stamp + 2, STORE.types[TEMPERATURE](
                header(STORE, stamp, 'imu'), 20.0 + 0.01 * k, 0.0)))
        if k % 11 == 5:
            made.append((3, stamp + 3, STORE.types[STRING]('x' * (k % 23))))
    if shuffled:
        order = np.argsort(np.arange(len(made)) + rng.uniform(0, 40, len(made)))
        made = [made[k] for k in order]
    return tuple((topic, time, bytes(STORE.serialize_cdr(
        each, TOPICS[topic][1], little_endian=little_endian))) for topic, time, each in made)


def write(folder, kind, made):
    """Write a bag; a split one has two files, the second without words."""
    if kind != 'split':
        return MAKES[kind](folder, TOPICS, made)
    path = rosbag2(StoragePlugin.MCAP)(folder, TOPICS, made[:len(made) // 2])
    McapFile(TOPICS[:3], 'zstd').write(path / 'second.mcap', [
        each for each in made[len(made) // 2:] if each[0] < 3])
    about = yaml.safe_load((path / 'metadata.yaml').read_text())
    about['rosbag2_bagfile_information']['relative_file_paths'].append('second.mcap')
    (path / 'metadata.yaml').write_text(yaml.safe_dump(about))
    return path


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
    *((make, '/imu/a') for make in KINDS), ('mcap lz4', '/imu/b'), ('sqlite3', '/imu/b')])
def test_samples_are_those_that_rosbags_deserializes(make, topic, tmp_path):
    path = write(tmp_path, make, messages(1, shuffled=make not in IN_ORDER))
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
def test_messages_of_another_sensor_are_refused_until_one_is_chosen(make, names, tmp_path):
    path = write(tmp_path, make, messages(20, frame_ids=names * 50 + names[1:] * 100))
    check_refused(path, f"/imu/a: message 2 is from the sensor '{names[1]}', "
                  f"expected '{names[0]}' as before", '/imu/a')
    found = read_recording(path, '/imu/a', names[1])
    assert (len(found), found.sensor) == (150, names[1])
    whole = deserialized(path)
    np.testing.assert_array_equal(found.reading, whole[found.row - 1, 4:])


@pytest.mark.parametrize('make', ['mcap', 'sqlite3'])
def test_big_endian_messages_are_read_and_corrected(make, tmp_path):
    path = write(tmp_path, make, messages(2, little_endian=False))
    found = read_recording(path, '/imu/a')
    expected = deserialized(path)
    np.testing.assert_array_equal(np.column_stack([found['time'], found['rate'], found.reading]),
                                  expected)
    correct_bag(path, known(), tmp_path / 'out', ON_A)
    np.testing.assert_allclose(deserialized(tmp_path / 'out')[:, 4:],
                               known().correct(expected[:, 4:]), atol=1e-12)


@pytest.mark.parametrize(('make', 'turned'), [
    *((make, True) for make in KINDS), ('mcap zstd', False), ('sqlite3', False)])
def test_a_corrected_bag_keeps_all_other_content(make, turned, tmp_path):
    calibration = known()
    if turned:
        model = replace(calibration.model, rotation=rotation_from_rpy(0.2, -0.4, 1.0))
        calibration = replace(calibration, model=model)
    path = write(tmp_path, make, messages(4, shuffled=make not in IN_ORDER))
    calls = []
    count = correct_bag(path, calibration, tmp_path / 'out', ON_A,
                        lambda done, of: calls.append((done, of)))
    assert count == COUNT
    assert calls[-1] == (COUNT, COUNT) or make == 'split'  # whose metadata count the first file
    check_copy(path, tmp_path / 'out', '/imu/a', calibration)
    assert sorted(item.name for item in tmp_path.iterdir()) == sorted([path.name, 'out'])


@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_copy_is_compressed_like_its_bag_unless_it_is_one_file(mode, tmp_path):
    path = rosbag2(StoragePlugin.MCAP, mode)(tmp_path, TOPICS, messages(4))
    for name, found in (('out', mode.name.lower()), ('out.mcap', None), ('out.db3', None)):
        correct_bag(path, known(), tmp_path / name, ON_A)
        assert len(deserialized(tmp_path / name)) == COUNT
        if found:
            with Reader(tmp_path / name) as copy:
                assert copy.compression_mode == found


@pytest.mark.parametrize('plugin', StoragePlugin)
def test_a_file_becomes_a_file_or_a_folder_with_the_metadata_of_its_messages(plugin, tmp_path):
    path = rosbag2(plugin)(tmp_path, TOPICS, messages(7))
    file = next(item for item in path.iterdir() if item.suffix != '.yaml')
    correct_bag(file, known(), tmp_path / f'out{file.suffix}', ON_A)
    assert (tmp_path / f'out{file.suffix}').is_file()
    correct_bag(file, known(), tmp_path / 'out', ON_A)
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
def test_a_damaged_message_is_reported_in_one_line(make, spoil, tmp_path):
    made = list(messages(9))
    which = [k for k, (channel, _, _) in enumerate(made) if channel == 0][-1]
    broken = spoil(made[which][2])
    made[which] = (0, made[which][1], broken)
    path = write(tmp_path, make, made)
    check_refused(path, f'/imu/a: message {COUNT} of {len(broken)} bytes is damaged', '/imu/a')
    assert len(read_recording(path, '/imu/b')) == COUNT


@pytest.mark.parametrize('make', ['mcap', 'sqlite3'])
def test_a_topic_without_messages_is_reported_in_one_line(make, tmp_path):
    path = write(tmp_path, make, [each for each in messages(11) if each[0]])
    check_refused(path, 'has no message on /imu/a', '/imu/a')


def test_poses_do_not_depend_on_the_size_of_blocks(recording, tmp_path, monkeypatch):
    path = write_bag(tmp_path / 'in', 'mcap', recording)
    whole = capture(read_recording(path), MPS2)
    monkeypatch.setattr(*ROWS_OF_A_BAG, 50)
    monkeypatch.setattr(*BLOCK_OF_A_BAG, 20)
    with open_log(path, LogOptions(in_child=False)) as stream:
        assert stream.samples == len(recording)
        assert re.search(r'/\S+.* \d+ Hz.*m/s2$', stream.read_as)
        found = capture(stream.blocks, MPS2)
    assert len(whole.poses) == 12
    assert (found.recorded, found.seconds) == (len(recording), whole.seconds)
    for key in whole.poses.columns:
        np.testing.assert_allclose(found.poses[key], whole.poses[key], rtol=1e-12)


# Temperature and supply voltage


BAG, SAMPLES = LOG_CORPUS / 'bags' / 'float64_mcap.mcap', 40
WARM = LogOptions(context={'temperature': '/imu/temp'})


@pytest.mark.parametrize(('column', 'numbers', 'asked', 'field'), table('fields_of_columns'))
def test_a_field_is_read_only_if_one_can_hold_the_column(
        column: str, numbers: tuple[str, ...], asked: str, field: str) -> None:
    assert field_of(column, numbers, asked) == field


def test_a_bag_is_corrected_with_a_named_temperature(tmp_path: Path) -> None:
    thermal = with_effects(known('g'), {'offset_temperature': (0.01, -0.005, 0.015)},
                           temperature=np.linspace(10.0, 40.0, 20))
    out = tmp_path / 'out'
    with pytest.raises(InputError, match='name the topic with'):
        correct_bag(BAG, thermal, out)
    notes: list[str] = []
    assert correct_bag(BAG, thermal, out, WARM, note=notes.append) == SAMPLES
    assert len(notes) == 1  # the temperatures have no stamp
    raw, found = read_log(BAG, WARM).table, read_recording(out)
    assert isinstance(raw, Recording)
    expected = thermal.correct(raw.reading / 9.80665, {'temperature': raw['temperature']})
    np.testing.assert_allclose(found.reading, expected * 9.80665, atol=1e-9)
    assert np.ptp(found.reading, axis=0).max() > 0.05

    write_calibration(tmp_path / 'c.yaml', thermal)
    given = 'apply', BAG, '-c', tmp_path / 'c.yaml', '-o', tmp_path / 'other'
    assert run(*given) == 2
    assert run(*given, '--context', 'temperature:=/imu/temp') == 0


def test_a_calibration_without_temperature_needs_no_topic(tmp_path: Path) -> None:
    notes: list[str] = []
    assert correct_bag(BAG, known('g'), tmp_path / 'out', note=notes.append) == SAMPLES
    assert notes == []
