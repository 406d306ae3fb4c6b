# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The messages of one topic in an MCAP file, chunk by chunk."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
import struct
from typing import BinaryIO

import numpy as np

from .mcap import CHUNK, chunk_of, content_of, contents_of, damaged, HEAD, MESSAGE, Record
from .serialized import Bytes, Indices, merged, Messages, rows_at

_CHANNEL, _LOG_TIME, _DATA = HEAD, HEAD + 6, HEAD + 22  # places in the record of a message
_FOREVER = (1 << 63) - 1


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
    channels = contents.of(topic, msgtype)
    return _in_order(path, chunks if channels else [], [*limits, _FOREVER], channels)


def _in_order(path: Path, chunks: Sequence[Record], limits: Sequence[int],
              channels: Collection[int]) -> Iterator[Messages]:
    """Give the messages in the order of log time, also where chunks overlap."""
    kept, kept_time = None, np.zeros(0, np.int64)
    with path.open('rb') as file:
        for record, limit in zip(chunks, limits):
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
