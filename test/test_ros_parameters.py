# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The parameters are the same in the code, in the node and in config/calibrator.yaml."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from textwrap import wrap
from typing import Any

from accel_calib.errors import InputError
from accel_calib.session import CalibratorSettings
from inside import capture_settings, changed, default_of, expected
from inside_ros import SimulatorSettings
import pytest
import yaml

CONFIG = Path(__file__).parent.parent / 'config' / 'calibrator.yaml'
SETTINGS = [CalibratorSettings, SimulatorSettings]
WIDTH = 99
COMMENT = '    # '


def yaml_lines(settings: type[Any]) -> Iterator[str]:
    """Yield the lines of a parameter file with all defaults, for any node name."""
    yield '# Parameters of the calibrator with their defaults; generated from'
    yield '# accel_calib/session/settings.py. Parameters with * can be set while the node runs.'
    yield '/**:'
    yield '  ros__parameters:'
    for each in fields(settings):
        live = ' *' if each.metadata['live'] else ''
        words = f"{each.metadata['words']} ({expected(each)}){live}"
        yield from wrap(words, WIDTH, initial_indent=COMMENT, subsequent_indent=COMMENT)
        yield f'    {each.name}: {yaml_value(default_of(each))}'


def yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value)


def test_parameter_file_is_the_table() -> None:
    """Check the file; write it with: python test/test_ros_parameters.py."""
    assert CONFIG.read_text(encoding='utf-8').splitlines() == list(yaml_lines(CalibratorSettings))


def test_parameter_file_holds_the_defaults() -> None:
    given = yaml.safe_load(CONFIG.read_text(encoding='utf-8'))['/**']['ros__parameters']
    assert CalibratorSettings(**given) == CalibratorSettings()
    assert list(given) == [parameter.name for parameter in fields(CalibratorSettings)]


def test_parameters_accept_numbers_of_other_types() -> None:
    settings = changed(CalibratorSettings(), {'model': 10, 'min_dwell': 2, 'sensor': 7,
                                              'use_sim_time': True})
    assert (settings.model, settings.min_dwell, settings.sensor) == ('10', 2.0, '7')
    assert isinstance(settings.min_dwell, float)


@pytest.mark.parametrize(('name', 'value'), [
    ('model', '12'), ('model', True), ('gravity', 0.5), ('gravity', float('nan')),
    ('gravity', '9.8'), ('auto_capture', 1), ('auto_fit_poses', 12.5), ('auto_fit_poses', True),
    ('units', 'counts'), ('sensor', ['a'])])
def test_values_that_parameters_do_not_accept_are_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f'parameter {name} is .*, expected '):
        changed(CalibratorSettings(), {name: value})


def test_lists_are_checked() -> None:
    settings = changed(SimulatorSettings(), {'mounting': [1, 2.5, 3], 'effects': []})
    assert settings.mounting == [1.0, 2.5, 3.0]
    assert settings.effects == []
    with pytest.raises(InputError, match='a list of 3 numbers'):
        changed(SimulatorSettings(), {'mounting': [1.0]})


def test_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(InputError, match='max_dwell'):
        capture_settings(CalibratorSettings(min_dwell=2.0, max_dwell=3.0))


def test_node_declares_all_parameters_and_refuses_invalid_values_while_it_runs(bench: Any) -> None:
    from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
    from rclpy.parameter import Parameter
    bench.calibrator()

    def ask(kind: Any, name: str, **request: Any) -> Any:
        return bench.ask(kind, f'calibrator/{name}', **request)

    table = {parameter.name: parameter.metadata for parameter in fields(CalibratorSettings)}
    names = ask(ListParameters, 'list_parameters').result.names
    assert set(table) <= set(names)
    described = ask(DescribeParameters, 'describe_parameters', names=list(table)).descriptors
    assert {each.name: (each.description, not each.read_only) for each in described} == {
        name: (about['words'], about['live']) for name, about in table.items()}
    tried = [Parameter('model', value=7), Parameter('model', value='11'),
             Parameter('gravity', value=9.81), Parameter('auto_fit_poses', value=2)]
    results = ask(SetParameters, 'set_parameters',
                  parameters=[each.to_parameter_msg() for each in tried]).results
    assert [each.successful for each in results] == [True, False, False, False]
    assert 'expected one of auto' in results[1].reason


if __name__ == '__main__':
    CONFIG.write_text('\n'.join(yaml_lines(CalibratorSettings)) + '\n', encoding='utf-8')
