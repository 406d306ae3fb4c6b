# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameters: given values to settings, and settings to a parameter file.

Types are checked here and not by rclpy, which refuses ``5`` for ``5.0`` and ``model:=10`` for
``'10'``, and ends a node with a traceback.

"""

from __future__ import annotations

from dataclasses import Field, fields, MISSING, replace
from textwrap import wrap
from typing import Any, TYPE_CHECKING, TypeVar

from .settings import CalibratorSettings, SimulatorSettings
from ..errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_WIDTH = 99
_COMMENT = '    # '

Settings = TypeVar('Settings', CalibratorSettings, SimulatorSettings)


def default_of(parameter: Field[Any]) -> Any:
    """Give the default value of a field of the settings."""
    factory = parameter.default_factory
    return parameter.default if factory is MISSING else factory()


def _converted(parameter: Field[Any], value: Any) -> Any:
    """Give the value in the type of its default, or None where it is of another type."""
    default = default_of(parameter)
    if isinstance(default, bool) or isinstance(value, bool):
        return value if isinstance(value, bool) and isinstance(default, bool) else None
    if isinstance(default, float):
        return float(value) if isinstance(value, (int, float)) else None
    if isinstance(default, str):
        return str(value) if isinstance(value, (str, int, float)) else None
    if isinstance(default, int):
        return value if isinstance(value, int) else None
    return _converted_list(default, value)


def _converted_list(default: list[Any], value: Any) -> list[Any] | None:
    """Give a list in the type of the first default; rclpy has arrays and bytes for lists."""
    try:
        items = [type(default[0])(item) for item in value]
    except (TypeError, ValueError):
        return None
    fixed_length = isinstance(default[0], float)
    return None if fixed_length and len(items) != len(default) else items


def expected(parameter: Field[Any]) -> str:
    """Say in words which values a parameter takes."""
    if parameter.metadata['choices']:
        return 'one of ' + ', '.join(parameter.metadata['choices'])
    default = default_of(parameter)
    if isinstance(default, list):
        kind = 'strings' if isinstance(default[0], str) else f'{len(default)} numbers'
        return f'a list of {kind}'
    kind = {bool: 'true or false', int: 'a whole number', float: 'a number',
            str: 'text'}[type(default)]
    limits = parameter.metadata['limits']
    return kind if limits is None else f'{kind} from {limits[0]:.10g} to {limits[1]:.10g}'


def checked(parameter: Field[Any], value: Any) -> Any:
    """
    Give a value of a parameter in its own type.

    Raises
    ------
    InputError
        If the value is not one that the parameter takes.

    """
    converted, limits = _converted(parameter, value), parameter.metadata['limits']
    choices = parameter.metadata['choices']
    if (converted is None or (choices and converted not in choices)
            or (limits is not None and not limits[0] <= converted <= limits[1])):
        raise InputError(f'parameter {parameter.name} is {value!r}, expected '
                         f'{expected(parameter)}', 'give such a value')
    return converted


def changed(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """
    Give the settings with these parameters changed; names of other parameters are passed over.

    Raises
    ------
    InputError
        As `checked`.

    """
    known = {parameter.name: parameter for parameter in fields(settings)}
    return replace(settings, **{name: checked(known[name], value)
                                for name, value in values.items() if name in known})


def yaml_lines(settings: type[CalibratorSettings]) -> Iterable[str]:
    """Write the parameter file with all defaults, line by line, for any node name."""
    yield '# Parameters of the calibrator with their defaults; made from'
    yield '# accel_calib/ros/settings.py. Those marked * can be set while the node runs.'
    yield '/**:'
    yield '  ros__parameters:'
    for parameter in fields(settings):
        live = ' *' if parameter.metadata['live'] else ''
        words = f"{parameter.metadata['words']} ({expected(parameter)}){live}"
        yield from wrap(words, _WIDTH, initial_indent=_COMMENT, subsequent_indent=_COMMENT)
        yield f'    {parameter.name}: {_yaml_value(default_of(parameter))}'


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)
