# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""An independent writer of MCAP files of every kind, according to the specification."""

from pathlib import Path
import struct
import zlib

import lz4.frame
from rosbags.typesys import get_typestore, Stores

try:
    from compression import zstd
except ImportError:
    from backports import zstd

STORE = get_typestore(Stores.ROS2_JAZZY)
COMPRESS = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstd.compress}
MAGIC = b'\x89MCAP0\r\n'


def text(value):
    data = value.encode()
    return struct.pack('<I', len(data)) + data


def record(code, content):
    return struct.pack('<BQ', code, len(content)) + content


class McapFile:
    """
    Writer of messages (channel, log time [ns], bytes) in the order of the file.

    The file has an attachment before the chunks, metadata after them, and all possible checksums.

    """

    def __init__(self, topics, compression='', chunk=4000, in_chunks=True, summary=True):
        self.topics = topics  # (name, type)
        self.compression = compression
        self.chunk = chunk
        self.in_chunks = in_chunks
        self.summary = summary

    def definitions(self):
        types = sorted({kind for _, kind in self.topics})
        schemas = [record(3, struct.pack('<H', k + 1) + text(kind) + text('ros2msg') + text(
            STORE.generate_msgdef(kind, ros_version=2)[0])) for k, kind in enumerate(types)]
        channels = [record(4, struct.pack('<HH', k, types.index(kind) + 1) + text(name)
                           + text('cdr') + struct.pack('<I', 0))
                    for k, (name, kind) in enumerate(self.topics)]
        return schemas, channels

    def write(self, path: Path, messages):
        """Write the file."""
        self.out = bytearray(MAGIC) + record(1, text('ros2') + text('by hand'))
        self.counts = dict.fromkeys(range(len(self.topics)), 0)
        self.indexes, self.times = [], []
        attached = len(self.out)
        content = struct.pack('<QQ', 1, 1) + text('notes') + text('text/plain') + struct.pack(
            '<Q', 5) + b'hello'
        self.out += record(9, content + struct.pack('<I', zlib.crc32(content)))
        attachment = struct.pack('<QQQQQ', attached, len(self.out) - attached, 1, 1, 5) + text(
            'notes') + text('text/plain')
        schemas, channels = self.definitions()
        self.put(b''.join([*schemas, *channels]), messages)
        described = len(self.out)
        self.out += record(12, text('rosbag2') + struct.pack('<I', 0))
        metadata = struct.pack('<QQ', described, len(self.out) - described) + text('rosbag2')
        self.out += record(15, struct.pack('<I', zlib.crc32(self.out)))
        self.end(attachment, metadata)
        path.write_bytes(self.out)
        return path

    def put(self, beginning, messages):
        pending, offsets = bytearray(beginning), []
        for channel, time, data in messages:
            self.counts[channel] += 1
            self.times.append(time)
            offsets.append((channel, time, len(pending)))
            pending += record(5, struct.pack('<HIQQ', channel, 0, time, time) + data)
            if self.in_chunks and len(pending) > self.chunk:
                self.put_chunk(pending, offsets)
                pending, offsets = bytearray(), []
        if self.in_chunks and pending:
            self.put_chunk(pending, offsets)
        elif pending:
            self.out += pending

    def put_chunk(self, data, offsets):
        times = [time for _, time, _ in offsets] or [0]
        packed = COMPRESS[self.compression](bytes(data))
        start = len(self.out)
        self.out += record(6, struct.pack('<QQQI', min(times), max(times), len(data), zlib.crc32(
            data)) + text(self.compression) + struct.pack('<Q', len(packed)) + packed)
        end, places = len(self.out), b''
        for channel in sorted({each for each, _, _ in offsets}):
            places += struct.pack('<HQ', channel, len(self.out))
            entries = b''.join(struct.pack('<QQ', time, offset) for each, time, offset in offsets
                               if each == channel)
            self.out += record(7, struct.pack('<HI', channel, len(entries)) + entries)
        self.indexes.append(record(8, struct.pack(
            '<QQQQI', min(times), max(times), start, end - start, len(places)) + places
            + struct.pack('<Q', len(self.out) - end) + text(self.compression) + struct.pack(
                '<QQ', len(packed), len(data))))

    def end(self, attachment, metadata):
        summary, offsets = bytearray(), b''
        begin = len(self.out)
        schemas, channels = self.definitions()
        counts = b''.join(struct.pack('<HQ', *item) for item in self.counts.items())
        statistics = record(11, struct.pack(
            '<QHIIIIQQI', len(self.times), len(schemas), len(channels), 1, 1, len(self.indexes),
            min(self.times), max(self.times), len(counts)) + counts)
        groups = {3: schemas, 4: channels, 8: self.indexes, 10: [record(10, attachment)],
                  13: [record(13, metadata)], 11: [statistics]}
        for code, group in groups.items() if self.summary else ():
            offsets += record(14, struct.pack('<BQQ', code, begin + len(summary),
                                              len(b''.join(group))))
            summary += b''.join(group)
        places = (begin, begin + len(summary)) if self.summary else (0, 0)
        footer = struct.pack('<BQQQ', 2, 20, *places)
        summary += offsets + footer
        checksum = zlib.crc32(summary) if self.summary else 0
        self.out += summary + struct.pack('<I', checksum) + MAGIC
