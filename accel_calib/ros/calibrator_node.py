# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator node: Imu in, corrected Imu out, poses on the way.

The stream is in `stream`; what services do in `commands`. Header stamps are the clock of all that
is measured, so that a bag or a simulation may run at any speed; only the diagnostics go by a
steady clock, and come without ``/clock`` too.

"""

from __future__ import annotations

import math
from typing import Any, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool
from visualization_msgs.msg import MarkerArray

from . import qos
from .applied import Applied
from .commands import Commands
from .declare import declared, follow
from .fitting import title
from .health import status_of
from .settings import CalibratorSettings, capture_settings
from .storage import load, Loaded, Store, store_of
from .stream import Stream
from .vitals import Vitals
from .watch import Change, Watch
from .worker import Worker
from ..calibrate.watching import told
from ..units import units_of

if TYPE_CHECKING:
    from concurrent.futures import Future

    from ..calibrate import Calibration


class CalibratorNode(Node):
    """Calibrate an accelerometer in place and correct what it says."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        self.settings = declared(self, CalibratorSettings)
        follow(self, lambda: self.settings, self._set_settings)
        self.units = units_of(self.settings.units, self.settings.gravity)
        self.applied = Applied(self.settings.gravity)
        self.worker = Worker(self)
        self.store: Store | None = None
        self.sensor = self.settings.sensor
        self.frame_id = ''
        self.problem = ''
        self.message_context: dict[str, Any] = {}
        self._known = False
        self.vitals = Vitals(self.units.per_g if self.units.name != 'native' else math.nan)
        self._publish_all()
        self.stream = Stream(self, Watch(capture_settings(self.settings), self.units))
        self.commands = Commands(self)
        if self.sensor or self.settings.calibration_file:
            self.store = store_of(self.settings.calibration_file, self.sensor)
            self._take_up(load(self.store, self.sensor, self.units.name))

    def start(self) -> None:
        """Begin, once there is an executor."""
        self.commands.view.show(store=False)
        self._subscribe_all()

    @property
    def watch(self) -> Watch:
        """Give the watch, which has seen all messages so far."""
        return self.stream.watch

    def _publish_all(self) -> None:
        self.calibrated = self.create_publisher(Imu, 'imu/data_calibrated', qos.STREAM)
        self.motion = self.create_publisher(Vector3Stamped, '~/linear_acceleration', qos.STREAM)
        self.still = self.create_publisher(Bool, '~/still', qos.LATCHED)
        self.poses = self.create_publisher(MarkerArray, '~/poses', qos.LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.still.publish(Bool(data=False))

    def _subscribe_all(self) -> None:
        try:
            self.create_subscription(Imu, 'imu/data_raw', self.stream.on_serialized, qos.SENSOR,
                                     raw=True)
        except TypeError:  # an rclpy that gives no serialized messages
            self.create_subscription(Imu, 'imu/data_raw', self.stream.on_message, qos.SENSOR)
        self.create_subscription(Temperature, 'temperature', self._on_temperature, qos.SENSOR)
        self.create_timer(1.0, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _set_settings(self, settings: CalibratorSettings) -> None:
        self.settings = settings

    def adopt(self, calibration: Calibration | None) -> None:
        """Correct with this calibration from now on."""
        self.applied.adopt(calibration)
        self.problem = ''
        if calibration is not None:
            self.get_logger().info(f'correcting with {title(calibration)}')

    def _on_temperature(self, message: Temperature) -> None:
        if math.isfinite(message.temperature):
            self.stream.heat(message.temperature)
            self.vitals.temperature = message.temperature
            self.message_context = {'temperature': np.array([message.temperature])}

    def note(self, change: Change) -> None:
        """Act on a rest and on poses."""
        least, before = self.settings.drift_warn / self.settings.gravity, self.applied.departed
        if change.rest is not None:
            self.applied.rested(change.rest, least)
        for dwell in change.ended:
            self.applied.ended(dwell, least)
        if self.applied.standing is not None and self.applied.departed is not before:
            self.get_logger().warning(told(self.applied.standing))
        if change.taken_back:
            self.get_logger().info(f'taken back {change.taken_back} of the poses: the sensor was '
                                   'not still, as is known now')
        if change.poses:
            self.commands.poses_changed(ended=bool(change.ended))

    def identify(self, frame_id: str) -> None:
        """Learn from the first message which sensor this is."""
        if self._known:
            return
        self._known = True
        self.frame_id = frame_id
        self.sensor = self.settings.sensor or frame_id
        sensor, units = self.sensor, self.units.name
        store = self.store = self.store or store_of('', sensor)
        if not (self.settings.sensor or self.settings.calibration_file):
            self.worker.run(lambda: load(store, sensor, units), self._take_up_later)
        else:
            self.commands.check_sensor()

    def _take_up_later(self, done: Future[Loaded]) -> None:
        self._take_up(done.result())
        self.commands.view.show(store=False)

    def _take_up(self, loaded: Loaded) -> None:
        """Go on with what was stored."""
        if loaded.poses is not None:
            self.watch.book.take_up(loaded.poses)
            self.get_logger().info(f'{len(loaded.poses)} poses were stored before')
        if loaded.calibration is not None:
            self.adopt(loaded.calibration)
        self.problem = loaded.problem
        for line in filter(None, (loaded.problem, loaded.note)):
            self.get_logger().error(line)

    def _on_tick(self) -> None:
        """Publish the diagnostics."""
        self.vitals.tick()
        array = DiagnosticArray(status=[status_of(self.vitals.health(self))])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def close(self) -> None:
        """Finish what is being written."""
        self.worker.close()
