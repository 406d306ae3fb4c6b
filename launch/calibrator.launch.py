# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the calibrator for the driver of a robot.

    ros2 launch accel_calib calibrator.launch.py imu:=camera/imu output:=camera/imu_calibrated

`ros2 launch accel_calib calibrator.launch.py --show-args` lists all arguments.

**Names of topics.** A name without a leading slash is inside `namespace`, a name with a leading
slash is not. Only the default of `temperature` has a leading slash: with ``namespace:=left`` the
node listens to ``/left/imu/data_raw`` and to ``/temperature``, so that several Imus can share one
thermometer. If the driver in the namespace publishes the temperature, add
``temperature:=temperature``.

**Parameters.** An argument that is empty does not override `params_file`.

**Lifecycle.** With ``lifecycle:=true`` the node is a managed node. This file configures and
activates it once; later transitions are up to you, for example by `ros2 lifecycle set`.

**Live page.** With ``web:=true`` the node serves the live page at `web_port` of this machine, and
logs the file with its link. For a phone, add ``web_host:=0.0.0.0``. A second node needs another
port.

"""

import re
from typing import Any

from ament_index_python.packages import get_package_share_path
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.parameter_descriptions import ParameterValue
from lifecycle_msgs.msg import Transition

TOPICS = {
    'imu': ('imu/data_raw', 'imu/data_raw', 'Topic of the readings (sensor_msgs/Imu).'),
    'temperature': (
        'temperature', '/temperature',
        'Topic of the temperature of the sensor (sensor_msgs/Temperature), optional. The default '
        'is outside the namespace; temperature:=temperature is inside.'),
    'output': ('imu/data_calibrated', 'imu/data_calibrated',
               'Topic of the corrected readings (sensor_msgs/Imu).'),
    'linear_acceleration': (
        '~/linear_acceleration', '~/linear_acceleration',
        'Topic of the acceleration without gravity (geometry_msgs/Vector3Stamped).'),
}
"""Topics by argument: name in the node, default and description."""

PARAMETERS = {
    'gravity': (float, 'Local gravity [m/s²].'),
    'passthrough': (bool, 'Whether to publish raw messages until there is a calibration.'),
    'auto_fit': (bool, 'Whether to fit automatically after enough poses.'),
    'drift_warn': (float, 'Smallest lasting change of |a| at rest for a warning [m/s²].'),
    'units': (str, 'Unit of the incoming linear_acceleration: m/s2, g or native.'),
    'model': (str, 'Model for ~/fit: auto, 4, 7, 9 or 10.'),
    'frame': (str, 'Levelled frame of the messages: ros, ned or android.'),
    'output_frame_id': (str, 'frame_id of messages in the levelled frame.'),
    'rotate': (bool, 'Whether to turn corrected messages into the levelled frame.'),
    'mounting_rpy': (list, 'Roll, pitch and yaw of the sensor on the robot [rad], such as '
                           "'0 0 1.57'."),
    'base_frame': (str, 'Frame of the robot, to take the mounting from /tf_static.'),
    'publish_tf': (bool, 'Whether to publish the levelled frame on /tf_static.'),
    'context': (tuple, 'Further topics with a number that may act on the sensor, such as '
                       "'supply_voltage:=battery rotor_temperature:=/motor/temp'."),
    'gyro_bias': (bool, 'Whether to subtract the bias of the gyro.'),
    'fill_covariance': (bool, 'Whether to state the measured noise as covariance.'),
    'confirm': (bool, 'Whether a new result waits for ~/save or ~/undo.'),
    'calibration_file': (str, 'File of the calibration.'),
    'web_host': (str, 'Address of the live page; 0.0.0.0: for the whole network.'),
    'sensor': (str, 'Name of the sensor and of its files.'),
}
"""Parameters of the node by argument: type and description. A list is 3 numbers, a tuple texts."""

_NO_QUOTES = str.maketrans('', '', '\'"')

BOOLS = ['true', 'false', 'True', 'False']


def generate_launch_description() -> LaunchDescription:
    params_file = get_package_share_path('accel_calib') / 'config' / 'calibrator.yaml'
    return LaunchDescription([
        DeclareLaunchArgument(
            'namespace', default_value='',
            description='Namespace of the node. Topic names without a leading slash are in it.'),
        *(DeclareLaunchArgument(name, default_value=default, description=words)
          for name, (_, default, words) in TOPICS.items()),
        DeclareLaunchArgument('params_file', default_value=str(params_file),
                              description='File with the parameters of the node.'),
        *(DeclareLaunchArgument(name, default_value='',
                                description=f'{words} Empty: as in params_file.',
                                choices=['', *BOOLS] if kind is bool else None)
          for name, (kind, words) in PARAMETERS.items()),
        DeclareLaunchArgument(
            'lifecycle', default_value='false', choices=BOOLS,
            description='Whether to start the managed node, and configure and activate it.'),
        DeclareLaunchArgument(
            'web', default_value='false', choices=BOOLS,
            description='Whether to serve the live page.'),
        DeclareLaunchArgument(
            'web_port', default_value='8080', description='Port of the live page with web:=true.'),
        OpaqueFunction(function=_calibrator),
    ])


def _calibrator(context: LaunchContext) -> list[Any]:
    """Return the node, and the transitions of a managed node."""
    about = {
        'package': 'accel_calib',
        'name': 'calibrator',
        'namespace': LaunchConfiguration('namespace'),
        'parameters': [LaunchConfiguration('params_file'), *_overrides(context)],
        'remappings': [(inside, LaunchConfiguration(name))
                       for name, (inside, _, _) in TOPICS.items()],
        'output': 'screen',
    }
    if IfCondition(LaunchConfiguration('lifecycle')).evaluate(context):
        return _activated(LifecycleNode(executable='calibrator_lifecycle', **about))
    return [Node(executable='calibrator', **about)]


def _overrides(context: LaunchContext) -> list[dict[str, Any]]:
    """Return one dictionary of the parameters that are given, or nothing if none is given."""
    values: dict[str, Any] = {}
    for name, (kind, _) in PARAMETERS.items():
        given = LaunchConfiguration(name)
        text = given.perform(context)
        if text:
            values[name] = (_numbers(name, text) if kind is list
                            else _parts(text.translate(_NO_QUOTES)) if kind is tuple
                            else ParameterValue(given, value_type=kind))
    if IfCondition(LaunchConfiguration('web')).evaluate(context):
        values['web_port'] = ParameterValue(LaunchConfiguration('web_port'), value_type=int)
    return [values] if values else []


def _parts(text: str) -> list[str]:
    """Return the parts of a list, written with spaces or as in YAML."""
    return re.split(r'[\s,]+', text.strip('[] '))


def _numbers(name: str, text: str) -> list[float]:
    """Return three numbers, written as in YAML or as in a URDF; launch refuses '[0, 0, 1.57]'."""
    try:
        roll, pitch, yaw = map(float, _parts(text))
    except ValueError:
        raise ValueError(f"argument {name} is '{text}', expected 3 numbers; write for example "
                         f"{name}:='0 0 1.57'") from None
    return [roll, pitch, yaw]


def _activated(node: LifecycleNode) -> list[Any]:
    """Return the actions that start a managed node, configure it and then activate it."""
    configure, activate = (
        EmitEvent(event=ChangeState(lifecycle_node_matcher=matches_action(node),
                                    transition_id=transition))
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE))
    # Without start_state and handle_once, a later deactivation would be undone at once.
    configured = OnStateTransition(
        target_lifecycle_node=node, start_state='configuring', goal_state='inactive',
        entities=[activate], handle_once=True)
    return [RegisterEventHandler(configured), node, configure]
