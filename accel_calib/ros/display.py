# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What a node shows: diagnostics, markers for rviz, and the live page.

The server of the page has its own thread. The executor of the node only makes the messages, and
runs the commands of the page as those of the services.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
import numpy as np
from rclpy.clock import Clock, ClockType
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..calibrate import NextPose
from ..errors import AccelCalibError
from ..live import check_installed
from ..session import (
    CalibratorSettings, CallSoon, Check, checks, figures, Level, Log, Progress, Session, ShowPoses,
    Worker, worst)
from ..table import Floats

if TYPE_CHECKING:
    from rclpy.node import Node

    from .stream import Stream
    from ..live.host import Exchange
    from ..live.server import PageServer


def diagnostics_of(session: Session, node: str) -> list[DiagnosticStatus]:
    """Return the state with all values, and one status for each concern."""
    found = checks(session)
    state = _status(worst(session, found), node, session.name)
    state.values = _values(figures(session))
    return [state, *(_status(check, node, session.name) for check in found)]


def self_test_of(session: Session, node: str) -> list[DiagnosticStatus]:
    """Return one status for each check; the test passes if all are OK."""
    return [_status(check, node, session.name) for check in checks(session)]


def progress_of(progress: Progress, node: str, sensor: str) -> DiagnosticStatus:
    """Return the progress of a calibration as a message."""
    return DiagnosticStatus(level=bytes([Level.OK]), name=f'{node}: progress', hardware_id=sensor,
                            message=progress.advice, values=_values(progress.figures()))


def _status(check: Check, node: str, sensor: str) -> DiagnosticStatus:
    return DiagnosticStatus(level=bytes([check.level]), name=f'{node}: {check.name}',
                            message=check.words, hardware_id=sensor)


def _values(named: Iterable[tuple[str, str]]) -> list[KeyValue]:
    return [KeyValue(key=key, value=value) for key, value in named]


_CAPTURED = (0.2, 0.7, 0.3, 1.0)
_ASKED_FOR = (1.0, 0.6, 0.0, 1.0)
_WORDS = (1.0, 1.0, 1.0, 1.0)
_SPHERE = (0.6, 0.6, 0.7, 0.15)
_NUMBER_AT, _WORDS_AT = 1.12, 1.35
_ABOVE = np.array([0.0, 0.0, _WORDS_AT])
_DOT, _LETTER, _SHAFT = 0.1, 0.1, 0.04


def pose_markers(directions: Floats, asked: NextPose, frame_id: str) -> MarkerArray:
    """
    Return markers of the captured poses and of the next pose; they replace all earlier markers.

    Parameters
    ----------
    directions : (n, 3) array
        Directions of up in the sensor axes, unit vectors.
    asked : NextPose
        The next pose, or that more poses no longer help.
    frame_id : str
        Frame of the sensor.

    """
    markers = [Marker(action=Marker.DELETEALL),
               _marker('sphere', 0, Marker.SPHERE, _SPHERE, 2.0)]
    for k, direction in enumerate(directions):
        markers.append(_at(_marker('poses', k, Marker.SPHERE, _CAPTURED, _DOT), direction))
        markers.append(_text('numbers', k, str(k + 1), direction * _NUMBER_AT))
    if asked.direction is None:
        markers.append(_text('next', 1, asked.words, _ABOVE))
    else:
        arrow = _marker('next', 0, Marker.ARROW, _ASKED_FOR, _SHAFT)
        arrow.points = [Point(), _point(asked.direction)]
        markers += [arrow, _text('next', 1, asked.words, asked.direction * _WORDS_AT)]
    for marker in markers:
        marker.header.frame_id = frame_id
    return MarkerArray(markers=markers)


def _marker(namespace: str, number: int, kind: int, color: tuple[float, ...],
            size: float) -> Marker:
    red, green, blue, alpha = color
    marker = Marker(ns=namespace, id=number, type=kind, action=Marker.ADD,
                    color=ColorRGBA(r=red, g=green, b=blue, a=alpha))
    marker.scale.x = marker.scale.y = marker.scale.z = size
    if kind == Marker.ARROW:
        marker.scale.y = marker.scale.z = 2.0 * size
    marker.pose.orientation.w = 1.0
    return marker


def _text(namespace: str, number: int, text: str, at: Floats) -> Marker:
    marker = _marker(namespace, number, Marker.TEXT_VIEW_FACING, _WORDS, _LETTER)
    marker.text = text
    return _at(marker, at)


def _at(marker: Marker, position: Floats) -> Marker:
    marker.pose.position = _point(position)
    return marker


def _point(position: Floats) -> Point:
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


class Page:
    """The live page of a node; it does nothing if the parameter ``web_port`` is 0."""

    def __init__(self, node: Node, session: Session, stream: Stream, worker: Worker,
                 call_soon: CallSoon, log: Callable[[Log], None]) -> None:
        self._node, self._session, self._stream = node, session, stream
        self._worker, self._call_soon, self._log = worker, call_soon, log
        self._exchange: Exchange | None = None
        self._server: PageServer | None = None

    def start(self) -> None:
        """Serve the page; if this is not possible, log why."""
        settings = self._session.settings
        if not settings.web_port:
            return
        try:
            self._serve(settings)
        except AccelCalibError as error:
            self._log(Log('error', str(error)))

    def _serve(self, settings: CalibratorSettings) -> None:
        """Serve the page."""
        check_installed()
        from ..live.host import Exchange
        from ..live.messages import PERIOD
        from ..live.server import PageServer
        exchange = Exchange(self._session, self._worker, self._call_soon, self._log,
                            self._stream.flush)
        server = PageServer(exchange, settings.web_host, settings.web_port)
        server.start()
        exchange.show, self._exchange, self._server = server.show, exchange, server
        self._log(Log('info', server.announce()))
        self._node.create_timer(PERIOD, self._show_progress,
                                clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _show_progress(self) -> None:
        if self._exchange is not None:
            self._exchange.show_progress(self._stream.newest)

    def show_state(self) -> None:
        """Show the state of the session."""
        if self._exchange is not None:
            self._exchange.show_state()

    def show_poses(self, event: ShowPoses) -> None:
        """Show the poses, and the state that may have changed with them."""
        if self._exchange is not None:
            self._exchange.show_poses(event)
            self._exchange.show_state()

    def show_line(self, line: Log) -> None:
        """Show a log line."""
        if self._exchange is not None:
            self._exchange.show_line(line)

    def close(self) -> None:
        """Stop serving."""
        if self._server is not None:
            self._exchange = None
            self._server.close()
