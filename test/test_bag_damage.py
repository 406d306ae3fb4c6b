# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Every damaged bag ends in one clear line or in a result, and leaves nothing half-written."""

from collections.abc import Callable
from pathlib import Path
import shutil
import sqlite3

from accel_calib.errors import InputError
from accel_calib.logs import open_log, read_recording
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from bag_files import (
    by_hand, check_refused, COUNT, execute, header, IMU, imu, MAKES, raw_messages, ros1, rosbag2,
    STORE)
from faults.fuzz import ended, read_bag
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from shared import known, run_on_small_disk


def check(path: Path) -> None:
    """Check that reading and correcting a bag end in a result or in one line."""
    assert ended(read_bag, path, np.random.default_rng(1)) in ('read', 'refused')


def read(path: Path) -> tuple[int, tuple[str, ...]]:
    """Return the number of samples in a bag, and the notes."""
    with open_log(path) as opened:
        return sum(map(len, opened.blocks)), opened.notes


def killed(folder: Path, *statements: str) -> Path:
    """Return a bag as a recorder leaves it that is killed after these statements."""
    path = MAKES['sqlite3'](folder)
    database = sqlite3.connect(path / 'bag.db3', isolation_level=None)
    for each in statements:
        database.execute(each)
    copy = Path(shutil.copytree(path, folder / 'killed'))
    database.close()
    return copy


def test_the_messages_in_the_journal_of_a_killed_recorder_are_read(tmp_path: Path) -> None:
    path = killed(tmp_path, 'PRAGMA journal_mode = WAL', 'PRAGMA wal_autocheckpoint = 0',
                  'INSERT INTO messages SELECT id + 1000, topic_id, timestamp + 1000000000, data '
                  'FROM messages WHERE topic_id = 1')
    (path / 'bag.db3-shm').unlink()
    before = {each.name: each.read_bytes() for each in path.iterdir()}
    for each in (path, path / 'bag.db3'):
        count, notes = read(each)
        assert count == 2 * COUNT
        assert 'its last messages are read from bag.db3-wal' in notes[0]
    assert correct_bag(path, known(), tmp_path / 'out') == 2 * COUNT
    assert {each.name: each.read_bytes() for each in path.iterdir()} == before


def test_an_interrupted_transaction_is_undone(tmp_path: Path) -> None:
    path = killed(tmp_path, 'PRAGMA cache_size = 1', 'BEGIN', "UPDATE messages SET data = x'00'")
    assert (path / 'bag.db3-journal').stat().st_size
    assert len(read_recording(path)) == COUNT


@pytest.mark.parametrize('name', ['run #1', 'what?', '100%20'])
def test_letters_of_a_uri_in_a_name_are_read(name: str, tmp_path: Path) -> None:
    path = MAKES['sqlite3'](tmp_path).rename(tmp_path / name)
    for each in (path, path / 'bag.db3'):
        assert len(read_recording(each)) == COUNT


@pytest.mark.parametrize('suffix', ['-wal', '-journal'])
def test_a_damaged_journal_ends_in_one_line_or_in_a_result(suffix: str, tmp_path: Path) -> None:
    (tmp_path / 'in').mkdir()
    path = MAKES['sqlite3'](tmp_path / 'in')
    for content in (b'x', bytes(4096), b'SQLite format 3' * 500):
        (path / f'bag.db3{suffix}').write_bytes(content)
        check(path)


def anchors(path: Path) -> None:
    """Give several values of the metadata one anchor, of which YAML warns."""
    text = (path / 'metadata.yaml').read_text()
    assert text.count('message_count: ') > 1
    (path / 'metadata.yaml').write_text(text.replace('message_count: ', 'message_count: &a '))


@pytest.mark.parametrize(('spoil', 'note'), [
    (lambda path: (path / 'metadata.yaml').unlink(), 'no metadata.yaml'),
    (lambda path: shutil.copy(path / 'bag.mcap', path / 'later.mcap'), 'later.mcap'),
    (anchors, '')], ids=['missing', 'incomplete', 'damaged'])
def test_a_folder_is_read_whatever_its_metadata(
        spoil: Callable[[Path], object], note: str, tmp_path: Path,
        recwarn: pytest.WarningsRecorder) -> None:
    path = MAKES['mcap folder'](tmp_path)
    spoil(path)
    count, notes = read(path)
    assert (count, len(notes)) == (COUNT, bool(note))
    assert note in ''.join(notes)
    assert not [str(each.message) for each in recwarn]


def test_lost_messages_are_noted(tmp_path: Path) -> None:
    path = MAKES['sqlite3'](tmp_path)
    execute(path / 'bag.db3', 'DELETE FROM messages WHERE rowid % 2')
    found, said = read(path)
    assert 0 < found < COUNT
    assert said[0].startswith(f'{COUNT - found} of {COUNT} messages on /imu are lost')
    notes: list[str] = []
    assert correct_bag(path, known(), tmp_path / 'out', note=notes.append) == found
    assert notes == [*said]


@pytest.mark.parametrize('value', [1e300, np.inf, np.nan])
def test_an_acceleration_beyond_any_sensor_is_refused(value: float, tmp_path: Path) -> None:
    made = [each for each in raw_messages() if each[0] == 0]
    topic, stamp, raw = made[7]
    made[7] = (topic, stamp, raw[:-96] + np.float64(value).tobytes() + raw[-88:])
    check_refused(by_hand()(tmp_path, made=made), 'Imu message 8')


def test_a_long_name_of_a_sensor_is_not_shown_whole(tmp_path: Path) -> None:
    path = by_hand()(tmp_path, made=[
        (0, stamp, bytes(STORE.serialize_cdr(
            imu(STORE, header(STORE, stamp, name), (0.0, 0.0, 9.8)), IMU)))
        for stamp, name in enumerate(('imu', 100_000 * 'b'))])
    with pytest.raises(InputError, match=r"the sensor 'bbb.* … .*, expected 'imu'") as caught:
        read_recording(path)
    assert len(str(caught.value)) < 3000


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
