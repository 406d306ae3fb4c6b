# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The calibrator node: it converts messages, calls the session, and publishes its events.

`Calibrator` is the same for the plain node and for the managed node, whose transitions are in
`run`. `accel_calib.session` contains the state, and `stream` processes Imu messages. Diagnostics
use a steady clock, so they are also published without ``/clock``.

**Services.** The response is sent when the task of a command is done, so that no callback waits.
For an error, it is ``success: false`` with the message of the error. This works with every
executor. Coroutines as service callbacks, which rclpy offers for this purpose, do not work with
EventsExecutor.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial, partialmethod
from queue import SimpleQueue
from time import monotonic
from traceback import format_exc
from typing import Any, TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from diagnostic_msgs.srv import SelfTest
from geometry_msgs.msg import Point, Vector3Stamped
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Imu, Temperature
from std_msgs.msg import Bool, ColorRGBA, String
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from .declare import (
    CALLS, declared, follow, LATCHED, mismatches, name_of, needs_tf2, published_by_others, SENSOR,
    static_transform, STREAM, TOPIC, watch_static)
from .stream import ContextTopics, Stream
from ..errors import AccelCalibError
from ..finding import LEVELS, NextStep
from ..live import check_installed
from ..logs import named_topics
from ..session import (
    CalibratorSettings, CallSoon, Check, COMMANDS, conditions, diagnostics, enable, Event, figures,
    Log, Mounting, next_step, progress, Result, run, Session, ShowPoses, Still, Surroundings, Task,
    Worker)
from ..table import Floats

if TYPE_CHECKING:
    from rclpy.lifecycle import LifecycleState

    from ..live.server import PageServer

_PROGRESS_EVERY = 0.25
"""Shortest time between two messages of ~/progress without a new pose [s]."""


_CAPTURED = (0.2, 0.7, 0.3, 1.0)
_ASKED_FOR = (1.0, 0.6, 0.0, 1.0)
_WORDS = (1.0, 1.0, 1.0, 1.0)
_SPHERE = (0.6, 0.6, 0.7, 0.15)
_NUMBER_AT, _WORDS_AT = 1.12, 1.35
_CENTRE, _ABOVE = np.zeros(3), (0.0, 0.0, 1.0)
_DOT, _LETTER, _SHAFT = 0.1, 0.1, 0.04


def pose_markers(directions: Floats, step: NextStep, frame_id: str) -> MarkerArray:
    """
    Return markers of the captured poses and of the next step; they replace all earlier markers.

    The (n, 3) directions of up are unit vectors in the sensor axes.

    """
    markers = [Marker(action=Marker.DELETEALL), _marker('sphere', 0, _SPHERE, 2.0)]
    for k, direction in enumerate(directions):
        markers += [_marker('poses', k, _CAPTURED, _DOT, direction),
                    _marker('numbers', k, _WORDS, _LETTER, direction * _NUMBER_AT,
                            text=str(k + 1))]
    up = np.array(step.direction or _ABOVE)
    if step.direction:
        arrow = _marker('next', 0, _ASKED_FOR, _SHAFT)
        arrow.type, arrow.scale.y, arrow.scale.z = Marker.ARROW, 2.0 * _SHAFT, 2.0 * _SHAFT
        arrow.points = [Point(), Point(**dict(zip('xyz', up.tolist())))]
        markers.append(arrow)
    markers.append(_marker('next', 1, _WORDS, _LETTER, up * _WORDS_AT, text=step.text))
    for marker in markers:
        marker.header.frame_id = frame_id
    return MarkerArray(markers=markers)


def _marker(namespace: str, number: int, color: tuple[float, ...], size: float,
            at: Floats = _CENTRE, *, text: str = '') -> Marker:
    """Return a sphere, or a text if it is not empty."""
    marker = Marker(ns=namespace, id=number, action=Marker.ADD, text=text,
                    type=Marker.TEXT_VIEW_FACING if text else Marker.SPHERE,
                    color=ColorRGBA(**dict(zip('rgba', color))))
    marker.scale.x = marker.scale.y = marker.scale.z = size
    marker.pose.position = Point(**dict(zip('xyz', at.tolist())))
    marker.pose.orientation.w = 1.0
    return marker


class Calibrator:
    """
    The topics, services and parameters of a calibrator in a node.

    InputError if a parameter does not accept its value, or the settings contradict each other.

    """

    def __init__(self, node: Node) -> None:
        self._node, self._steady = node, Clock(clock_type=ClockType.STEADY_TIME)
        self._name = node.get_fully_qualified_name().lstrip('/')
        self._topic = node.resolve_topic_name('imu/data_raw')
        settings = declared(node, CalibratorSettings)
        self._mounting = (node.create_publisher(needs_tf2('publish_tf'), TOPIC, LATCHED)
                          if settings.publish_tf else None)
        self._transforms = (watch_static(node, self._on_transforms) if settings.base_frame
                            else None)
        self._context = ContextTopics(node, settings)
        self.session = Session(settings, self._topic)  # last, because it locks the files
        self._followed = follow(node, lambda: self.session.state.settings,
                                self.session.set_settings)
        self._call_soon = in_executor(node)
        self._worker = Worker(self.session.events, self._call_soon, self._show,
                              lambda: self.stream.flush())
        self._progress_at = 0.0
        self._shown: ShowPoses | None = None
        self._drawn: tuple[NextStep, str] | None = None  # with the frame, of their last markers
        self._still = node.create_publisher(Bool, '~/still', LATCHED)
        self._poses = node.create_publisher(MarkerArray, '~/poses', LATCHED)
        self._progress = node.create_publisher(DiagnosticStatus, '~/progress', LATCHED)
        self._result = node.create_publisher(String, '~/result', LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._overrides = QoSOverridingOptions.with_default_policies()
        self.stream = Stream(self.session, [
            node.create_publisher(kind, topic, STREAM, qos_overriding_options=self._overrides)
            for kind, topic in ((Imu, 'imu/data_calibrated'), (Imu, '~/preview'),
                                (Vector3Stamped, '~/linear_acceleration'))], self._on_samples)
        self._page: PageServer | None = None
        self._still.publish(Bool(data=False))
        for name in COMMANDS:
            serve(node, name, partial(run, self.session, name), self._worker)
        node.create_service(SetBool, '~/enable', self._on_enable, qos_profile=CALLS)
        node.create_service(SelfTest, '~/self_test', self._on_self_test, qos_profile=CALLS)

    def start(self) -> None:
        """Start; to be called when the node has an executor."""
        self._worker.handle_events()
        node, overrides, settings = self._node, self._overrides, self.session.state.settings
        node.create_subscription(Imu, 'imu/data_raw', self.stream.on_message, SENSOR, raw=True,
                                 qos_overriding_options=overrides)
        if 'temperature' not in named_topics(settings.context):
            around = self.session.state.around
            node.create_subscription(
                Temperature, 'temperature',
                lambda message: around.take('temperature', message.temperature),
                SENSOR, qos_overriding_options=overrides)
        node.create_timer(1.0, self._on_tick, clock=self._steady)
        if not settings.web_port:
            return
        try:  # to serve the live page, in its own thread
            check_installed()
            from ..live.exchange import Exchange, PERIOD
            from ..live.server import PageServer
            exchange = Exchange(self.session, self._worker, self._call_soon)
            page = PageServer(exchange, settings.web_host, settings.web_port)
            page.start()
            self._page = page
            self._worker.log('info', page.announce())
            node.create_timer(PERIOD, lambda: exchange.show_progress(self.stream.newest),
                              clock=self._steady)
        except AccelCalibError as error:
            self._worker.log('error', str(error))

    def _on_transforms(self) -> None:
        """Take the mounting from the static transforms, as soon as they connect the frames."""
        state = self.session.state
        if self._transforms is not None and state.frame_id:
            rotation = self._transforms.rotation(state.settings.base_frame, state.frame_id)
            if rotation is not None:
                self.session.set_mounting(rotation.T)

    def _on_tick(self) -> None:
        node = self._node
        imus, thermometers = published_by_others(
            node, ('sensor_msgs/msg/Imu', 'sensor_msgs/msg/Temperature'))
        self.session.change(surroundings=Surroundings(
            tuple(map(name_of, node.get_publishers_info_by_topic(self._topic))), imus,
            thermometers, mismatches(node), self._context.look(self.session.state.around)))
        self.stream.flush_if_due()
        self.session.tick()
        self._on_transforms()
        self._on_samples()
        self._show_poses()
        if self._diagnostics.get_subscription_count():
            state = self.session.state
            first, *others = diagnostics(state)
            array = DiagnosticArray(status=[
                self._status(first, figures(state)), *map(self._status, others)])
            array.header.stamp = node.get_clock().now().to_msg()
            self._diagnostics.publish(array)
        if self._page is not None:
            self._page.exchange.show_state()

    def _status(self, check: Check, shown: Iterable[tuple[str, str]] = ()) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=bytes([LEVELS.index(check.level)]), name=f'{self._name}: {check.concern}',
            message=check.words, hardware_id=self.session.state.name,
            values=[KeyValue(key=key, value=value) for key, value in shown])

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        response.success, response.message = True, enable(self.session, request.data)
        return response

    def _on_self_test(self, request: SelfTest.Request, response: SelfTest.Response) -> Any:
        self.stream.flush()
        found = diagnostics(self.session.state)[1:]
        response.id, response.status = self.session.state.name, list(map(self._status, found))
        response.passed = bytes([all(each.level == LEVELS[0] for each in found)])
        return response

    def _on_samples(self) -> None:
        """Show what the samples caused, and the progress if it is due."""
        self._worker.handle_events()
        due = monotonic() - self._progress_at >= _PROGRESS_EVERY
        if due and self._progress.get_subscription_count():
            self._show_progress()

    def _show_progress(self) -> None:
        self._progress_at, now = monotonic(), self.session.state
        first = conditions(now)[0]
        self._progress.publish(self._status(
            Check('progress', first.text, first.level), progress(now).figures()))

    def _show_poses(self) -> None:
        """Publish new markers if somebody listens: to make them takes 5 ms."""
        poses, state = self._shown, self.session.state
        if poses is not None and self._poses.get_subscription_count() and (
                new := (next_step(state), state.frame_id or '')) != self._drawn:
            self._poses.publish(pose_markers(poses.up, *new))
            self._drawn = new

    def _show(self, event: Event) -> None:
        if self._page is not None:
            self._page.exchange.show_event(event)
        log = self._node.get_logger()
        match event:  # rclpy needs a separate line of code for each severity
            case Log('error', words):
                log.error(words)
            case Log('warning', words):
                log.warning(words)
            case Log(_, words):
                log.info(words)
            case Still(still):
                self._still.publish(Bool(data=still))
            case ShowPoses():
                self._shown, self._drawn = event, None
                self._show_poses()
                self._show_progress()
            case Result(text):
                self._result.publish(String(data=text))
            case Mounting(rotation, frame_id, levelled) if self._mounting is not None:
                self._mounting.publish(static_transform(
                    self._node.get_clock().now().to_msg(), frame_id, levelled, rotation))

    def close(self) -> None:
        """Finish writing, and release the files."""
        self._node.remove_on_set_parameters_callback(self._followed)
        if self._page is not None:
            self._page.close()
        self._worker.close()
        self.session.close()


def in_executor(node: Node) -> CallSoon:
    """Return a function that lets the executor of a node call functions, in their order."""
    waiting: SimpleQueue[Callable[[], object]] = SimpleQueue()

    def call_next() -> None:
        try:
            waiting.get()()
        except Exception:  # EventsExecutor crashes on an exception in a task (rclpy issue 1641)
            node.get_logger().error(f'unexpected error in accel_calib:\n{format_exc()}')

    def call_soon(function: Callable[[], object]) -> None:
        waiting.put(function)
        executor = node.executor
        if executor is not None:
            # The executor may run tasks in any order; the queue keeps their order.
            executor.create_task(call_next)

    return call_soon


def serve(node: Node, name: str, command: Callable[[], Task], worker: Worker) -> None:
    """Create the service ``~/name``, which responds the result of a command."""
    service = node.create_service(Trigger, f'~/{name}', lambda request, response: response,
                                  qos_profile=CALLS)
    send = service.send_response

    def send_response(response: Any, header: Any) -> None:
        worker.do(name, command(), lambda success, words: send(
            Trigger.Response(success=success, message=words), header))

    service.send_response = send_response


class CalibratorNode(Node):
    """Calibrate an accelerometer in place and correct its messages."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        calibrator = Calibrator(self)
        self.start, self.close = calibrator.start, calibrator.close


class ManagedCalibrator(LifecycleNode):
    """A calibrator whose states are those of a managed node."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        self._calibrator: Calibrator | None = None
        self._own = [*self.publishers, *self.subscriptions, *self.services, *self.timers]
        service = self._service_change_state
        self._change, service.callback = service.callback, self._on_change
        self._settings = CalibratorSettings()
        try:
            self._settings = declared(self, CalibratorSettings, fixed=False)
        except AccelCalibError as error:
            self.get_logger().error(f'{error}; set it before configuring')
        # The parameters of the next configuration are checked now.
        follow(self, lambda: self._settings, partial(setattr, self, '_settings'), runs=False)

    def start(self) -> None:
        """Do nothing: transitions start the calibrator."""

    def _on_change(self, request: Any, response: Any) -> Any:
        """Change the state; a transition that this state has not would end rclpy (issue 1209)."""
        with suppress(RuntimeError):  # rcl logs it
            return self._change(request, response)
        response.success = False
        return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, load the calibration and listen, without publishing."""
        try:
            self._calibrator = Calibrator(self)
        except AccelCalibError as error:
            self.get_logger().error(str(error))
            self.on_cleanup(state)
            return TransitionCallbackReturn.FAILURE
        self._calibrator.session.change(is_active=False)
        self._calibrator.start()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the files and remove all topics and services."""
        self.close()
        for kinds, destroy in ((self.publishers, self.destroy_publisher),
                               (self.subscriptions, self.destroy_subscription),
                               (self.services, self.destroy_service),
                               (self.timers, self.destroy_timer)):
            for each in list(kinds):
                if each not in self._own:
                    # The executor calls these for the events that it has already received.
                    each.callback = each.send_response = lambda *given: None
                    destroy(each)
        return TransitionCallbackReturn.SUCCESS

    on_shutdown = on_cleanup

    def _set_active(self, state: LifecycleState, *, active: bool) -> TransitionCallbackReturn:
        """Publish corrected messages, or stop it."""
        if self._calibrator is not None:
            self._calibrator.session.change(is_active=active)
        return TransitionCallbackReturn.SUCCESS

    on_activate = partialmethod(_set_active, active=True)
    on_deactivate = partialmethod(_set_active, active=False)

    def close(self) -> None:
        """Finish writing, and release the files."""
        if self._calibrator is not None:
            self._calibrator.close()
            self._calibrator = None
