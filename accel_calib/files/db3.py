# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The messages of one topic in the SQLite files of rosbag2: read, or changed in a copy."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
import shutil
import sqlite3

from .serialized import joined, Messages

_BLOCK = 8192


def opened(path: Path, mode: str) -> sqlite3.Connection:
    """Open a file: ``immutable=1`` for reading, ``mode=rw`` for writing."""
    return sqlite3.connect(f'{path.absolute().as_uri()}?{mode}', uri=True, isolation_level=None)


def topics_in(path: Path) -> dict[tuple[str, str], int]:
    """
    Give the topics of a file by name and type, each with a number of messages it does not exceed.

    Raises
    ------
    ValueError
        If messages are not in CDR.
    sqlite3.Error
        If it is not a file of rosbag2.

    """
    with closing(opened(path, 'immutable=1')) as database:
        last, = database.execute('SELECT coalesce(max(id), 0) FROM messages').fetchone()
        topics = database.execute('SELECT name, type, serialization_format FROM topics').fetchall()
    if any(form != 'cdr' for _, _, form in topics):
        raise ValueError('messages are not in CDR')
    return {(name, msgtype): last for name, msgtype, _ in topics}


def _numbers(database: sqlite3.Connection, topic: str, msgtype: str) -> list[int]:
    """Give the numbers of a topic."""
    return [number for number, in database.execute(
        'SELECT id FROM topics WHERE name = ? AND type = ?', (topic, msgtype))]


def topic_messages(path: Path, topic: str, msgtype: str) -> Iterator[Messages]:
    """Give the messages of a topic in the order of the time of receipt, block by block."""
    with closing(opened(path, 'immutable=1')) as database:
        numbers = _numbers(database, topic, msgtype)
        rows = database.execute('SELECT data FROM messages WHERE topic_id IN '
                                f'({marks(numbers)}) ORDER BY timestamp', numbers)
        while block := rows.fetchmany(_BLOCK):
            yield joined([data for data, in block], ros2=True)


def marks(numbers: Sequence[int]) -> str:
    """Give a question mark for each."""
    return ','.join('?' * len(numbers))


def rewrite(source: Path, target: Path, topic: str, msgtype: str,
            change: Callable[[Messages], None]) -> None:
    """
    Write a copy of a file with the messages of a topic changed.

    Parameters
    ----------
    source, target : Path
        The file, and its copy.
    topic, msgtype : str
        Which messages.
    change : callable
        Changes messages in their buffer; their lengths stay.

    """
    shutil.copyfile(source, target)
    with closing(opened(source, 'immutable=1')) as old, closing(opened(target, 'mode=rw')) as new:
        # Nobody else sees the copy before it is whole.
        new.execute('PRAGMA journal_mode = OFF')
        new.execute('PRAGMA synchronous = OFF')
        new.execute('PRAGMA locking_mode = EXCLUSIVE')
        changed: dict[int, memoryview] = {}
        new.create_function('changed', 1, changed.__getitem__)
        numbers = _numbers(old, topic, msgtype)
        which = f'topic_id IN ({marks(numbers)})'
        rows = old.execute(f'SELECT id, data FROM messages WHERE {which} ORDER BY id', numbers)
        new.execute('BEGIN')
        while block := rows.fetchmany(_BLOCK):
            messages = joined([data for _, data in block], ros2=True)
            change(messages)
            changed.clear()
            changed.update(zip((number for number, _ in block), messages.each(), strict=True))
            # A statement for each block: one for each message takes twice the time.
            new.execute(f'UPDATE messages SET data = changed(id) WHERE {which} '
                        'AND id BETWEEN ? AND ?', (*numbers, block[0][0], block[-1][0]))
        new.execute('COMMIT')
