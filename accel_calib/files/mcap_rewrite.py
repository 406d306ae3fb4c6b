# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Rewriting an MCAP file: messages of one topic change, in their place, and all else stays.

Records are copied one by one. A chunk that holds such messages is taken out of its compression,
changed, and compressed again; so its length may change, and what the summary says of places in
the file moves with it. Checksums are made anew where there were any, but for that of the whole
data section, which becomes 0: not available.

"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection
from pathlib import Path
import shutil
import struct
import zlib

import numpy as np

from .compression import compressed
from .mcap import (
    CHUNK,
    chunk_of,
    content_of,
    contents_of,
    damaged,
    FOOTER,
    HEAD,
    MAGIC,
    Record,
)
from .mcap_messages import messages_in
from .serialized import Messages

CHUNK_INDEX, ATTACHMENT_INDEX, METADATA_INDEX = 0x08, 0x0A, 0x0D
SUMMARY_OFFSET, DATA_END = 0x0E, 0x0F

_PLACES = {ATTACHMENT_INDEX: (0,), METADATA_INDEX: (0,), SUMMARY_OFFSET: (1,), FOOTER: (0, 8)}
"""Where in its content a record tells the place of another."""

Change = Callable[[Messages], None]


class _Moves:
    """Where what was at a place of the old file is in the new one."""

    def __init__(self) -> None:
        self._ends = [0]
        self._shifts = [0]
        self.chunks: dict[int, tuple[int, int]] = {}

    def add(self, record: Record, size: int, stored: int) -> None:
        """Tell of a chunk whose content now has this size, and its records that."""
        self._ends.append(record.start + HEAD + record.size)
        self._shifts.append(self._shifts[-1] + size - record.size)
        self.chunks[record.start] = HEAD + size, stored

    def new(self, place: int) -> int:
        """Give the new place; 0, for none, stays."""
        return place + self._shifts[bisect_right(self._ends, place) - 1] if place else 0

    def move(self, content: bytearray, at: int) -> None:
        """Move the place that the content tells there."""
        place, = struct.unpack_from('<Q', content, at)
        struct.pack_into('<Q', content, at, self.new(place))


def can_rewrite(source: Path) -> bool:
    """Tell whether a file is as `contents_of` wants it."""
    with source.open('rb') as file:
        try:
            contents_of(file)
        except ValueError:
            return False
    return True


def rewrite(source: Path, target: Path, topic: str, msgtype: str, change: Change) -> None:
    """
    Write a copy of a file with the messages of a topic changed.

    Parameters
    ----------
    source, target : Path
        The file, and its copy, which must not be there yet.
    topic, msgtype : str
        Which messages.
    change : callable
        Changes messages in their buffer; their lengths stay.

    Raises
    ------
    InputError
        If a chunk is damaged.

    """
    moves = _Moves()
    checksum, in_summary = 0, False
    with source.open('rb') as file, target.open('xb') as out:
        contents = contents_of(file)
        records, channels = contents.records, contents.of(topic, msgtype)
        out.write(MAGIC)
        for record in records:
            content = content_of(file, record)
            try:
                content = (_changed(content, record, channels, change, moves)
                           if record.code == CHUNK else _moved(content, record, moves))
            except (ValueError, KeyError, struct.error) as err:
                raise damaged(file, record, str(err)) from err
            head = struct.pack('<BQ', record.code, len(content))
            if record.code == FOOTER and any(content[16:]):
                content = content[:16] + zlib.crc32(head + content[:16], checksum).to_bytes(
                    4, 'little')
            out.write(head)
            out.write(content)
            checksum = zlib.crc32(head + content, checksum) if in_summary else 0
            in_summary = in_summary or record.code == DATA_END
        file.seek(records[-1].start + HEAD + records[-1].size)
        shutil.copyfileobj(file, out)


def _changed(content: bytes, record: Record, channels: Collection[int], change: Change,
             moves: _Moves) -> bytes:
    """Give the content of a chunk with its messages changed."""
    chunk = chunk_of(content)
    data = bytearray(chunk.data)
    messages, _ = messages_in(np.frombuffer(data, np.uint8), channels)
    start = 40 + len(chunk.compression)
    stored = len(content) - start
    if len(messages):
        change(messages)
        packed = compressed(data, chunk.compression)
        stored = len(packed)
        checksum = zlib.crc32(data) if chunk.checksum else 0
        content = b''.join((content[:24], checksum.to_bytes(4, 'little'), content[28:start - 8],
                            stored.to_bytes(8, 'little'), packed))
    moves.add(record, len(content), stored)
    return content


def _moved(content: bytes, record: Record, moves: _Moves) -> bytes:
    """Give the content of another record with the places that it tells moved."""
    new = bytearray(content)
    places = _PLACES.get(record.code, ())
    if record.code == CHUNK_INDEX:
        length, stored = moves.chunks[int.from_bytes(content[16:24], 'little')]
        places = (16, *range(38, 36 + int.from_bytes(content[32:36], 'little'), 10))
        new[24:32] = length.to_bytes(8, 'little')
        new[-16:-8] = stored.to_bytes(8, 'little')
    for place in places:
        moves.move(new, place)
    return bytes(len(new)) if record.code == DATA_END else bytes(new)
