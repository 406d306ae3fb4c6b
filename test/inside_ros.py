# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""What tests use of the nodes, as `inside` does for the parts that need no ROS."""

from collections.abc import Sequence
from typing import Any

from accel_calib.ros.calibrator_node import in_executor, pose_markers, serve
from accel_calib.ros.declare import LATCHED, static_transform, TOPIC as TF_TOPIC, watch_static
from accel_calib.ros.simulator_node import SimulatedImu, SimulatorSettings
import numpy as np
from numpy.typing import NDArray

Link = tuple[str, str, Sequence[float]]
"""Parent, child, and quaternion (x, y, z, w) of a static transform."""


def force_of(message: Any) -> NDArray[np.float64]:
    """Return the acceleration of an Imu."""
    force = message.linear_acceleration
    return np.array([force.x, force.y, force.z])


def publish_static(node: Any, *links: Link) -> None:
    """Publish transforms as one latched message of a new publisher."""
    from geometry_msgs.msg import Quaternion, TransformStamped
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from tf2_msgs.msg import TFMessage
    message = TFMessage()
    for parent, child, quaternion in links:
        stamped = TransformStamped(child_frame_id=child)
        stamped.header.frame_id = parent
        stamped.transform.rotation = Quaternion(**dict(zip('xyzw', quaternion, strict=True)))
        message.transforms.append(stamped)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    node.create_publisher(TFMessage, TF_TOPIC, latched).publish(message)
