# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized sensor_msgs/Imu messages, from bags and from topics.

`layout` says what is where in a message. `arrays` reads many messages at once and `correction`
corrects them; `rewriter` corrects one message after the other.

"""
