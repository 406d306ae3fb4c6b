# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The samples of a bag in blocks, with temperature and supply voltage from its other topics.

A topic of type sensor_msgs/Temperature is used without being asked for, if it is clear which. All
other topics are used where the user names them: any message with a number that is a temperature or
a voltage, such as std_msgs/Float32, sensor_msgs/BatteryState or a type of the user. The bag
contains the definition of such a type, except for old db3 files. Topics that look like one of both
quantities and are not used are reported.

**Time.** Readings have the stamps of their headers. Other messages without a stamp of this clock
have only the time at which the bag received them. The median difference of both times, over the
first messages of the Imu, converts this time to that of the stamps.

"""

from collections.abc import Collection, Container, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import math
from operator import attrgetter
from pathlib import Path
import re
from typing import Any

import numpy as np

from .bag import Bag, BLOCK, imus_of, NANO, NUMBERS, open_bag, Received, TEMPERATURE, types_of
from .columns import LogOptions
from .names import ZEROS
from ..errors import InputError
from ..table import concatenated, CONTEXT, Floats, quantity_key, Recording
from ..text import counted, listed, some

_PRESSURE = 'sensor_msgs/msg/FluidPressure'
_OF_TYPE = {TEMPERATURE: 'temperature', 'sensor_msgs/msg/BatteryState': 'supply_voltage'}
"""Columns of types whose definition names other quantities, too."""

_ROWS = 65536
"""Smallest number of samples in a block of a recording."""

FIRST_MESSAGES = 100
"""Number of messages at the beginning of a topic that show its clock and its unit."""

_SAME_CLOCK_S = 60.0
"""Largest difference of a stamp from the time of receipt; a larger one is another clock."""


def named_topics(entries: Iterable[str]) -> dict[str, str]:
    """
    Return the topic, with its field if one is named, of each column of the context.

    An entry is ``column:=topic`` or ``column:=topic/field``; InputError if one is not usable.

    """
    topics: dict[str, str] = {}
    for entry in filter(None, entries):
        column, _, topic = (part.strip() for part in entry.partition(':='))
        known = column in (*CONTEXT, quantity_key(column))
        if not (known and column and topic) or column in topics:
            raise InputError(
                f'context has the entry {entry!r}, expected column:=topic or column:=topic/field, '
                f'each column once: {", ".join(CONTEXT)}, or a new name of letters, digits and '
                '_', 'correct the entry')
        topics[column] = topic
    return topics


def topic_and_field(asked: str, topics: Container[str]) -> tuple[str, str]:
    """Return the topic that a text names among those that exist, and the field or ''."""
    topic, field_of = asked, ''
    while topic and topic not in topics:
        topic, _, last = topic.rpartition('/')
        field_of = f'{last}.{field_of}' if field_of else last
    return (topic, field_of) if topic else (asked, '')


@dataclass(frozen=True)
class Quantity:
    """
    A quantity that is known beside the readings: its column and its name.

    `fields` are names of fields that hold it, the best first, and `parts` are parts of the name of
    a topic or field that is likely to hold it. `units` are the name of a unit, its lowest and
    highest plausible value, and factor and summand that convert it to the first of them.

    """

    key: str
    words: str
    fields: tuple[str, ...]
    parts: tuple[str, ...]
    units: tuple[tuple[str, float, float, float, float], ...]


QUANTITIES = (
    Quantity('temperature', 'temperature', ('temperature', 'temp'),
             ('temp', 'therm'), (('°C', -100.0, 200.0, 1.0, 0.0),
                                 ('K', 200.0, 450.0, 1.0, ZEROS['K']))),
    Quantity('supply_voltage', 'supply voltage',
             ('supply_voltage', 'voltage', 'volt', 'vdd', 'vcc'),
             ('volt', 'vdd', 'vcc', 'supply', 'battery'),
             (('V', 0.5, 200.0, 1.0, 0.0), ('mV', 200.0, 2e5, 1e-3, 0.0))))


_USUAL_FIELDS = ('data', 'voltage', 'fluid_pressure', 'temperature')
"""Fields of messages with several numbers that are read for a column of the user."""


def quantity_of(column: str) -> Quantity:
    """Return the quantity of a column of the context; that of a user can have any value."""
    return next((each for each in QUANTITIES if each.key == column), Quantity(
        column, column.replace('_', ' '), (column,), (column.lower(),),
        (('', -math.inf, math.inf, 1.0, 0.0),)))


def field_of(column: str, numbers: Sequence[str], asked: str = '') -> str:
    """
    Return the field of a message that holds a column of the context; '' if none or several can.

    `numbers` are the paths of all numbers in the message, and `asked` the one that a user names.

    """
    quantity, last = quantity_of(column), {each: each.rpartition('.')[2].lower()
                                           for each in numbers}
    choices = [[each for each in numbers if each == asked]] if asked else [
        *([each for each in numbers if last[each] == name] for name in quantity.fields),
        [each for each in numbers if any(part in last[each] for part in quantity.parts)],
        [each for each in numbers if each in column],
        *([each] for each in _USUAL_FIELDS if each in numbers and quantity not in QUANTITIES),
        list(numbers) if len(numbers) == 1 else []]
    fields = next(filter(None, choices), [])
    return fields[0] if len(fields) == 1 else ''


@dataclass(frozen=True)
class ContextTopic:
    """
    A topic with a quantity in a field such as ``status.temperature``.

    `late` is added to the time of receipt [s]; None: the stamps of the headers are used. `factor`
    and `summand` convert to the unit of the column.

    """

    bag: Bag
    quantity: Quantity
    topic: str
    msgtype: str
    field: str
    late: float | None = None
    factor: float = 1.0
    summand: float = 0.0

    def values(self, block: Sequence[Received]) -> tuple[Floats, Floats]:
        """Return the times [s] and values of messages; a damaged message is an InputError."""
        if self.msgtype == TEMPERATURE:
            messages = self.bag.joined(block, self.topic, TEMPERATURE)
            stamps, values = messages.stamps, messages.doubles(slice(0, 1))[:, 0]
        else:
            store = types_of(block[0][0].msgdef, self.msgtype, self.bag.ros2)
            read = store.deserialize_cdr if self.bag.ros2 else store.deserialize_ros1
            found = [read(raw, self.msgtype) for _, _, raw in block]
            values = np.array([*map(attrgetter(self.field), found)], float)
            parts = [getattr(getattr(each, 'header', None), 'stamp', None) for each in found]
            stamps = np.array([np.nan if each is None else each.sec + each.nanosec * NANO
                               for each in parts])
        time = stamps
        if self.late is not None:
            time = np.array([received for _, received, _ in block]) * NANO + self.late
        return time, values * self.factor + self.summand

    def track(self) -> Floats:
        """Return the times [s] and finite values of the whole bag, (2, n); one NaN if none is."""
        connections = self.bag.connections(self.topic, self.msgtype)
        blocks = [self.values(block) for block in self.bag.blocks(connections)]
        time, value = np.hstack([np.zeros((2, 0)), *map(np.array, blocks)])
        known = np.flatnonzero(np.isfinite(value))
        order = known[np.argsort(time[known], kind='stable')]
        return np.array([time[order], value[order]] if len(order) else [[0.0], [np.nan]])


def context_of(bag: Bag, imu: str, sensor: str, options: LogOptions
               ) -> tuple[list[ContextTopic], list[str]]:
    """
    Return the topics with a number beside the readings, and notes about them and about others.

    Parameters
    ----------
    bag, imu, sensor
        The open bag; topic and frame_id of the readings.
    options : LogOptions
        The topics to use. Without one, the temperature is that of the only topic of type
        sensor_msgs/Temperature, or of the only one with the frame_id or in the namespace of the
        Imu.

    Raises
    ------
    InputError
        If a topic is missing, has no messages, or does not contain the quantity.

    """
    used: list[ContextTopic] = []
    notes: list[str] = []
    for quantity in map(quantity_of, dict.fromkeys((*CONTEXT, *options.context))):
        asked = options.context.get(quantity.key, '')
        found = _choose(bag, quantity, asked, imu, sensor)
        if found is not None:
            found, about = _with_clock_and_unit(found, imu, named=bool(asked))
            used += [found] if found is not None else []
            notes += about
        notes += _not_used(bag, quantity, found)
    return used, notes


def _choose(bag: Bag, quantity: Quantity, asked: str, imu: str, sensor: str
            ) -> ContextTopic | None:
    """Return the topic that is asked for, or the Temperature that belongs to the Imu, or None."""
    if not asked:
        temperatures = [
            topic for topic in bag.topics(TEMPERATURE) if quantity.key == 'temperature' and any(
                connection.msgcount for connection in bag.connections(topic, TEMPERATURE))]
        space = imu.rpartition('/')[0]
        for wanted in (lambda topic: True,
                       lambda topic: sensor and bag.frame_id(topic, TEMPERATURE) == sensor,
                       lambda topic: space and topic.rpartition('/')[0] == space):
            of_imu = [topic for topic in temperatures if wanted(topic)]
            if len(of_imu) == 1:
                return ContextTopic(bag, quantity, of_imu[0], TEMPERATURE, 'temperature')
        return None
    topic, field = topic_and_field(asked, {c.topic for c in bag.reader.connections})
    known = [connection for connection in bag.reader.connections if connection.topic == topic]
    if not known:
        every = some(sorted({f'{c.topic} ({c.msgtype})' for c in bag.reader.connections}))
        raise InputError(f'{bag.path} has the topics {every}, expected {topic}',
                         f'choose one of them with --context {quantity.key}:=TOPIC')
    numbers = bag.numbers(known[0])
    if found := field_of(quantity.key, numbers, field):
        return ContextTopic(bag, quantity, topic, known[0].msgtype, found)
    have = f'the numbers {some(numbers)}' if numbers else 'no single number'
    raise InputError(
        f'{bag.path}: topic {topic} ({known[0].msgtype}) has {have}, expected '
        f'{field or f"one {quantity.words}"}', 'name another topic, or the field with --context '
        f'{quantity.key}:={topic}/FIELD')


def _with_clock_and_unit(topic: ContextTopic, imu: str, *, named: bool
                         ) -> tuple[ContextTopic | None, list[str]]:
    """Return a topic with its clock and unit, as its first messages show them, and notes."""
    block = topic.bag.first(topic.topic, topic.msgtype, FIRST_MESSAGES)
    time, values = topic.values(block) if block else (np.zeros(0), np.zeros(0))
    known, what = values[np.isfinite(values)], f'{topic.topic} ({topic.msgtype})'
    if not len(known) and len(block) < FIRST_MESSAGES:
        message = f'{counted(len(block), "message")} on {what} with no finite number'
        if named:
            raise InputError(f'{topic.bag.path} has {message}, expected the '
                             f'{topic.quantity.words}', 'name another topic')
        return None, [f'there is no {topic.quantity.words}: {message}']
    notes = []
    late = 0.0  # the stamps of the first messages of the Imu after their receipt [s]
    of_imu = topic.bag.first(imu, size=FIRST_MESSAGES)
    received, of_block = (np.array([stamp for _, stamp, _ in each]) * NANO
                          for each in (of_imu, block))
    if of_imu:
        late = float(np.median(topic.bag.joined(of_imu, imu).stamps - received))
    if not np.median(np.abs(time - of_block - late)) <= _SAME_CLOCK_S:
        topic = replace(topic, late=late)
        notes.append(f'the messages on {what} have no stamp of the clock of the Imu: their '
                     'times are those at which the bag received them')
    if topic.msgtype != TEMPERATURE and len(known):
        typical, (ours, lowest, highest, *_) = float(np.median(known)), topic.quantity.units[0]
        fitting = [unit for unit in topic.quantity.units if unit[1] <= typical < unit[2]]
        if not fitting:
            raise InputError(f'{topic.bag.path}: the values on {what} are about '
                             f'{typical:.4g}, expected a {topic.quantity.words} from {lowest:g} '
                             f'to {highest:g} {ours}', 'name another topic')
        name, _, _, factor, summand = fitting[0]
        topic = replace(topic, factor=factor, summand=summand)
        notes += [f'the numbers on {what} are read as {name}'] if name != ours else []
    return topic, notes


def _not_used(bag: Bag, quantity: Quantity, used: ContextTopic | None) -> list[str]:
    """Return notes about topics whose name, type or definition shows a quantity."""
    topics, parts = {}, '|'.join(quantity.parts)
    defined = re.compile(rf'^\s*(?:float|double|u?int)\d*\s+\w*(?:{parts})\w*\s*(?:[#;]|$)',
                         re.IGNORECASE | re.MULTILINE)
    for each in bag.reader.connections:
        if not each.msgcount or (used is not None and each.topic == used.topic):
            continue
        if each.msgtype in _OF_TYPE:
            is_like = _OF_TYPE[each.msgtype] == quantity.key
        elif each.msgtype.startswith('std_msgs/'):
            single = each.msgtype.rpartition('/')[2].lower() in NUMBERS
            is_like = single and bool(re.search(parts, each.topic.lower()))
        else:
            is_like = bool(defined.search(each.msgdef.data))
        if is_like:
            topics[each.topic] = f'{each.topic} ({each.msgtype})'
    named = [topics[topic] for topic in sorted(topics)]
    if len(named) == 1:
        return [f'topic {named[0]} looks like a {quantity.words} and is not used: name it with '
                f'--context {quantity.key}:={min(topics)}']
    if named:
        return [f'topics {some(named)} look like a {quantity.words} and are not used: name '
                f'one with --context {quantity.key}:=TOPIC']
    pressures = bag.topics(_PRESSURE)
    if used is None and pressures and quantity.key == 'temperature':
        return [f'{listed("topic", pressures)} ({_PRESSURE}): a pressure is no temperature, and '
                'the bag has no other topic that looks like one']
    return []


# ----------------------------------------------------------------------------------- samples

def imu_samples(bag: Bag, topic: str, sensor: str, *, chosen: bool,
                context: Sequence[ContextTopic], notes: list[str]) -> Iterator[Recording]:
    """
    Yield the samples of an Imu topic in blocks; `sensor` and `chosen` are as in `imus_of`.

    A note about lost messages is added to `notes` at the end. A message that is damaged, contains
    NaN, or is from another sensor is an InputError.

    """
    tracks = {source.quantity.key: source.track() for source in context}
    parts: list[Recording] = []
    before = 0
    for block in bag.blocks(bag.connections(topic), BLOCK):
        messages = bag.joined(block, topic, before=before)
        columns, which = imus_of(messages, f'{bag.path}, {topic}', before, sensor, chosen=chosen)
        columns |= {key: np.interp(columns['time'], *track) for key, track in tracks.items()}
        samples = Recording(columns, before + np.arange(len(block)) + 1, 'm/s2', sensor)
        parts.append(samples if np.all(which) else samples.take(which))
        before += len(block)
        if sum(map(len, parts)) >= _ROWS:
            yield concatenated(parts)
            parts = []
    if parts:
        yield concatenated(parts)
    notes += bag.lost(topic, before)


# ---------------------------------------------------------------------------------- messages

def messages_of(path: Path, options: LogOptions, needs: Collection[str]) -> Generator[Any]:
    """
    Yield what a corrected copy of a bag needs: what is known first, the messages, the notes.

    The options are those of the Imu topic and of the context, of which only the `needs` of a
    calibration are read: InputError if one of them is not in the bag. Messages come in blocks,
    with the number of their connection, the time of receipt [ns] and the size of each, and their
    bytes.

    """
    from rosbags.rosbag2.metadata import dump_qos_v9

    with open_bag(path) as bag:
        topic = bag.imu_topic(options.topic)
        sensor = bag.frame_id(topic)
        used, notes = context_of(bag, topic, sensor, options)
        topics, tracks = {source.quantity: source for source in used}, dict[str, Floats]()
        for quantity in dict.fromkeys([*QUANTITIES, *topics]):
            if quantity.key not in needs:
                continue
            if quantity not in topics:
                raise InputError(f'{bag.path} has no {quantity.words} in a topic that is used'
                                 f'{"".join(f"; {line}" for line in notes)}, but the calibration '
                                 f'depends on the {quantity.words}', 'name the topic with '
                                 f'--context {quantity.key}:=TOPIC, or use a calibration without '
                                 'it')
            track = tracks[quantity.key] = topics[quantity].track()
            if np.isnan(track[1, 0]):
                raise InputError(f'{bag.path}: {topics[quantity].topic} has no finite number, '
                                 f'expected the {quantity.words}', 'name another topic')
        connections = bag.reader.connections
        number = {id(each): k for k, each in enumerate(connections)}
        imu = [number[id(each)] for each in bag.connections(topic)]
        yield {'topic': topic, 'sensor': sensor, 'count': bag.count(topic), 'imu': imu,
               'tracks': tracks,
               'compression': getattr(bag.reader, 'compression_mode', None),
               'connections': [{
                   'topic': each.topic, 'msgtype': each.msgtype, 'msgdef': each.msgdef.data,
                   'digest': each.digest, 'ext': [
                       dump_qos_v9(part) if isinstance(part, list) else part for part in each.ext]
               } for each in connections]}
        found = 0
        for block in bag.blocks():
            which = np.array([number[id(connection)] for connection, _, _ in block])
            found += int(np.count_nonzero(np.isin(which, imu)))
            yield {'connection': which, 'stamp': np.array([stamp for _, stamp, _ in block]),
                   'size': np.array([len(raw) for _, _, raw in block]),
                   'data': np.frombuffer(b''.join(raw for _, _, raw in block), np.uint8)}
        yield [*bag.notes, *(notes if tracks else ()), *bag.lost(topic, found)]
