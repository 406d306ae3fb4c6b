# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Messages and small sound bags of every kind; `McapFile` writes by the specification alone."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
import sqlite3
import struct
from typing import Any
import zlib

from accel_calib.logs import IMU_DOUBLES
from accel_calib.table import Recording
import lz4.frame
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer as Writer2
from rosbags.typesys import get_typestore, Stores
from shared import MPS2

try:
    from compression import zstd
except ImportError:
    from backports import zstd

STORE = get_typestore(Stores.ROS2_JAZZY)
COMPRESS = {'': bytes, 'lz4': lz4.frame.compress, 'zstd': zstd.compress}
MAGIC = b'\x89MCAP0\r\n'

IMU, TEMPERATURE, STRING = ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature',
                            'std_msgs/msg/String')
TOPICS = [('/imu', IMU), ('/temperature', TEMPERATURE), ('/words', STRING)]
COUNT = 60
START = 1_700_000_000 * 10 ** 9
RATE_NS = 10 ** 7

Write = Callable[..., Path]
"""Write a bag into a folder: topics and messages, by default `TOPICS` and `messages`."""

Made = Iterable[tuple[int, int, Any]]
"""Number of the topic, time of receipt [ns], and message or its bytes."""


def header(store: Any, stamp: int, frame_id: str = 'imu_link') -> Any:
    """Return a header with a stamp [ns]."""
    kind = store.types['std_msgs/msg/Header']
    extra = {'seq': 0} if 'seq' in kind.__annotations__ else {}
    return kind(frame_id=frame_id, stamp=store.types['builtin_interfaces/msg/Time'](
        sec=stamp // 10 ** 9, nanosec=stamp % 10 ** 9), **extra)


def imu(store: Any, about: Any, force: Any, rate: Any = (0.0, 0.0, 0.0),
        quaternion: Any = (0.0, 0.0, 0.0, 1.0), covariances: Any = np.zeros((3, 9))) -> Any:
    """Return an Imu with this header."""
    vector = store.types['geometry_msgs/msg/Vector3']
    return store.types[IMU](
        about, store.types['geometry_msgs/msg/Quaternion'](*map(float, quaternion)),
        covariances[0], vector(*map(float, rate)), covariances[1], vector(*map(float, force)),
        covariances[2])


def writer_of(path: Path, kind: str) -> tuple[Any, Any]:
    """Return a writer of bag (ROS 1), mcap or sqlite3, and its types."""
    if kind == 'bag':
        return Writer1(path), get_typestore(Stores.ROS1_NOETIC)
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
    return writer, get_typestore(Stores.ROS2_JAZZY)


def fill(writer: Any, store: Any, topics: Sequence[tuple[str, str]], made: Made) -> None:
    """Write messages with a writer of `rosbags`."""
    serialize = store.serialize_ros1 if isinstance(writer, Writer1) else store.serialize_cdr
    with writer:
        known = [writer.add_connection(*topic, typestore=store) for topic in topics]
        for topic, stamp, each in made:
            data = each if isinstance(each, bytes) else serialize(each, topics[topic][1])
            writer.write(known[topic], stamp, data)


def write_bag(path: Path, kind: str, recording: Recording,
              topics: Sequence[str] = ('/imu/data_raw',)) -> Path:
    """Write the samples [g] of a recording with Imu, temperature and text."""
    writer, store = writer_of(path, kind)
    reading, count = MPS2.from_g(recording.reading), len(topics)

    def made() -> Iterator[tuple[int, int, Any]]:
        for k, time in enumerate(recording['time']):
            receipt = 100 * 10 ** 9 + round(time * 1e9)
            about = header(store, receipt)
            for topic in range(count):
                yield topic, receipt, imu(store, about, reading[k], recording['rate'][k])
            if k % 50 == 0:
                warm = float(recording['temperature'][k])
                yield count, receipt, store.types[TEMPERATURE](about, warm, 0.0)
                yield count + 1, receipt, store.types[STRING](f'word {k}')

    fill(writer, store, [*((topic, IMU) for topic in topics), *TOPICS[1:]], made())
    return path


def messages(store: Any = STORE) -> list[tuple[int, int, Any]]:
    """Return (number of the topic, time of receipt [ns], message)."""
    types, rng, found = store.types, np.random.default_rng(1), []
    for k in range(COUNT):
        stamp = START + RATE_NS * k
        about = header(store, stamp, 'imu')
        found.append((0, stamp, imu(store, about, rng.normal([0.1, -0.2, 9.8], 0.01))))
        if k % 5 == 0:
            found.append((1, stamp + 1, types[TEMPERATURE](about, 20.0 + 0.1 * k, 0.0)))
            found.append((2, stamp + 2, types[STRING](f'word {k}')))
    return found


def raw_messages() -> list[tuple[int, int, bytes]]:
    """Return (number of the topic, time of receipt [ns], CDR)."""
    return [(topic, stamp, bytes(STORE.serialize_cdr(each, TOPICS[topic][1])))
            for topic, stamp, each in messages()]


def swapped(data: bytes) -> bytes:
    """Return an Imu in little-endian CDR as a big-endian machine writes it."""
    stamp, begin = struct.unpack_from('<iII', data, 4), len(data) - 8 * IMU_DOUBLES
    return (bytes(4) + struct.pack('>iII', *stamp) + data[16:begin]
            + np.frombuffer(data[begin:], '<f8').astype('>f8').tobytes())


def by_hand(compression: str = '', **how: bool) -> Write:
    def write(folder: Path, topics: Any = TOPICS, made: Made = ()) -> Path:
        return McapFile(topics, compression, **how).write(folder / 'bag.mcap',
                                                          made or raw_messages())
    return write


def rosbag2(plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE) -> Write:
    def write(folder: Path, topics: Any = TOPICS, made: Made = ()) -> Path:
        writer = Writer2(folder / 'bag', version=9, storage_plugin=plugin)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        fill(writer, STORE, topics, made or messages())
        return folder / 'bag'
    return write


def ros1(compression: Any = None) -> Write:
    def write(folder: Path) -> Path:
        store, writer = get_typestore(Stores.ROS1_NOETIC), Writer1(folder / 'bag.bag')
        if compression is not None:
            writer.set_compression(compression)
        fill(writer, store, TOPICS, messages(store))
        return folder / 'bag.bag'
    return write


MAKES: dict[str, Write] = {
    'mcap': by_hand(), 'mcap lz4': by_hand('lz4'), 'mcap zstd': by_hand('zstd'),
    'mcap without chunks': by_hand(in_chunks=False),
    'mcap without summary': by_hand(summary=False),
    'sqlite3': rosbag2(StoragePlugin.SQLITE3), 'mcap folder': rosbag2(StoragePlugin.MCAP),
    'sqlite3 messages': rosbag2(StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    'mcap file': rosbag2(StoragePlugin.MCAP, CompressionMode.FILE),
    'mcap storage': rosbag2(StoragePlugin.MCAP, CompressionMode.STORAGE),
    'ros1': ros1(), 'ros1 bz2': ros1(Writer1.CompressionFormat.BZ2),
    'ros1 lz4': ros1(Writer1.CompressionFormat.LZ4)}


def execute(file: Path, statement: str, *values: Any) -> None:
    """Execute a statement of SQL on a db3 file."""
    database = sqlite3.connect(file)
    database.execute('PRAGMA synchronous = OFF')
    database.execute(statement, values)
    database.commit()
    database.close()


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
