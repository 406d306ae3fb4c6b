# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator node: it converts messages, calls the session, and publishes its events.

`accel_calib.session` contains the state, and `stream` processes Imu messages. Diagnostics use a
steady clock, so they are also published without ``/clock``.

"""

from __future__ import annotations

from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from . import qos
from .declare import declared, follow
from .display import pose_markers, self_test_of, status_of
from .services import Services, Worker
from .stream import Stream
from ..session import CalibratorSettings, Event, Job, Log, Session, ShowPoses, Still

_TRIGGERS = ('capture_pose', 'undo_pose', 'fit', 'refine', 'set_level', 'set_heading', 'save',
             'load', 'reset')
"""Services that are methods of the session."""


class CalibratorNode(Node):
    """Calibrate an accelerometer in place and correct its messages."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        self.session = Session(declared(self, CalibratorSettings),
                               self.resolve_topic_name('imu/data_raw'))
        follow(self, lambda: self.session.settings, self._set_settings)
        self._worker = Worker(self, self._handle_events)
        self._last_logged: dict[str, float] = {}
        self._still = self.create_publisher(Bool, '~/still', qos.LATCHED)
        self._poses = self.create_publisher(MarkerArray, '~/poses', qos.LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.stream = Stream(
            self.session, self.create_publisher(Imu, 'imu/data_calibrated', qos.STREAM),
            self.create_publisher(Vector3Stamped, '~/linear_acceleration', qos.STREAM),
            self._handle_events)
        self._still.publish(Bool(data=False))
        services = Services(self, self._worker, self._handle_events)
        for name in _TRIGGERS:
            services.serve(name, self._command(name))
        self.create_service(SetBool, '~/enable', self._on_enable)
        self.create_service(SelfTest, '~/self_test', self._on_self_test)

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._handle_events()
        self.create_subscription(Imu, 'imu/data_raw', self._on_imu, qos.SENSOR, raw=True)
        self.create_subscription(Temperature, 'temperature', self._on_temperature, qos.SENSOR)
        self.create_timer(1.0, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _command(self, name: str) -> Any:
        """Return a command of the session that first processes all messages so far."""
        command = getattr(self.session, name)

        def call() -> str | Job:
            self.stream.flush()
            found: str | Job = command()
            return found

        return call

    def _set_settings(self, settings: CalibratorSettings) -> None:
        self.session.settings = settings

    def _on_imu(self, data: bytes) -> None:
        try:
            self.stream.on_message(data)
        except RuntimeError:
            if self.context.ok():
                raise  # otherwise a signal came during publishing

    def _on_temperature(self, message: Temperature) -> None:
        self.stream.set_temperature(message.temperature)

    def _on_tick(self) -> None:
        """Publish the diagnostics."""
        self.stream.flush()
        self.session.tick()
        self._handle_events()
        array = DiagnosticArray(status=[status_of(self.session.health())])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        response.success, response.message = True, self.session.enable(request.data)
        return response

    def _on_self_test(self, request: SelfTest.Request, response: SelfTest.Response) -> Any:
        self.stream.flush()
        health = self.session.health()
        response.id = health.sensor
        response.status = self_test_of(health)
        passed = all(status.level == b'\x00' for status in response.status)
        response.passed = b'\x01' if passed else b'\x00'
        return response

    def _handle_events(self) -> None:
        """Publish and log what the session reports."""
        for event in self.session.events():
            self._handle(event)

    def _handle(self, event: Event) -> None:
        if isinstance(event, Log):
            self._log(event)
        elif isinstance(event, Still):
            self._still.publish(Bool(data=event.still))
        elif isinstance(event, ShowPoses):
            self._poses.publish(pose_markers(event.up, event.asked, event.frame_id))
        else:
            self._worker.run(event, lambda success, words: self._log(
                Log('info' if success else 'warning', words)))

    def _log(self, line: Log) -> None:
        if not line.words:
            return
        if line.once_in:
            kind, now = line.words[:20], monotonic()
            if now - self._last_logged.get(kind, -line.once_in) < line.once_in:
                return
            self._last_logged[kind] = now
        log = self.get_logger()  # rclpy needs a separate line of code for each severity
        if line.severity == 'error':
            log.error(line.words)
        elif line.severity == 'warning':
            log.warning(line.words)
        else:
            log.info(line.words)

    def close(self) -> None:
        """Finish writing, and release the files."""
        self._worker.close()
        self.session.close()
