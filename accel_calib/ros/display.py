# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Markers for rviz: captured poses and the next pose on the unit sphere.

**Diagnostics.** The state of the calibrator as diagnostic messages.

"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
import numpy as np
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from ..session import Check, checks, Health, worst
from ..session.health import figures, Level

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ..calibrate import NextPose
    from ..session.guidance import Progress
    from ..table import Floats


def statuses_of(health: Health, node: str) -> list[DiagnosticStatus]:
    """Return the diagnostics: the state with all values, and one status for each concern."""
    state = _status(worst(health), node, health.sensor)
    state.values = _values(figures(health))
    return [state, *self_test_of(health, node)]


def self_test_of(health: Health, node: str) -> list[DiagnosticStatus]:
    """Return one status for each check; the test passes if all are OK."""
    return [_status(check, node, health.sensor) for check in checks(health)]


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
    Return the markers of poses.

    Parameters
    ----------
    directions : (n, 3) array
        Directions of up in the sensor axes, unit vectors.
    asked : NextPose
        The next pose, or that more poses no longer help.
    frame_id : str
        Frame of the sensor.

    Returns
    -------
    MarkerArray
        Markers in the namespaces ``sphere``, ``poses``, ``numbers`` and ``next``; they replace all
        earlier markers.

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
