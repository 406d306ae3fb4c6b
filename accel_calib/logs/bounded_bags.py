# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Readers of `rosbags` whose memory and time are bounded by the size of the file.

A file of 67 kB can decompress to 2 GB, or can point to the same bytes many times. The readers here
check the stated sizes before they allocate, and stop as soon as a size is exceeded:

- A chunk, a message or a file decompresses to at most `_RATIO` times its size; 32 MiB are always
  allowed. Sensor messages compress 2 to 10 times, and black pictures in large chunks stay below
  32 MiB.
- The chunks of an MCAP file do not overlap in the file, and those that are open at the same time
  obey the same rule together.
- A db3 file consists of plain tables, which are read in a number of steps that depends on its
  size. A view, a trigger or a computed column could run any statement without end.

A recorder that was killed leaves the last messages of a db3 file in a second file, the journal of
SQLite (``-wal`` or ``-journal``). `rosbags` ignores it. SQLite joins both files, in a copy.

"""

from bz2 import BZ2Decompressor
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack
from functools import partial
import io
from itertools import pairwise
from pathlib import Path, PosixPath
import re
import shutil
import sqlite3
import sys
from tempfile import TemporaryDirectory
import threading
from typing import Any

import apsw
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import reader as rosbag2_reader, storage_mcap
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
import yaml

from ..disk import check_regular
from ..errors import InputError
from ..text import listed

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_MB = 1 << 20
_RATIO = 256
"""Largest ratio of decompressed to compressed size; LZ4 reaches at most 255."""

_ALWAYS = 32 * _MB
_TOGETHER = 128 * _MB
_IN_ALL = 1024 * _MB
"""Decompressed sizes that are always allowed: of one chunk, of the chunks that are open at the
same time, and of all chunks of a file [bytes]."""

_STEPS, _STEPS_PER_BYTE = 10_000_000, 20
"""Largest number of steps of SQLite until the next row; a message has about 30 in 100 bytes."""

_EVERY = 100_000
"""Number of steps of SQLite after which they are counted."""

_READ_TABLES = ('topics', 'messages', 'schema', 'message_definitions')
_PLAIN = re.compile(r'CREATE (TABLE|INDEX|UNIQUE INDEX)\s', re.IGNORECASE)

_LARGEST_METADATA = 16 * _MB
_LARGEST_MESSAGE = 256 * _MB
"""Largest cell of a db3 file, of its topics and of its messages [bytes]."""

_LARGEST_EXPANDED = 64 * _MB
_DEEPEST_METADATA = 50
_ZSTD_MAGIC = re.compile(rb'\x28\xb5\x2f\xfd|[\x50-\x5f]\x2a\x4d\x18')

_JOURNALS = ('-wal', '-journal')
_IN_URI = {'?', '#', '%'}
"""Letters that `rosbags` does not escape when it opens a db3 file by its URI."""

_Messages = Generator[tuple[Connection, int, bytes], None, None]


def largest(compressed: int, always: int = _ALWAYS) -> int:
    """Return the largest allowed size [bytes] of data with this compressed size [bytes]."""
    return max(always, _RATIO * compressed)


def decompressed(make: Callable[[], Any], data: bytes, stated: int | None = None) -> bytes:
    """Return decompressed frames; ValueError if cut, or over `stated` or `largest` [bytes]."""
    size = len(data)
    _check_size(stated or 0, size)
    left = largest(size) if stated is None else stated
    parts = []
    while data:
        decompressor = make()
        while not decompressor.eof:
            if not data and decompressor.needs_input:
                raise ValueError(f'{size} compressed bytes end early')
            parts.append(decompressor.decompress(data, max_length=left + 1))
            data, left = b'', left - len(parts[-1])
            if left < 0:
                raise ValueError(f'{size} compressed bytes hold more than '
                                 f'{sum(map(len, parts)) - 1} bytes')
        data = decompressor.unused_data or b''
    return b''.join(parts)


def _check_size(stated: int, compressed: int, what: str = 'a chunk', always: int = _ALWAYS
                ) -> None:
    if stated > largest(compressed, always):
        raise ValueError(f'{what} of {compressed} bytes states {stated} bytes, more than '
                         f'{_RATIO} times as many')


class _File(io.BufferedReader):
    """A file that never allocates more than its size, whatever number of bytes is asked for."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(size if size is None else min(size, self._size))


class _BoundedPath(PosixPath):
    def open(self, *_: Any, **__: Any) -> Any:  # noqa: A003
        return _File(Path(self))


class Reader1(rosbag1.Reader):
    """Reader of ROS 1 bags."""

    def __init__(self, path: Path) -> None:
        super().__init__(_BoundedPath(path))
        self._places: set[int] = set()

    def read_chunk_info(self) -> rosbag1_reader.ChunkInfo:
        """Read the place of a chunk; refuse a chunk that is listed twice."""
        chunk = super().read_chunk_info()
        if chunk.pos in self._places:
            raise ValueError(f'the index lists the chunk at {chunk.pos} twice')
        self._places.add(chunk.pos)
        return chunk

    def read_chunk(self) -> rosbag1_reader.Chunk:
        """Read the header of a chunk."""
        assert self.bio is not None
        place = self.bio.tell()
        header = rosbag1_reader.Header.read(self.bio, rosbag1_reader.RecordType.CHUNK)
        stated, kind = header.get_uint32('size'), header.get_string('compression')
        self.bio.seek(place)
        chunk = super().read_chunk()
        make = {'bz2': BZ2Decompressor, 'lz4': LZ4FrameDecompressor}.get(kind)
        return chunk if make is None else chunk._replace(
            decompressor=lambda data: decompressed(make, data, stated))


class _Mcap(storage_mcap.McapReader):
    def __init__(self, path: Any) -> None:
        super().__init__(_BoundedPath(path))
        # `rosbags` looks its decompressors up in this table, also when it scans a file to open it.
        storage_mcap.DECOMPRESSORS.update(lz4=partial(decompressed, LZ4FrameDecompressor),
                                          zstd=partial(decompressed, zstd.ZstdDecompressor))

    def open(self) -> None:  # noqa: A003
        super().open()
        try:
            _check_places(self.chunks)
            _check_together(self.chunks)
        except ValueError:
            self.close()
            raise


def _check_places(chunks: Sequence[storage_mcap.ChunkInfo]) -> None:
    """Check that no bytes of the file are in two chunks, and the size of all chunks."""
    for each in chunks:
        _check_size(each.uncompressed_size, each.compressed_size)
        if each.compressed_size > each.chunk_length:
            raise ValueError(f'a chunk of {each.chunk_length} bytes states '
                             f'{each.compressed_size} compressed bytes')
    for before, after in pairwise(sorted(chunks, key=lambda each: each.chunk_start_offset)):
        if before.chunk_start_offset + before.chunk_length > after.chunk_start_offset:
            raise ValueError(f'the chunks at {before.chunk_start_offset} and '
                             f'{after.chunk_start_offset} overlap')
    _check_size(sum(each.uncompressed_size for each in chunks),
                sum(each.compressed_size for each in chunks), 'all chunks', _IN_ALL)


def _check_together(chunks: Sequence[storage_mcap.ChunkInfo]) -> None:
    """Check the size of the chunks that are open at the same time, which are merged by time."""
    events = [event for each in chunks for event in (
        (each.message_start_time, 0, each.uncompressed_size, each.compressed_size),
        (max(each.message_end_time, each.message_start_time), 1, -each.uncompressed_size,
         -each.compressed_size))]
    size = compressed = 0
    for _, _, more, more_compressed in sorted(events):
        size, compressed = size + more, compressed + more_compressed
        _check_size(size, compressed, 'chunks of the same time', _TOGETHER)


class _Sqlite(Sqlite3Reader):
    def open(self) -> None:  # noqa: A003
        """Open the file, and check that it consists of plain tables."""
        self._size = self.path.stat().st_size
        self._steps = 0
        with self._limited():
            flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
            with closing(apsw.Connection(f'file:{self.path}?immutable=1', flags)) as connection:
                _check_schema(connection, self._size)
            super().open()
        assert self.dbconn is not None
        self.dbconn.limit(apsw.SQLITE_LIMIT_LENGTH, _LARGEST_MESSAGE)

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> _Messages:
        """Yield the messages; raise ValueError if they are larger than the file."""
        size = self._steps = 0
        for found in super().messages(connections, start, stop):
            size += _stored_size(found[2:])
            if size > self._size:
                raise ValueError(f'the messages are larger than the {self._size} bytes of the '
                                 'file')
            yield found
            self._steps = 0

    @contextmanager
    def _limited(self) -> Iterator[None]:
        """Limit steps and cells of all connections that this thread opens in the block."""
        thread = threading.get_ident()

        def hook(connection: apsw.Connection) -> None:
            if threading.get_ident() == thread:
                connection.limit(apsw.SQLITE_LIMIT_LENGTH, _LARGEST_METADATA)
                connection.set_progress_handler(self._count, _EVERY)

        apsw.connection_hooks.append(hook)
        try:
            yield
        finally:
            apsw.connection_hooks.remove(hook)

    def _count(self) -> bool:
        self._steps += _EVERY
        limit = _STEPS + _STEPS_PER_BYTE * self._size
        if self._steps > limit:
            raise ValueError(f'a query needs more than {limit} steps of SQLite')
        return False


def _check_schema(connection: apsw.Connection, size: int) -> None:
    """Check that there are only tables and indexes, without computed columns."""
    for kind, name, statement in connection.execute('SELECT type, name, sql FROM sqlite_master'):
        if statement is not None and not _PLAIN.match(str(statement)):
            raise ValueError(f'it contains the {kind} {name}, but a bag has only plain tables')
    for table in _READ_TABLES:
        for column in connection.execute(f'PRAGMA table_xinfo({table})'):
            if column[6]:
                raise ValueError(f'column {column[1]} of table {table} is computed, but a bag has '
                                 'only plain tables')
    known = {name for (name,) in connection.execute('SELECT lower(name) FROM sqlite_master')}
    for table in known & {'topics', 'message_definitions'}:
        if sum(map(_stored_size, connection.execute(f'SELECT * FROM {table}'))) > size:
            raise ValueError(f'table {table} is larger than the {size} bytes of the file')


def _stored_size(row: Iterable[Any]) -> int:
    """Return the least number of bytes of a row in a file."""
    return 2 + sum(len(cell) for cell in row if isinstance(cell, (str, bytes)))


class _Folder(rosbag2_reader.DirectoryReader):
    STORAGE_PLUGINS = {'mcap': _Mcap, 'sqlite3': _Sqlite}  # noqa: RUF012
    by_message = False
    """Whether each message is compressed."""

    def open(self) -> None:  # noqa: A003
        folder = Path(str(self.path))
        words = _checked_metadata(folder / 'metadata.yaml')
        for each in sorted(folder / name for name in {Path(word).name for word in words} if name):
            if each.exists():
                check_regular(each)
                if 'zstd' in words:
                    _check_compressed(each)
        super().open()
        self.by_message = self.metadata.compression_mode == 'message'
        if self.by_message:  # `rosbags` would decompress messages without limit
            self.metadata = self.metadata._replace(compression_mode=None)

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> _Messages:
        for connection, stamp, data in super().messages(connections, start, stop):
            yield connection, stamp, (decompressed(zstd.ZstdDecompressor, data)
                                      if self.by_message else data)


class Reader2(rosbag2.Reader):
    """Reader of rosbag2 folders and their files."""

    STORAGE_PLUGINS = {'dir': _Folder, '.mcap': _Mcap, '.db3': _Sqlite}  # noqa: RUF012

    @property
    def compression_mode(self) -> str | None:
        """Return what is compressed: files, messages or nothing."""
        if isinstance(self.storage, _Folder) and self.storage.by_message:
            return 'message'
        return super().compression_mode


def _check_compressed(path: Path) -> None:
    """Check the size of a file that is compressed with zstd, without storing it."""
    with path.open('rb') as file:
        if not _ZSTD_MAGIC.match(file.read(4)):
            return
    size, limit = 0, largest(path.stat().st_size)
    with zstd.open(path, 'rb') as file:
        while piece := file.read(_MB):
            size += len(piece)
            if size > limit:
                raise ValueError(f'{path.name} decompresses to more than {limit} bytes, '
                                 f'{_RATIO} times its size')


def _checked_metadata(path: Path) -> set[str]:
    """Return the words of metadata.yaml; ValueError if too large or deep to parse recursively."""
    check_regular(path)
    if path.stat().st_size > _LARGEST_METADATA:
        raise ValueError(f'{path.name} has more than {_LARGEST_METADATA} bytes')
    words, sizes = set(), [0]
    anchors: list[str | None] = []
    known: dict[str | None, int] = {}
    for event in yaml.parse(path.read_bytes(), getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):
        if isinstance(event, yaml.ScalarEvent):
            words.add(event.value)
            known[event.anchor] = 1 + len(event.value)
            sizes[-1] += known[event.anchor]
        elif isinstance(event, yaml.AliasEvent):
            sizes[-1] += known.get(event.anchor, 0)
        elif isinstance(event, yaml.CollectionStartEvent):
            sizes.append(1)
            anchors.append(event.anchor)
        elif isinstance(event, yaml.CollectionEndEvent):
            known[anchors.pop()] = sizes[-1]
            sizes[-2:] = [sum(sizes[-2:])]
        if len(sizes) > _DEEPEST_METADATA or sizes[-1] > _LARGEST_EXPANDED:
            raise ValueError(f'{path.name} is nested more than {_DEEPEST_METADATA} deep, or its '
                             f'aliases stand for more than {_LARGEST_EXPANDED} characters')
    return words


def readable(path: Path, stack: ExitStack) -> tuple[Path, list[str]]:
    """Return the path to read, in a copy if SQLite cannot read it as it is, and notes."""
    if path.suffix == '.bag':
        return path, []
    if not path.is_dir():
        return (_copies([path], stack)[0] if _needs_copy(path) else path), _recovered([path])
    stored = sorted(each for each in path.iterdir() if each.suffix in ('.mcap', '.db3'))
    for each in stored:
        if each.exists():
            check_regular(each)
    if (path / 'metadata.yaml').exists():
        notes = [*_not_listed(path, stored), *_recovered(stored)]
        if not any(map(_needs_copy, stored)):
            return path, notes
        files = [*path.glob('*.yaml'), *path.glob('*.zstd'), *stored]
        return _copies(files, stack)[0].parent, notes
    if not stored:
        raise InputError(f'{path} is a folder without a bag, expected a rosbag2 folder or a file',
                         'choose a file in it')
    if len(stored) != 1:
        return path, []
    found, notes = readable(stored[0], stack)
    return found, [f'{path} has no metadata.yaml, as after a recorder was killed; '
                   f'{stored[0].name} is read without it', *notes]


def _not_listed(path: Path, stored: Sequence[Path]) -> list[str]:
    check_regular(path / 'metadata.yaml')
    text = (path / 'metadata.yaml').read_text(encoding='utf-8', errors='replace')
    lost = [each.name for each in stored if each.name not in text]
    if not 0 < len(lost) < len(stored):
        return []
    return [f'metadata.yaml of {path} does not list {listed("file", lost)}: the messages there '
            'are not read; ros2 bag reindex lists all files']


def _journals(path: Path) -> list[Path]:
    """Return the journals of a db3 file that are not empty."""
    found = [path.with_name(path.name + suffix) for suffix in _JOURNALS]
    return [each for each in found if path.suffix == '.db3' and each.is_file()
            and each.stat().st_size]


def _needs_copy(path: Path) -> bool:
    """Return whether a db3 file has journals, or a name that is not read as a name in a URI."""
    return path.suffix == '.db3' and (bool(_journals(path)) or bool(_IN_URI & {*str(path)}))


def _recovered(stored: Sequence[Path]) -> list[str]:
    names = [each.name for path in stored for each in _journals(path)]
    return [f'the recorder was killed; its last messages are read from {", ".join(names)}'
            ] if names else []


def _copies(paths: Sequence[Path], stack: ExitStack) -> list[Path]:
    """Return files in a temporary folder: databases joined with their journals, and links."""
    folder = Path(stack.enter_context(TemporaryDirectory(prefix='accel_calib_')))
    copies = []
    for path in paths:
        name = path.name if len(paths) > 1 else f'bag{path.suffix}'
        copies.append(folder / name)
        if not _journals(path):
            copies[-1].symlink_to(path.absolute())
            continue
        for each in (path, *_journals(path)):
            shutil.copyfile(each, folder / f'{name}{each.name.removeprefix(path.name)}')
        with closing(sqlite3.connect(copies[-1])) as database:
            database.execute('PRAGMA journal_mode = DELETE').fetchone()
    return copies
