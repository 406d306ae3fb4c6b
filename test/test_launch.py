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

from accel_calib.session import CalibratorSettings
import pytest
from shared import table
import yaml

ROOT = Path(__file__).parent.parent
DEFAULTS = {each.name: each.metadata['default'] for each in fields(CalibratorSettings)}


class Context:
    """What launch knows while it visits a launch file."""

    def __init__(self, given: Mapping[str, str]) -> None:
        self.values = dict(given)
        self.declared: dict[str, Any] = {}


def record(name: str, *members: str, optional: Iterable[str] = (), **methods: Any) -> Any:
    """Return a class with these members, whose visit starts nothing if it is not given."""
    also = [(each, Any, field(default=None, kw_only=True)) for each in optional]
    return make_dataclass(name, [*members, *also], frozen=True,
                          namespace={'visit': lambda self, context: [], **methods})


def declare(argument: Any, context: Context) -> list[Any]:
    context.declared[argument.name] = argument
    value = context.values.setdefault(argument.name, argument.default_value)
    assert argument.choices is None or value in argument.choices
    return []


def include(included: Any, context: Context) -> list[Any]:
    for name, value in included.launch_arguments or ():
        context.values[name] = value_of(value, context)
    return runpy.run_path(included.source)['generate_launch_description']()


def converted(parameter: Any, context: Context) -> Any:
    """Return a parameter in its type; of a text, launch does not convert it."""
    text, kind = parameter.value.perform(context), parameter.value_type
    return text.lower() == 'true' if kind is bool else kind(text)


LaunchConfiguration = record('LaunchConfiguration', 'name',
                             perform=lambda self, context: context.values[self.name])
OpaqueFunction = record('OpaqueFunction', 'function',
                        visit=lambda self, context: self.function(context))
IfCondition = record('IfCondition', 'predicate', evaluate=lambda self, context: {
    'true': True, 'false': False}[self.predicate.perform(context).lower()])
ChangeState = record('ChangeState', 'lifecycle_node_matcher', 'transition_id')
EmitEvent = record('EmitEvent', 'event')
OnStateTransition = record('OnStateTransition', 'target_lifecycle_node', 'start_state',
                           'goal_state', 'entities', 'handle_once')
RegisterEventHandler = record('RegisterEventHandler', 'event_handler')
DeclareLaunchArgument = record('DeclareLaunchArgument', 'name', optional=(
    'default_value', 'description', 'choices'), visit=declare)
IncludeLaunchDescription = record('IncludeLaunchDescription', 'source', optional=[
    'launch_arguments'], visit=include)
ParameterValue = record('ParameterValue', 'value', 'value_type', perform=converted)


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


def test_the_defaults_are_those_of_the_parameter_file(started: Any) -> None:
    node, = started().nodes
    params_file, = (each for each in node.parameters if not isinstance(each, dict))
    assert node.package == 'accel_calib'
    assert Path(value_of(params_file, node.context)) == ROOT / 'config' / 'calibrator.yaml'


@pytest.mark.parametrize(('file', 'arguments', 'expected'), table('launches'))
def test_a_launch_file_starts_nodes_with_these_topics_and_parameters(
        file: str, arguments: dict[str, str], expected: list[Any], started: Any) -> None:
    nodes = started(file, **arguments).nodes
    assert expected == [
        [node.executable, {name: node.topic(name) for name in topics}, node.values()]
        for node, (_, topics, _) in zip(nodes, expected, strict=True)]


GIVEN = table('launch_arguments')
ARGUMENTS = {'namespace', 'params_file', 'lifecycle', 'web', 'web_port', 'imu', 'output',
             'temperature', 'linear_acceleration', *GIVEN}


@pytest.mark.parametrize('name', GIVEN)
def test_each_parameter_argument_sets_a_parameter_of_its_type(name: str, started: Any) -> None:
    text, value = GIVEN[name]
    given = started(**{name: text}).node.values()
    assert given == {name: value}
    assert type(given[name]) is type(DEFAULTS[name])


def test_every_argument_is_described(started: Any) -> None:
    declared = started().declared
    assert set(declared) == ARGUMENTS
    assert all(each.description.endswith('.') for each in declared.values())


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
