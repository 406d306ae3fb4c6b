# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Parameters of a node as fields of a dataclass, and as a parameter file.

Types are checked here and not by rclpy. rclpy refuses ``5`` for ``5.0`` and ``model:=10`` for
``'10'``, and ends the node with a traceback.

"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import Field, field, fields, MISSING, replace
from textwrap import wrap
from typing import Any, TYPE_CHECKING, TypeVar

from ..errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_WIDTH = 99
_COMMENT = '    # '

Settings = TypeVar('Settings', bound='DataclassInstance')
"""A dataclass whose fields are made by `parameter`."""


def parameter(default: Any, words: str, *, limits: tuple[float, float] | None = None,
              choices: tuple[str, ...] = (), live: bool = False) -> Any:
    """
    Return a field that is a parameter.

    Parameters
    ----------
    default : bool, int, float, str or list of them
        Default value; it defines the type of the parameter.
    words : str
        Description, with the unit.
    limits : (float, float), optional
        Least and largest value.
    choices : tuple of str
        Possible values of a text; empty: any text.
    live : bool
        Whether the parameter can be set while the node runs.

    """
    about = {'words': words, 'limits': limits, 'choices': choices, 'live': live}
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=about)
    return field(default=default, metadata=about)


def default_of(given: Field[Any]) -> Any:
    """Return the default value of a field."""
    factory = given.default_factory
    return given.default if factory is MISSING else factory()


def _converted(given: Field[Any], value: Any) -> Any:
    """Return a value converted to the type of the default, or None if that is not possible."""
    default = default_of(given)
    if isinstance(default, bool) or isinstance(value, bool):
        return value if isinstance(value, bool) and isinstance(default, bool) else None
    if isinstance(default, float):
        return float(value) if isinstance(value, int | float) else None
    if isinstance(default, str):
        return str(value) if isinstance(value, str | int | float) else None
    if isinstance(default, int):
        return value if isinstance(value, int) else None
    return _converted_list(default, value)


def _converted_list(default: list[Any], value: Any) -> list[Any] | None:
    """Return a list converted to the type of the default; rclpy passes arrays and bytes."""
    try:
        items = [type(default[0])(item) for item in value]
    except (TypeError, ValueError):
        return None
    fixed_length = isinstance(default[0], float)
    return None if fixed_length and len(items) != len(default) else items


def expected(given: Field[Any]) -> str:
    """Return a text about the values that a parameter accepts."""
    if given.metadata['choices']:
        return 'one of ' + ', '.join(given.metadata['choices'])
    default = default_of(given)
    if isinstance(default, list):
        kind = 'strings' if isinstance(default[0], str) else f'{len(default)} numbers'
        return f'a list of {kind}'
    kind = {bool: 'true or false', int: 'a whole number', float: 'a number',
            str: 'text'}[type(default)]
    limits = given.metadata['limits']
    return kind if limits is None else f'{kind} from {limits[0]:.10g} to {limits[1]:.10g}'


def checked(given: Field[Any], value: Any) -> Any:
    """
    Return a value converted to the type of a parameter.

    Raises
    ------
    InputError
        If the parameter does not accept the value.

    """
    converted, limits = _converted(given, value), given.metadata['limits']
    choices = given.metadata['choices']
    if (converted is None or (choices and converted not in choices)
            or (limits is not None and not limits[0] <= converted <= limits[1])):
        raise InputError(f'parameter {given.name} is {value!r}, expected {expected(given)}',
                         'correct the value')
    return converted


def changed(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """
    Return the settings with these parameters changed; other names are ignored.

    Raises
    ------
    InputError
        As in `checked`.

    """
    known = {each.name: each for each in fields(settings)}
    given = {name: checked(known[name], value) for name, value in values.items() if name in known}
    return replace(settings, **given)


def yaml_lines(settings: type[Any]) -> Iterable[str]:
    """Yield the lines of a parameter file with all defaults, for any node name."""
    yield '# Parameters of the calibrator with their defaults; generated from'
    yield '# accel_calib/session/settings.py. Parameters with * can be set while the node runs.'
    yield '/**:'
    yield '  ros__parameters:'
    for each in fields(settings):
        live = ' *' if each.metadata['live'] else ''
        words = f"{each.metadata['words']} ({expected(each)}){live}"
        yield from wrap(words, _WIDTH, initial_indent=_COMMENT, subsequent_indent=_COMMENT)
        yield f'    {each.name}: {_yaml_value(default_of(each))}'


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)
