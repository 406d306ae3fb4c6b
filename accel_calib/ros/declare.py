# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the nodes declare: their parameters, quality of service and static transforms.

A node must bridge the time of a batch: at 8 kHz it loses 8 messages in 10,000 with depth 100, and
none with depth 1000.

Transforms of a URDF that do not move arrive on /tf_static in several latched messages, often from
several nodes. Only their rotations are needed. The message type is in tf2_msgs, which is imported
only if a parameter needs it: the node also runs without this package. As in tf2, names of frames
have no leading slash.

"""

from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any

from geometry_msgs.msg import Quaternion, TransformStamped
from rcl_interfaces.msg import (
    FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ..errors import InputError
from ..geometry import quaternion_of, StaticTransforms
from ..session import changed, expected, Settings
from ..table import Floats


def declared(node: Node, kind: type[Settings], *, fixed: bool = True) -> Settings:
    """
    Declare the parameters of these settings and return them; InputError for invalid values.

    `fixed`: those that cannot change while the node runs are read-only.

    """
    try:
        for each in fields(kind):
            default, limits = each.metadata['default'], each.metadata['limits']
            descriptor = ParameterDescriptor(  # for `ros2 param describe` and rqt
                name=each.name, description=each.metadata['words'],
                type=Parameter.Type.from_parameter_value(default).value,
                additional_constraints=expected(each),
                read_only=fixed and not each.metadata['live'], dynamic_typing=True)
            if limits is not None and isinstance(default, float):
                descriptor.floating_point_range = [FloatingPointRange(
                    from_value=limits[0], to_value=limits[1])]
            elif limits is not None:
                descriptor.integer_range = [IntegerRange(
                    from_value=int(limits[0]), to_value=int(limits[1]))]
            if not node.has_parameter(each.name):  # a managed node may be configured again
                node.declare_parameter(each.name, default, descriptor)
    except InvalidParameterValueException as error:
        raise InputError(str(error), 'correct the value') from error
    return changed(kind(), {each.name: node.get_parameter(each.name).value
                            for each in fields(kind)})


def follow(node: Node, settings: Callable[[], Settings],
           adopt: Callable[[Settings], None], *, runs: bool = True) -> Callable[..., Any]:
    """
    Pass new settings to `adopt` when parameters are set; refuse invalid values.

    `runs`: refuse those that cannot change while the node runs, too. Returns the callback, which
    ``node.remove_on_set_parameters_callback`` removes.

    """
    def on_set(parameters: list[Parameter]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in parameters}
        fixed = [each.name for each in fields(settings()) if not each.metadata['live']
                 and runs and each.name in values]
        if fixed:
            return SetParametersResult(successful=False, reason=f'{fixed[0]} cannot change while '
                                       'the node is configured: clean up, set it and configure')
        try:
            adopt(changed(settings(), values))
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)
    return on_set


SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For messages of drivers; it also matches reliable publishers."""

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""For published messages; it also matches best-effort subscribers."""

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For latched topics; late subscribers receive the last message."""

CALLS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""For services. If more calls than the depth wait for the node, the oldest are never answered."""

_UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""Name of a node of which DDS knows only the topic so far."""


def name_of(endpoint: TopicEndpointInfo) -> str:
    """Return the name of the node of a publisher or subscriber, with its namespace."""
    if endpoint.node_name == _UNKNOWN:
        return 'a node whose name is not known yet'
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


def published_by_others(node: Node, types: Iterable[str]) -> list[tuple[str, ...]]:
    """Return for each type, such as ``sensor_msgs/msg/Imu``, the topics of no calibrator."""
    graph = dict(node.get_topic_names_and_types())
    return [tuple(topic for topic, of_topic in graph.items() if wanted in of_topic
                  and any(f'{name_of(each)}/preview' not in graph
                          for each in node.get_publishers_info_by_topic(topic)))
            for wanted in types]


def mismatches(node: Node) -> tuple[str, ...]:
    """
    Return one line for each endpoint that cannot exchange messages with those of a node.

    A line is what is wrong and what to do. Of other policies than reliability and durability,
    rclpy reports a difference.

    """
    pairs = [(own, other, True) for own in node.subscriptions
             for other in node.get_publishers_info_by_topic(own.topic_name)]
    pairs += [(own, other, False) for own in node.publishers
              for other in node.get_subscriptions_info_by_topic(own.topic_name)]
    lines: dict[str, None] = {}
    for own, other, receives in pairs:
        offered, wanted = own.qos_profile, other.qos_profile
        if receives:
            offered, wanted = wanted, offered
        words = []
        if (offered.reliability == ReliabilityPolicy.BEST_EFFORT
                and wanted.reliability == ReliabilityPolicy.RELIABLE):
            words.append('best effort, but the subscriber expects reliable')
        if (offered.durability == DurabilityPolicy.VOLATILE
                and wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL):
            words.append('volatile, but the subscriber expects transient local')
        topic, why, name = own.topic_name, ' and '.join(words), name_of(other)
        if why:
            lines[f'{name} publishes on {topic} with the QoS {why}, so that nothing arrives here: '
                  f'start this node without qos_overrides.{topic}.subscription' if receives else
                  f'{topic} has the QoS {why}, so that {name} receives nothing: change the QoS of '
                  'that subscriber'] = None
    return tuple(lines)


# ----------------------------------------------------------------------------- static transforms

TOPIC = '/tf_static'

_ALL_STATIC = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE,
                         durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Each publisher of static transforms keeps its own last messages."""

_INSTEAD = {'base_frame': 'set mounting_rpy instead', 'publish_tf': 'set publish_tf to false'}


def needs_tf2(parameter: str) -> Any:
    """Return `tf2_msgs.msg.TFMessage`, which a parameter needs; InputError if not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError as error:
        raise InputError(
            f'the parameter {parameter} needs the package tf2_msgs, which is not installed',
            f'install ros-jazzy-tf2-msgs, or {_INSTEAD[parameter]}') from error
    return TFMessage


def watch_static(node: Node, on_change: Callable[[], None]) -> StaticTransforms:
    """
    Subscribe to the static transforms, and return those that have arrived at any time.

    `on_change` is called after a message with at least one new or different transform. A transform
    that is not valid is logged. InputError if tf2_msgs is not installed.

    """
    transforms = StaticTransforms()

    def on_message(message: Any) -> None:
        is_new = False
        for stamped in message.transforms:
            q = stamped.transform.rotation
            try:
                is_new |= transforms.add(stamped.header.frame_id, stamped.child_frame_id,
                                         (q.x, q.y, q.z, q.w))
            except InputError as error:
                node.get_logger().warning(str(error))
        if is_new:
            on_change()

    node.create_subscription(needs_tf2('base_frame'), TOPIC, on_message, _ALL_STATIC)
    return transforms


def static_transform(stamp: Any, parent: str, child: str, rotation: Floats) -> Any:
    """Return a message with the (3, 3) rotation of vectors from `child` to `parent`."""
    stamped = TransformStamped(child_frame_id=child.removeprefix('/'))
    stamped.header.stamp, stamped.header.frame_id = stamp, parent.removeprefix('/')
    stamped.transform.rotation = Quaternion(**dict(zip('xyzw', quaternion_of(rotation))))
    return needs_tf2('publish_tf')(transforms=[stamped])
