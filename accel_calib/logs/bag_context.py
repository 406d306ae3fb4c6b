# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Temperature and supply voltage from the topics of a bag.

A topic of type sensor_msgs/Temperature is used without being asked for, if it is clear which. All
other topics are used where the user names them: any message with a number that is a temperature or
a voltage, such as std_msgs/Float32, sensor_msgs/BatteryState or a type of the user. The bag
contains the definition of such a type, except for old db3 files. Topics that look like one of both
quantities and are not used are reported.

**Time.** Readings have the stamps of their headers. A message without a header, or with an unset
stamp, has only the time at which the bag received it. The median difference of both times, over
the first messages of the Imu, converts this time to that of the stamps.

"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
import re
from typing import Any, TYPE_CHECKING

import numpy as np

from .bag_reader import Bag, damage_as_input_error, Received
from .serialized import doubles_at, frame_ids, stamps_of
from ..errors import InputError
from ..table import Floats, Recording
from ..text import counted, listed

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

TEMPERATURE = 'sensor_msgs/msg/Temperature'
_TEMPERATURE_DOUBLES = 2
"""Number of doubles of a Temperature: temperature and variance."""

_AROUND = 10
"""Number of values that are kept before a block."""

_PEEKED = 100
"""Number of messages at the beginning of a topic that show its clock and its unit."""

_SAME_CLOCK_S = 60.0
"""Largest difference of a stamp from the time of receipt; a larger one is another clock."""

_NUMBERS = ('float32', 'float64', 'int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'int64',
            'uint64')
_TIMES = ('std_msgs/msg/Header', 'builtin_interfaces/msg/Time', 'builtin_interfaces/msg/Duration')
_PRESSURE = 'sensor_msgs/msg/FluidPressure'
_OF_TYPE = {TEMPERATURE: 'temperature', 'sensor_msgs/msg/BatteryState': 'supply_voltage'}
"""Columns of types whose definition names other quantities, too."""

_NANO = 1e-9


@dataclass(frozen=True)
class Quantity:
    """
    A quantity that is known beside the readings.

    Parameters
    ----------
    key : str
        Column of `accel_calib.table.COLUMNS`.
    words : str
        Name in messages.
    option : str
        Option of the command line that names its topic.
    fields : tuple of str
        Names of fields that hold it, the best first.
    parts : tuple of str
        Parts of the name of a topic or of a field that is likely to hold it.
    units : tuple of (str, float, float, float, float)
        Name of a unit, its lowest and highest plausible value, and factor and summand that convert
        it to the unit of the column; the unit of the column comes first.

    """

    key: str
    words: str
    option: str
    fields: tuple[str, ...]
    parts: tuple[str, ...]
    units: tuple[tuple[str, float, float, float, float], ...]


QUANTITIES = (
    Quantity('temperature', 'temperature', '--temperature-topic', ('temperature', 'temp'),
             ('temp', 'therm'), (('°C', -100.0, 200.0, 1.0, 0.0),
                                 ('K', 200.0, 450.0, 1.0, -273.15))),
    Quantity('supply_voltage', 'supply voltage', '--supply-topic',
             ('supply_voltage', 'voltage', 'volt', 'vdd', 'vcc'),
             ('volt', 'vdd', 'vcc', 'supply', 'battery'),
             (('V', 0.5, 200.0, 1.0, 0.0), ('mV', 200.0, 2e5, 1e-3, 0.0))))


@dataclass(frozen=True)
class Track:
    """Values of a quantity at increasing times [s]."""

    time: Floats
    value: Floats

    def at(self, time: Floats) -> Floats:
        """Return the (n,) interpolated values; NaN if the track is empty."""
        if not len(self.time):
            return np.full(len(time), np.nan)
        return np.interp(time, self.time, self.value)

    def plus(self, time: Floats, value: Floats) -> Track:
        """Return the track with the finite ones of these (k,) values added."""
        known = np.isfinite(value)
        times = np.concatenate([self.time, time[known]])
        order = np.argsort(times, kind='stable')
        return Track(times[order], np.concatenate([self.value, value[known]])[order])

    def covers(self, samples: Recording) -> bool:
        """Return whether the track reaches the end of these samples."""
        return bool(len(self.time) and samples['time'][-1] <= self.time[-1])

    def since(self, time: float) -> Track:
        """Return the track without values long before a time."""
        first = max(0, int(np.searchsorted(self.time, time)) - _AROUND)
        return Track(self.time[first:], self.value[first:])


@dataclass(frozen=True)
class ContextTopic:
    """
    A topic with a quantity; `context_topics` makes it.

    Parameters
    ----------
    bag : Bag
        The open bag.
    quantity : Quantity
        The quantity.
    topic, msgtype, field : str
        Topic, type and field of the value, such as ``status.temperature``.
    late : float or None
        Time that is added to the time of receipt [s]; None if the stamps of the headers are used.
    factor, summand : float
        Conversion to the unit of the column.

    """

    bag: Bag
    quantity: Quantity
    topic: str
    msgtype: str
    field: str
    late: float | None = None
    factor: float = 1.0
    summand: float = 0.0

    @property
    def connections(self) -> list[Connection]:
        """Return the connections of the topic."""
        return self.bag.connections(self.topic, self.msgtype)

    def values(self, block: Sequence[Received]) -> tuple[Floats, Floats]:
        """
        Return the times [s] and values of messages.

        Raises
        ------
        InputError
            If a message is damaged.

        """
        received = np.array([stamp for _, stamp, _ in block]) * _NANO
        if self.msgtype == TEMPERATURE:
            messages = self.bag.joined([raw for _, _, raw in block], self.topic, 0,
                                       _TEMPERATURE_DOUBLES)
            stamps, found = stamps_of(messages), doubles_at(messages, slice(0, 1))[:, 0]
        else:
            with damage_as_input_error(self.bag.path):
                stamps, found = _deserialized(self, block)
        time = stamps if self.late is None else received + self.late
        return time, found * self.factor + self.summand


def _deserialized(of: ContextTopic, block: Sequence[Received]) -> tuple[Floats, Floats]:
    """Return stamps [s], NaN without a header, and values of messages of any type."""
    store = _types(block[0][0], ros2=of.bag.ros2)
    read = store.deserialize_cdr if of.bag.ros2 else store.deserialize_ros1
    rows = []
    for _, _, raw in block:
        value: Any = read(raw, of.msgtype)
        stamp = getattr(getattr(value, 'header', None), 'stamp', None)
        for name in of.field.split('.'):
            value = getattr(value, name)
        rows.append((np.nan if stamp is None else stamp.sec + stamp.nanosec * _NANO, value))
    found = np.array(rows, float)
    return found[:, 0], found[:, 1]


def _types(connection: Connection, *, ros2: bool) -> Typestore:
    """Return the types of a connection: those that the bag defines, otherwise the usual ones."""
    from rosbags.typesys import get_typestore, Stores

    definition = connection.msgdef
    if definition.data:
        return _defined(definition.format.name, definition.data, connection.msgtype)
    return get_typestore(Stores.ROS2_JAZZY if ros2 else Stores.ROS1_NOETIC)


@cache
def _defined(kind: str, text: str, msgtype: str) -> Typestore:
    """Return the types in a definition; an IDL definition has a line before each type."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg, get_typestore, Stores

    store = get_typestore(Stores.EMPTY)
    if kind == 'MSG':
        store.register(get_types_from_msg(text, msgtype))
        return store
    types, parts = {}, text.split(80 * '=' + '\n')
    for part in [each.partition('\n')[2] for each in parts[1:]] or parts:
        types.update(get_types_from_idl(part))
    store.register(types)
    return store


def _numbers_of(bag: Bag, connection: Connection) -> tuple[str, ...]:
    """Return the paths of the single numbers of a message, without those of headers and times."""
    from rosbags.interfaces import Nodetype

    with damage_as_input_error(bag.path):
        types = _types(connection, ros2=bag.ros2).fielddefs

        def below(msgtype: str, path: tuple[str, ...]) -> Iterator[str]:
            for name, (kind, about) in types[msgtype][1]:
                if kind == Nodetype.BASE and str(about[0]) in _NUMBERS:
                    yield '.'.join((*path, name))
                elif kind == Nodetype.NAME and str(about) not in _TIMES:
                    yield from below(str(about), (*path, name))

        return tuple(below(connection.msgtype, ())) if connection.msgtype in types else ()


@dataclass(frozen=True)
class ContextTopics:
    """The topics that are used beside those of the Imu, and notes about them and about others."""

    used: tuple[ContextTopic, ...]
    notes: tuple[str, ...]

    def tracks(self) -> dict[str, Track]:
        """Return all values of the bag by column; raise InputError if there are none."""
        found = {}
        for each in self.used:
            track = Track(np.zeros(0), np.zeros(0))
            for block in each.bag.blocks(each.connections):
                track = track.plus(*each.values(block))
            if not len(track.time):
                raise InputError(f'{each.bag.path}: {each.topic} has no finite number, expected '
                                 f'the {each.quantity.words}', 'name another topic')
            found[each.quantity.key] = track
        return found


def context_of(bag: Bag, imu: str, sensor: str, temperature_topic: str = '',
               supply_topic: str = '') -> ContextTopics:
    """
    Return the topics with temperature and supply voltage.

    Parameters
    ----------
    bag : Bag
        The open bag.
    imu, sensor : str
        Topic and frame_id of the readings.
    temperature_topic, supply_topic : str
        Topics to use, as ``TOPIC`` or ``TOPIC:FIELD``. By default, the temperature is that of the
        only topic of type sensor_msgs/Temperature, or of the only one with the frame_id or in the
        namespace of the Imu.

    Raises
    ------
    InputError
        If a topic is missing, has no messages, or does not contain the quantity.

    """
    used, notes = [], []
    for quantity, asked in zip(QUANTITIES, (temperature_topic, supply_topic), strict=True):
        found = (_asked(bag, quantity, asked) if asked else
                 _own(bag, imu, sensor) if quantity.key == 'temperature' else None)
        if found is not None:
            found, about = _with_clock_and_unit(found, imu, named=bool(asked))
            used += [found] if found is not None else []
            notes += about
        notes += _not_used(bag, quantity, found)
    return ContextTopics(tuple(used), tuple(notes))


def _asked(bag: Bag, quantity: Quantity, asked: str) -> ContextTopic:
    """Return the topic and field that the user names."""
    topic, _, field = asked.partition(':')
    known = [each for each in bag.reader.connections if each.topic == topic]
    if not known:
        others = sorted({f'{each.topic} ({each.msgtype})' for each in bag.reader.connections})
        raise InputError(f'{bag.path} has the topics {", ".join(others)}, expected {topic}',
                         f'choose one of them with {quantity.option}')
    numbers = _numbers_of(bag, known[0])
    return ContextTopic(bag, quantity, topic, known[0].msgtype,
                        _field(bag, quantity, known[0], numbers, field))


def _field(bag: Bag, quantity: Quantity, connection: Connection, numbers: Sequence[str],
           asked: str) -> str:
    """Return the path of the field of a quantity."""
    last = {path: path.rpartition('.')[2].lower() for path in numbers}
    choices = [[path for path in numbers if path == asked]] if asked else [
        *([path for path in numbers if last[path] == name] for name in quantity.fields),
        [path for path in numbers if any(part in last[path] for part in quantity.parts)],
        numbers if len(numbers) == 1 else []]
    found = next(filter(None, choices), [])
    if len(found) == 1:
        return found[0]
    what = f'{connection.topic} ({connection.msgtype})'
    have = f'the numbers {", ".join(numbers)}' if numbers else 'no single number'
    raise InputError(
        f'{bag.path}: topic {what} has {have}, expected {asked or f"one {quantity.words}"}',
        f'name another topic, or the field with {quantity.option} {connection.topic}:FIELD')


def _own(bag: Bag, imu: str, sensor: str) -> ContextTopic | None:
    """Return the topic of type Temperature that belongs to the Imu, or None."""
    known = [topic for topic in bag.topics(TEMPERATURE)
             if any(each.msgcount for each in bag.connections(topic, TEMPERATURE))]
    space = imu.rpartition('/')[0]
    for wanted in (lambda topic: True,
                   lambda topic: sensor and _frame_id(bag, topic) == sensor,
                   lambda topic: space and topic.rpartition('/')[0] == space):
        of_imu = [topic for topic in known if wanted(topic)]
        if len(of_imu) == 1:
            return ContextTopic(bag, QUANTITIES[0], of_imu[0], TEMPERATURE, 'temperature')
    return None


def _frame_id(bag: Bag, topic: str) -> str:
    """Return the frame_id of the first Temperature of a topic."""
    block = next(bag.blocks(bag.connections(topic, TEMPERATURE), 1), [])
    raws = [raw for _, _, raw in block]
    return frame_ids(bag.joined(raws, topic, 0, _TEMPERATURE_DOUBLES))[0] if raws else ''


def _with_clock_and_unit(found: ContextTopic, imu: str, *, named: bool
                         ) -> tuple[ContextTopic | None, list[str]]:
    """Return a topic with its clock and unit, as its first messages show them, and notes."""
    block = next(found.bag.blocks(found.connections, _PEEKED), [])
    time, values = found.values(block) if block else (np.zeros(0), np.zeros(0))
    known = values[np.isfinite(values)]
    what = f'{found.topic} ({found.msgtype})'
    if not len(known) and len(block) < _PEEKED:
        message = f'{counted(len(block), "message")} on {what} with no finite number'
        if named:
            raise InputError(f'{found.bag.path} has {message}, expected the '
                             f'{found.quantity.words}', 'name another topic')
        return None, [f'there is no {found.quantity.words}: {message}']
    notes = []
    late = _late(found.bag, imu)
    received = np.array([stamp for _, stamp, _ in block]) * _NANO
    if not np.median(np.abs(time - received - late)) <= _SAME_CLOCK_S:
        found = replace(found, late=late)
        notes.append(f'the messages on {what} have no stamp of the clock of the Imu: their times '
                     'are those at which the bag received them')
    if found.msgtype != TEMPERATURE and len(known):
        name, factor, summand = _unit(found, float(np.median(known)))
        found = replace(found, factor=factor, summand=summand)
        notes += [f'the numbers on {what} are read as {name}'] if name else []
    return found, notes


def _unit(found: ContextTopic, typical: float) -> tuple[str, float, float]:
    """Return the unit of a value, empty if it is that of the column, and its conversion."""
    quantity = found.quantity
    for k, (name, least, most, factor, summand) in enumerate(quantity.units):
        if least <= typical < most:
            return name if k else '', factor, summand
    (name, least, most, *_), *_ = quantity.units
    raise InputError(f'{found.bag.path}: the values on {found.topic} ({found.msgtype}) are about '
                     f'{typical:.4g}, expected a {quantity.words} from {least:g} to {most:g} '
                     f'{name}', 'name another topic')


def _late(bag: Bag, imu: str) -> float:
    """Return the median stamp of the first messages of an Imu after their receipt [s]."""
    block = next(bag.blocks(bag.connections(imu), _PEEKED), [])
    if not block:
        return 0.0
    stamps = stamps_of(bag.joined([raw for _, _, raw in block], imu, 0))
    return float(np.median(stamps - np.array([stamp for _, stamp, _ in block]) * _NANO))


def _not_used(bag: Bag, quantity: Quantity, used: ContextTopic | None) -> list[str]:
    """Return a note about topics that look like a quantity and are not used."""
    topics = dict(sorted({each.topic: each.msgtype for each in bag.reader.connections
                          if each.msgcount and _looks_like(each, quantity)}.items()))
    if used is not None:
        topics.pop(used.topic, None)
    named = [f'{topic} ({msgtype})' for topic, msgtype in topics.items()]
    if len(named) == 1:
        return [f'topic {named[0]} looks like a {quantity.words} and is not used: name it with '
                f'{quantity.option} {next(iter(topics))}']
    if named:
        return [f'topics {", ".join(named)} look like a {quantity.words} and are not used: name '
                f'one with {quantity.option} TOPIC']
    pressures = bag.topics(_PRESSURE)
    if used is None and pressures and quantity.key == 'temperature':
        return [f'{listed("topic", pressures)} ({_PRESSURE}): a pressure is no temperature, and '
                'the bag has no other topic that looks like one']
    return []


def _looks_like(connection: Connection, quantity: Quantity) -> bool:
    """Return whether the name, the type or the definition of a topic shows a quantity."""
    if connection.msgtype in _OF_TYPE:
        return _OF_TYPE[connection.msgtype] == quantity.key
    parts = '|'.join(quantity.parts)
    if connection.msgtype.startswith('std_msgs/'):
        single = connection.msgtype.rpartition('/')[2].lower() in _NUMBERS
        return single and bool(re.search(parts, connection.topic.lower()))
    return bool(re.search(rf'^\s*(?:float|double|u?int)\d*\s+\w*(?:{parts})\w*\s*(?:[#;]|$)',
                          connection.msgdef.data, re.IGNORECASE | re.MULTILINE))
