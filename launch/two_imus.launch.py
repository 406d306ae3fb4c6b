# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Example: two Imus, each with a calibrator, and one thermometer.

    ros2 launch accel_calib two_imus.launch.py

The drivers publish ``/left/imu/data_raw`` and ``/right/imu/data_raw``. The calibrators publish
``/left/imu/data_calibrated`` and ``/right/imu/data_calibrated``, and both listen to
``/temperature``. If each Imu has its own thermometer, add ``temperature:=temperature``: the topics
are then ``/left/temperature`` and ``/right/temperature``.

Further arguments go to both calibrators, for example ``fill_covariance:=true``. Do not set
`calibration_file` or `sensor` here: each calibrator needs its own files, and by default the files
are named after the topic.

With ``web:=true`` the live page of the left Imu is at port 8080, that of the right one at 8081.

"""

from ament_index_python.packages import get_package_share_path
from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

WEB_PORTS = {'left': '8080', 'right': '8081'}
"""Ports of the live pages by namespace."""


def generate_launch_description() -> LaunchDescription:
    calibrator = get_package_share_path('accel_calib') / 'launch' / 'calibrator.launch.py'
    return LaunchDescription([
        IncludeLaunchDescription(PythonLaunchDescriptionSource(str(calibrator)),
                                 launch_arguments=[('namespace', namespace), ('web_port', port)])
        for namespace, port in WEB_PORTS.items()])
