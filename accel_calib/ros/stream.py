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

from collections.abc import Callable
import math
from time import monotonic
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

from ..calibrate import Calibration
from ..errors import AccelCalibError
from ..messages.correction import motion_of, Rewriter
from ..messages.layout import (
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
from ..session import CalibratorSettings, Session

_TOGETHER = 0.3
"""
Batch interval of the session [s], and interval between counts of the subscribers.

A batch takes several ms on a slow machine, and messages that arrive in this time wait. At 1 kHz
and 3 batches per second, these are less than 1 % of the messages.

"""

_NO_LAYOUT = Layout(b'', 0, -1)


class Stream:
    """
    The messages of one sensor.

    Parameters
    ----------
    session : Session
        The session; it receives the samples and contains the calibration.
    calibrated, motion : Publisher
        Publishers of corrected messages, and of the acceleration without gravity.
    on_events : callable
        Function that is called after the session received samples.

    """

    def __init__(self, session: Session, calibrated: Any, motion: Any,
                 on_events: Callable[[], None]) -> None:
        self._session = session
        self._calibrated, self._motion = calibrated, motion
        self._on_events = on_events
        self._layout = _NO_LAYOUT
        self._waiting: list[bytes] = []
        self._temperatures: list[float] = []
        self._due = self._arrived = 0.0
        self._temperature = math.nan
        self._listeners = self._motion_listeners = 0
        self._rewriter: Rewriter | None = None
        self._calibration: Calibration | None = None
        self._settings: CalibratorSettings | None = None

    def set_temperature(self, temperature: float) -> None:
        """Set the temperature of the following messages [°C]; NaN is ignored."""
        if math.isfinite(temperature):
            self._temperature = temperature
            self._session.set_temperature(temperature)

    def on_message(self, data: bytes) -> None:
        """Correct and publish a serialized Imu message."""
        now = monotonic()
        due = now >= self._due
        if due:
            self._count_listeners()
        layout = self._layout
        if (len(data) != layout.size or data[:4] != LITTLE_ENDIAN
                or data[NAME_AT:layout.name_end] != layout.name):
            usual = self._adopted(data)
            if usual is None:
                self._on_events()
                return
            data = usual
        if self._listeners or self._motion_listeners:
            self._send(data)
        self._waiting.append(data)
        self._temperatures.append(self._temperature)
        self._arrived = now
        if due:
            self._due = now + _TOGETHER
            self.flush()

    def _count_listeners(self) -> None:
        """Count the subscribers; messages without subscribers are not computed."""
        self._listeners = self._calibrated.get_subscription_count()
        self._motion_listeners = self._motion.get_subscription_count()

    def _adopted(self, data: bytes) -> bytes | None:
        """
        Return a message with a new layout, in the usual encoding.

        The result is None if the message cannot be read, or is from another sensor.

        """
        layout = layout_of(data)
        if layout is None:
            data = _usual(data)
            layout = layout_of(data)
        if layout is None:
            self._session.drop_unreadable(len(data))
            return None
        if layout != self._layout:
            self.flush()
            if not self._session.accepts(layout.frame_id):
                return None
            self._layout, self._settings = layout, None
        return data

    def _send(self, data: bytes) -> None:
        """Publish the corrected message, or the raw message if so configured."""
        session = self._session
        active, settings = session.active, session.settings
        if not session.publishes:
            return
        if not active.enabled or (active.calibration is None and settings.passthrough):
            if math.isfinite(sum(THREE.unpack_from(data, self._layout.place(ACCELERATION)))):
                self._calibrated.publish(data)
            return
        if active.calibration is not self._calibration or settings is not self._settings:
            self._calibration, self._settings = active.calibration, settings
            self._rewriter = None if active.calibration is None else Rewriter(
                self._layout, active.calibration, active.scale, settings.gravity,
                settings.output_frame_id)
        if self._rewriter is not None:
            self._rewrite(data, self._rewriter)

    def _rewrite(self, data: bytes, rewriter: Rewriter) -> None:
        """Publish the corrected message, and the acceleration without gravity."""
        try:
            corrected = rewriter(data, self._temperature)
        except AccelCalibError as error:
            self._session.drop_corrected(error)
            return
        if corrected is None:
            return
        if self._listeners:
            self._calibrated.publish(corrected)
        gravity = self._session.active.gravity
        if self._motion_listeners and gravity is not None:
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
