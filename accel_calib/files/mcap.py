# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The records of MCAP files.

A record is an operation code, the length of its content in 8 bytes, and the content. Messages
stand in chunks, which are compressed as a whole; the summary at the end tells of schemas and
channels [1]_. Files that keep messages outside of chunks are left to `rosbags`.

References
----------
.. [1] MCAP format specification, https://mcap.dev/spec

"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

from .compression import decompressed
from ..errors import InputError

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL = 0x01, 0x02, 0x03, 0x04
MESSAGE, CHUNK, STATISTICS = 0x05, 0x06, 0x0B
HEAD = 9  # bytes of operation code and length


class Record(NamedTuple):
    """A record of a file: its operation code, where it begins, and the length of its content."""

    code: int
    start: int
    size: int


class Contents(NamedTuple):
    """What is in a file: its records, and by channel the topic with its type, and the messages."""

    records: list[Record]
    channels: dict[int, tuple[str, str]]
    counts: dict[int, int]

    def of(self, topic: str, msgtype: str) -> list[int]:
        """Give the channels of a topic."""
        return [number for number, about in self.channels.items() if about == (topic, msgtype)]


class Chunk(NamedTuple):
    """A chunk: least and last log time [ns], checksum or 0, compression, and its records."""

    begin: int
    end: int
    checksum: int
    compression: str
    data: bytes | memoryview


def contents_of(file: BinaryIO) -> Contents:
    """
    Go through the records of a file, without looking into the chunks.

    Raises
    ------
    ValueError
        If it is not a whole file of ROS 2 with all messages in chunks and all channels in a
        summary.

    """
    records = _records_of(file)
    contents = {code: [content_of(file, record) for record in records if record.code == code]
                for code in (HEADER, SCHEMA, CHANNEL, STATISTICS)}
    try:
        if _text(contents[HEADER][0], 0) != 'ros2':
            raise ValueError('not of ROS 2')
        schemas = {content[:2]: _text(content, 2) for content in contents[SCHEMA]}
        channels = dict(_channel(content, schemas) for content in contents[CHANNEL])
        statistics = contents[STATISTICS][0]
        counts = dict(struct.iter_unpack('<HQ', statistics[46:]))
    except (LookupError, struct.error) as err:
        raise ValueError('not a whole summary') from err
    if len(channels) != int.from_bytes(statistics[10:14], 'little') or not channels.keys() >= (
            counts.keys()):
        raise ValueError('the summary does not tell of all channels')
    return Contents(records, channels, counts)


def _channel(content: bytes, schemas: Mapping[bytes, str]) -> tuple[int, tuple[str, str]]:
    """Give the number of a channel, and its topic with its type."""
    topic = _text(content, 4)
    if _text(content, 8 + len(topic.encode())) != 'cdr':
        raise ValueError(f'{topic} is not in CDR')
    return int.from_bytes(content[:2], 'little'), (topic, schemas[content[2:4]])


def _records_of(file: BinaryIO) -> list[Record]:
    """Give the records of a file, from header to footer."""
    if file.read(len(MAGIC)) != MAGIC:
        raise ValueError('not an MCAP file')
    found: list[Record] = []
    position, end = len(MAGIC), file.seek(0, 2)
    while position < end:
        file.seek(position)
        head = file.read(HEAD)
        record = Record(head[0], position, int.from_bytes(head[1:], 'little'))
        found.append(record)
        position += HEAD + record.size
        if record.code == FOOTER and position <= end:
            return found
        if record.code == MESSAGE:
            raise ValueError('messages outside of chunks')
    raise ValueError('it is cut short')


def content_of(file: BinaryIO, record: Record) -> bytes:
    """Read the content of a record."""
    file.seek(record.start + HEAD)
    return file.read(record.size)


def _text(content: bytes, start: int) -> str:
    begin = start + 4
    size = int.from_bytes(content[start:begin], 'little')
    return content[begin:begin + size].decode(errors='replace')


def topics_in(path: Path) -> dict[tuple[str, str], int]:
    """Give the number of messages of each topic, by name and type; raises as `contents_of`."""
    with path.open('rb') as file:
        contents = contents_of(file)
    topics = dict.fromkeys(contents.channels.values(), 0)
    for channel, count in contents.counts.items():
        topics[contents.channels[channel]] += count
    return topics


def chunk_of(content: bytes) -> Chunk:
    """
    Take a chunk out of its compression.

    Raises
    ------
    ValueError
        If it is damaged.

    """
    try:
        begin, end, size, checksum, length = struct.unpack_from('<QQQII', content)
    except struct.error as err:
        raise ValueError('it is cut short') from err
    compression = content[32:32 + length].decode()
    data = decompressed(memoryview(content)[40 + length:], compression)
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):
        raise ValueError('its length or its checksum is wrong')
    return Chunk(begin, end, checksum, compression, data)


def damaged(file: BinaryIO, record: Record, why: str) -> InputError:
    """Give the error that says which chunk is damaged."""
    return InputError(f'{file.name} is not a whole bag (chunk at byte {record.start}: {why})',
                      'record it again, or recover it with the mcap tool')
