# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Example: from raw readings to the motion of the robot.

    sudo apt install ros-jazzy-imu-filter-madgwick ros-jazzy-robot-localization
    ros2 launch accel_calib with_filters.launch.py imu:=camera/imu odometry:=wheels/odom

accel_calib does not depend on these two packages.

1. The calibrator reads `imu` and publishes `output`. Calibrate and level first: then the messages
   are in `base_link` and state the measured noise.
2. imu_filter_madgwick adds the orientation, and publishes ``imu/data``.
3. robot_localization combines orientation, angular velocity and acceleration with the velocity of
   the wheels from `odometry`. It publishes ``odometry/filtered``, and the transform from ``odom``
   to `base_link`. Only one node may publish that transform: switch it off in the driver of the
   wheels.

Without odometry the velocity and the position drift, because nothing but the acceleration
determines them. Without a magnetometer the heading starts at an arbitrary value and drifts.
Further arguments are those of calibrator.launch.py.

"""

from ament_index_python.packages import get_package_share_path
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ORIENTATION_SD = 0.02
"""Standard deviation of the orientation for robot_localization [rad]; the filter has none."""

MADGWICK = {'use_mag': False, 'publish_tf': False, 'orientation_stddev': ORIENTATION_SD}

# The fused variables: x y z, roll pitch yaw, their rates in the same order, and acceleration.
IMU = [*[False] * 3, *[True] * 3, *[False] * 3, *[True] * 3, *[True] * 3]
WHEELS = [*[False] * 6, True, True, False, *[False] * 6]

EKF = {
    'world_frame': 'odom',
    'odom_frame': 'odom',
    'base_link_frame': LaunchConfiguration('base_link'),
    'imu0': 'imu/data',
    'imu0_config': IMU,
    'imu0_remove_gravitational_acceleration': True,
    'odom0': LaunchConfiguration('odometry'),
    'odom0_config': WHEELS,
}


def generate_launch_description() -> LaunchDescription:
    for package in ('imu_filter_madgwick', 'robot_localization'):
        get_package_share_path(package)  # before a node starts; the error names the package
    calibrator = get_package_share_path('accel_calib') / 'launch' / 'calibrator.launch.py'
    arguments = {
        'namespace': ('', 'Namespace of the three nodes.'),
        'output': ('imu/data_calibrated', 'Topic between the calibrator and imu_filter_madgwick.'),
        'odometry': ('odom', 'Topic of the wheel odometry (nav_msgs/Odometry).'),
        'base_link': ('base_link', 'Frame of the robot.'),
    }
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=words)
          for name, (default, words) in arguments.items()),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(calibrator)),
            launch_arguments=[('output_frame_id', LaunchConfiguration('base_link')),
                              ('fill_covariance', 'true')]),
        Node(package='imu_filter_madgwick', executable='imu_filter_madgwick_node',
             name='imu_filter', namespace=LaunchConfiguration('namespace'),
             parameters=[MADGWICK],
             remappings=[('imu/data_raw', LaunchConfiguration('output'))], output='screen'),
        Node(package='robot_localization', executable='ekf_node', name='ekf_filter_node',
             namespace=LaunchConfiguration('namespace'), parameters=[EKF], output='screen'),
    ])
