# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The ROS nodes. They only convert messages, call other parts, and publish the results.

`calibrator_node`, `managed_node` and `simulator_node` are the nodes; `run` has the executables,
which start, spin and end them. In the calibrator, `stream` processes Imu messages,
`services` answers service calls and runs jobs, `display` makes diagnostics and markers,
`declare` declares parameters, and `qos` defines the quality of service. `demo` runs both nodes.

All callbacks run in one thread, and only callbacks use the session.

"""
