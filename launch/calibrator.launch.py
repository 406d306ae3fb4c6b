# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the calibrator for the driver of a robot.

    ros2 launch accel_calib calibrator.launch.py imu:=camera/imu output:=camera/imu_calibrated

"""

from ament_index_python.packages import get_package_share_path
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    params_file = get_package_share_path('accel_calib') / 'config' / 'calibrator.yaml'
    arguments = {
        'namespace': ('', 'Namespace of the node; the topics are relative to it.'),
        'imu': ('imu/data_raw', 'Topic of the readings (sensor_msgs/Imu).'),
        'output': ('imu/data_calibrated', 'Topic of the corrected readings.'),
        'params_file': (str(params_file), 'File with the parameters of the node.'),
        'calibration_file': ('', 'File of the calibration; empty: as in params_file.'),
        'sensor': ('', 'Name of the sensor; empty: as in params_file.'),
    }
    declared = [DeclareLaunchArgument(name, default_value=default, description=description)
                for name, (default, description) in arguments.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=_calibrator)])


def _calibrator(context: LaunchContext) -> list[Node]:
    """Return the node; an empty argument does not override the parameter file."""
    given = {name: LaunchConfiguration(name).perform(context)
             for name in ('calibration_file', 'sensor')}
    overrides = {name: ParameterValue(value, value_type=str)
                 for name, value in given.items() if value}
    return [Node(
        package='accel_calib',
        executable='calibrator',
        name='calibrator',
        namespace=LaunchConfiguration('namespace'),
        parameters=[LaunchConfiguration('params_file'), *([overrides] if overrides else [])],
        remappings=[('imu/data_raw', LaunchConfiguration('imu')),
                    ('imu/data_calibrated', LaunchConfiguration('output'))],
        output='screen',
    )]
