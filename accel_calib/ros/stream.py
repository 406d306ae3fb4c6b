# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Processing of Imu messages, from imu/data_raw to imu/data_calibrated.

Messages remain serialized. Each message is corrected and published at once. The session receives
several messages as one array later, which is cheaper and does not delay a message. A message in
another encoding (byte order) is serialized again in the usual encoding and then processed in the
same way.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
import operator
from time import monotonic
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

from ..calibrate import Calibration
from ..errors import AccelCalibError
from ..logs import (
    ACCELERATION,
    IMU_DOUBLES,
    joined,
    Layout,
    layout_of,
    LITTLE_ENDIAN,
    NAME_AT,
    samples_of,
    THREE,
)
from ..messages.correction import motion_of, output_frame, output_scale, Rewriter
from ..messages.one_reading import Triple
from ..session import BATCH, CalibratorSettings, Session

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

    def count(self) -> None:
        """Count the subscribers."""
        self.listeners = self._publisher.get_subscription_count()

    def prepare(self, layout: Layout, calibration: Calibration | None, session: Session) -> None:
        """Prepare the correction of messages by this calibration, unless it is prepared."""
        settings, sensor = session.settings, session.sensor
        fills = settings.fill_covariance and sensor.noise is not None
        made_for = layout, calibration, settings, fills
        if self._made_for and all(map(operator.is_, made_for, self._made_for)):
            return
        self._made_for, self.rewriter = made_for, None
        if calibration is not None:
            frame_id = output_frame(calibration, layout.frame_id, settings.output_frame_id)
            self.rewriter = Rewriter(
                layout, calibration, output_scale(calibration, settings.gravity),
                settings.gravity, frame_id, sensor.noise if fills else None,
                sensor.temperatures.stream(calibration.model))


class Stream:
    """
    The messages of one sensor.

    Parameters
    ----------
    session : Session
        The session; it receives the samples and contains the calibration.
    publishers : sequence of 3 Publishers
        For corrected messages, those by an offered calibration, and the acceleration without
        gravity.
    on_events : callable
        Function that is called after the session received samples.

    """

    def __init__(self, session: Session, publishers: Sequence[Any],
                 on_events: Callable[[], None]) -> None:
        self._session, self._on_events = session, on_events
        self._outputs = [Output(publisher) for publisher in publishers]
        self._calibrated, self._preview, self._motion = self._outputs
        self._layout = _NO_LAYOUT
        self._waiting: list[bytes] = []
        self._temperatures: list[float] = []
        self._due = self._arrived = 0.0
        self._temperature = math.nan
        self._listened = False
        self._applied: Calibration | None = None
        self._offered: Calibration | None = None
        self._settings: CalibratorSettings | None = None
        self._active = True

    def set_active(self, *, active: bool) -> None:
        """Start or stop publishing."""
        self._active = active
        self._prepare()

    def set_temperature(self, temperature: float) -> None:
        """Set the temperature of the following messages [°C]; NaN is ignored."""
        if math.isfinite(temperature):
            self._temperature = temperature
            self._session.statistics.temperature = temperature

    @property
    def newest(self) -> Triple | None:
        """Return the newest reading, unless the session has it already."""
        if not self._waiting:
            return None
        x, y, z = THREE.unpack_from(self._waiting[-1], self._layout.place(ACCELERATION))
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
        self._waiting.append(data)
        self._temperatures.append(self._temperature)
        self._arrived = now
        if due:
            self._due = now + BATCH
            self.flush()

    def _prepare(self) -> None:
        """Count the subscribers, and prepare the corrections."""
        session = self._session
        self._applied, self._offered = session.sensor.applied, session.sensor.offered
        self._settings = session.settings
        for output in self._outputs:
            output.count()
        self._listened = self._active and any(output.listeners for output in self._outputs)
        gyro = session.sensor.gyro if session.settings.gyro_bias else None
        bias = _NO_BIAS if gyro is None else gyro.at(self._temperature)
        for output, calibration in ((self._calibrated, self._applied),
                                    (self._preview, session.sensor.previewed)):
            output.prepare(self._layout, calibration, session)
            if output.rewriter is not None:
                output.rewriter.bias = tuple(bias.tolist())

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
            corrected = rewriter(data, self._temperature)
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

    def flush(self) -> None:
        """Pass the waiting messages to the session."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            temperatures, self._temperatures = self._temperatures, []
            found = samples_of(joined(waiting, IMU_DOUBLES, 'imu/data_raw'))
            rows = np.full((len(waiting), 9), np.nan)
            rows[:, 0], rows[:, 1:4] = found['time'], found['reading']
            rows[:, 4:7], rows[:, 7] = found['rate'], temperatures
            self._session.push(rows, self._arrived)
        self._on_events()


def _usual(data: bytes) -> bytes:
    """Return an Imu message in the usual encoding; empty if the middleware cannot read it."""
    try:
        return bytes(serialize_message(deserialize_message(data, Imu)))
    except Exception:  # each middleware has its own errors; the caller reports the message
        return b''
