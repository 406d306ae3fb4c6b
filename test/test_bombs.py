# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A small file can't take much memory or work: it ends in one line, or in a result."""

import bz2
import os
from pathlib import Path
import shutil
import socket
import sqlite3
import struct
from typing import Any

from accel_calib.errors import InputError
from accel_calib.logs import read_recording
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from bag_files import (
    COMPRESS, COUNT, execute, McapFile, messages, raw_messages, rosbag2 as folder_of, TOPICS, zstd)
from inside import check_regular, DECOMPRESSED, decompressed, largest, open_bag
import pytest
from rosbags import rosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import get_typestore, Stores
import shared

pytestmark = pytest.mark.usefixtures('in_time')

BOMB_SIZE = 1 << 31
ZSTD_BOMB = zstd.compress(bytes(1 << 26)) * (BOMB_SIZE >> 26)
MOST_BYTES = 150e6
"""Largest size of all that is decompressed until a file is refused."""

RAWS = raw_messages()


def refused(path: Path, words: str) -> None:
    """Check that reading ends in one line, with little memory, and decompresses little."""
    sizes = []

    def counted(*given: Any) -> bytes:
        sizes.append(len(data := decompressed(*given)))
        return data

    with pytest.MonkeyPatch.context() as patch, shared.little_memory():
        patch.setattr(*DECOMPRESSED, counted)
        with pytest.raises(InputError, match=words) as found:
            read_recording(path)
    assert str(path) in str(found.value)
    assert '\n' not in str(found.value)
    assert sum(sizes) < MOST_BYTES


# ------------------------------------------------------------------- compressed chunks and files

@pytest.mark.parametrize('summary', [True, False])
def test_a_chunk_that_holds_more_than_it_states_or_states_two_gigabytes_is_refused(
        summary: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(ZSTD_BOMB) < 100_000
    monkeypatch.setitem(COMPRESS, 'zstd', lambda data: zstd.compress(data) + ZSTD_BOMB)
    path = McapFile(TOPICS, 'zstd', summary=summary, chunk=10 ** 6).write(
        tmp_path / 'more.mcap', RAWS)
    refused(path, 'compressed bytes hold more than')
    monkeypatch.setitem(COMPRESS, 'zstd', lambda data: ZSTD_BOMB)
    path = McapFile(TOPICS, 'zstd', summary=summary, chunk=10 ** 6).write(
        tmp_path / 'large.mcap', RAWS)
    data, size = path.read_bytes(), sum(len(raw) + 31 for _, _, raw in RAWS)
    size += len(b''.join(each for part in McapFile(TOPICS).definitions() for each in part))
    assert data.count(struct.pack('<Q', size)) == 1 + summary
    path.write_bytes(data.replace(struct.pack('<Q', size), struct.pack('<Q', BOMB_SIZE)))
    refused(path, f'states {BOMB_SIZE} bytes')


def test_an_index_that_lists_a_chunk_many_times_is_refused(tmp_path: Path) -> None:
    class Repeated(McapFile):
        def put_chunk(self, data: Any, offsets: Any) -> None:
            super().put_chunk(data, offsets)
            self.indexes = self.indexes * 1000

    path = Repeated(TOPICS, 'lz4', chunk=10 ** 6).write(tmp_path / 'bag.mcap', RAWS)
    refused(path, 'the chunks at [0-9]+ and [0-9]+ overlap')


def test_chunks_of_the_same_time_are_not_all_decompressed(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Padded(McapFile):
        def put_chunk(self, data: Any, offsets: Any) -> None:
            first, last = RAWS[0][1], RAWS[-1][1]  # each chunk has messages at both ends
            padding = struct.pack('<BQ', 0x80, 30 << 20) + bytes(30 << 20)
            super().put_chunk(bytes(data) + padding, [(0, first, 0), *offsets, (0, last, 0)])

    path = Padded(TOPICS, 'zstd', chunk=4000).write(tmp_path / 'bag.mcap', RAWS)
    assert path.stat().st_size < 100_000
    refused(path, 'chunks of the same time')


def test_a_compressed_message_that_is_a_bomb_is_refused(tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.SQLITE3, CompressionMode.MESSAGE)(tmp_path)
    execute(path / 'bag.db3', 'UPDATE messages SET data = ? WHERE id = 9', ZSTD_BOMB)
    refused(path, 'compressed bytes hold more than')


def test_a_compressed_file_that_is_a_bomb_is_refused_and_not_stored(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder_of(StoragePlugin.MCAP, CompressionMode.FILE)(tmp_path)
    file = next(path.glob('*.zst*'))
    file.write_bytes(ZSTD_BOMB)
    monkeypatch.setattr(shutil, 'copyfileobj', lambda *_: pytest.fail('the bomb is unpacked'))
    refused(path, f'{file.name} decompresses to more than')


@pytest.mark.parametrize('kind', ['BZ2', 'LZ4'])
def test_a_chunk_of_ros_1_that_is_a_bomb_is_refused(kind: str, tmp_path: Path) -> None:
    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path / 'bag.bag'
    writer = Writer1(path)
    writer.set_compression(getattr(Writer1.CompressionFormat, kind))
    pack = writer.compressor
    with writer:
        known = writer.add_connection(*TOPICS[0], typestore=store)
        writer.compressor = lambda data: pack(data) + pack(bytes(1 << 24)) * 32
        for topic, stamp, each in messages(store):
            if topic == 0:
                writer.write(known, stamp, store.serialize_ros1(each, TOPICS[0][1]))
    refused(path, 'compressed bytes hold more than')


def test_data_that_compress_well_are_read() -> None:
    black = bytes(24 << 20)  # a picture
    kinds: list[tuple[Any, Any]] = [(zstd.ZstdDecompressor, zstd.compress),
                                    (bz2.BZ2Decompressor, bz2.compress)]
    for make, pack in kinds:
        assert decompressed(make, pack(black), len(black)) == black
        assert decompressed(make, pack(b'one') + pack(b'two')) == b'onetwo'
        with pytest.raises(ValueError, match='end early'):
            decompressed(make, pack(b'one')[:-1])
    assert largest(100 << 20) > 10 * (100 << 20)


def test_sizes_that_a_file_cannot_hold_are_not_allocated(tmp_path: Path) -> None:
    path = McapFile(TOPICS, in_chunks=False).write(tmp_path / 'bag.mcap', RAWS)
    data = bytearray(path.read_bytes())
    place = data.index(struct.pack('<BQ', 5, len(RAWS[0][2]) + 22))
    data[place + 1:place + 9] = struct.pack('<Q', 1 << 31)
    path.write_bytes(data)
    refused(path, 'is damaged or not a bag')


def test_blocks_of_large_messages_are_short(tmp_path: Path) -> None:
    large = [(2, RAWS[0][1] + k, bytes(1 << 19)) for k in range(80)]
    path = McapFile(TOPICS, 'zstd', chunk=16 << 20).write(tmp_path / 'bag.mcap', large)
    with open_bag(path) as bag:
        sizes = [len(block) for block in bag.blocks()]
    assert sum(sizes) == 80
    assert max(sizes) <= 64


# ---------------------------------------------------------------------------------- metadata

BILLION = '\n'.join(['a0: &a0 [x, x, x, x, x, x, x, x, x, x]', *(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]' for k in range(1, 10))])


@pytest.mark.parametrize(('text', 'words'), [
    (BILLION, 'aliases stand for more than'),
    ('a: ' + '[' * 100_000, 'nested more than|maximum nesting depth'),
    ('- ' * 100_000 + 'a', 'nested more than')])
def test_metadata_without_end_are_refused(text: str, words: str, tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.MCAP)(tmp_path)
    (path / 'metadata.yaml').write_text(text)
    refused(path, words)


# ------------------------------------------------------------------------------------ SQLite

ENDLESS = 'WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x'
NUMBERS = f'({ENDLESS} FROM c LIMIT 8000)'

FORGED = {
    'the view schema': [
        'DROP TABLE schema', f'CREATE VIEW schema(schema_version) AS {ENDLESS} FROM c'],
    'the view messages': [
        'ALTER TABLE messages RENAME TO old', 'CREATE VIEW messages AS SELECT * FROM old'],
    'the table message_definitions': [
        'DROP TABLE message_definitions',
        'CREATE VIRTUAL TABLE message_definitions USING fts5(a)'],
    'the trigger no': [
        'CREATE TRIGGER no BEFORE INSERT ON messages BEGIN SELECT RAISE(IGNORE); END'],
    'column data of table messages is computed': [
        'CREATE TABLE other AS SELECT id, topic_id, timestamp FROM messages',
        'DROP TABLE messages', 'ALTER TABLE other RENAME TO messages',
        'ALTER TABLE messages ADD COLUMN data BLOB AS (zeroblob(900000000))'],
    'a query needs more than [0-9]+ steps': [
        'CREATE TABLE loose AS SELECT * FROM topics', 'DROP TABLE topics',
        'ALTER TABLE loose RENAME TO topics',
        f"INSERT INTO topics SELECT 1, 't', 'e', 'cdr', '', '' FROM {NUMBERS}",
        f"INSERT INTO messages SELECT NULL, 1, x, x'00' FROM {NUMBERS}"]}
"""Statements that make a database one that no recorder writes, and words of the refusal."""

LARGE_CELLS = [
    ['UPDATE messages SET data = zeroblob(270000000) WHERE id = 9'],
    ['UPDATE messages SET timestamp = zeroblob(20000000) WHERE id = 9'],
    ['UPDATE topics SET name = zeroblob(20000000) WHERE id = 1'],
    ['UPDATE message_definitions SET topic_type = zeroblob(20000000) WHERE id = 1'],
    ['CREATE TABLE loose(schema_version)', 'DROP TABLE schema',
     'ALTER TABLE loose RENAME TO schema', 'INSERT INTO schema VALUES (4)',
     'UPDATE schema SET schema_version = zeroblob(20000000)']]


@pytest.mark.parametrize(('words', 'statements'), [
    *FORGED.items(), *(('string or blob too big', each) for each in LARGE_CELLS)])
def test_a_database_that_no_recorder_writes_is_refused(words: str, statements: list[str],
                                                       tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.SQLITE3)(tmp_path)
    for each in statements:
        execute(path / 'bag.db3', each)
    for each in (path, path / 'bag.db3'):
        refused(each, words)


def test_pages_that_are_listed_many_times_are_refused(tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.SQLITE3)(tmp_path) / 'bag.db3'
    execute(path, f'INSERT INTO messages SELECT NULL, 1, x, zeroblob(300) FROM ({ENDLESS} FROM c '
            'LIMIT 30000)')
    database = sqlite3.connect(path)
    root, = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'messages'"
                             ).fetchone()
    size, = database.execute('PRAGMA page_size').fetchone()
    database.close()
    data = bytearray(path.read_bytes())
    inner = (root - 1) * size
    while data[inner] == 5:  # all children of the inner pages become the first one
        count, = struct.unpack('>H', data[inner + 3:inner + 5])
        cells = [inner + cell for cell in struct.unpack(f'>{count}H', data[
            inner + 12:inner + 12 + 2 * count])]
        child = bytes(data[cells[0]:cells[0] + 4])
        for place in (*cells, inner + 8):
            data[place:place + 4] = child
        inner = (int.from_bytes(child, 'big') - 1) * size
    path.write_bytes(data)
    refused(path, 'is damaged or not a bag')


def test_correcting_leaves_a_database_as_it_is_and_refuses_a_copy_that_lacks_messages(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, count = rosbag2.Writer.write, iter(range(10 ** 6))

    def losing(self: Any, *message: Any) -> None:
        if next(count) != 20:
            write(self, *message)

    path = folder_of(StoragePlugin.SQLITE3)(tmp_path)

    def state() -> dict[Path, Any]:
        return {each: (each.read_bytes(), each.stat().st_mtime_ns) for each in path.iterdir()}

    before = state()
    assert correct_bag(path, shared.known(), tmp_path / 'whole') == COUNT
    assert state() == before
    monkeypatch.setattr(rosbag2.Writer, 'write', losing)
    with pytest.raises(InputError, match='the copy holds 83 of 84 messages'):
        correct_bag(path, shared.known(), tmp_path / 'out')
    assert sorted(each.name for each in tmp_path.iterdir()) == ['bag', 'whole']


# ----------------------------------------------------------------------------- regular files

def test_only_regular_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / 'fifo')
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / 'socket'))
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'fifo')
    for name, kind in (('fifo', 'a pipe'), ('socket', 'a socket'), ('folder', 'a folder'),
                       ('/dev/zero', 'a character device'), ('link', 'a pipe')):
        with pytest.raises(InputError, match=f'is {kind}.*, expected a regular file; (sto|choo)'):
            check_regular(tmp_path / name)
    (tmp_path / 'file').write_text('')
    (tmp_path / 'right').symlink_to(tmp_path / 'file')
    check_regular(tmp_path / 'right')
    with pytest.raises(FileNotFoundError):
        check_regular(tmp_path / 'missing')


COMMANDS = [('fit', '{}'), ('fit', '{}', '--rows', '1:9'), ('verify', '{}', '-c', '{yaml}'),
            ('verify', '{yaml}', '-c', '{}'),
            ('refine', '{}'), ('calibrate', '{}', '-o', '{out}'), ('capture', '{}', '-o', '{out}'),
            ('noise', '{}'), ('thermal', '{}', '-o', '{out}'),
            ('apply', '{}', '-c', '{yaml}', '-o', '{out}'),
            ('report', '{}', '-o', '{out}'), ('compare', '{}', '{}'), ('history', '{}'),
            ('export', '{}', '--to', 'c'),
            ('export', '{yaml}', '--to', 'kalibr', '--noise', '{}'),
            ('verify', '{yaml}', '-c', '{yaml}', '--also', '{}'), ('fleet', '@{}', '-o', '{out}')]


@pytest.mark.parametrize(('command', 'suffix'), [
    *((command, '') for command in COMMANDS),
    *((('capture', '{}', '-o', '{out}'), suffix)
      for suffix in ('.bag', '.mcap', '.db3', '.ulg', '.bin'))])
def test_a_pipe_ends_every_command_in_one_line(
        command: tuple[str, ...], suffix: str, tmp_path: Path,
        capsys: pytest.CaptureFixture[str]) -> None:
    pipe, stored, out = tmp_path / f'pipe{suffix}', tmp_path / 'c.yaml', tmp_path / 'out'
    os.mkfifo(pipe)
    write_calibration(stored, shared.known())
    given = [each.replace('{out}', str(out)).replace('{yaml}', str(stored)).replace(
        '{}', str(pipe)) for each in command]
    assert '(FIFO)' in shared.refused(capsys, *given).partition(str(pipe))[2]
    assert not out.exists()


@pytest.mark.parametrize('name', ['bag.mcap', 'metadata.yaml'])
def test_a_pipe_in_the_folder_of_a_bag_is_refused(name: str, tmp_path: Path) -> None:
    path = folder_of(StoragePlugin.MCAP)(tmp_path)
    (path / name).unlink()
    os.mkfifo(path / name)
    refused(path, f'{name} is a pipe')
