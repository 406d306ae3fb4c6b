# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Declaration of parameters in a node."""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any, TYPE_CHECKING

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter

from ..errors import InputError
from ..session.settings import changed, default_of, expected, Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node


def declared(node: Node, kind: type[Settings]) -> Settings:
    """
    Declare the parameters of these settings and return their values.

    Raises
    ------
    InputError
        If a parameter does not accept its value.

    """
    try:
        values = {parameter.name: _declared(node, parameter).value for parameter in fields(kind)}
    except InvalidParameterValueException as error:
        raise InputError(str(error), 'correct the value') from error
    return changed(kind(), values)


def _declared(node: Node, parameter: Field[Any]) -> Parameter:
    """Return a parameter; a managed node that is configured again has declared it before."""
    if node.has_parameter(parameter.name):
        return node.get_parameter(parameter.name)
    return node.declare_parameter(parameter.name, default_of(parameter), _descriptor(parameter))


def follow(node: Node, settings: Callable[[], Settings],
           adopt: Callable[[Settings], None]) -> Callable[..., Any]:
    """
    Pass new settings to `adopt` when parameters are set; refuse invalid values.

    Returns
    -------
    callable
        The callback, which ``node.remove_on_set_parameters_callback`` removes.

    """
    def on_set(parameters: list[Parameter]) -> SetParametersResult:
        values = {parameter.name: parameter.value for parameter in parameters}
        try:
            adopt(changed(settings(), values))
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(on_set)
    return on_set


def _descriptor(parameter: Field[Any]) -> ParameterDescriptor:
    """Return the description of a parameter, for `ros2 param describe` and rqt."""
    default, limits = default_of(parameter), parameter.metadata['limits']
    descriptor = ParameterDescriptor(
        name=parameter.name, description=parameter.metadata['words'],
        type=Parameter.Type.from_parameter_value(default).value,
        additional_constraints=expected(parameter), read_only=not parameter.metadata['live'],
        dynamic_typing=True)
    if limits is None:
        return descriptor
    if isinstance(default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=limits[0], to_value=limits[1])]
    else:
        descriptor.integer_range = [
            IntegerRange(from_value=int(limits[0]), to_value=int(limits[1]))]
    return descriptor
