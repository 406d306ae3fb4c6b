# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A small file can't take much memory or work: it ends in one line, or in a result."""

from collections.abc import Callable
import gzip
import os
from pathlib import Path
import socket
import struct
from typing import Any
import zipfile

from accel_calib.errors import InputError
from accel_calib.logs import read_recording
from accel_calib.messages import correct_bag
from accel_calib.stored import write_calibration
from bag_files import (
    COMPRESS, COUNT, execute, fill, McapFile, messages, raw_messages, rosbag2 as folder_of, TOPICS,
    zstd)
from inside import check_regular, open_bag, PATIENCE_WITH_A_CHILD
import numpy as np
import openpyxl
import pytest
from rosbags import rosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import get_typestore, Stores
import scipy.io
import shared
from test_logs import write

pytestmark = pytest.mark.usefixtures('in_time')

BOMB_SIZE = 1 << 31
ZSTD_BOMB = zstd.compress(bytes(1 << 26)) * (BOMB_SIZE >> 26)
RAWS = raw_messages()
BILLION = '\n'.join(['a0: &a0 [x, x, x, x, x, x, x, x, x, x]', *(
    f'a{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 10)}]' for k in range(1, 10))])
ENDLESS = 'WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x'


def chunk(folder: Path, *, summary: bool = True) -> Path:
    """Write a chunk that holds 2 GB more than it states."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(COMPRESS, 'zstd', lambda data: zstd.compress(data) + ZSTD_BOMB)
        return McapFile(TOPICS, 'zstd', summary=summary, chunk=10 ** 6).write(
            folder / 'bag.mcap', RAWS)


def length(folder: Path) -> Path:
    """Write a message that states 2 GB."""
    path = McapFile(TOPICS, in_chunks=False).write(folder / 'bag.mcap', RAWS)
    data = bytearray(path.read_bytes())
    place = data.index(struct.pack('<BQ', 5, len(RAWS[0][2]) + 22))
    data[place + 1:place + 9] = struct.pack('<Q', 1 << 40)
    path.write_bytes(data)
    return path


def message(folder: Path) -> Path:
    path = folder_of(StoragePlugin.SQLITE3, CompressionMode.MESSAGE)(folder)
    execute(path / 'bag.db3', 'UPDATE messages SET data = ? WHERE id = 9', ZSTD_BOMB)
    return path


def whole_file(folder: Path) -> Path:
    path = folder_of(StoragePlugin.MCAP, CompressionMode.FILE)(folder)
    next(path.glob('*.zst*')).write_bytes(ZSTD_BOMB)
    return path


def ros1(folder: Path) -> Path:
    store, path = get_typestore(Stores.ROS1_NOETIC), folder / 'bag.bag'
    writer = Writer1(path)
    writer.set_compression(Writer1.CompressionFormat.BZ2)
    pack = writer.compressor
    bomb = pack(bytes(1 << 26)) * 32
    writer.compressor = lambda data: pack(data) + bomb
    fill(writer, store, TOPICS, messages(store))
    return path


def metadata(text: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder_of(StoragePlugin.MCAP)(folder)
        (path / 'metadata.yaml').write_text(text)
        return path
    return write


def database(*statements: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        path = folder_of(StoragePlugin.SQLITE3)(folder)
        for each in statements:
            execute(path / 'bag.db3', each)
        return path
    return write


def file(name: str, save: Callable[[Path], object]) -> Callable[[Path], Path]:
    return lambda folder: write(folder, save, name)


def archive(path: Path) -> None:
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as made, made.open('a.csv', 'w') as one:
        for _ in range(8):
            one.write(b'1' * (1 << 24))


def far_row(path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.append(['ax', 'ay', 'az', *[None] * 16, 'note'])
    book.active.cell(1 << 20, 1, 1.0)
    book.save(path)


def arrow(path: Path) -> None:
    pa = pytest.importorskip('pyarrow')
    pytest.importorskip('pyarrow.parquet').write_table(
        pa.table({name: np.zeros(1 << 22) for name in ('t', 'ax', 'ay', 'az')}), path)


def hdf5(path: Path) -> None:
    with pytest.importorskip('h5py').File(path, 'w') as made:
        made.create_dataset('acc', (10 ** 9, 3), 'f8', compression='gzip')


BOMBS: dict[str, Callable[[Path], Path]] = {
    'chunk': chunk, 'chunk without summary': lambda folder: chunk(folder, summary=False),
    'length': length, 'message': message, 'file': whole_file, 'bz2': ros1,
    'aliases': metadata(BILLION), 'nested': metadata('a: ' + '[' * 100_000),
    'view': database('DROP TABLE messages', 'CREATE VIEW messages(id, topic_id, timestamp, data) '
                     f"AS SELECT x, 1, x, x'00' FROM ({ENDLESS} FROM c)"),
    'computed': database('CREATE TABLE other AS SELECT id, topic_id, timestamp FROM messages',
                         'DROP TABLE messages', 'ALTER TABLE other RENAME TO messages',
                         'ALTER TABLE messages ADD COLUMN data BLOB AS (zeroblob(900000000))'),
    'gzip': file('log.csv.gz', lambda path: path.write_bytes(
        gzip.compress(b'ax,ay,az\n') + gzip.compress(b'1' * (1 << 26)) * 32)),
    'zip': file('log.zip', archive), 'xlsx': file('log.xlsx', far_row),
    'mat': file('log.mat', lambda path: scipy.io.savemat(
        path, {'acc': np.zeros((1 << 25, 3), np.int8)}, do_compression=True)),
    'npz': file('log.npz', lambda path: np.savez_compressed(
        path, acc=np.zeros((1 << 25, 3), np.int8))),
    'parquet': file('log.parquet', arrow), 'hdf5': file('log.h5', hdf5)}
"""Functions that write a bomb into a folder."""


@pytest.mark.parametrize('kind', BOMBS)
def test_a_bomb_ends_in_one_line_with_little_memory(kind: str, tmp_path: Path,
                                                    monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*PATIENCE_WITH_A_CHILD, 2)
    path = BOMBS[kind](tmp_path)
    before = {*tmp_path.rglob('*')}
    with shared.little_memory(), pytest.raises(InputError) as found:
        read_recording(path)
    assert str(path) in str(found.value)
    assert '\n' not in str(found.value)
    assert {*tmp_path.rglob('*')} == before


def test_blocks_of_large_messages_are_short(tmp_path: Path) -> None:
    large = [(2, RAWS[0][1] + k, bytes(1 << 19)) for k in range(80)]
    path = McapFile(TOPICS, 'zstd', chunk=16 << 20).write(tmp_path / 'bag.mcap', large)
    with open_bag(path) as bag:
        sizes = [len(block) for block in bag.blocks()]
    assert sum(sizes) == 80
    assert max(sizes) <= 64


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
