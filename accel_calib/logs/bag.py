# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Open bags without ROS, rosbag2 (folder, mcap, db3) and ROS 1; and the layout of their messages.

**Messages.** In both CDR (ROS 2) and the serialization of ROS 1, a message with a header starts
with four 32-bit words: the encapsulation (CDR) or seq (ROS 1), two words of the stamp, and the
length of frame_id. The letters of frame_id follow, and then the doubles: 37 for an Imu, 2 for a
Temperature. CDR aligns the doubles to 8 bytes, counted from the end of the encapsulation, and its
length of frame_id includes a NUL. ROS 1 has no alignment. Padding bytes can have any value.

The messages of a bag can differ in the length of frame_id and in the byte order. Both are
therefore read from each message. ROS 1 messages are always little endian. CDR messages are little
endian if the second byte of the encapsulation is 1.

**Damage.** Damaged bytes cause many kinds of errors in `rosbags`, also long after the bag is open,
and can take much memory and time. `accel_calib.logs.child` limits and converts them.

A recorder that was killed leaves the last messages of a db3 file in a second file, the journal of
SQLite (``-wal`` or ``-journal``). `rosbags` ignores it. SQLite joins both files, in a copy.

"""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, ExitStack
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
import shutil
import sqlite3
import struct
import sys
from tempfile import TemporaryDirectory
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..disk import check_regular
from ..errors import InputError
from ..table import Floats
from ..text import listed, some

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, MessageDefinition
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

ORIENTATION = slice(0, 4)
ORIENTATION_COVARIANCE = slice(4, 13)
ANGULAR_VELOCITY = slice(13, 16)
ANGULAR_VELOCITY_COVARIANCE = slice(16, 25)
ACCELERATION = slice(25, 28)
ACCELERATION_COVARIANCE = slice(28, 37)
IMU_DOUBLES = 37
"""Number of doubles of an Imu; the slices above are the places of its fields."""

LITTLE_ENDIAN = b'\x00\x01\x00\x00'
"""Encapsulation of plain little-endian CDR, which all common middlewares send."""

STAMP_AT, NAME_AT, LETTERS_AT = 4, 12, 16
"""Places of the stamp, of the length of frame_id, and of the letters of frame_id."""

THREE, NINE, STAMP = struct.Struct('<3d'), struct.Struct('<9d'), struct.Struct('<iI')


def begin_of(name_length: Any, *, ros2: bool) -> Any:
    """Return the place of the first double for one length of frame_id, or an array of lengths."""
    end = LETTERS_AT + name_length
    return (end - STAMP_AT + 7) // 8 * 8 + STAMP_AT if ros2 else end


@dataclass(frozen=True)
class Layout:
    """
    Layout of the Imu messages with one frame_id, in little-endian CDR.

    `name` is length and letters of frame_id as in a message, `begin` the place of the first
    double, and `size` the length of a message.

    """

    name: bytes
    begin: int
    size: int

    @property
    def name_end(self) -> int:
        """Place after the letters of frame_id."""
        return NAME_AT + len(self.name)

    @property
    def frame_id(self) -> str:
        return self.name[4:-1].decode(errors='replace')

    def place(self, field: slice) -> int:
        return self.begin + 8 * int(field.start)


def layout_with(frame_id: str) -> Layout:
    """Return the layout of messages with this frame_id."""
    letters = frame_id.encode() + b'\x00'
    begin = begin_of(len(letters), ros2=True)
    return Layout(len(letters).to_bytes(4, 'little') + letters, begin, begin + 8 * IMU_DOUBLES)


def layout_of(data: bytes) -> Layout | None:
    """Return the layout of a message, or None if it is not a whole Imu in little-endian CDR."""
    length = int.from_bytes(data[NAME_AT:LETTERS_AT], 'little')
    name = data[NAME_AT:LETTERS_AT + length]
    begin = begin_of(len(name) - 4, ros2=True)
    layout = Layout(name, begin, begin + 8 * IMU_DOUBLES)
    whole = (data[:4] == LITTLE_ENDIAN and length > 0 and len(name) == 4 + length
             and len(data) == layout.size)
    return layout if whole and name[-1] == 0 else None


Indices = NDArray[np.int64]

NANO = 1e-9


@dataclass(frozen=True)
class Messages:
    """
    Serialized messages with a header and doubles, in one buffer; `joined` makes them.

    `start`, `stop` and `begin` (n,) are the places of the beginning, the end and the first double
    of each message, `head` (n, 4) its first four words, and `swapped` (n,) whether it is big
    endian. Messages of ROS 1 are not CDR.

    """

    data: NDArray[np.uint8]
    start: Indices
    stop: Indices
    head: NDArray[np.uint32]
    begin: Indices
    swapped: NDArray[np.bool_]
    ros2: bool

    def __len__(self) -> int:
        return len(self.start)

    @property
    def stamps(self) -> Floats:
        """Return the header stamps [s]."""
        seconds = self.head[:, 1]
        signed = seconds.view(np.int32) if self.ros2 else seconds
        return signed + self.head[:, 2] * NANO

    @property
    def frame_ids(self) -> list[str]:
        """Return the frame_id of each message; only one item if all are equal."""
        length, first = self.head[:, 3].astype(np.int64), self.start + LETTERS_AT
        if np.all(length == length[0]):
            names = sliding_window_view(self.data, int(length[0]))[first]
            if np.all(names == names[0]):
                length, first = length[:1], first[:1]
        return [self.data[place:place + size].tobytes().rstrip(b'\0').decode(errors='replace')
                for place, size in zip(first.tolist(), length.tolist(), strict=True)]

    @property
    def columns(self) -> dict[str, Floats]:
        """
        Return Imu messages as columns of `accel_calib.table`.

        They are ``time`` (n,) [s], ``reading`` (n, 3) and ``rate`` (n, 3) [rad/s], which is NaN
        for a message without a rate.

        """
        rate, first = self.doubles(ANGULAR_VELOCITY), ANGULAR_VELOCITY_COVARIANCE.start
        absent = self.doubles(slice(first, first + 1))[:, 0] == -1.0
        rate[absent | ~np.isfinite(rate).all(axis=1)] = np.nan
        return {'time': self.stamps, 'reading': self.doubles(ACCELERATION), 'rate': rate}

    def doubles(self, which: slice) -> Floats:
        """Return a slice of the doubles of each message, (n, k)."""
        begin, width = self.begin + 8 * which.start, 8 * (which.stop - which.start)
        values = sliding_window_view(self.data, width)[begin].view('<f8')
        if np.any(self.swapped):
            values[self.swapped] = values[self.swapped].byteswap()
        return values

    def rewrite(self, values: Floats, frame_id: str | None) -> Iterator[bytes]:
        """Yield messages with all (n, k) doubles replaced, and their frame_id, if not None."""
        stored, data = values.astype('<f8'), self.data.data
        stored[self.swapped] = stored[self.swapped].byteswap()
        letters = (frame_id or '').encode() + (b'\0' if self.ros2 else b'')
        size = begin_of(len(letters), ros2=self.ros2)
        for doubles, start, begin, stop, swapped in zip(stored, *(each.tolist() for each in (
                self.start, self.begin, self.stop, self.swapped)), strict=True):
            body = doubles.tobytes()
            if frame_id is None:
                yield bytes(data[start:begin]) + body + data[begin + len(body):stop]
            else:
                length = len(letters).to_bytes(4, 'big' if swapped else 'little')
                head = bytes(data[start:start + NAME_AT]) + length + letters
                yield head.ljust(size, b'\0') + body


def joined(raws: Sequence[bytes | memoryview], doubles: int, name: str, *, ros2: bool = True,
           before: int = 0) -> Messages:
    """
    Copy messages with a header and this number of doubles into one buffer.

    For errors, `name` is the topic, and `before` the number of its earlier messages.

    Raises
    ------
    InputError
        If the length of a message does not match its header, or it is not plain CDR.

    """
    stop = np.cumsum(np.fromiter(map(len, raws), np.int64, len(raws)))
    start = np.concatenate([np.zeros(1, np.int64), stop])[:-1]
    data = np.frombuffer(b''.join(raws), np.uint8)
    size = stop - start
    _check(size >= LETTERS_AT + 8 * doubles, size, name, before)
    head = sliding_window_view(data, LETTERS_AT)[start].view('<u4')
    swapped = np.zeros(len(raws), dtype=bool)
    if ros2:
        swapped = head[:, 0] & 0xffff == 0
        _check(swapped | (head[:, 0] & 0xffff == 0x100), size, name, before)
        if np.any(swapped):
            head[swapped] = head[swapped].byteswap()
    begin = begin_of(head[:, 3].astype(np.int64), ros2=ros2)
    extra = size - begin - 8 * doubles
    # A CDR message may end with up to 3 bytes of padding.
    _check((extra >= 0) & (extra <= (3 if ros2 else 0)), size, name, before)
    return Messages(data=data, start=start, stop=stop, head=head, begin=start + begin,
                    swapped=swapped, ros2=ros2)


def _check(sound: NDArray[np.bool_], size: Indices, name: str, before: int) -> None:
    if not np.all(sound):
        first = int(np.argmin(sound))
        raise InputError(f'{name}: message {before + first + 1} of {size[first]} bytes is '
                         'damaged, expected a whole message',
                         'remove it from the bag, or record again')


# ------------------------------------------------------------------------------- an open bag

IMU, TEMPERATURE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'
_DOUBLES = {IMU: IMU_DOUBLES, TEMPERATURE: 2}
"""Number of doubles of a message; those of a Temperature are temperature and variance."""

BLOCK = 4096
"""Number of messages per block; a block fits in the cache of the processor."""

LARGEST = 1e6
"""Larger accelerations [m/s²] and rates [rad/s] are those of damaged bytes."""

_BLOCK_BYTES = 1 << 24
"""Number of bytes above which a block ends."""

ZSTD = 'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'
"""The zstd of Python 3.14, or that which `rosbags` needs before."""

_PACKED = b'\x28\xb5\x2f\xfd'
"""First bytes of a message that zstd compressed, which no CDR begins with."""

NUMBERS = ('float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64',
           'uint64')
NO_QUANTITIES = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time',
                 'builtin_interfaces/msg/Duration', 'std_msgs/msg/MultiArrayLayout')
"""Types whose numbers are not quantities of the user."""

Received = tuple['Connection', int, bytes]
"""Connection, time of receipt [ns] and serialized message."""


@dataclass(frozen=True)
class Bag:
    """
    An open bag; `open_bag` makes it.

    Notes state which parts of the bag are not read or were recovered.

    """

    path: Path
    reader: 'Reader1 | Reader2'
    ros2: bool
    notes: tuple[str, ...] = ()

    def topics(self, msgtype: str) -> list[str]:
        return sorted({c.topic for c in self.reader.connections if c.msgtype == msgtype})

    def connections(self, topic: str, msgtype: str = IMU) -> 'list[Connection]':
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

    def blocks(self, connections: 'Sequence[Connection]' = (), size: int = BLOCK
               ) -> Iterator[list[Received]]:
        """
        Yield blocks of messages, in order of receipt; by default those of all connections.

        A block has at most `size` messages; large messages make it shorter.

        """
        block: list[Received] = []
        left = _BLOCK_BYTES
        for connection, received, raw in self.reader.messages(connections):
            if raw[:4] == _PACKED and self.ros2:  # without metadata.yaml that tells it
                raw = import_module(ZSTD).decompress(raw)
            block.append((connection, received, raw))
            left -= len(raw)
            if left < 0 or len(block) == size:
                yield block
                block, left = [], _BLOCK_BYTES
        if block:
            yield block

    def first(self, topic: str, msgtype: str = IMU, size: int = 1) -> list[Received]:
        return next(self.blocks(self.connections(topic, msgtype), size), [])

    def joined(self, block: Sequence[Received], topic: str, msgtype: str = IMU, before: int = 0
               ) -> Messages:
        """Return messages of a topic as arrays; `before` is the number of earlier messages."""
        return joined([raw for _, _, raw in block], _DOUBLES[msgtype], f'{self.path}, {topic}',
                      ros2=self.ros2, before=before)

    def frame_id(self, topic: str, msgtype: str = IMU) -> str:
        """Return the frame_id of the first message of a topic; of an Imu there must be one."""
        block = self.first(topic, msgtype)
        if not block and msgtype == IMU:
            raise InputError(f'{self.path} has no message on {topic}, expected Imu messages',
                             'record while the sensor publishes')
        return self.joined(block, topic, msgtype).frame_ids[0] if block else ''

    def numbers(self, connection: 'Connection') -> tuple[str, ...]:
        """Return the paths of the single numbers of a message that can be a quantity."""
        from rosbags.interfaces import Nodetype

        types = types_of(connection.msgdef, connection.msgtype, self.ros2).fielddefs

        def below(msgtype: str, path: tuple[str, ...]) -> Iterator[str]:
            for name, (kind, about) in types[msgtype][1]:
                if kind == Nodetype.BASE and str(about[0]) in NUMBERS:
                    yield '.'.join((*path, name))
                elif kind == Nodetype.NAME and str(about) not in NO_QUANTITIES:
                    yield from below(str(about), (*path, name))

        known = connection.msgtype in types
        return tuple(below(connection.msgtype, ())) if known else ()

    # -------------------------------------------------------------------------- Imu messages

    def imu_topic(self, topic: str = '') -> str:
        """Return the Imu topic, or check the given one; it must be one that the bag has."""
        topics = self.topics(IMU)
        if not topics:
            every = some(sorted({f'{c.topic} ({c.msgtype})' for c in self.reader.connections}))
            raise InputError(f'{self.path} has {every or "no topics"}, expected a topic of type '
                             f'{IMU}', 'record the Imu topic')
        if topic not in topics and (topic or len(topics) > 1):
            found = (f'has the Imu topics {some(topics)}, expected {topic}' if topic else
                     f'has {len(topics)} Imu topics, expected one: {some(topics)}')
            raise InputError(f'{self.path} {found}', 'choose one of them with --topic')
        return topic or topics[0]

    def lost(self, topic: str, found: int) -> list[str]:
        """Return a note if fewer messages of a topic were found than the bag states."""
        stated = self.count(topic)
        return [f'{stated - found} of {stated} messages on {topic} are lost: the index of '
                f'{self.path} states them, but they are not in the bag'
                ] if found < stated else []


def imus_of(messages: Messages, name: str, before: int, sensor: str, *, chosen: bool = False
            ) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """
    Return Imu messages as columns of a recording, and which are of a sensor.

    For errors, `name` is the bag and the topic, and `before` the number of earlier messages.
    Messages of another sensor are an InputError unless the user chose the sensor. So are an
    acceleration that is not finite, and a number beyond any sensor.

    """
    names = messages.frame_ids
    same = np.array([each == sensor for each in names])
    if not chosen and not np.all(same):
        first = int(np.argmin(same))
        raise InputError(f'{name}: message {before + first + 1} is from the sensor '
                         f'{names[first]!r}, expected {sensor!r} as before',
                         'capture and refine choose one with --sensor; apply needs a topic for '
                         'each sensor')
    columns = messages.columns
    for key, what in (('reading', 'acceleration'), ('rate', 'angular velocity')):
        values = columns[key] if key == 'reading' else np.nan_to_num(columns[key])
        sound = np.all(np.abs(values) < LARGEST, axis=1)
        if not np.all(sound):
            first = int(np.argmin(sound))
            found = ('contains NaN or infinity' if not np.all(np.isfinite(values[first])) else
                     f'has the {what} {np.max(np.abs(values[first])):.3g}')
            raise InputError(f'{name}: Imu message {before + first + 1} {found}, expected finite '
                             f'numbers below {LARGEST:g}', 'fix the driver, or record again')
    return columns, np.broadcast_to(same, len(messages))


@cache
def types_of(definition: 'MessageDefinition', msgtype: str, ros2: bool) -> 'Typestore':
    """Return the types that the bag defines for a type of messages, or else the usual ones."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

    text = definition.data
    if not text:
        return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)
    store = get_typestore(Stores.EMPTY)
    if definition.format.name == 'MSG':
        store.register(get_types_from_msg(text, msgtype))
        return store
    types, parts = {}, text.split(80 * '=' + '\n')  # a line before each type, in IDL
    for part in [part.partition('\n')[2] for part in parts[1:]] or parts:
        types.update(get_types_from_idl(part))
    store.register(types)
    return store


# ----------------------------------------------------------------------------- files of a bag

@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """
    Open a bag for reading; for a bag of somebody else, in a child process.

    It is read in a copy if SQLite cannot read it as it is. Damage raises errors of any class, also
    later, while the bag is read.

    """
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    source, stored, notes = path, [path], list[str]()
    if path.is_dir():
        for each in path.iterdir():
            if each.exists() and not each.is_dir():  # `rosbags` would wait for a pipe
                check_regular(each)
        stored = sorted(each for each in path.iterdir() if each.suffix in ('.mcap', '.db3'))
        metadata = path / 'metadata.yaml'
        if metadata.exists():
            text = metadata.read_text(encoding='utf-8', errors='replace')
            lost = [each.name for each in stored if each.name not in text]
            if 0 < len(lost) < len(stored):
                notes = [f'metadata.yaml of {path} does not list {listed("file", lost)}: the '
                         'messages there are not read; ros2 bag reindex lists all files']
        elif not stored:
            raise InputError(f'{path} is a folder without a bag, expected a rosbag2 folder or a '
                             'file', 'choose a file in it')
        elif len(stored) == 1:
            notes = [f'{path} has no metadata.yaml, as after a recorder was killed; '
                     f'{stored[0].name} is read without it']
            source, = stored
    databases = [each for each in stored if each.suffix == '.db3']
    journals = [journal for each in databases for suffix in ('-wal', '-journal')
                if (journal := each.with_name(each.name + suffix)).is_file()
                and journal.stat().st_size]
    if journals:
        notes.append('the recorder was killed; its last messages are read from '
                     f'{", ".join(each.name for each in journals)}')
    with ExitStack() as stack:
        if databases:
            source = _copied(source, databases, journals, stack)
        ros2 = path.suffix != '.bag'
        reader: Any = stack.enter_context((Reader2 if ros2 else Reader1)(source))
        yield Bag(path, reader, ros2, tuple(notes))


def _copied(path: Path, databases: Sequence[Path], journals: Sequence[Path], stack: ExitStack
            ) -> Path:
    """
    Return a bag in a temporary folder: databases joined with their journals, and links.

    The name of a db3 file there has no letters that `rosbags` would have to escape in a URI.

    """
    made = Path(stack.enter_context(TemporaryDirectory(prefix='accel_calib_'))) / 'bag.db3'
    if path.is_dir():
        made.mkdir()
    for each in path.iterdir() if path.is_dir() else [path, *journals]:
        copy = Path(f'{made}{str(each).removeprefix(str(path))}')
        if journals and each in (*databases, *journals):
            shutil.copyfile(each, copy)
        elif not each.name.endswith('-shm'):
            copy.symlink_to(each.absolute())
    for each in databases if journals else ():
        with closing(sqlite3.connect(f'{made}{str(each).removeprefix(str(path))}')) as database:
            database.execute('PRAGMA journal_mode = DELETE').fetchone()
    return made
