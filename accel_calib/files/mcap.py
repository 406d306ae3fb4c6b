# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The records of MCAP files, and the messages of one topic among them.

A record is an operation code, the length of its content in 8 bytes, and the content. Messages
stand in chunks, which are compressed as a whole; the summary at the end tells of schemas and
channels [1]_. Files that keep messages outside of chunks are left to `rosbags`.

References
----------
.. [1] MCAP format specification, https://mcap.dev/spec

"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
import struct
from typing import BinaryIO, NamedTuple
import zlib

import numpy as np

from .compression import decompressed
from .serialized import Bytes, Indices, merged, Messages, rows_at
from ..errors import InputError

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL = 0x01, 0x02, 0x03, 0x04
MESSAGE, CHUNK, STATISTICS = 0x05, 0x06, 0x0B
HEAD = 9  # bytes of operation code and length

_CHANNEL, _LOG_TIME, _DATA = HEAD, HEAD + 6, HEAD + 22  # places in the record of a message
_FOREVER = (1 << 63) - 1


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
    by_code: dict[int, list[bytes]] = {code: [] for code in (HEADER, SCHEMA, CHANNEL, STATISTICS)}
    for record in records:
        if record.code in by_code:
            by_code[record.code].append(content_of(file, record))
    if records[-1].code != FOOTER or not by_code[STATISTICS] or _text(
            by_code[HEADER][0], 0) != 'ros2':
        raise ValueError('not a whole file of ROS 2 with a summary')
    schemas = {content[:2]: _text(content, 2) for content in by_code[SCHEMA]}
    channels = {}
    for content in by_code[CHANNEL]:
        topic = _text(content, 4)
        if _text(content, 8 + len(topic.encode())) != 'cdr':
            raise ValueError(f'{topic} is not in CDR')
        channels[int.from_bytes(content[:2], 'little')] = topic, schemas[content[2:4]]
    statistics = by_code[STATISTICS][0]
    if len(channels) != int.from_bytes(statistics[10:14], 'little'):
        raise ValueError('the summary does not tell of all channels')
    return Contents(records, channels, dict(struct.iter_unpack('<HQ', statistics[46:])))


def _records_of(file: BinaryIO) -> list[Record]:
    """Give the records of a file up to its footer."""
    if file.read(len(MAGIC)) != MAGIC:
        raise ValueError('not an MCAP file')
    found: list[Record] = []
    position = len(MAGIC)
    while len(head := file.read(HEAD)) == HEAD:
        record = Record(head[0], position, int.from_bytes(head[1:], 'little'))
        found.append(record)
        if record.code == FOOTER:
            break
        if record.code == MESSAGE:
            raise ValueError('messages outside of chunks')
        position = file.seek(position + HEAD + record.size)
    return found


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


def messages_in(data: Bytes, channels: Collection[int]) -> tuple[Messages, Indices]:
    """
    Find the messages of some channels in the records of a chunk.

    Parameters
    ----------
    data : (m,) array of bytes
        The records.
    channels : collection of int
        Which.

    Returns
    -------
    messages : Messages
        In the order of the records.
    log_time : (n,) array
        When each was received [ns].

    Raises
    ------
    ValueError
        If a record does not end where it should.

    """
    place = _places_of_messages(data)
    size = rows_at(data, place + 1, 8).view('<i8')[:, 0]
    if np.any(size < _DATA - HEAD):
        raise ValueError('a message is cut short')
    channel = rows_at(data, place + _CHANNEL, 2).view('<u2')[:, 0]
    wanted = np.isin(channel, list(channels))
    place, size = place[wanted], size[wanted]
    log_time = rows_at(data, place + _LOG_TIME, 8).view('<i8')[:, 0]
    return Messages(data, place + _DATA, place + HEAD + size, ros2=True), log_time


def _places_of_messages(data: Bytes) -> Indices:
    """Go from record to record; a plain loop, for each record tells where the next begins."""
    places: list[int] = []
    head = struct.Struct('<BQ').unpack_from
    records, place, end = data.data, 0, len(data)
    try:
        while place < end:
            code, size = head(records, place)
            if code == MESSAGE:
                places.append(place)
            place += HEAD + size
    except struct.error as err:
        raise ValueError('its last record is cut short') from err
    if place != end:
        raise ValueError('its last record is cut short')
    return np.array(places, np.int64)


def topic_messages(path: Path, topic: str, msgtype: str) -> Iterator[Messages] | None:
    """Give the messages of a topic chunk by chunk, or None where `rosbags` has to do it."""
    with path.open('rb') as file:
        try:
            contents = contents_of(file)
        except ValueError:
            return None
        chunks = [record for record in contents.records if record.code == CHUNK]
        begins = [int.from_bytes(content_of(file, record._replace(size=8)), 'little')
                  for record in chunks]
    # Least log time of the chunks that follow each.
    limits = [*accumulate(reversed(begins[1:]), min)][::-1]
    return _in_order(path, chunks, [*limits, _FOREVER], contents.of(topic, msgtype))


def _in_order(path: Path, chunks: Sequence[Record], limits: Sequence[int],
              channels: Collection[int]) -> Iterator[Messages]:
    """Give the messages in the order of log time, also where chunks overlap."""
    kept, kept_time = None, np.zeros(0, np.int64)
    with path.open('rb') as file:
        for record, limit in zip(chunks, limits, strict=True):
            found, log_time = _in_chunk(file, record, channels)
            if kept is not None:
                found, log_time = merged(kept, found), np.concatenate([kept_time, log_time])
            if np.any(log_time[1:] < log_time[:-1]):
                order = np.argsort(log_time, kind='stable')
                found, log_time = found.take(order), log_time[order]
            count = int(np.searchsorted(log_time, limit, 'right'))
            kept, kept_time = found.take(slice(count, None)), log_time[count:]
            kept = kept if len(kept) else None
            if count:
                yield found.take(slice(count))


def _in_chunk(file: BinaryIO, record: Record, channels: Collection[int]
              ) -> tuple[Messages, Indices]:
    try:
        chunk = chunk_of(content_of(file, record))
        return messages_in(np.frombuffer(chunk.data, np.uint8), channels)
    except ValueError as err:
        raise damaged(file, record, str(err)) from err
