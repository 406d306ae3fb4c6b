# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags of every kind, read and corrected without ROS, and by `rosbags` for comparison.

The golden case `logs_bags` reads topics of any type (temperature, supply voltage and others), and
bags of several sensors, with damaged messages, without metadata, and of a killed recorder.

"""

from dataclasses import replace
from functools import cache
from pathlib import Path
import re
import shutil
import sqlite3

from accel_calib.calibration import fit_poses, level
from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.logs import field_of, LogOptions, open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stillness import capture
from accel_calib.stored import write_calibration
from accel_calib.table import Recording
from bag_files import (
    COUNT as FEW, header, IMU, imu, MAKES, McapFile, messages as few_messages, RATE_NS, ros1,
    rosbag2, START, STORE, STRING, TEMPERATURE, write_bag)
from faults.fuzz import ended, read_bag
from inside import (
    BLOCK_OF_A_BAG, read_log, rotation_from_rpy, ROWS_OF_A_BAG, simulate_recording,
    spread_directions)
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin
from scipy.spatial.transform import Rotation
from shared import known, LOG_CORPUS, MPS2, run, run_on_small_disk, sensor, table, with_effects
import yaml

ON_A = LogOptions(topic='/imu/a')


@pytest.fixture(scope='module')
def recording():
    rng = np.random.default_rng(5)
    return simulate_recording(sensor(rng), spread_directions(12), rng, dwell=2.0, turn=0.5,
                              temperatures=(20.0, 30.0))


@pytest.fixture(scope='module')
def bag_of_ros_1(recording, tmp_path_factory):
    """Return a ROS 1 bag of the recording, its poses, and their calibration."""
    path = write_bag(tmp_path_factory.mktemp('ros1') / 'recording.bag', 'bag', recording)
    poses = capture(read_recording(path), MPS2).poses
    return path, poses, fit_poses(poses, MPS2, sensor='imu_link')


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


def test_a_bag_of_ros_1_is_read_and_its_copy_differs_only_in_the_acceleration(
        bag_of_ros_1, recording, tmp_path):
    path, poses, calibration = bag_of_ros_1
    found = read_recording(path)
    assert (found.units, found.sensor) == ('m/s2', 'imu_link')
    np.testing.assert_array_equal(found.reading, MPS2.from_g(recording.reading))
    np.testing.assert_array_equal(found['rate'], recording['rate'])
    np.testing.assert_allclose(found['temperature'], recording['temperature'], atol=0.2)
    assert correct_bag(path, calibration, tmp_path / 'out.bag') == len(recording)
    check_copy(path, tmp_path / 'out.bag', '/imu/data_raw', calibration)
    still = capture(read_recording(tmp_path / 'out.bag'), MPS2).poses
    assert len(still) == len(poses)
    assert np.linalg.norm(still.reading, axis=1) == pytest.approx(9.80665, abs=0.01)


def test_a_calibration_of_another_sensor_writes_no_bag(bag_of_ros_1, tmp_path):
    path, _, calibration = bag_of_ros_1
    with pytest.raises(StoredCalibrationError, match='imu_rear'):
        correct_bag(path, replace(calibration, sensor='imu_rear'), tmp_path / 'out.bag')
    with pytest.raises(InputError, match=r'recording\.bag exists'):
        correct_bag(path, calibration, path)
    assert list(tmp_path.iterdir()) == []


def test_a_bag_in_ned_is_forward_right_down_and_one_of_gravity_is_refused(bag_of_ros_1, tmp_path):
    path, poses, fitted = bag_of_ros_1
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

BIG_ENDIAN = 'mcap big-endian'
KINDS = [*(name for name in MAKES if 'ros1' not in name), 'split', BIG_ENDIAN]
COUNT = 200


@cache
def messages(seed, *, shuffled=False, little_endian=True):
    """Return (topic, time of receipt, bytes); some messages can be slightly out of order."""
    rng, made = np.random.default_rng(seed), []
    for k in range(COUNT):
        stamp = START + RATE_NS * k
        for topic in (0, 1):
            numbers = rng.normal(size=37)
            about = header(STORE, stamp, 'imu')
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


def write(folder, kind, seed):
    """Write a bag; a split one has two files, the second without words."""
    made = messages(seed, shuffled=kind not in IN_ORDER, little_endian=kind != BIG_ENDIAN)
    if kind != 'split':
        return MAKES[kind.removesuffix(' big-endian')](folder, TOPICS, made)
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
    path = write(tmp_path, make, 1)
    found, expected = read_recording(path, topic), deserialized(path, topic)
    assert len(expected) == COUNT
    assert (found.units, found.sensor) == ('m/s2', 'imu')
    np.testing.assert_array_equal(
        np.column_stack([found['time'], found['rate'], found.reading]), expected)
    assert list(found.row) == list(range(1, COUNT + 1))
    warm = 20.0 + np.clip((expected[:, 0] - 1.7e9), 0.03, 1.99)
    np.testing.assert_allclose(found['temperature'], warm, atol=1e-6)


@pytest.mark.parametrize(('make', 'turned'), [
    *((make, True) for make in KINDS), ('mcap zstd', False), ('sqlite3', False)])
def test_a_corrected_bag_keeps_all_other_content(make, turned, tmp_path):
    calibration = known()
    if turned:
        model = replace(calibration.model, rotation=rotation_from_rpy(0.2, -0.4, 1.0))
        calibration = replace(calibration, model=model)
    path = write(tmp_path, make, 4)
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


NOT_READ = sorted(path for path in (LOG_CORPUS / 'bags').iterdir() if re.match(
    'message|acceleration|two_sensors|no_message', path.name))


@pytest.mark.parametrize('path', NOT_READ, ids=lambda path: path.stem)
def test_a_bag_that_is_not_read_is_not_corrected(path, tmp_path):
    with pytest.raises(InputError):
        correct_bag(path, known(), tmp_path / 'out')
    assert not any(tmp_path.iterdir())


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


def test_the_layout_of_an_array_is_no_quantity(tmp_path: Path) -> None:
    types, kind = STORE.types, 'std_msgs/msg/Float64MultiArray'
    array = types[kind](types['std_msgs/msg/MultiArrayLayout']([], 7), np.array([20.0, 21.0]))
    topics = [('/imu', IMU), ('/temperature', TEMPERATURE), ('/words', STRING), ('/arr', kind)]
    made = [*few_messages(), *((3, START + RATE_NS * k, array) for k in range(0, FEW, 5))]
    path = MAKES['mcap folder'](tmp_path, topics, made)
    options = LogOptions(context={'warmth': '/arr'})
    with pytest.raises(InputError, match='has no single number, expected one warmth'), open_log(
            path, options):
        pass


def test_a_bag_is_corrected_with_a_named_temperature(tmp_path: Path) -> None:
    thermal = with_effects(known('g'), {'offset_temperature': (0.01, -0.005, 0.015)},
                           temperature=np.linspace(10.0, 40.0, 20))
    out = tmp_path / 'out'
    with pytest.raises(InputError, match='name the topic with'):
        correct_bag(BAG, thermal, out)
    notes: list[str] = []
    assert correct_bag(BAG, known('g'), tmp_path / 'plain', note=notes.append) == SAMPLES
    assert notes == []  # this one needs no temperature
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


# Bags of killed recorders, and full disks


def test_the_messages_in_the_journal_of_a_killed_recorder_are_read(tmp_path: Path) -> None:
    made = MAKES['sqlite3'](tmp_path)
    database = sqlite3.connect(made / 'bag.db3', isolation_level=None)
    for statement in ('PRAGMA journal_mode = WAL', 'PRAGMA wal_autocheckpoint = 0',
                      'INSERT INTO messages SELECT id + 1000, topic_id, timestamp + 1000000000, '
                      'data FROM messages WHERE topic_id = 1'):
        database.execute(statement)
    path = Path(shutil.copytree(made, tmp_path / 'killed'))
    database.close()
    (path / 'bag.db3-shm').unlink()
    before = {each: (each.read_bytes(), each.stat().st_mtime_ns) for each in path.iterdir()}
    for each in (path, path / 'bag.db3'):
        log = read_log(each)
        assert len(log.table) == 2 * FEW
        assert 'its last messages are read from bag.db3-wal' in log.notes[0]
    assert correct_bag(path, known(), tmp_path / 'out') == 2 * FEW
    assert before == {
        each: (each.read_bytes(), each.stat().st_mtime_ns) for each in path.iterdir()}


@pytest.mark.parametrize('name', ['run #1', 'what?', '100%20'])
def test_letters_of_a_uri_in_a_name_are_read(name: str, tmp_path: Path) -> None:
    path = MAKES['sqlite3'](tmp_path).rename(tmp_path / name)
    for each in (path, path / 'bag.db3'):
        assert len(read_recording(each)) == FEW


@pytest.mark.parametrize('suffix', ['-wal', '-journal'])
def test_a_damaged_journal_ends_in_one_line_or_in_a_result(suffix: str, tmp_path: Path) -> None:
    (tmp_path / 'in').mkdir()
    path = MAKES['sqlite3'](tmp_path / 'in')
    for content in (b'x', bytes(4096), b'SQLite format 3' * 500):
        (path / f'bag.db3{suffix}').write_bytes(content)
        assert ended(read_bag, path, np.random.default_rng(1)) in ('read', 'refused')


def test_an_anchor_of_several_values_in_the_metadata_causes_no_warning(
        tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    path = MAKES['mcap folder'](tmp_path)
    text = (path / 'metadata.yaml').read_text()
    assert text.count('message_count: ') > 1
    (path / 'metadata.yaml').write_text(text.replace('message_count: ', 'message_count: &a '))
    assert len(read_recording(path)) == FEW
    assert not [str(each.message) for each in recwarn]


@pytest.mark.parametrize(('name', 'size_kb'), [
    ('out', 8), ('out', 24), ('out.db3', 24), ('out.mcap', 8), ('out.bag', 24)])
def test_a_copy_on_a_full_disk_is_one_line_and_nothing_stored(
        name: str, size_kb: int, tmp_path: Path) -> None:
    write_calibration(tmp_path / 'c.yaml', known())
    path = (ros1() if name.endswith('.bag') else rosbag2(StoragePlugin.SQLITE3))(tmp_path)
    disk = tmp_path / 'disk'
    done, copy = run_on_small_disk(
        disk, size_kb, 'apply', path, '-c', tmp_path / 'c.yaml', '-o', disk / name)
    assert (done.returncode, done.stderr.count('\n')) == (2, 1), done.stderr
    assert f'{disk}/' in done.stderr
    assert 'No space left' in done.stderr
    assert list(copy.iterdir()) == []
