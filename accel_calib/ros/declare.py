# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the nodes declare: their parameters, and the quality of service of their topics.

At 1 kHz, a busy machine loses a few messages in 10,000 with depth 10, and none with depth 100.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import Field, fields
from difflib import get_close_matches
from typing import Any, TYPE_CHECKING

from rcl_interfaces.msg import (
    FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ..errors import InputError
from ..session import changed, default_of, expected, Settings

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.topic_endpoint_info import TopicEndpointInfo


def declared(node: Node, kind: type[Settings], *, fixed: bool = True) -> Settings:
    """
    Declare the parameters of these settings and return them; InputError for invalid values.

    `fixed`: those that cannot change while the node runs are read-only.

    """
    try:
        values = {parameter.name: _declared(node, parameter, fixed).value
                  for parameter in fields(kind)}
    except InvalidParameterValueException as error:
        raise InputError(str(error), 'correct the value') from error
    return changed(kind(), values)


def misspelt(node: Node) -> list[str]:
    """Return one line for each parameter that was given to a node and that it does not have."""
    names = [name for name in node._parameter_overrides if not node.has_parameter(name)
             and not name.startswith('qos_overrides.')]
    known = list(node.get_parameters_by_prefix(''))
    near = {name: ' or '.join(get_close_matches(name, known)) for name in names}
    return [f'there is no parameter {name}, expected {words or "one of ros2 param list"}: correct '
            'the name' for name, words in near.items()]


def _declared(node: Node, parameter: Field[Any], fixed: bool) -> Parameter:
    """Return a parameter; a managed node that is configured again has declared it before."""
    if node.has_parameter(parameter.name):
        return node.get_parameter(parameter.name)
    return node.declare_parameter(parameter.name, default_of(parameter),
                                  _descriptor(parameter, fixed))


def follow(node: Node, settings: Callable[[], Settings],
           adopt: Callable[[Settings], None], *, runs: bool = True) -> Callable[..., Any]:
    """
    Pass new settings to `adopt` when parameters are set; refuse invalid values.

    `runs`: refuse those that cannot change while the node runs, too.

    Returns the callback, which ``node.remove_on_set_parameters_callback`` removes.

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


def _descriptor(parameter: Field[Any], fixed: bool) -> ParameterDescriptor:
    """Return the description of a parameter, for `ros2 param describe` and rqt."""
    default, limits = default_of(parameter), parameter.metadata['limits']
    descriptor = ParameterDescriptor(
        name=parameter.name, description=parameter.metadata['words'],
        type=Parameter.Type.from_parameter_value(default).value,
        additional_constraints=expected(parameter),
        read_only=fixed and not parameter.metadata['live'], dynamic_typing=True)
    if limits is None:
        return descriptor
    if isinstance(default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=limits[0], to_value=limits[1])]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]))]
    return descriptor


SENSOR = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""For messages of drivers; it also matches reliable publishers."""

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""For published messages; it also matches best-effort subscribers."""

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""For latched topics; late subscribers receive the last message."""

CALLS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""
For services.

The default depth is 10. If more calls than these wait for the node, the oldest ones are never
answered. The depth of the answers that wait for a client is set by the client.

"""

_UNKNOWN = '_NODE_NAME_UNKNOWN_'
"""Name of a node of which DDS knows only the topic so far."""


def name_of(endpoint: TopicEndpointInfo) -> str:
    """Return the name of the node of a publisher or subscriber, with its namespace."""
    if endpoint.node_name == _UNKNOWN:
        return 'a node whose name is not known yet'
    return f'{endpoint.node_namespace.rstrip("/")}/{endpoint.node_name}'


def published_by_others(node: Node, types: Iterable[str]) -> list[tuple[str, ...]]:
    """Return for each type, such as ``sensor_msgs/msg/Imu``, the topics of other nodes."""
    own = node.get_namespace(), node.get_name()
    graph = node.get_topic_names_and_types()
    return [tuple(topic for topic, of_topic in graph if wanted in of_topic
                  and any((each.node_namespace, each.node_name) != own
                          for each in node.get_publishers_info_by_topic(topic)))
            for wanted in types]


def mismatches(node: Node, subscriptions: Iterable[Any], publishers: Iterable[Any]
               ) -> tuple[str, ...]:
    """
    Return one line for each endpoint that cannot exchange messages with a node.

    Parameters
    ----------
    node : Node
        The node.
    subscriptions, publishers
        Subscriptions and publishers of the node.

    Returns
    -------
    tuple of str
        What is wrong and what to do. Of other policies than these two, rclpy reports a difference.

    """
    lines = []
    for own in subscriptions:
        for other in node.get_publishers_info_by_topic(own.topic_name):
            why = _mismatch(other.qos_profile, own.qos_profile)
            if why:
                lines.append(f'{name_of(other)} publishes on {own.topic_name} with the QoS {why}, '
                             'so that nothing arrives here: start this node without '
                             f'qos_overrides.{own.topic_name}.subscription')
    for own in publishers:
        for other in node.get_subscriptions_info_by_topic(own.topic_name):
            why = _mismatch(own.qos_profile, other.qos_profile)
            if why:
                lines.append(f'{own.topic_name} has the QoS {why}, so that {name_of(other)} '
                             'receives nothing: change the QoS of that subscriber')
    return tuple(dict.fromkeys(lines))


def _mismatch(offered: QoSProfile, wanted: QoSProfile) -> str:
    """Return why a subscription does not receive what a publisher offers; empty if it does."""
    words = []
    if (offered.reliability == ReliabilityPolicy.BEST_EFFORT
            and wanted.reliability == ReliabilityPolicy.RELIABLE):
        words.append('best effort, but the subscriber expects reliable')
    if (offered.durability == DurabilityPolicy.VOLATILE
            and wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL):
        words.append('volatile, but the subscriber expects transient local')
    return ' and '.join(words)
