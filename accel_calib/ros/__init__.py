# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The nodes: convert, call, publish.

====================  ============================================================
`calibrator`          `main` of the calibrator, `calibrator_node` the node itself
`simulator`           `main` of the simulator, `simulator_node` the node itself
`demo`                both at work
`run`                 init, spin, clean shutdown
`settings`            parameters of both nodes, in one table each; `parameters`, `declare`
`conversion`, `qos`   messages to plain numbers and back
`stream`              from imu/data_raw to imu/data_calibrated
`serialized`          where what is in a serialized Imu; `rewriter` corrects one (no ROS)
`watch`, `pose_book`  samples to rests to poses (no ROS)
`applied`             the calibration in use, gravity held from the last rest (no ROS)
`fitting`             poses to calibration, and words about it (no ROS)
`storage`             where calibration and poses are kept (no ROS)
`commands`            what services do; `answers` and `worker` how they answer
`apart`               a process for what computes (no ROS)
`vitals`, `health`    what is counted, and how it is judged
`markers`             poses on the unit sphere; `pose_view` when they change
====================  ============================================================

The calibrator's callbacks run in one thread, and only they change its state. What takes longer
(fits, files) goes to `worker`, and computing from there to `apart`, and comes back as a callback.

"""
