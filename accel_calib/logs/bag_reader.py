# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Opening of bags without ROS: rosbag2 (folder, mcap, db3) and ROS 1.

`rosbags` reads the serialized messages. Damaged bytes cause many kinds of errors there, also long
after the bag is open. `damage_as_input_error` is the only place that converts them.

A recorder that was killed leaves the last messages of a db3 file in a second file, the journal of
SQLite (``-wal`` or ``-journal``). `rosbags` ignores it. SQLite joins both files, in a copy.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass
import errno
from itertools import islice
from pathlib import Path
import shutil
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any, TYPE_CHECKING

from .serialized import IMU_DOUBLES, joined, Messages
from ..disk import check_regular
from ..errors import InputError
from ..text import listed

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

IMU = 'sensor_msgs/msg/Imu'
SUFFIXES = ('.bag', '.mcap', '.db3')
BLOCK = 4096
"""Number of messages per block; a block fits in the cache of the processor."""

_BLOCK_BYTES = 1 << 24
_AT_ONCE = 64
"""Number of bytes above which a block ends, and of messages after which they are counted."""

Received = tuple['Connection', int, bytes]
"""Connection, time of receipt [ns] and serialized message."""

_JOURNALS = ('-wal', '-journal')
_LONGEST_REASON = 400
"""Longest reason that is shown [characters]; damaged files have names of any length."""

_IN_URI = {'?', '#', '%'}
"""Letters that `rosbags` does not escape when it opens a db3 file by its URI."""

_BY_VALUE = (errno.EINVAL, errno.EOVERFLOW, errno.EISDIR, errno.EFBIG,
             errno.ENAMETOOLONG, errno.ENOTDIR)
"""System errors that a damaged size or place in a file causes; others are not about its bytes."""


def is_bag(path: Path) -> bool:
    """Return whether a path names a bag rather than a table."""
    return path.is_dir() or path.suffix in SUFFIXES


@dataclass(frozen=True)
class Bag:
    """
    An open bag; `open_bag` makes it.

    Parameters
    ----------
    path : Path
        File or folder.
    reader : Reader
        The reader of `rosbags`.
    ros2 : bool
        Whether it is a rosbag2; otherwise it is a ROS 1 bag.
    notes : tuple of str
        Parts of the bag that are not read or were recovered.

    """

    path: Path
    reader: Reader1 | Reader2
    ros2: bool
    notes: tuple[str, ...] = ()

    def topics(self, msgtype: str) -> list[str]:
        """Return the topics of a type, sorted."""
        return sorted({c.topic for c in self.reader.connections if c.msgtype == msgtype})

    def connections(self, topic: str, msgtype: str = IMU) -> list[Connection]:
        """Return the connections of a topic; a topic can have several."""
        return [c for c in self.reader.connections if (c.topic, c.msgtype) == (topic, msgtype)]

    def count(self, topic: str) -> int:
        """Return the number of Imu messages of a topic, according to the index of the bag."""
        return sum(connection.msgcount for connection in self.connections(topic))

    @property
    def stored(self) -> int:
        """Return the number of all messages, according to the files rather than metadata.yaml."""
        storage = getattr(self.reader, 'storage', self.reader)
        return sum(connection.msgcount for file in getattr(storage, 'storages', [storage])
                   for connection in file.connections)

    def blocks(self, connections: Sequence[Connection] = (), size: int = BLOCK
               ) -> Iterator[list[Received]]:
        """
        Yield blocks of messages, in order of receipt.

        Parameters
        ----------
        connections : sequence of Connection
            Connections to read; by default all.
        size : int
            Largest number of messages in a block; large messages make it shorter.

        Yields
        ------
        list of (Connection, int, bytes)
            Connection, time of receipt [ns] and serialized message.

        Raises
        ------
        InputError
            If the bag is damaged.

        """
        with damage_as_input_error(self.path):
            messages = self.reader.messages(connections)
        while True:
            with damage_as_input_error(self.path):
                block = _next_block(messages, size)
            if not block:
                return
            yield block

    def joined(self, raws: Sequence[bytes], topic: str, before: int, doubles: int = IMU_DOUBLES
               ) -> Messages:
        """
        Return messages of a topic as arrays; `before` is the number of earlier messages.

        Raises
        ------
        InputError
            If a message is damaged.

        """
        return joined(raws, doubles, f'{self.path}, {topic}', ros2=self.ros2, before=before)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading.

    Raises
    ------
    InputError
        If the bag is damaged; also later, while it is read.
    FileNotFoundError
        If the file is missing.

    """
    from .bounded_bags import Reader1, Reader2

    if not path.is_dir():
        check_regular(path)
    ros2 = path.suffix != '.bag'
    with ExitStack() as stack:
        with damage_as_input_error(path):
            source, notes = _source(path, stack)
            reader = (Reader2 if ros2 else Reader1)(source)
            reader.open()
            stack.callback(_close, path, reader)
            _check_files(reader)
            _check_connections(reader.connections)
        yield Bag(path, reader, ros2, tuple(notes))


def _close(path: Path, reader: Reader1 | Reader2) -> None:
    with damage_as_input_error(path):
        reader.close()


@contextmanager
def damage_as_input_error(path: Path) -> Iterator[None]:
    """
    Convert errors of `rosbags` to InputError; only calls of `rosbags` belong inside.

    Errors of the system, such as a missing file or permission, pass.

    """
    try:
        yield
    except InputError:
        raise
    except OSError as err:
        if err.errno is not None and err.errno not in _BY_VALUE:
            raise
        raise _not_whole(path, err) from err
    except Exception as err:  # damaged bytes cause many kinds of errors
        raise _not_whole(path, err) from err


def _not_whole(path: Path, err: Exception) -> InputError:
    words = ' '.join(str(err)[:_LONGEST_REASON].split())
    what = words if ' ' in words else f'{type(err).__name__} {words}'.strip()
    inside = ' or the .mcap or .db3 file inside it' if path.is_dir() else ''
    return InputError(f'{path} is damaged or not a bag ({what}), expected a rosbag2 folder, '
                      '.mcap, .db3 or .bag', f'use another file{inside}; ros2 bag reindex may '
                      'repair this one')


def _check_files(reader: Any) -> None:
    """Check the list of files in metadata.yaml, which `rosbags` clears when it closes the bag."""
    files = getattr(getattr(reader, 'storage', None), 'files', [])
    if not isinstance(files, list):
        raise ValueError(f'files in metadata.yaml is {files!r}')


def _check_connections(connections: Sequence[Any]) -> None:
    """Check the types of names and counts, which `rosbags` reads from YAML or SQLite as stored."""
    for each in connections:
        if not (isinstance(each.topic, str) and isinstance(each.msgtype, str)):
            raise ValueError(f'a topic has the name {each.topic!r} and the type {each.msgtype!r}')
        if not isinstance(each.msgcount, int) or each.msgcount < 0:
            raise ValueError(f'topic {each.topic} has {each.msgcount!r} messages')


def _next_block(messages: Iterator[Received], size: int) -> list[Received]:
    """Return the next messages: at most `size`, and not many more bytes than `_BLOCK_BYTES`."""
    block: list[Received] = []
    left = _BLOCK_BYTES
    while left > 0 and len(block) < size:
        part = list(islice(messages, min(_AT_ONCE, size - len(block))))
        _check_messages(part)
        if not part:
            break
        block += part
        left -= sum(len(raw) for _, _, raw in part)
    return block


def _check_messages(block: Sequence[tuple[Any, Any, Any]]) -> None:
    """Check the types of messages, which SQLite returns as stored."""
    for kinds, position, what in (((int,), 1, 'time of receipt'),
                                  ((bytes, memoryview, bytearray), 2, 'content')):
        if not {type(each[position]) for each in block} <= {*kinds}:
            bad = next(each for each in block if type(each[position]) not in kinds)
            raise ValueError(f'a message on {bad[0].topic} has the {what} '
                             f'{str(bad[position])[:20]!r}')


def _source(path: Path, stack: ExitStack) -> tuple[Path, list[str]]:
    """Return the path to read, which is in a copy if SQLite cannot read it as it is, and notes."""
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
    found, notes = _source(stored[0], stack)
    return found, [f'{path} has no metadata.yaml, as after a recorder was killed; '
                   f'{stored[0].name} is read without it', *notes]


def _not_listed(path: Path, stored: Sequence[Path]) -> list[str]:
    """Return a note about files of the folder that its metadata do not list."""
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
    """Return a note about the journals of these files."""
    names = [each.name for path in stored for each in _journals(path)]
    if not names:
        return []
    return [f'the recorder was killed; its last messages are read from {", ".join(names)}']


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
        _join_journals(copies[-1])
    return copies


def _join_journals(file: Path) -> None:
    """Join a database with its journals, in place."""
    database = sqlite3.connect(file)
    try:
        database.execute('PRAGMA journal_mode = DELETE').fetchone()
    finally:
        database.close()
