# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Static transforms between frames, on /tf_static.

Transforms of a URDF that do not move arrive in several latched messages, often from several
nodes. Only their rotations are needed. The message type is in tf2_msgs, which is imported only if
a parameter needs it: the node also runs without this package.

"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Any, TYPE_CHECKING

from geometry_msgs.msg import Quaternion, TransformStamped
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from .declare import LATCHED
from ..errors import InputError
from ..geometry import quaternion_of, rotation_from_quaternion
from ..table import Floats

if TYPE_CHECKING:
    from rclpy.node import Node

TOPIC = '/tf_static'

_ALL_STATIC = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Each publisher of static transforms keeps its own last messages."""

_LENGTH_TOLERANCE = 0.01
"""Largest error of the squared length of a quaternion, as in tf2."""

_INSTEAD = {'base_frame': 'set mounting_rpy instead', 'publish_tf': 'set publish_tf to false'}


def needs_tf2(parameter: str) -> Any:
    """Return `tf2_msgs.msg.TFMessage`, which a parameter needs; InputError if not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise InputError(
            f'the parameter {parameter} needs the package tf2_msgs, which is not installed',
            f'install ros-jazzy-tf2-msgs, or {_INSTEAD[parameter]}') from error
    return TFMessage


class StaticTransforms:
    """A tree of frames, and the rotations between them."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Floats]] = {}

    def add(self, parent: str, child: str, quaternion: Sequence[float]) -> bool:
        """
        Add a transform, or replace the previous one of this child.

        Parameters
        ----------
        parent, child : str
            Names of the frames; a leading slash is ignored.
        quaternion : sequence of 4 floats
            x, y, z, w of the rotation that transforms a vector from `child` to `parent`.

        Returns
        -------
        bool
            Whether the tree has changed.

        Raises
        ------
        InputError
            If a name is empty, the quaternion is not a rotation, or the frames form a loop. The
            tree is then unchanged.

        """
        parent, child = _plain(parent), _plain(child)
        if not (parent and child):
            raise InputError(f'a static transform from {parent!r} to {child!r} has an empty frame '
                             'name, expected two names', 'correct the node that publishes it')
        if child in self._rotations_above(parent):
            raise InputError(f'the static transform from {parent} to {child} makes a loop, '
                             f'expected that {child} is not above {parent}',
                             'correct the node that publishes it, or restart this node if the '
                             'frames were rearranged')
        rotation = _rotation_of(quaternion, f'the static transform from {parent} to {child}')
        before = self._parents.get(child)
        self._parents[child] = (parent, rotation)
        return before is None or before[0] != parent or not np.array_equal(before[1], rotation)

    def rotation(self, base: str, frame: str) -> Floats | None:
        """Return the (3, 3) rotation of vectors from `frame` to `base`; None: not connected."""
        above_base = self._rotations_above(_plain(base))
        for common, mat_common_frame in self._rotations_above(_plain(frame)).items():
            if common in above_base:
                return above_base[common].T @ mat_common_frame
        return None

    def _rotations_above(self, frame: str) -> dict[str, Floats]:
        """Return the rotation from a frame to itself and to each frame above it, nearest first."""
        found: dict[str, Floats] = {frame: np.eye(3)}
        while frame in self._parents:
            parent, mat_parent_frame = self._parents[frame]
            found[parent] = mat_parent_frame @ found[frame]
            frame = parent
        return found


def watch_static(node: Node, on_change: Callable[[], None]) -> StaticTransforms:
    """
    Subscribe to the static transforms, and return those that have arrived at any time.

    `on_change` is called after a message with at least one new or different transform. A transform
    that is not valid is logged. InputError if tf2_msgs is not installed.

    """
    transforms = StaticTransforms()

    def added(stamped: TransformStamped) -> bool:
        q = stamped.transform.rotation
        try:
            return transforms.add(stamped.header.frame_id, stamped.child_frame_id,
                                  (q.x, q.y, q.z, q.w))
        except InputError as error:
            node.get_logger().warning(str(error))
            return False

    def on_message(message: Any) -> None:
        changed = [added(stamped) for stamped in message.transforms]
        if any(changed):
            on_change()

    node.create_subscription(needs_tf2('base_frame'), TOPIC, on_message, _ALL_STATIC)
    return transforms


class MountingBroadcaster:
    """Publisher of one static transform, without translation; it needs tf2_msgs."""

    def __init__(self, node: Node) -> None:
        self._message = needs_tf2('publish_tf')
        self._publisher = node.create_publisher(self._message, TOPIC, LATCHED)

    def publish(self, stamp: Any, parent: str, child: str, rotation: Floats) -> None:
        """Publish the (3, 3) rotation of vectors from `child` to `parent`."""
        stamped = TransformStamped(child_frame_id=_plain(child))
        stamped.header.stamp, stamped.header.frame_id = stamp, _plain(parent)
        x, y, z, w = quaternion_of(rotation)
        stamped.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
        self._publisher.publish(self._message(transforms=[stamped]))


def _plain(frame: str) -> str:
    """Return the name of a frame as tf2 has it, without a leading slash."""
    return frame.removeprefix('/')


def _rotation_of(quaternion: Sequence[float], what: str) -> Floats:
    """Return the rotation matrix of a quaternion (x, y, z, w), which must have length 1."""
    x, y, z, w = quaternion
    squared = x * x + y * y + z * z + w * w
    if not abs(squared - 1.0) < _LENGTH_TOLERANCE:  # NaN too
        raise InputError(
            f'{what} has the quaternion ({x:g}, {y:g}, {z:g}, {w:g}) of length '
            f'{math.sqrt(squared):.3g}, expected length 1', 'correct the node that publishes it')
    return rotation_from_quaternion(quaternion)
