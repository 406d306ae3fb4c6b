# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The launch files start the right executables with real topics, parameters and states.

launch is not on PyPI. The stand-ins for its classes have the same keywords as those of Jazzy, so a
misspelt keyword fails here too. `started` visits a launch file as launch does.

"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
import re
import runpy
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from accel_calib.session import CalibratorSettings, WEB_PORT
import pytest
from shared import table
import yaml

ROOT = Path(__file__).parent.parent
DEFAULTS = {each.name: each.metadata['default'] for each in fields(CalibratorSettings)}


class Context:
    """What launch knows while it visits a launch file."""

    def __init__(self, given: Mapping[str, str]) -> None:
        self.values = dict(given)
        self.declared: dict[str, DeclareLaunchArgument] = {}


def record(name: str, *members: str, kw_only: bool = True, **methods: Any) -> Any:
    """Return a class with these members, whose visit starts nothing if it is not given."""
    return make_dataclass(name, members, kw_only=kw_only, frozen=True,
                          namespace={'visit': lambda self, context: [], **methods})


LaunchConfiguration = record('LaunchConfiguration', 'name', kw_only=False,
                             perform=lambda self, context: context.values[self.name])
OpaqueFunction = record('OpaqueFunction', 'function',
                        visit=lambda self, context: self.function(context))
IfCondition = record('IfCondition', 'predicate', kw_only=False, evaluate=lambda self, context: {
    'true': True, 'false': False}[self.predicate.perform(context).lower()])
ChangeState = record('ChangeState', 'lifecycle_node_matcher', 'transition_id')
EmitEvent = record('EmitEvent', 'event')
OnStateTransition = record('OnStateTransition', 'target_lifecycle_node', 'start_state',
                           'goal_state', 'entities', 'handle_once')
RegisterEventHandler = record('RegisterEventHandler', 'event_handler', kw_only=False)


@dataclass(frozen=True)
class DeclareLaunchArgument:
    name: str
    default_value: str | None = field(default=None, kw_only=True)
    description: str | None = field(default=None, kw_only=True)
    choices: list[str] | None = field(default=None, kw_only=True)

    def visit(self, context: Context) -> list[Any]:
        context.declared[self.name] = self
        value = context.values.setdefault(self.name, self.default_value)
        assert self.choices is None or value in self.choices
        return []


@dataclass(frozen=True)
class IncludeLaunchDescription:
    source: str
    launch_arguments: Iterable[tuple[str, Any]] = field(default=(), kw_only=True)

    def visit(self, context: Context) -> list[Any]:
        for name, value in self.launch_arguments:
            context.values[name] = value_of(value, context)
        return runpy.run_path(self.source)['generate_launch_description']()


@dataclass(frozen=True)
class ParameterValue:
    value: LaunchConfiguration  # of a text, launch does not convert the type
    value_type: type = field(kw_only=True)

    def perform(self, context: Context) -> Any:
        text = self.value.perform(context)
        return text.lower() == 'true' if self.value_type is bool else self.value_type(text)


@dataclass(kw_only=True, eq=False)
class Node:
    package: str
    executable: str
    name: str
    namespace: Any
    output: str
    parameters: list[Any]
    remappings: list[tuple[Any, Any]] = field(default_factory=list)
    context: Context | None = None

    def visit(self, context: Context) -> list[Any]:
        self.context = Context(context.values)
        return []

    def topic(self, name: str) -> str:
        """Return the full name of a topic of the node."""
        renamed = {inside: value_of(outside, self.context) for inside, outside in self.remappings}
        short = renamed.get(name, name).replace('~', self.name)
        namespace = value_of(self.namespace, self.context)
        return re.sub('/+', '/', short if short[0] == '/' else f'/{namespace}/{short}')

    def values(self) -> dict[str, Any]:
        """Return the parameters that are not in a file."""
        return {name: value_of(value, self.context) for given in self.parameters
                if isinstance(given, dict) for name, value in given.items()}


class LifecycleNode(Node):
    """A managed node."""


def value_of(value: Any, context: Context) -> Any:
    """Return the value of a substitution, or of what is a value already."""
    return value.perform(context) if hasattr(value, 'perform') else value


TRANSITION = SimpleNamespace(TRANSITION_CONFIGURE=1, TRANSITION_ACTIVATE=3)
MODULES: dict[str, dict[str, Any]] = {
    'ament_index_python.packages': {'get_package_share_path': lambda name: ROOT},
    'launch': {'LaunchContext': Context, 'LaunchDescription': list},
    'launch.actions': {each.__name__: each for each in (
        DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, OpaqueFunction,
        RegisterEventHandler)},
    'launch.conditions': {'IfCondition': IfCondition},
    'launch.events': {'matches_action': lambda node: node},
    'launch.launch_description_sources': {'PythonLaunchDescriptionSource': str},
    'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
    'launch_ros.actions': {'LifecycleNode': LifecycleNode, 'Node': Node},
    'launch_ros.event_handlers': {'OnStateTransition': OnStateTransition},
    'launch_ros.events.lifecycle': {'ChangeState': ChangeState},
    'launch_ros.parameter_descriptions': {'ParameterValue': ParameterValue},
    'lifecycle_msgs.msg': {'Transition': TRANSITION},
}


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Return a function that visits a launch file with arguments, and returns what it did."""
    for name, content in MODULES.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent = name.rpartition('.')[0]
        if parent and parent not in MODULES:
            monkeypatch.setitem(sys.modules, parent, ModuleType(parent))

    def start(file: str = 'calibrator', **arguments: str) -> Any:
        context, actions = Context(arguments), []

        def visit(entities: Iterable[Any]) -> None:
            for entity in entities:
                actions.append(entity)
                visit(entity.visit(context))

        visit(described(file))
        nodes = [each for each in actions if isinstance(each, Node)]
        return SimpleNamespace(actions=actions, nodes=nodes, node=nodes[0],
                               declared=context.declared)

    return start


def described(file: str) -> Any:
    """Return the description of a launch file."""
    path = ROOT / 'launch' / f'{file}.launch.py'
    return runpy.run_path(str(path))['generate_launch_description']()


def test_defaults_start_one_node_and_change_no_parameter(started: Any) -> None:
    node, = started().nodes
    assert (node.package, node.executable) == ('accel_calib', 'calibrator')
    assert node.values() == {}
    params_file, = node.parameters
    assert Path(value_of(params_file, node.context)) == ROOT / 'config' / 'calibrator.yaml'


TOPICS = {'imu': 'imu/data_raw', 'output': 'imu/data_calibrated', 'temperature': 'temperature',
          'linear_acceleration': '~/linear_acceleration'}


@pytest.mark.parametrize(('given', 'topics'), table('topics_of_launch'))
def test_each_topic_has_an_argument_and_is_in_the_namespace_without_a_leading_slash(
        given: dict[str, str], topics: list[str], started: Any) -> None:
    node = started(**given).node
    assert [node.topic(each) for each in TOPICS.values()] == topics


GIVEN = table('launch_arguments')
ARGUMENTS = {'namespace', 'params_file', 'lifecycle', 'web', 'web_port', *TOPICS, *GIVEN}


@pytest.mark.parametrize('name', GIVEN)
def test_each_parameter_argument_sets_a_parameter_of_its_type(name: str, started: Any) -> None:
    text, value = GIVEN[name]
    given = started(**{name: text}).node.values()
    assert given == {name: value}
    assert type(given[name]) is type(DEFAULTS[name])


def test_web_serves_the_live_page(started: Any) -> None:
    assert started(web='true').node.values() == {'web_port': WEB_PORT}
    assert started(web='true', web_port='9000').node.values() == {'web_port': 9000}
    assert started(web_port='9000').node.values() == {}
    assert DEFAULTS['web_port'] == 0


def test_every_argument_is_described(started: Any) -> None:
    declared = started().declared
    assert set(declared) == ARGUMENTS
    assert all(each.description.endswith('.') for each in declared.values())


@pytest.mark.parametrize('text', ['0 0 1.57', '0, 0, 1.57', '[0.0, 0, 1.57]'])
def test_mounting_is_written_as_in_a_urdf_or_as_in_yaml(text: str, started: Any) -> None:
    assert started(mounting_rpy=text).node.values() == {'mounting_rpy': [0.0, 0.0, 1.57]}


@pytest.mark.parametrize('text', ['0 0', '0 0 x', '1 2 3 4', '[]'])
def test_mounting_that_is_not_three_numbers_is_refused(text: str, started: Any) -> None:
    with pytest.raises(ValueError, match='mounting_rpy is .*, expected 3 numbers; write'):
        started(mounting_rpy=text)


def test_lifecycle_starts_the_managed_node_and_activates_it_once(started: Any) -> None:
    plain, managed = started().node, started(lifecycle='true', model='7', namespace='left')
    node = managed.node
    assert [type(plain), type(node)] == [Node, LifecycleNode]
    assert node.executable == 'calibrator_lifecycle'
    assert node.remappings == plain.remappings
    assert node.values() == {'model': '7'}
    configure, activate = (EmitEvent(event=ChangeState(
        lifecycle_node_matcher=node, transition_id=number)) for number in (1, 3))
    once_configured = RegisterEventHandler(OnStateTransition(
        target_lifecycle_node=node, start_state='configuring', goal_state='inactive',
        entities=[activate], handle_once=True))
    assert managed.actions[-3:] == [once_configured, node, configure]


def test_two_imus_have_their_own_topics_and_pages_and_share_the_thermometer(started: Any) -> None:
    nodes = started('two_imus', model='7', web='true').nodes
    assert [node.topic('imu/data_calibrated') for node in nodes] == [
        '/left/imu/data_calibrated', '/right/imu/data_calibrated']
    assert [node.topic('temperature') for node in nodes] == ['/temperature', '/temperature']
    assert [node.values() for node in nodes] == [
        {'model': '7', 'web_port': WEB_PORT}, {'model': '7', 'web_port': WEB_PORT + 1}]
    own = started('two_imus', temperature='temperature').nodes
    assert [node.topic('temperature') for node in own] == [
        '/left/temperature', '/right/temperature']


@pytest.mark.parametrize('package', ['imu_filter_madgwick', 'robot_localization'])
def test_no_node_is_started_where_a_filter_is_not_installed(
        package: str, started: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def share(name: str) -> Path:
        if name == package:
            raise LookupError(name)
        return ROOT

    packages = sys.modules['ament_index_python.packages']
    monkeypatch.setattr(packages, 'get_package_share_path', share)
    with pytest.raises(LookupError, match=package):
        described('with_filters')


@pytest.mark.parametrize('namespace', ['', 'robot'])
def test_filters_are_connected_from_the_raw_readings_to_the_odometry(
        namespace: str, started: Any) -> None:
    calibrator, madgwick, filtered = started(
        'with_filters', namespace=namespace, output='corrected', odometry='wheels',
        base_link='base').nodes
    ekf = filtered.values()
    assert madgwick.topic('imu/data_raw') == calibrator.topic('imu/data_calibrated')
    assert filtered.topic(ekf['imu0']) == madgwick.topic('imu/data')
    assert ekf['odom0'] == 'wheels'
    assert calibrator.values()['output_frame_id'] == ekf['base_link_frame'] == 'base'
    assert calibrator.values()['fill_covariance'] is True
    assert ekf['imu0_remove_gravitational_acceleration'] is True
    assert madgwick.values()['publish_tf'] is False
    # Three each of: position, attitude, velocity, angular rate, acceleration
    assert ekf['imu0_config'] == [*[False] * 3, *[True] * 3, *[False] * 3, *[True] * 6]
    assert ekf['odom0_config'] == [*[False] * 6, True, True, *[False] * 7]


# Names of other packages

NAV2 = ROOT / 'docs' / 'guides' / 'nav2.md'

THEIRS = {name for names in table('parameters_of_others').values() for name in names}


def test_parameters_of_other_packages_have_their_names(started: Any) -> None:
    text = NAV2.read_text(encoding='utf-8')
    given = [about['ros__parameters']
             for block in re.findall(r'^```yaml\n(.*?)^```', text, re.MULTILINE | re.DOTALL)
             for about in yaml.safe_load(block).values()]
    launched = [node.values() for node in started('with_filters').nodes]
    assert {name for each in (*given, *launched) for name in each} <= {*THEIRS, *DEFAULTS}
    ekf, = (each for each in given if 'imu0' in each)
    for key in ('imu0_config', 'odom0_config'):
        assert [type(each) for each in ekf[key]] == [bool] * 15
    bringup, = re.findall(r'ros2 launch nav2_bringup bringup_launch.py (.*)', text)
    assert re.fullmatch(r'map:=\S+ params_file:=\S+', bringup)


@pytest.mark.parametrize(('name', 'more'), [
    ('calibrator', set()), ('two_imus', set()), ('with_filters', {'odometry', 'base_link'})])
def test_launch_finds_the_arguments_of_each_file(name: str, more: set[str]) -> None:
    pytest.importorskip('launch_ros', reason='not on PyPI')
    assert {each.name for each in described(name).get_launch_arguments()} == ARGUMENTS | more
