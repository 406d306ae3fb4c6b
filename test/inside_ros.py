# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""What tests use of the nodes, as `inside` does for the parts that need no ROS."""

from accel_calib.ros.calibrator_node import in_executor, serve
from accel_calib.ros.display import pose_markers
from accel_calib.ros.simulator_node import SimulatedImu, SimulatorSettings
from accel_calib.ros.transforms import (
    MountingBroadcaster, needs_tf2, StaticTransforms, TOPIC as TF_TOPIC, watch_static)
