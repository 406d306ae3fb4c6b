# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The stream of a calibrator node: from imu/data_raw to imu/data_calibrated.

Messages come and go serialized. Each is corrected and published at once, and what the watch makes
of it comes after: messages wait for that until `_TOGETHER` has passed, and are then taken in as
one array, for that is cheaper and is never in the way of a message. Messages that are not what
`serialized` reads (another byte order, another encoding), and all of them where rclpy gives no
serialized ones, go the long way through a typed message, with the same result.

"""

from __future__ import annotations

import math
from time import monotonic
from typing import TYPE_CHECKING

from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu
from std_msgs.msg import Bool

from . import conversion
from .context import context_of_message
from .rewriter import Rewriter
from .serialized import (
    are_finite,
    is_finite,
    Layout,
    layout_of,
    LITTLE_ENDIAN,
    motion_of,
    NAME_AT,
    rows_of,
)
from ..errors import AccelCalibError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .calibrator_node import CalibratorNode
    from .settings import CalibratorSettings
    from .watch import Watch
    from ..calibrate import Calibration
    from ..effects import Context
    from ..table import Floats

_TOGETHER = 0.3
"""
So long messages wait to be taken in by the watch [s]; listeners are counted as often.

Taking in is some ms on a slow machine, and the message that comes meanwhile waits: at 3 a second
that is less than 1 in 100 from 1 kHz on.

"""

_SAY_AGAIN = 10.0
"""A line about the stream is logged at most once in this time [s]."""

_NO_RATE = (math.nan, math.nan, math.nan)
_NO_LAYOUT = Layout(b'', 0, 0, -1)


class Stream:
    """
    Messages of a calibrator node.

    Parameters
    ----------
    node : CalibratorNode
        Whose stream this is.
    watch : Watch
        What looks at the samples; of no other's concern, for messages may be waiting for it.

    """

    def __init__(self, node: CalibratorNode, watch: Watch) -> None:
        self._node = node
        self._watch = watch
        self._layout = _NO_LAYOUT
        self._waiting: list[tuple[bytes, float]] = []
        self._due = 0.0
        self._temperature = math.nan
        self._listeners = self._motion_listeners = 0
        self._rewriter: Rewriter | None = None
        self._calibration: Calibration | None = None
        self._settings: CalibratorSettings | None = None
        self._still = False

    @property
    def watch(self) -> Watch:
        """Give the watch with all messages so far taken in."""
        self.take_in()
        return self._watch

    def heat(self, temperature: float) -> None:
        """Take the temperature [°C] of the messages that follow."""
        self._temperature = temperature

    def on_serialized(self, data: bytes) -> None:
        """Take a serialized Imu."""
        now = monotonic()
        due = now >= self._due
        if due:
            self._count_listeners()
        layout = self._layout
        try:
            if (data[:4] != LITTLE_ENDIAN or data[NAME_AT:layout.name_end] != layout.name
                    or len(data) != layout.size):
                found = layout_of(data)
                if found is None:
                    self._on_odd(data)
                    return
                self._adopt(found)
            if self._listeners or self._motion_listeners:
                self._send(data)
            self._waiting.append((data, self._temperature))
            if due:
                self._due = now + _TOGETHER
                self.take_in()
        except RuntimeError:
            if self._node.context.ok():
                raise  # otherwise it was publishing while a signal came

    def _count_listeners(self) -> None:
        """See who listens: what nobody listens to is not made."""
        self._listeners = self._node.calibrated.get_subscription_count()
        self._motion_listeners = self._node.motion.get_subscription_count()

    def _adopt(self, layout: Layout) -> None:
        """Go on with messages of another layout."""
        self.take_in()
        self._layout = layout
        self._settings = None
        self._node.identify(layout.frame_id)

    def _send(self, data: bytes) -> None:
        """Publish the corrected message, or the raw one where that is asked for."""
        node = self._node
        applied, settings = node.applied, node.settings
        if not applied.enabled or (applied.calibration is None and settings.passthrough):
            if is_finite(data, self._layout):
                node.calibrated.publish(data)
            return
        if applied.calibration is not self._calibration or settings is not self._settings:
            self._calibration, self._settings = applied.calibration, settings
            self._rewriter = None if applied.calibration is None else Rewriter(
                self._layout, applied.calibration, applied.scale, settings.output_frame_id)
        if self._rewriter is not None:
            self._rewrite(data, self._rewriter)

    def _rewrite(self, data: bytes, rewriter: Rewriter) -> None:
        """Publish the corrected message, and its motion."""
        try:
            corrected = rewriter(data, self._temperature)
        except AccelCalibError as error:
            self._say_why_not(error)
            return
        if corrected is None:
            return
        if self._listeners:
            self._node.calibrated.publish(corrected)
        gravity = self._node.applied.gravity
        if self._motion_listeners and gravity is not None:
            self._node.motion.publish(motion_of(corrected, rewriter.layout, gravity))

    def _say_why_not(self, error: AccelCalibError) -> None:
        self._node.get_logger().error(f'messages are not corrected: {error}',
                                      throttle_duration_sec=_SAY_AGAIN)

    def take_in(self) -> None:
        """Have the watch look at the messages that wait for it."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        messages, temperatures = zip(*waiting)
        rows = rows_of(messages, self._layout, temperatures)
        good = are_finite(rows[:, 1:4])
        if not np.all(good):
            for reading in rows[~good, 1:4].tolist():
                self._drop(reading)
            rows = rows[good]
        if len(rows):
            self._look_at(rows)

    def _look_at(self, rows: Floats) -> None:
        """Have the watch look at samples, and act on what it saw."""
        node = self._node
        node.vitals.good(float(rows[-1, 0]), tuple(rows[-1, 1:4].tolist()), len(rows))
        changes = self._watch.push_block(rows, node.settings.auto_capture)
        if self._watch.detector.still is not self._still:
            self._still = not self._still
            node.still.publish(Bool(data=self._still))
        for change in changes:
            node.note(change)

    def _drop(self, reading: Sequence[float]) -> None:
        self._node.vitals.bad()
        self._node.get_logger().warning(
            f'an Imu has the linear_acceleration {tuple(reading)}, expected three finite numbers; '
            'it is dropped: look at the driver', throttle_duration_sec=_SAY_AGAIN)

    def _on_odd(self, data: bytes) -> None:
        """Take a serialized message that is not as it commonly is."""
        try:
            message = deserialize_message(data, Imu)
        except Exception as error:  # each middleware has its own
            self._node.vitals.bad()
            self._node.get_logger().warning(
                f'an Imu of {len(data)} bytes cannot be read ({error}); it is dropped: look at '
                'the driver', throttle_duration_sec=_SAY_AGAIN)
            return
        self.on_message(message)

    def on_message(self, message: Imu) -> None:
        """Take an Imu."""
        self.take_in()
        reading, rate = conversion.reading_of(message), conversion.rate_of(message)
        if not conversion.is_finite(reading):
            self._drop(reading)
            return
        self._node.identify(message.header.frame_id)
        self._send_message(message)
        row = (conversion.seconds(message.header), *reading, *(rate or _NO_RATE),
               self._temperature, math.nan)
        self._look_at(np.array([row]))

    def _send_message(self, message: Imu) -> None:
        """Publish the corrected message, or the raw one, as `_send` does."""
        node = self._node
        applied, settings = node.applied, node.settings
        if not applied.enabled or (applied.calibration is None and settings.passthrough):
            node.calibrated.publish(message)
        elif applied.calibration is not None:
            try:
                corrected = conversion.corrected_message(
                    message, applied.calibration, applied.scale, self._context_of(message),
                    settings.output_frame_id)
            except AccelCalibError as error:
                self._say_why_not(error)
                return
            node.calibrated.publish(corrected)
            self._send_motion(corrected)

    def _context_of(self, message: Imu) -> Context:
        """Give what the effects of the calibration in use need beside a message."""
        calibration = self._node.applied.calibration
        needs = () if calibration is None else calibration.model.needs
        return context_of_message(message, needs, self._node.message_context)

    def _send_motion(self, corrected: Imu) -> None:
        """Publish the acceleration without gravity, as the last rest had it."""
        gravity, motion = self._node.applied.gravity, self._node.motion
        if gravity is not None and motion.get_subscription_count():
            force = np.array(conversion.reading_of(corrected)) - gravity
            motion.publish(Vector3Stamped(header=corrected.header,
                                          vector=conversion.vector3(force)))
