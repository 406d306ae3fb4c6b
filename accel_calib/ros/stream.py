# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Processing of Imu messages, from imu/data_raw to imu/data_calibrated, and of their context.

Messages remain serialized. Each message is corrected and published at once. The session receives
several messages as one array later, which is cheaper. The array is made after one message and
processed after the next, so that neither delays a message of a fast sensor. A message in another
encoding (byte order) is serialized again in the usual encoding and then processed in the same way.

"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
import math
import operator
from time import monotonic
from typing import Any, TYPE_CHECKING

import numpy as np
from rclpy.exceptions import InvalidTopicNameException
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.validate_topic_name import validate_topic_name
from sensor_msgs.msg import BatteryState, FluidPressure, Imu, Temperature
from std_msgs.msg import Float32, Float64

from .declare import published_by_others, SENSOR
from ..calibrate import Calibration
from ..errors import AccelCalibError, InputError
from ..logs import (
    ACCELERATION, IMU_DOUBLES, joined, Layout, layout_of, LITTLE_ENDIAN, NAME_AT, samples_of,
    THREE)
from ..messages.correction import motion_of, output_frame, Rewriter
from ..messages.one_reading import Triple
from ..session import BATCH, CalibratorSettings, columns_of, context_topics, Session
from ..table import Floats

if TYPE_CHECKING:
    from rclpy.node import Node

_MANY = 30
"""Number of messages from which their array is made and processed after different messages."""

_NO_LAYOUT = Layout(b'', 0, -1)
_NO_BIAS = np.zeros(3)


class Output:
    """A publisher of corrected messages, with the prepared correction, if it has listeners."""

    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher
        self.publish = publisher.publish
        self.listeners = 0
        self.rewriter: Rewriter | None = None
        self._made_for: tuple[object, ...] = ()

    def prepare(self, layout: Layout, calibration: Calibration | None, session: Session) -> None:
        """Count the subscribers, and prepare the correction by this calibration for them."""
        self.listeners = self._publisher.get_subscription_count()
        settings, sensor = session.settings, session.sensor
        fills = settings.fill_covariance and sensor.noise is not None
        made_for = layout, calibration, settings, fills
        if self._made_for and all(map(operator.is_, made_for, self._made_for)):
            return
        self._made_for, self.rewriter = made_for, None
        if calibration is not None:
            frame_id = output_frame(calibration, layout.frame_id, settings.output_frame_id)
            self.rewriter = Rewriter(layout, calibration, settings.gravity, frame_id,
                                     sensor.noise if fills else None,
                                     sensor.temperatures.stream(calibration.model))


_NUMBERS: dict[str, tuple[Any, tuple[str, ...]]] = {
    'sensor_msgs/msg/BatteryState': (BatteryState, ('voltage', 'current', 'temperature')),
    'sensor_msgs/msg/FluidPressure': (FluidPressure, ('fluid_pressure',)),
    'sensor_msgs/msg/Temperature': (Temperature, ('temperature',)),
    'std_msgs/msg/Float32': (Float32, ('data',)), 'std_msgs/msg/Float64': (Float64, ('data',))}
"""Types of context, with their fields: the first one, or one that the name of the column has."""


class ContextTopics:
    """
    The topics of the parameter `context`, whose types come from the graph.

    InputError if the name of a topic is not valid.

    """

    def __init__(self, node: Node, settings: CalibratorSettings) -> None:
        self._node, self._waiting = node, dict[str, str]()
        for column, topic in context_topics(settings).items():
            try:
                validate_topic_name(topic)
            except InvalidTopicNameException as error:
                raise InputError(f'context has the topic {topic!r}, which is not a name: '
                                 f'{str(error).splitlines()[0]}', 'correct the entry') from error
            self._waiting[column] = node.resolve_topic_name(topic)

    def look(self, session: Session) -> None:
        """Subscribe to the topics that exist by now, and note why others do not arrive."""
        types = dict(self._node.get_topic_names_and_types()) if self._waiting else {}
        for column, topic in list(self._waiting.items()):
            known = [name for name in types.get(topic, ()) if name in _NUMBERS]
            if known:
                del self._waiting[column]
                kind, fields = _NUMBERS[known[0]]
                field = next((each for each in fields if each in column), fields[0])
                self._node.create_subscription(
                    kind, topic, lambda message, column=column, field=field: session.around.take(
                        column, getattr(message, field)), SENSOR)
                session.missing[column] = f'nothing comes on {topic} ({_short(known[0])})'
            else:
                session.missing[column] = self._why(topic, types.get(topic, ()))

    def _why(self, topic: str, types: Sequence[str]) -> str:
        """Return why a topic cannot be used, and which ones can be."""
        others = sorted({each for topics in published_by_others(self._node, _NUMBERS)
                         for each in topics})
        usable = f'; topics with a number: {", ".join(others)}' if others else ''
        found = (f'{topic} has the type {" and ".join(map(_short, types))}, expected '
                 f'{", ".join(map(_short, _NUMBERS))}: ' if types else
                 f'there is no topic {topic}: start its driver, or ')
        return f'{found}correct context, and restart the node{usable}'


def _short(name: str) -> str:
    """Return the name of a type as in the documentation of ROS."""
    return name.replace('/msg/', '/')


class Stream:
    """
    The messages of one sensor.

    The `publishers` are those of corrected messages, of those by an offered calibration, and of
    the acceleration without gravity. `on_events` is called after the session received samples.

    """

    def __init__(self, session: Session, publishers: Sequence[Any],
                 on_events: Callable[[], None]) -> None:
        self._session, self._on_events = session, on_events
        self._columns = columns_of(session.settings)
        self._outputs = [Output(publisher) for publisher in publishers]
        self._calibrated, self._preview, self._motion = self._outputs
        self._layout = _NO_LAYOUT
        self._newest = b''
        self._waiting: list[bytes] = []
        self._contexts: list[Mapping[str, float]] = []
        self._collected: tuple[Floats, float] | None = None  # and when the newest one arrived
        self._due = self._arrived = 0.0
        self._listened = False
        self._applied: Calibration | None = None
        self._offered: Calibration | None = None
        self._settings: CalibratorSettings | None = None
        self._active = True

    def set_active(self, *, active: bool) -> None:
        """Start or stop publishing."""
        self._active = active
        self._prepare()

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
            usual = self._adopted(data)
            if usual is None:
                self._on_events()
                return
            data = usual
        session = self._session
        sensor = session.sensor
        if (due or sensor.applied is not self._applied or sensor.offered is not self._offered
                or session.settings is not self._settings):
            self._prepare()
        if self._listened:
            self._send(data)
        self._newest = data
        self._waiting.append(data)
        self._contexts.append(session.around.values)
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
        """Prepare the outputs."""
        session = self._session
        sensor, self._settings = session.sensor, session.settings
        self._applied, self._offered = sensor.applied, sensor.offered
        gyro = sensor.gyro if session.settings.gyro_bias else None
        bias = _NO_BIAS if gyro is None else gyro.at(session.around.temperature)
        for output, calibration in zip(self._outputs, (sensor.applied, sensor.previewed, None)):
            output.prepare(self._layout, calibration, session)
            if output.rewriter is not None:
                output.rewriter.bias = tuple(bias.tolist())
        self._listened = self._active and any(output.listeners for output in self._outputs)

    def _adopted(self, data: bytes) -> bytes | None:
        """Return a message with a new layout as usual; None: not readable, or another sensor."""
        layout = layout_of(data)
        if layout is None:
            data = _usual(data)
            layout = layout_of(data)
        if layout is None:
            self._session.reports.unreadable(len(data))
            return None
        if layout != self._layout:
            self.flush()
            if not self._session.accepts(layout.frame_id):
                return None
            self._layout, self._settings = layout, None  # the corrections are prepared again
        return data

    def _send(self, data: bytes) -> None:
        """Publish the corrected message, or the raw message if so configured."""
        session = self._session
        sensor = session.sensor
        if session.files.problem:
            return  # another node uses the files
        if sensor.offered is not None and self._preview.listeners:
            self._rewrite(data, self._preview)
        if not session.enabled or (sensor.calibration is None and session.settings.passthrough):
            if math.isfinite(sum(THREE.unpack_from(data, self._layout.place(ACCELERATION)))):
                self._calibrated.publish(data)
        elif self._calibrated.listeners or self._motion.listeners:
            self._rewrite(data, self._calibrated)

    def _rewrite(self, data: bytes, output: Output) -> None:
        """Publish the corrected message, and the acceleration without gravity."""
        rewriter = output.rewriter
        if rewriter is None:
            return
        try:
            corrected = rewriter(data, self._session.around.filled)
        except AccelCalibError as error:
            self._session.reports.uncorrected(error)
            return
        if corrected is None:
            return
        if output.listeners:
            output.publish(corrected)
        gravity = self._session.sensor.gravity
        if self._motion.listeners and gravity is not None and output is self._calibrated:
            self._motion.publish(motion_of(corrected, rewriter.layout, gravity))

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
            found = samples_of(joined(messages, IMU_DOUBLES, 'imu/data_raw'))
            rows = np.column_stack([found['time'], found['reading'], found['rate'],
                                    self._around(contexts)])
            self._collected = rows, self._arrived

    def _pass_on(self) -> None:
        """Pass the array to the session."""
        if self._collected is not None:
            collected, self._collected = self._collected, None
            self._session.push(*collected)
            self._on_events()

    def _around(self, contexts: Sequence[Mapping[str, float]]) -> Floats:
        """Return the columns of the context of each message, (n, k)."""
        runs = [(known, len([*same])) for known, same in groupby(contexts)]
        values = [[known.get(column, math.nan) for column in self._columns] for known, _ in runs]
        return np.repeat(values, [count for _, count in runs], axis=0)


def _usual(data: bytes) -> bytes:
    """Return an Imu message in the usual encoding; empty if the middleware cannot read it."""
    try:
        return bytes(serialize_message(deserialize_message(data, Imu)))
    except Exception:  # each middleware has its own errors; the caller reports the message
        return b''
