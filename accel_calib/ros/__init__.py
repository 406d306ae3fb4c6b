# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The nodes: convert, call, publish.

`calibrator` and `simulator` are the executables, `calibrator_node` and `simulator_node` the nodes;
`run` starts, spins and ends them. Of the calibrator, `stream` is the way of an Imu message,
`services` answers, `worker` runs jobs, `diagnostics` and `markers` make messages, `declare`
declares parameters. `demo` shows both nodes at work.

All callbacks run in one thread, and only they use the session.

"""
