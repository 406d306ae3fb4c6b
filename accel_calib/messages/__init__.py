# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Serialized sensor_msgs/Imu messages, from bags and from topics.

`layout` defines the places of the fields in a message and reads many messages at once.
`correction` corrects many messages or single ones.

"""
