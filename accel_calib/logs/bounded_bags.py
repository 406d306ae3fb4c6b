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

`rosbags` converts none of these to one kind of error; `bag_reader.damage_as_input_error` does.

"""

from __future__ import annotations

from bz2 import BZ2Decompressor
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
import io
from itertools import pairwise
from pathlib import Path, PosixPath
import re
import sys
import threading
from typing import Any, Protocol

import apsw
from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import reader as rosbag2_reader
from rosbags.rosbag2 import storage_mcap
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
import yaml

from ..disk import check_regular

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
_LARGEST_EXPANDED = 64 * _MB
_DEEPEST_METADATA = 50
_ZSTD_MAGIC = re.compile(rb'\x28\xb5\x2f\xfd|[\x50-\x5f]\x2a\x4d\x18')

Messages = Generator[tuple[Connection, int, bytes], None, None]


class _Decompressor(Protocol):
    """The common part of the decompressors of bz2, lz4 and zstd."""

    eof: bool
    needs_input: bool
    unused_data: bytes

    def decompress(self, data: bytes, max_length: int) -> bytes:
        """Return at most so many bytes."""


def largest(compressed: int, always: int = _ALWAYS) -> int:
    """Return the largest allowed size of data [bytes] that are compressed to a size [bytes]."""
    return max(always, _RATIO * compressed)


def decompressed(make: Callable[[], Any], data: bytes, stated: int | None = None) -> bytes:
    """
    Return decompressed data.

    Parameters
    ----------
    make : callable
        Class of the decompressor.
    data : bytes
        One or more compressed frames.
    stated : int, optional
        Stated size of the result [bytes].

    Raises
    ------
    ValueError
        If the result is larger than stated or than `largest`, or the data end early.

    """
    size = len(data)
    _check_size(stated or 0, size)
    left = largest(size) if stated is None else stated
    parts = []
    while data:
        one: _Decompressor = make()
        while not one.eof:
            if not data and one.needs_input:
                raise ValueError(f'{size} compressed bytes end early')
            parts.append(one.decompress(data, max_length=left + 1))
            data, left = b'', left - len(parts[-1])
            if left < 0:
                raise ValueError(f'{size} compressed bytes hold more than '
                                 f'{sum(map(len, parts)) - 1} bytes')
        data = one.unused_data or b''
    return b''.join(parts)


def _check_size(stated: int, compressed: int, what: str = 'a chunk', always: int = _ALWAYS
                ) -> None:
    """Check a stated size before anything is allocated."""
    if stated > largest(compressed, always):
        raise ValueError(f'{what} of {compressed} bytes states {stated} bytes, more than '
                         f'{_RATIO} times as many')


class _File(io.BufferedReader):
    """A file that never allocates more than its size, whatever number of bytes is asked for."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Return at most so many bytes."""
        return super().read(size if size is None else min(size, self._size))


class _BoundedPath(PosixPath):
    """A path whose file is a `_File`."""

    def open(self, *_: Any, **__: Any) -> Any:  # noqa: A003
        """Open the file for reading bytes."""
        return _File(Path(self))


# ------------------------------------------------------------------------------------- ROS 1

class Reader1(rosbag1.Reader):
    """Reader of ROS 1 bags."""

    def __init__(self, path: Path) -> None:
        super().__init__(_BoundedPath(path))
        self._places: set[int] = set()

    def read_chunk_info(self) -> rosbag1_reader.ChunkInfo:
        """Read the information about a chunk; refuse a chunk that is there twice."""
        found = super().read_chunk_info()
        if found.pos in self._places:
            raise ValueError(f'the index lists the chunk at {found.pos} twice')
        self._places.add(found.pos)
        return found

    def read_chunk(self) -> rosbag1_reader.Chunk:
        """Read the header of a chunk."""
        assert self.bio is not None
        place = self.bio.tell()
        header = rosbag1_reader.Header.read(self.bio, rosbag1_reader.RecordType.CHUNK)
        stated, kind = header.get_uint32('size'), header.get_string('compression')
        self.bio.seek(place)
        found = super().read_chunk()
        make = {'bz2': BZ2Decompressor, 'lz4': LZ4FrameDecompressor}.get(kind)
        if make is None:
            return found
        return found._replace(decompressor=lambda data: decompressed(make, data, stated))


# -------------------------------------------------------------------------------------- MCAP

def _by_table(make: Callable[[], Any]) -> Callable[[bytes, int], bytes]:
    return lambda data, size: decompressed(make, data, size)


class _Mcap(storage_mcap.McapReader):
    """Reader of MCAP files."""

    def __init__(self, path: Any) -> None:
        super().__init__(_BoundedPath(path))
        # `rosbags` looks its decompressors up in this table, also when it scans a file to open it.
        storage_mcap.DECOMPRESSORS.update(lz4=_by_table(LZ4FrameDecompressor),
                                          zstd=_by_table(zstd.ZstdDecompressor))

    def open(self) -> None:  # noqa: A003
        """Open the file, and check the sizes that its index states."""
        super().open()
        try:
            _check_places(self.chunks)
            _check_together(self.chunks)
        except BaseException:
            self.close()
            raise


def _check_places(chunks: Sequence[storage_mcap.ChunkInfo]) -> None:
    """Check that no bytes of the file are in two chunks, and the size of all chunks."""
    for each in chunks:
        _check_size(each.uncompressed_size, each.compressed_size)
        if each.compressed_size > each.chunk_length:
            raise ValueError(f'a chunk of {each.chunk_length} bytes states '
                             f'{each.compressed_size} compressed bytes')
    for one, two in pairwise(sorted(chunks, key=lambda each: each.chunk_start_offset)):
        if one.chunk_start_offset + one.chunk_length > two.chunk_start_offset:
            raise ValueError(f'the chunks at {one.chunk_start_offset} and '
                             f'{two.chunk_start_offset} overlap')
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


# ------------------------------------------------------------------------------------ SQLite

class _Steps:
    """Counter of the steps of SQLite."""

    def __init__(self, limit: int) -> None:
        self.limit, self.count = limit, 0

    def __call__(self) -> bool:
        """Count; raise ValueError above the limit."""
        self.count += _EVERY
        if self.count > self.limit:
            raise ValueError(f'a query needs more than {self.limit} steps of SQLite')
        return False


class _Sqlite(Sqlite3Reader):
    """Reader of db3 files."""

    def open(self) -> None:  # noqa: A003
        """Open the file, and check that it consists of plain tables."""
        self._size = self.path.stat().st_size
        self._steps = _Steps(_STEPS + _STEPS_PER_BYTE * self._size)
        with _counted(self._steps):
            connection = apsw.Connection(f'file:{self.path}?immutable=1', flags=(
                apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI))
            try:
                _check_schema(connection, self._size)
            finally:
                connection.close()
            super().open()

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Messages:
        """Yield the messages; raise ValueError once they are larger than the file."""
        size = 0
        self._steps.count = 0
        for found in super().messages(connections, start, stop):
            size += _stored_size(found[2:])
            if size > self._size:
                raise ValueError(f'the messages are larger than the {self._size} bytes of the '
                                 'file')
            yield found
            self._steps.count = 0


@contextmanager
def _counted(steps: _Steps) -> Iterator[None]:
    """Count the steps of all connections that this thread opens in the block."""
    thread = threading.get_ident()

    def hook(connection: apsw.Connection) -> None:
        if threading.get_ident() == thread:
            connection.set_progress_handler(steps, _EVERY)

    apsw.connection_hooks.append(hook)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(hook)


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


# ---------------------------------------------------------------------------------- rosbag2

class _Folder(rosbag2_reader.DirectoryReader):
    """Reader of rosbag2 folders."""

    STORAGE_PLUGINS = {'mcap': _Mcap, 'sqlite3': _Sqlite}  # noqa: RUF012
    by_message = False
    """Whether each message is compressed."""

    def open(self) -> None:  # noqa: A003
        """Check the files of the folder, and open them."""
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
                 stop: int | None = None) -> Messages:
        """Yield the messages, decompressed."""
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
    """
    Return the words in metadata.yaml, which `rosbags` parses recursively.

    Raises
    ------
    ValueError
        If the file is too large, also with its aliases replaced, or nested too deep.

    """
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
