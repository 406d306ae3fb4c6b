# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Every damaged bag ends in one clear line or in a result, and leaves nothing half-written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import shutil
import sqlite3
from typing import Any

from accel_calib.calibrate import Calibration, fit_poses
from accel_calib.errors import InputError
from accel_calib.files import correct_bag, read_recording
from accel_calib.files.bag import open_samples
from accel_calib.simulate import simulate_poses
from accel_calib.sphere import spread_directions
from accel_calib.units import units_of
from mcap_file import McapFile, STORE
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import get_typestore, Stores
from shared import sensor
import yaml

IMU, TEMPERATURE, STRING = ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature',
                            'std_msgs/msg/String')
TOPICS = [('/imu', IMU), ('/temperature', TEMPERATURE), ('/words', STRING)]
COUNT = 60
START = 1_700_000_000 * 10 ** 9
RATE_NS = 10 ** 7

Rng = np.random.Generator
Write = Callable[[Path], Path]


def messages(store: Any = STORE) -> list[tuple[int, int, Any]]:
    """Return (number of the topic, time of receipt [ns], message)."""
    types, rng = store.types, np.random.default_rng(1)
    header = types['std_msgs/msg/Header']
    extra = {'seq': 0} if 'seq' in header.__annotations__ else {}
    vector, found = types['geometry_msgs/msg/Vector3'], []
    for k in range(COUNT):
        stamp = START + RATE_NS * k
        about = header(frame_id='imu', stamp=types['builtin_interfaces/msg/Time'](
            sec=stamp // 10 ** 9, nanosec=stamp % 10 ** 9), **extra)
        reading = rng.normal([0.1, -0.2, 9.8], 0.01).tolist()
        found.append((0, stamp, types[IMU](
            about, types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0), np.zeros(9),
            vector(0.0, 0.0, 0.0), np.zeros(9), vector(*reading), np.zeros(9))))
        if k % 5 == 0:
            found.append((1, stamp + 1, types[TEMPERATURE](about, 20.0 + 0.1 * k, 0.0)))
            found.append((2, stamp + 2, types[STRING](f'word {k}')))
    return found


def by_hand(compression: str = '', **how: bool) -> Write:
    def write(folder: Path) -> Path:
        made = [(topic, stamp, bytes(STORE.serialize_cdr(each, TOPICS[topic][1])))
                for topic, stamp, each in messages()]
        return McapFile(TOPICS, compression, **how).write(folder / 'bag.mcap', made)
    return write


def rosbag2(plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Write:
    def write(folder: Path) -> Path:
        writer = Writer2(folder / 'bag', version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            known = [writer.add_connection(*topic, typestore=STORE) for topic in TOPICS]
            for topic, stamp, each in messages():
                writer.write(known[topic], stamp, STORE.serialize_cdr(each, TOPICS[topic][1]))
        return folder / 'bag'
    return write


def ros1(compression: Any = None) -> Write:
    def write(folder: Path) -> Path:
        store, writer = get_typestore(Stores.ROS1_NOETIC), Writer1(folder / 'bag.bag')
        if compression is not None:
            writer.set_compression(compression)
        with writer:
            known = [writer.add_connection(*topic, typestore=store) for topic in TOPICS]
            for topic, stamp, each in messages(store):
                writer.write(known[topic], stamp, store.serialize_ros1(each, TOPICS[topic][1]))
        return folder / 'bag.bag'
    return write


MAKES: dict[str, Write] = {
    'mcap': by_hand(), 'mcap lz4': by_hand('lz4'), 'mcap zstd': by_hand('zstd'),
    'mcap without chunks': by_hand(in_chunks=False),
    'mcap without summary': by_hand(summary=False),
    'sqlite3': rosbag2(StoragePlugin.SQLITE3), 'mcap folder': rosbag2(StoragePlugin.MCAP),
    'sqlite3 messages': rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    'mcap file': rosbag2(StoragePlugin.MCAP, CompressionMode.FILE),
    'ros1': ros1(), 'ros1 bz2': ros1(Writer1.CompressionFormat.BZ2),
    'ros1 lz4': ros1(Writer1.CompressionFormat.LZ4)}


def flip(data: bytearray, rng: Rng) -> None:
    for place in rng.integers(len(data), size=int(rng.integers(1, 9))):
        data[place] ^= 1 << int(rng.integers(8))


def overwrite(data: bytearray, rng: Rng) -> None:
    start, size = int(rng.integers(len(data))), int(rng.integers(1, 64))
    data[start:start + size] = rng.bytes(len(data[start:start + size]))


def fill(data: bytearray, rng: Rng) -> None:
    start, value = int(rng.integers(len(data))), int(rng.choice([0, 255]))
    size = len(data[start:start + int(rng.choice([1, 8, 512]))])
    data[start:start + size] = bytes([value]) * size


def cut(data: bytearray, rng: Rng) -> None:
    del data[int(rng.integers(len(data))):]


def cut_out(data: bytearray, rng: Rng) -> None:
    start = int(rng.integers(len(data)))
    del data[start:start + int(rng.integers(1, 400))]


def insert(data: bytearray, rng: Rng) -> None:
    start = int(rng.integers(len(data)))
    data[start:start] = rng.bytes(int(rng.integers(1, 64)))


DAMAGES = (flip, flip, overwrite, fill, cut, cut_out, insert)


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {make: write(tmp_path_factory.mktemp('whole')) for make, write in MAKES.items()}


@pytest.fixture(scope='module')
def calibration() -> Calibration:
    rng, units = np.random.default_rng(3), units_of('m/s2')
    poses = simulate_poses(sensor(rng), spread_directions(16), rng)
    return fit_poses(poses.with_columns(reading=units.from_g(poses.reading),
                                        std=units.from_g(poses['std'])), units)


def copied(path: Path, folder: Path) -> Path:
    target = folder / path.name
    return Path(shutil.copytree(path, target) if path.is_dir() else shutil.copy(path, target))


def ending(path: Path, calibration: Calibration) -> str:
    """Read and correct a bag; return how reading ended. Any error but an InputError is raised."""
    out = path.with_name('out.bag' if path.suffix == '.bag' else 'out')
    found = [outcome(path, lambda: read_recording(path)),
             outcome(path, lambda: correct_bag(path, calibration, out))]
    assert out.exists() is (found[1] == 'read')
    assert not list(path.parent.glob('.*'))
    return found[0]


def outcome(path: Path, work: Callable[[], object]) -> str:
    try:
        work()
    except InputError as error:
        line = str(error)
    else:
        return 'read'
    assert str(path) in line
    assert '\n' not in line
    return 'refused'


@pytest.mark.parametrize('make', MAKES)
def test_every_damaged_bag_ends_in_one_line_or_in_a_result(
        make: str, whole: dict[str, Path], calibration: Calibration, tmp_path: Path) -> None:
    rng, found = np.random.default_rng(len(make)), []
    for k in range(28):
        folder = tmp_path / str(k)
        folder.mkdir()
        path = copied(whole[make], folder)
        files = sorted(path.iterdir()) if path.is_dir() else [path]
        file = files[int(rng.integers(len(files)))]
        data = bytearray(file.read_bytes())
        DAMAGES[k % len(DAMAGES)](data, rng)
        file.write_bytes(data)
        found.append(ending(path, calibration))
    assert 'refused' in found


CELLS = (None, 'words', '', 1.5, -1, 2 ** 62, b'\xff\xfe')
TABLES = {'messages': ('topic_id', 'timestamp', 'data'),
          'topics': ('name', 'type', 'serialization_format', 'offered_qos_profiles'),
          'schema': ('schema_version',),
          'message_definitions': ('topic_type', 'encoding', 'encoded_message_definition')}


@pytest.mark.parametrize('table', TABLES)
def test_sqlite_cells_of_another_type_end_in_one_line_or_in_a_result(
        table: str, whole: dict[str, Path], calibration: Calibration, tmp_path: Path) -> None:
    made = ((column, cell) for column in TABLES[table] for cell in CELLS)
    loose = copied(whole['sqlite3'], tmp_path)
    with_loose_columns(loose / 'bag.db3', table)
    for k, (column, cell) in enumerate(made):
        (tmp_path / str(k)).mkdir()
        path = copied(loose, tmp_path / str(k))
        execute(path / 'bag.db3', f'UPDATE {table} SET {column} = ? WHERE rowid = '
                f'(SELECT max(rowid) FROM {table})', cell)
        ending(path if k % 2 else path / 'bag.db3', calibration)


def with_loose_columns(file: Path, table: str) -> None:
    """Replace a table by one without types and constraints."""
    execute(file, f'CREATE TABLE loose AS SELECT * FROM {table}')
    execute(file, f'DROP TABLE {table}')
    execute(file, f'ALTER TABLE loose RENAME TO {table}')


def execute(file: Path, statement: str, *values: Any) -> None:
    database = sqlite3.connect(file)
    database.execute('PRAGMA synchronous = OFF')
    database.execute(statement, values)
    database.commit()
    database.close()


@pytest.mark.parametrize(('column', 'cell', 'words'), [
    ('data', None, "a message on /imu has the content 'None'"),
    ('data', 'words', "a message on /imu has the content 'words'"),
    ('timestamp', 'words', "a message on /imu has the time of receipt 'words'")])
def test_a_cell_of_another_type_is_named(column: str, cell: Any, words: str,
                                         whole: dict[str, Path], tmp_path: Path) -> None:
    path = copied(whole['sqlite3'], tmp_path)
    with_loose_columns(path / 'bag.db3', 'messages')
    execute(path / 'bag.db3', f'UPDATE messages SET {column} = ? WHERE rowid = 1', cell)
    with pytest.raises(InputError, match=f'is damaged or not a bag .{words}'):
        read_recording(path)


@pytest.mark.parametrize('value', [None, 7, -1, 'words', [], {}, [None], 2.5, True])
def test_metadata_of_another_type_end_in_one_line_or_in_a_result(
        value: Any, whole: dict[str, Path], calibration: Calibration, tmp_path: Path) -> None:
    about = yaml.safe_load((whole['mcap folder'] / 'metadata.yaml').read_text())
    for k, place in enumerate(list(places(about))):
        (tmp_path / str(k)).mkdir()
        path = copied(whole['mcap folder'], tmp_path / str(k))
        changed = yaml.safe_load((path / 'metadata.yaml').read_text())
        inside = changed
        for key in place[:-1]:
            inside = inside[key]
        inside[place[-1]] = value
        (path / 'metadata.yaml').write_text(yaml.safe_dump(changed))
        outcome(path, lambda path=path: read_recording(path))


def places(value: Any, above: tuple[Any, ...] = ()) -> Any:
    """Yield the place of each value in nested lists and mappings, for the first item of a list."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(
        value, list) else ()
    for key, each in items:
        yield (*above, key)
        yield from places(each, (*above, key))


def test_the_messages_in_the_journal_of_a_killed_recorder_are_read(
        whole: dict[str, Path], calibration: Calibration, tmp_path: Path) -> None:
    (tmp_path / 'recorded').mkdir()
    path = copied(whole['sqlite3'], tmp_path / 'recorded')
    database = sqlite3.connect(path / 'bag.db3')
    database.execute('PRAGMA journal_mode = WAL')
    database.execute('PRAGMA wal_autocheckpoint = 0')
    database.execute('INSERT INTO messages SELECT id + 1000, topic_id, timestamp + ?, data '
                     'FROM messages WHERE topic_id = 1', (10 ** 9,))
    database.commit()
    killed = Path(shutil.copytree(path, tmp_path / 'bag'))
    database.close()
    (killed / 'bag.db3-shm').unlink()
    before = {each.name: each.read_bytes() for each in killed.iterdir()}
    for each in (killed, killed / 'bag.db3'):
        with open_samples(each) as opened:
            assert sum(map(len, opened.blocks)) == 2 * COUNT
            assert 'its last messages are read from bag.db3-wal' in opened.notes[0]
    assert correct_bag(killed, calibration, tmp_path / 'out') == 2 * COUNT
    assert {each.name: each.read_bytes() for each in killed.iterdir()} == before


def test_an_interrupted_transaction_is_undone(whole: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / 'recorded').mkdir()
    path = copied(whole['sqlite3'], tmp_path / 'recorded')
    database = sqlite3.connect(path / 'bag.db3', isolation_level=None)
    database.execute('PRAGMA cache_size = 1')
    database.execute('BEGIN')
    database.execute("UPDATE messages SET data = x'00'")
    killed = Path(shutil.copytree(path, tmp_path / 'bag'))
    database.execute('ROLLBACK')
    database.close()
    assert (killed / 'bag.db3-journal').stat().st_size
    assert len(read_recording(killed)) == COUNT


@pytest.mark.parametrize('name', ['run #1', 'what?', '100%20'])
def test_letters_of_a_uri_in_a_name_are_read(name: str, whole: dict[str, Path], tmp_path: Path
                                             ) -> None:
    path = copied(whole['sqlite3'], tmp_path).rename(tmp_path / name)
    for each in (path, path / 'bag.db3'):
        assert len(read_recording(each)) == COUNT


def test_a_damaged_journal_ends_in_one_line_or_in_a_result(
        whole: dict[str, Path], calibration: Calibration, tmp_path: Path) -> None:
    for k, content in enumerate((b'x', bytes(4096), b'SQLite format 3' * 500)):
        for suffix in ('-wal', '-journal'):
            (tmp_path / f'{k}{suffix}').mkdir()
            path = copied(whole['sqlite3'], tmp_path / f'{k}{suffix}')
            (path / f'bag.db3{suffix}').write_bytes(content)
            ending(path, calibration)


def test_a_folder_without_metadata_is_read(whole: dict[str, Path], tmp_path: Path) -> None:
    path = copied(whole['mcap folder'], tmp_path)
    (path / 'metadata.yaml').unlink()
    with open_samples(path) as opened:
        assert sum(map(len, opened.blocks)) == COUNT
    assert opened.notes == (f'{path} has no metadata.yaml, as after a recorder was killed; '
                            'bag.mcap is read without it',)


def test_a_file_that_the_metadata_do_not_list_is_noted(whole: dict[str, Path],
                                                       tmp_path: Path) -> None:
    path = copied(whole['mcap folder'], tmp_path)
    shutil.copy(path / 'bag.mcap', path / 'later.mcap')
    with open_samples(path) as opened:
        assert sum(map(len, opened.blocks)) == COUNT
    assert 'does not list file later.mcap' in opened.notes[0]


def test_lost_messages_are_noted(whole: dict[str, Path], calibration: Calibration,
                                 tmp_path: Path) -> None:
    path = copied(whole['sqlite3'], tmp_path)
    execute(path / 'bag.db3', 'DELETE FROM messages WHERE rowid % 2')
    with open_samples(path) as opened:
        found = sum(map(len, opened.blocks))
    assert 0 < found < COUNT
    expected = (f'{COUNT - found} of {COUNT} messages on /imu are lost: the index of {path} '
                'states them, but they are not in the bag')
    assert opened.notes == (expected,)
    notes: list[str] = []
    assert correct_bag(path, calibration, tmp_path / 'out', note=notes.append) == found
    assert notes == [expected]


@pytest.mark.parametrize(('value', 'words'), [
    (1e300, r'Imu message 8 has the acceleration 1e\+300'),
    (np.inf, 'Imu message 8 contains NaN or infinity')])
def test_an_acceleration_beyond_any_sensor_is_refused(
        value: float, words: str, calibration: Calibration, tmp_path: Path) -> None:
    made = [(topic, stamp, bytearray(STORE.serialize_cdr(each, TOPICS[topic][1])))
            for topic, stamp, each in messages() if topic == 0]
    made[7][2][-96:-88] = np.float64(value).tobytes()
    path = McapFile(TOPICS).write(tmp_path / 'bag.mcap', made)
    for work in (lambda: read_recording(path),
                 lambda: correct_bag(path, calibration, tmp_path / 'out')):
        with pytest.raises(InputError, match=words):
            work()
