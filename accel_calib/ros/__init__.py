# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The ROS nodes. They only convert messages, call other parts, and publish the results.

`calibrator_node` and `simulator_node` are the nodes; `run` has the executables, which start, spin
and end them. In the calibrator, `stream` processes Imu messages. `declare` declares parameters,
services, the quality of service and static transforms. `client` receives the progress of a node,
and runs both nodes for a demonstration.

All callbacks run in one thread, and only callbacks use the session.

"""
