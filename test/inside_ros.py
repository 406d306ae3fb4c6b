# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""What tests use of the nodes, as `inside` does for the parts that need no ROS."""

from accel_calib.ros.calibrator_node import pose_markers
from accel_calib.ros.declare import (
    in_executor, MountingBroadcaster, needs_tf2, serve, StaticTransforms, TOPIC as TF_TOPIC,
    watch_static)
from accel_calib.ros.simulator_node import SimulatedImu, SimulatorSettings
