# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator node: it converts messages, calls the session, and publishes its events.

`accel_calib.session` contains the state, and `stream` processes Imu messages. Diagnostics use a
steady clock, so they are also published without ``/clock``. `Calibrator` is the same for the plain
node and for the managed node (`managed_node`).

"""

from __future__ import annotations

from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from . import qos
from .declare import declared, follow
from .display import pose_markers, progress_of, self_test_of, statuses_of
from .page import Page
from .services import in_executor, Services
from .stream import Stream
from .transforms import MountingBroadcaster, watch_static
from ..messages.correction import output_frame
from ..session import (
    CalibratorSettings,
    Event,
    Log,
    LogFilter,
    Mounting,
    Session,
    ShowPoses,
    state,
    Still,
    Task,
)
from ..session.worker import Worker

_TRIGGERS = ('capture_pose', 'undo_pose', 'fit', 'refine', 'set_level', 'set_heading',
             'calibrate_at_rest', 'save', 'load', 'undo', 'reset')
"""Services that are commands of the session."""

_PROGRESS_EVERY = 0.25
"""Shortest time between two messages of ~/progress without a new pose [s]."""


class CalibratorNode(Node):
    """Calibrate an accelerometer in place and correct its messages."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        self._calibrator = Calibrator(self)

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._calibrator.start()

    def close(self) -> None:
        """Finish writing, and release the files."""
        self._calibrator.close()


class Calibrator:
    """
    The topics, services and parameters of a calibrator in a node.

    Parameters
    ----------
    node : Node
        The node.

    Raises
    ------
    InputError
        If a parameter does not accept its value, or the settings contradict each other.

    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._topic = node.resolve_topic_name('imu/data_raw')
        settings = declared(node, CalibratorSettings)
        self._broadcaster = MountingBroadcaster(node) if settings.publish_tf else None
        self._transforms = (watch_static(node, self._on_transforms) if settings.base_frame
                            else None)
        self.session = Session(settings, self._topic)  # last, because it locks the files
        self._followed = follow(node, lambda: self.session.settings, self.session.set_settings)
        call_soon = in_executor(node)
        self._worker = Worker(call_soon, self._handle_events,
                              lambda words: self._log(Log('error', words)))
        self._filter = LogFilter()
        self._progress_at = 0.0
        self._still = node.create_publisher(Bool, '~/still', qos.LATCHED)
        self._poses = node.create_publisher(MarkerArray, '~/poses', qos.LATCHED)
        self._progress = node.create_publisher(DiagnosticStatus, '~/progress', qos.LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._overrides = QoSOverridingOptions.with_default_policies()
        outputs = (self._published(Imu, 'imu/data_calibrated'), self._published(Imu, '~/preview'),
                   self._published(Vector3Stamped, '~/linear_acceleration'))
        self.stream = Stream(self.session, *outputs, self._handle_events)
        self._heard: list[Any] = []
        self._said = [*outputs, self._still, self._poses, self._progress, self._diagnostics]
        self._page = Page(node, self.session, self.stream, self._worker, call_soon, self._log)
        self._still.publish(Bool(data=False))
        self._serve()

    def _published(self, kind: Any, topic: str) -> Any:
        return self._node.create_publisher(kind, topic, qos.STREAM,
                                           qos_overriding_options=self._overrides)

    def _serve(self) -> None:
        services = Services(self._node, self._worker, self._log)
        for name in _TRIGGERS:
            services.serve(name, self._command(name))
        self._node.create_service(SetBool, '~/enable', self._on_enable)
        self._node.create_service(SelfTest, '~/self_test', self._on_self_test)

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._handle_events()
        node, overrides = self._node, self._overrides
        self._heard = [
            node.create_subscription(Imu, 'imu/data_raw', self.stream.on_message, qos.SENSOR,
                                     raw=True, qos_overriding_options=overrides),
            node.create_subscription(Temperature, 'temperature', self._on_temperature, qos.SENSOR,
                                     qos_overriding_options=overrides)]
        node.create_timer(1.0, self._on_tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._page.start()

    def _command(self, name: str) -> Any:
        """Return a command of the session that first processes all messages so far."""
        command = getattr(self.session.commands, name)

        def call() -> Task:
            self.stream.flush()
            return (yield from command())

        return call

    def _on_temperature(self, message: Temperature) -> None:
        self.stream.set_temperature(message.temperature)

    def _on_transforms(self) -> None:
        """Take the mounting from the static transforms, as soon as they connect the frames."""
        session = self.session
        if self._transforms is None or not session.frame_id:
            return
        rotation = self._transforms.rotation(session.settings.base_frame, session.frame_id)
        if rotation is not None:
            session.set_mounting(rotation.T)

    def _on_tick(self) -> None:
        """Publish the diagnostics."""
        self.session.publishers = tuple(
            map(qos.name_of, self._node.get_publishers_info_by_topic(self._topic)))
        self.session.mismatches = qos.mismatches(self._node, self._heard, self._said)
        self.stream.flush()
        self.session.tick()
        self._on_transforms()
        self._handle_events()
        health = state.health(self.session)
        array = DiagnosticArray(status=statuses_of(health, self._name))
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(array)
        self._page.show_state(health)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        response.success, response.message = True, self.session.commands.enable(request.data)
        return response

    def _on_self_test(self, request: SelfTest.Request, response: SelfTest.Response) -> Any:
        self.stream.flush()
        health = state.health(self.session)
        response.id = health.sensor
        response.status = self_test_of(health, self._name)
        passed = all(status.level == b'\x00' for status in response.status)
        response.passed = b'\x01' if passed else b'\x00'
        return response

    def _handle_events(self) -> None:
        """Publish and log what the session reports."""
        shown = False
        for event in self.session.events():
            self._handle(event)
            shown |= isinstance(event, ShowPoses)
        due = monotonic() - self._progress_at >= _PROGRESS_EVERY
        if shown or (due and self._progress.get_subscription_count()):
            self._progress_at = monotonic()
            self._progress.publish(progress_of(state.progress(self.session), self._name,
                                               self.session.name))

    def _handle(self, event: Event) -> None:
        if isinstance(event, Log):
            self._log(event)
        elif isinstance(event, Still):
            self._still.publish(Bool(data=event.still))
        elif isinstance(event, ShowPoses):
            self._poses.publish(pose_markers(event.up, event.asked, event.frame_id))
            self._page.show_poses(event)
        elif isinstance(event, Mounting):
            self._broadcast(event)
        else:
            self._worker.run(event, lambda success, words: self._log(
                Log('info' if success else 'warning', words)))

    def _broadcast(self, event: Mounting) -> None:
        """Publish the levelled frame as a child of the frame of the sensor."""
        calibration = self.session.sensor.calibration
        if self._broadcaster is None or calibration is None or not event.frame_id:
            return
        child = output_frame(calibration, event.frame_id, self.session.settings.output_frame_id)
        self._broadcaster.publish(self._node.get_clock().now().to_msg(), event.frame_id, child,
                                  event.rotation)

    def _log(self, line: Log) -> None:
        if not self._filter.passes(line):
            return
        self._page.show_line(line)
        log = self._node.get_logger()  # rclpy needs a separate line of code for each severity
        if line.severity == 'error':
            log.error(line.words)
        elif line.severity == 'warning':
            log.warning(line.words)
        else:
            log.info(line.words)

    def close(self) -> None:
        """Finish writing, and release the files."""
        self._node.remove_on_set_parameters_callback(self._followed)
        self._page.close()
        self._worker.close()
        self.session.close()
