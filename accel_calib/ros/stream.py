# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Processing of Imu messages, from imu/data_raw to imu/data_calibrated, and of their context.

Messages remain serialized. Each message is corrected and published at once. The session receives
several messages as one array later, which is cheaper. The array is made after one message and
processed after the next, so that neither delays a message of a fast sensor. A message in another
encoding (byte order) is serialized again in the usual encoding and then processed in the same way.

"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
import math
import operator
import re
from time import monotonic
from typing import Any

import numpy as np
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import Imu

from .declare import published_by_others, SENSOR
from ..errors import AccelCalibError, InputError
from ..logs import (
    ACCELERATION, field_of, IMU_DOUBLES, joined, Layout, layout_of, LITTLE_ENDIAN, NAME_AT,
    named_topics, NO_QUANTITIES, THREE, topic_and_field)
from ..messages import motion_of, output_frame, Rewriter, Triple
from ..session import Around, BATCH, CalibratorSettings, columns_of, Session
from ..table import Floats
from ..text import some

_MANY = 30
"""Number of messages from which their array is made and processed after different messages."""

_NO_LAYOUT = Layout(b'', 0, -1)
_NO_BIAS = np.zeros(3)


@dataclass(eq=False)
class Output:
    """A publisher of corrected messages, with the correction, and what that is `made_for`."""

    publisher: Any
    listeners: int = 0
    rewriter: Rewriter | None = None
    made_for: tuple[object, ...] = (None,) * 4


_WITH_A_NUMBER = tuple(f'{package}/msg/{name}' for package, names in (
    ('sensor_msgs', ('BatteryState', 'FluidPressure', 'Temperature')),
    ('std_msgs', ('Float32', 'Float64'))) for name in names)
"""Types whose topics are named to the user."""

_NUMBER = re.compile(r'(float|double|u?int)\d*')


def _fields_of(kind: Any, before: str = '') -> list[str]:
    """Return the fields of a type of messages that are single numbers, such as ``state.load``."""
    found = []
    for name, of_field in kind.get_fields_and_field_types().items():
        if _NUMBER.fullmatch(of_field):
            found.append(before + name)
        elif re.fullmatch(r'\w+/\w+', of_field) and (
                kind_of_field := of_field.replace('/', '/msg/')) not in NO_QUANTITIES:
            inner = _type_of(kind_of_field)
            found += [] if inner is None else _fields_of(inner, f'{before}{name}.')
    return found


def _type_of(name: str) -> Any:
    """Return the class of a type such as ``std_msgs/msg/Float64``; None if it is not installed."""
    package, _, kind = name.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), kind)
    except (ImportError, AttributeError):
        return None


class ContextTopics:
    """
    The topics of the parameter `context`, whose types come from the graph.

    InputError if the name of a topic is not valid.

    """

    def __init__(self, node: Node, settings: CalibratorSettings) -> None:
        self._node, self._waiting, self._missing = node, dict[str, str](), dict[str, str]()
        for column, asked in named_topics(settings.context).items():
            topic, _, field = asked.rpartition('/')  # a field within a field is no name
            whole, field = (topic, f'/{field}') if '.' in field and topic else (asked, '')
            try:
                validate_topic_name(whole)
            except InvalidTopicNameException as error:
                raise InputError(f'context has the topic {asked!r}, which is not a name: '
                                 f'{str(error).splitlines()[0]}', 'correct the entry') from error
            self._waiting[column] = node.resolve_topic_name(whole) + field

    def look(self, around: Around) -> dict[str, str]:
        """Subscribe to the topics that exist by now; return why a column does not arrive."""
        types = dict(self._node.get_topic_names_and_types()) if self._waiting else {}
        for column, asked in list(self._waiting.items()):
            topic, field = topic_and_field(asked, types)
            kinds = types.get(topic, [])
            names = ' and '.join(kinds).replace('/msg/', '/')  # as in the documentation of ROS
            kind = _type_of(kinds[0]) if len(kinds) == 1 else None
            numbers = [] if kind is None else _fields_of(kind)
            read = field_of(column, numbers, field)
            if not read:
                others = sorted({each for topics in published_by_others(self._node, _WITH_A_NUMBER)
                                 for each in topics})
                usable = f'; topics with a number: {", ".join(others)}' if others else ''
                have = f'the numbers {some(numbers)}' if numbers else 'no number that can be read'
                found = f'there is no topic {topic}: start its driver, or' if not kinds else (
                    f'{topic} has the type {names} with {have}, '
                    f'expected {field or "one, or its name after the topic"}:')
                self._missing[column] = f'{found} correct context, and restart the node{usable}'
                continue
            del self._waiting[column]
            value = operator.attrgetter(read)
            self._node.create_subscription(
                kind, topic, lambda message, column=column, value=value: around.take(
                    column, float(value(message))), SENSOR)
            self._missing[column] = f'nothing comes on {topic} ({names})'
        return self._missing


class Stream:
    """
    The messages of one sensor.

    The `publishers` are those of corrected messages, of those by an offered calibration, and of
    the acceleration without gravity. `on_events` is called after the session received samples.

    """

    def __init__(self, session: Session, publishers: Sequence[Any],
                 on_events: Callable[[], None]) -> None:
        self._session, self._on_events = session, on_events
        self._columns = columns_of(session.state.settings)
        self._outputs = [Output(publisher) for publisher in publishers]
        self._calibrated, self._preview, self._motion = self._outputs
        self._layout = _NO_LAYOUT
        self._newest = b''
        self._waiting: list[bytes] = []
        self._contexts: list[Mapping[str, float]] = []
        self._collected: tuple[Floats, float] | None = None  # and when the newest one arrived
        self._due = self._arrived = 0.0
        self._listened = False
        self._state = session.state  # for which the outputs are prepared

    @property
    def newest(self) -> Triple | None:
        """Return the newest reading; None before the first one."""
        if not self._newest:
            return None
        x, y, z = THREE.unpack_from(self._newest, self._layout.place(ACCELERATION))
        return x, y, z

    def on_message(self, data: bytes) -> None:
        """Correct and publish a serialized Imu message."""
        now = monotonic()
        due = now >= self._due
        layout = self._layout
        if (len(data) != layout.size or data[:4] != LITTLE_ENDIAN
                or data[NAME_AT:layout.name_end] != layout.name):
            usual = self._adopt(data)
            if usual is None:
                self._on_events()
                return
            data = usual
        if due or self._session.state is not self._state:
            self._prepare()
        if self._listened:
            self._send(data)
        self._newest = data
        self._waiting.append(data)
        self._contexts.append(self._state.around.values)
        self._arrived = now
        if due:
            self._due = now + BATCH
            if len(self._waiting) < _MANY:
                self.flush()
            else:
                self._collect()
        elif self._collected is not None:
            self._pass_on()

    def _prepare(self) -> None:
        """Count the subscribers of the outputs, and prepare the corrections for them."""
        state = self._state = self._session.state
        settings, sensor, layout = state.settings, state.sensor, self._layout
        gyro, noise = sensor.gyro if settings.gyro_bias else None, (
            sensor.noise if settings.fill_covariance else None)
        bias = _NO_BIAS if gyro is None else gyro.at(state.around.temperature)
        for output, calibration in zip(self._outputs, (sensor.calibration, sensor.offered, None)):
            output.listeners = output.publisher.get_subscription_count()
            made_for = layout, calibration, settings, noise is None
            if not all(map(operator.is_, made_for, output.made_for)):
                turned = calibration and state.on_topics(calibration)
                output.made_for, output.rewriter = made_for, None if turned is None else Rewriter(
                    layout, turned, settings.gravity, output_frame(
                        turned, layout.frame_id, settings.output_frame_id), noise=noise,
                    thermal=sensor.temperatures.stream(turned.model))
            if output.rewriter is not None:
                output.rewriter.bias = tuple(bias.tolist())
        self._listened = state.is_active and any(output.listeners for output in self._outputs)

    def _adopt(self, data: bytes) -> bytes | None:
        """Return a message with a new layout as usual; None: not readable, or another sensor."""
        layout = layout_of(data)
        if layout is None:  # not in the usual encoding
            with suppress(Exception):  # each middleware has its own errors
                data = bytes(serialize_message(deserialize_message(data, Imu)))
                layout = layout_of(data)
        if layout is None:
            self._session.drop('not_finite', 'warning', f'an Imu message of {len(data)} bytes '
                               'cannot be read; it is dropped: check the driver')
            return None
        if layout != self._layout:
            self.flush()
            if not self._session.accepts(layout.frame_id):
                return None
            self._layout = layout
            self._prepare()
        return data

    def _send(self, data: bytes) -> None:
        """Publish the corrected message, or the raw message if so configured."""
        state, sensor = self._state, self._state.sensor
        if state.files.problem:
            return  # another node uses the files
        if sensor.offered is not None and self._preview.listeners:
            self._rewrite(data, self._preview)
        if not state.enabled or (sensor.calibration is None and state.settings.passthrough):
            if math.isfinite(sum(THREE.unpack_from(data, self._layout.place(ACCELERATION)))):
                self._calibrated.publisher.publish(data)
        elif self._calibrated.listeners or self._motion.listeners:
            self._rewrite(data, self._calibrated)

    def _rewrite(self, data: bytes, output: Output) -> None:
        """Publish the corrected message, and the acceleration without gravity."""
        rewriter = output.rewriter
        if rewriter is None:
            return
        try:
            corrected = rewriter(data, self._state.around.filled)
        except AccelCalibError as error:
            self._session.drop('implausible', 'error', f'messages are not corrected: {error}')
            return
        if corrected is None:
            return
        if output.listeners:
            output.publisher.publish(corrected)
        gravity = self._state.gravity
        if self._motion.listeners and gravity is not None and output is self._calibrated:
            self._motion.publisher.publish(motion_of(corrected, rewriter.layout, gravity))

    def flush_if_due(self) -> None:
        """Pass the waiting messages to the session, unless the next message does it in time."""
        if monotonic() >= self._due:
            self.flush()

    def flush(self) -> None:
        """Pass the waiting messages to the session."""
        self._collect()
        self._pass_on()

    def _collect(self) -> None:
        """Make the array of the waiting messages, after that before it has been passed on."""
        self._pass_on()
        if self._waiting:
            messages, self._waiting = self._waiting, []
            contexts, self._contexts = self._contexts, []
            found = joined(messages, IMU_DOUBLES, 'imu/data_raw').columns
            runs = [(known, len([*same])) for known, same in groupby(contexts)]
            around = np.repeat([[known.get(column, math.nan) for column in self._columns]
                                for known, _ in runs], [count for _, count in runs], axis=0)
            rows = np.column_stack([found['time'], found['reading'], found['rate'], around])
            self._collected = rows, self._arrived

    def _pass_on(self) -> None:
        """Pass the array to the session."""
        if self._collected is not None:
            collected, self._collected = self._collected, None
            self._session.push(*collected)
            self._on_events()
